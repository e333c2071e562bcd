"""``hiros process``: a recording in, clean motion out."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from contextlib import ExitStack, redirect_stdout
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from hiros_cli import options as shared
from hiros_cli.compiling import importing, prepare
from hiros_cli.completing import topics
from hiros_cli.live_run import STREAM, check_live, is_live, run_live
from hiros_cli.many_logs import ManyLogs, one_log
from hiros_cli.options import (
    INPUT,
    LOSSES,
    OUTPUT,
    PARAMETERS,
    argument,
    chosen_system,
    config_file,
    flag,
    option,
    seconds_range,
)
from hiros_cli.output import beside, check_outputs, print_json, warn
from hiros_mcap.errors import ConfigError, HirosError
from hiros_mcap.running.progress_bar import bar

if TYPE_CHECKING:
    from hiros_mcap.running.pipeline import Watcher
    from hiros_mcap.running.process_options import Calibration
    from hiros_mcap.summary import Summary


EXPORTED = frozenset({".csv", ".parquet", ".jsonl", ".npz", ".trc", ".mot", ".c3d", ".bvh"})
BAGS = frozenset({".db3", ".bag"})
SUFFIX = ".hiros.mcap"


def process(
    context: typer.Context,
    logs: list[str] = argument(
        "LOG", "Recordings: MCAP files, ROS bags, folders of them, globs, URLs; - is a pipe."
    ),
    output: str | None = option(
        "OUT",
        f"Output file, DIR/ for a ROS 2 bag, - for a pipe; with many logs, the folder for "
        f"all. Default: LOG's name with {SUFFIX}.",
        "--output",
        "-o",
        panel=OUTPUT,
    ),
    system: str | None = shared.SYSTEM,
    stages: str = option(
        "CHAIN",
        "Stages to run (track, merge, optimize, filter): T, TM, TO, TF, TMF, TMO or TMOF. "
        "Default: all stages of the system.",
        default="",
        panel=PARAMETERS,
    ),
    topic: list[str] | None = shared.CAMERAS,
    keep: list[str] | None = option(
        "GLOB",
        "Input channels to copy; may be repeated; '' copies none. Default: the cameras read, "
        "the transforms and /truth.",
        autocompletion=topics,
        panel=OUTPUT,
    ),
    preset: str = shared.PRESET,
    config: Path | None = shared.CONFIG,
    assignments: list[str] | None = shared.ASSIGNMENTS,
    extrinsics: Path | None = shared.EXTRINSICS,
    fixed_frame: str | None = option(
        "FRAME", "Frame of the output. Default: root of the transforms.", panel=INPUT
    ),
    model: str | None = option(
        "NAME",
        "Skeleton of the output: union, azure-kinect, zed-38, ..., or a camera's topic.",
        panel=INPUT,
    ),
    unit: str | None = option("UNIT", "Unit of the positions: m (default), cm or mm.", panel=INPUT),
    clock: list[str] | None = option(
        "CAMERA=SECONDS", "Add seconds to the stamps of a camera; may be repeated.", panel=INPUT
    ),
    limbs: Path | None = option(
        "FILE", "Use these limb lengths of an earlier session.", panel="Limb lengths"
    ),
    save_limbs: Path | None = option(
        "FILE", "Write the limb lengths to this file.", panel="Limb lengths"
    ),
    calibrate: str = option(
        "off|auto|require",
        "Camera poses: off keeps the log's, auto takes better ones where the people in the "
        "log prove them, require also refuses poses that they do not confirm.",
        default="auto",
        panel=INPUT,
    ),
    limb_window: list[str] | None = option(
        "START:END",
        "Calibrate limbs in this time range only, s from the log's start; may be repeated.",
        panel="Limb lengths",
    ),
    two_pass: bool = flag(
        "--two-pass", "Calibrate limbs on the whole log first.", panel="Limb lengths"
    ),
    solver: str | None = option(
        "NAME", "Optimizer: lm (default) or ceres (slow, for comparison).", panel="Limb lengths"
    ),
    markers: bool = flag(
        "--markers",
        "Also write MarkerArray, JointState and Log for RViz and Foxglove.",
        panel=OUTPUT,
    ),
    view: bool = flag("--view", "Show the run live in the Rerun viewer.", panel=OUTPUT),
    strict: bool = flag("--strict", "Fail if any message would be skipped.", panel=INPUT),
    recover: bool = flag(
        "--recover", "Run on what can be read of a damaged log; exit with 3 on losses.", panel=INPUT
    ),
    follow: bool = flag(
        "--follow", "Process a log while it is being written; Ctrl-C ends it.", panel=INPUT
    ),
    memory: float = option(
        "GIB",
        "Memory for a log whose chunks overlap in time, GiB; a message of a server may take a "
        "16th.",
        default=1.0,
        min=0.25,
        panel=INPUT,
    ),
    jobs: int | None = shared.JOBS,
    cluster: str | None = shared.CLUSTER,
    csv: Path | None = shared.TABLE,
    force: bool = shared.FORCE,
    json: bool = shared.JSON,
    quiet: bool = shared.QUIET,
) -> None:
    """Track, merge, optimize and filter the skeletons of a log.

    The output holds the input channels and the results: /hiros/tracked, /hiros/merged,
    /hiros/optimized and /hiros/filtered. The command prints a summary.
    """
    from hiros_mcap.io.remote import is_remote

    many = ManyLogs(logs, output or "", jobs, cluster, csv, force, json, quiet)
    source, wanted = Path(logs[0]), STREAM
    live = is_live(logs, output, follow=follow)
    is_many = not live and many.wanted
    config = config if live else config_file(config, logs)
    sides = (config, extrinsics, limbs)
    if is_many:
        many.refuse(view=view, save_limbs=save_limbs)
        if output is None:
            raise ConfigError("with many logs, name a folder for the results: -o FOLDER")
    elif live:
        many.refuse_alone()
        check_live(logs, output, follow=follow)
        if output != STREAM:
            wanted = _checked_output(source, output, sides, save_limbs, force=force)
    else:
        many.refuse_alone()
        source = one_log(context, logs[0])
        named = Path(source.name) if is_remote(logs[0]) else source
        wanted = _checked_output(named, output, sides, save_limbs, force=force)
    system = chosen_system(system, preset, live=live)
    if strict and recover:
        raise ConfigError("--strict refuses what --recover accepts; choose one")
    windows = list(map(_window, limb_window)) if limb_window else None
    settings: tuple[tuple[str, str, str, Any], ...] = (
        ("--fixed-frame", "input", "fixed_frame", fixed_frame),
        ("--limb-window", "optimize", "calibration_windows", windows),
        ("--two-pass", "optimize", "calibration", "two-pass" if two_pass else None),
        ("--solver", "optimize", "solver", solver),
        ("--model", "input", "model", model),
        ("--unit", "input", "unit", unit),
    )
    shortcuts = {
        name: {part: {key: value}} for name, part, key, value in settings if value is not None
    }
    if clock:
        shortcuts["--clock"] = {"clock": dict(map(_clock, clock))}
    with importing():
        prepare(quiet=quiet, everything=True)
        if output is None and not live:
            _refuse_result(source)
        from hiros_mcap.config import load_config
        from hiros_mcap.running.pipeline import ProcessOptions
        from hiros_mcap.running.pipeline import process as run

    _check_assignments(system, assignments or ())
    on_limbs = {"--limbs": limbs, "--save-limbs": save_limbs, "--limb-window": limb_window}
    _check_effects(system, stages, {**on_limbs, "--two-pass": two_pass, "--solver": solver})
    options = ProcessOptions(
        system=system,
        stages=stages,
        settings=config.absolute() if is_many and config else config,
        topics=tuple(topic or ()),
        keep=None if keep is None else tuple(filter(None, keep)),
        extrinsics=extrinsics.absolute() if is_many and extrinsics else extrinsics,
        limbs_in=limbs.absolute() if is_many and limbs else limbs,
        limbs_out=save_limbs,
        markers=markers,
        calibrate=_calibration(calibrate),
        strict=strict,
        recover=recover,
        memory=memory,
    )
    effective = load_config(config, assignments or (), preset, system, shortcuts)
    if is_many:
        from hiros_cli.many_logs import run as run_many
        from hiros_mcap.many.jobs import ProcessJob

        raise typer.Exit(run_many(ProcessJob(effective, options), many))
    with ExitStack() as stack:
        watcher = _live(source, wanted, stack) if view else None
        if live:
            if wanted == STREAM:  # what is printed must not go into the output
                stack.enter_context(redirect_stdout(sys.stderr))
            summary = run_live(logs[0], wanted, effective, options, watcher, quiet=quiet)
            _show(summary, json=json, quiet=quiet)
            return
        with bar(source.name, quiet=quiet) as progress:
            summary = run(
                source,
                wanted,
                config=effective,
                options=options,
                progress=progress,
                watcher=watcher,
                force=force,
            )
        _show(summary, json=json, quiet=quiet)
    if summary.losses:
        raise typer.Exit(LOSSES)


def _checked_output(
    source: Path,
    output: str | None,
    sides: Sequence[Path | None],
    limbs: Path | None,
    *,
    force: bool,
) -> str:
    """Return where the result of one log goes, after what must not be written was refused."""
    from hiros_mcap.outputs import target_kind

    wanted = str(beside(source, SUFFIX)) if output is None else output
    kind, target = target_kind(wanted), Path(wanted)
    check_outputs((target, kind), (limbs, "limb table"), inputs=(source, *sides), force=force)
    if kind == "log":
        _refuse_other_formats(target)
    return wanted


def _refuse_result(source: Path) -> None:
    """Refuse what ``for log in *.mcap`` does by accident; with --output it is on purpose."""
    from hiros_mcap.io.result import is_result

    if is_result(source):
        raise ConfigError(
            f"{source}: is a result of hiros already; to process its recording again, name an "
            "output with -o"
        )


def _refuse_other_formats(target: Path) -> None:
    suffix = target.suffix.lower()
    if suffix in EXPORTED:
        raise ConfigError(
            f"{target}: process writes MCAP; for {suffix}, run hiros export on its result"
        )
    if suffix in BAGS:
        raise ConfigError(
            f"{target}: process writes MCAP; for a ROS 2 bag, name a folder: "
            f"-o {target.with_suffix('')}/"
        )
    if suffix != ".mcap" and (suffix or not target.exists()):  # mktemp gives no suffix
        folder = "" if suffix else f", or {target}/ for a ROS 2 bag in a new folder"
        named = target.with_suffix(".mcap")
        raise ConfigError(f"{target}: process writes MCAP; name it {named}{folder}")


def _live(source: Path, target: str, stack: ExitStack) -> Watcher | None:
    """Open a viewer to watch the run; without a screen, a page that somebody may open.

    None if there is nobody to look or nothing to look with: the result matters more.
    """
    from hiros_viewer.destinations import has_display
    from hiros_viewer.live import live_page, live_view

    def say(text: str) -> None:
        print(f"hiros: {text}", file=sys.stderr, flush=True)

    def closed() -> None:
        say("the viewer was closed; processing goes on")

    later = f"look at the result with: hiros view {target} --web"
    try:
        if has_display():
            return stack.enter_context(live_view(source.name, closed))
        if sys.stderr.isatty():
            announce = f"no screen here; open {{}} and stop with Ctrl-C, or {later}"
            page = live_page(source.name, closed, lambda url: say(announce.format(url)))
            return stack.enter_context(page)
        warn(f"--view: there is no screen here; {later}")
    except HirosError:
        warn(f"--view: the Rerun viewer does not start; {later}")
    return None


def _calibration(text: str) -> Calibration:
    match text:
        case "off" | "auto" | "require":
            return text
    raise ConfigError(
        f"--calibrate: {text!r} is none of off, auto, require (a time range for limb lengths is "
        "--limb-window START:END)"
    )


def _clock(text: str) -> tuple[str, float]:
    camera, equals, seconds = text.rpartition("=")
    try:
        if not (equals and camera):
            raise ValueError
        return camera, float(seconds)
    except ValueError:
        raise ConfigError(f"--clock: {text!r} is not of the form CAMERA=SECONDS") from None


def _window(text: str) -> tuple[float, float]:
    start, end = seconds_range("--limb-window", text)
    if start < 0:
        raise ConfigError(f"--limb-window: {text!r} starts before the log, which starts at 0")
    return start, end


def _check_assignments(system: str, assignments: Sequence[str]) -> None:
    """Refuse parameters that the system does not read."""
    from hiros_mcap.config import Config
    from hiros_mcap.systems import sections_of

    unread = Config.model_fields.keys() - {*sections_of(system)}
    for text in assignments:
        name = text.partition("=")[0].strip()
        if name.partition(".")[0] in unread:
            raise ConfigError(
                f"--set: {name} has no effect: --system {system} does not read it; hiros systems "
                "and hiros config --system NAME show what does"
            )


def _check_effects(system: str, stages: str, given: Mapping[str, object]) -> None:
    """Refuse options on limb lengths that would change nothing."""
    from hiros_mcap.systems import chain_of, sections_of

    if "optimized" not in chain_of(system, stages):
        what = f"--stages {stages}" if stages else f"--system {system}"
        unused, why = set(given), f"{what} has no optimizer"
    elif "optimize" not in sections_of(system):
        # It calibrates in its own way; the lengths can be saved and given.
        unused = {*given} - {"--save-limbs", "--limbs"}
        why = f"--system {system} has an optimizer of its own; --system hiros reads it"
    elif given["--limbs"]:
        unused, why = {"--two-pass"}, "the limb lengths come from --limbs"
    else:
        return
    for name, value in given.items():
        if value and name in unused:
            raise ConfigError(f"{name} has no effect: {why}")


def _show(summary: Summary, *, json: bool, quiet: bool) -> None:

    for text in summary.warnings:
        warn(text, logged=True)
    if json:
        print_json("process", summary.to_dict())
    elif not quiet:
        from hiros_cli.run_report import show

        show(summary)
