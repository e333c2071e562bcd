"""``hiros process``: a recording in, clean motion out."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from contextlib import ExitStack, redirect_stdout
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import typer

from hiros_cli.compiling import importing, prepare
from hiros_cli.exit_codes import LOSSES
from hiros_cli.live_run import STREAM, check_live, is_file, is_graph, is_live, run_live
from hiros_cli.many_logs import ManyLogs, one_log
from hiros_cli.many_logs import run as run_many
from hiros_cli.options import (
    CAMERAS,
    EXTRINSICS,
    GROUP,
    INPUT,
    OUTPUT,
    PARAMETERS,
    Parameters,
    argument,
    by_camera,
    flag,
    grouped,
    option,
    settings_of,
)
from hiros_cli.output import beside, check_outputs, print_json, warn
from hiros_mcap.errors import ConfigError, HirosError
from hiros_mcap.progress import bar

if TYPE_CHECKING:
    from hiros_mcap.config import Settings, Table
    from hiros_mcap.running.pipeline import Watcher
    from hiros_mcap.running.process_options import Calibration, ProcessOptions
    from hiros_mcap.running.summary import Summary

SUFFIX = ".hiros.mcap"


@dataclass(frozen=True, slots=True)
class InputOptions:
    """Options on how a log is read."""

    topic: list[str] | None = CAMERAS
    extrinsics: Path | None = EXTRINSICS
    fixed_frame: str | None = option(
        "FRAME", "Frame of the output. Default: root of the transforms.", panel=INPUT
    )
    model: str | None = option(
        "NAME",
        "Skeleton of the output: union, azure-kinect, zed-38, ..., or a camera's topic.",
        panel=INPUT,
    )
    unit: str | None = option(
        "UNIT",
        "Unit of the positions: m (default), cm or mm; left=mm,right=cm of some cameras.",
        panel=INPUT,
    )
    negate: str | None = option(
        "AXIS",
        "Change the sign of x, y or z of detections whose axes are left-handed; left=x of one "
        "camera.",
        panel=INPUT,
    )
    clock: list[str] | None = option(
        "CAMERA=SECONDS", "Add seconds to the stamps of a camera; may be repeated.", panel=INPUT
    )
    calibrate: str = option(
        "off|auto|require",
        "Camera poses: off keeps the log's, auto takes better ones where the people in the "
        "log prove them, require also refuses poses that they do not confirm.",
        default="auto",
        panel=INPUT,
    )
    limbs: Path | None = option(
        "FILE", "Use these limb lengths of an earlier session.", panel=INPUT
    )
    strict: bool = flag("--strict", "Fail if any message would be skipped.", panel=INPUT)
    recover: bool = flag(
        "--recover", "Run on what can be read of a damaged log; exit with 3 on losses.", panel=INPUT
    )
    follow: bool = flag(
        "--follow", "Process a log while it is being written; Ctrl-C ends it.", panel=INPUT
    )
    ros_args: list[str] | None = option(
        "ARGS", "With ros2://: all that follows, up to --, is for ROS 2.", "--ros-args", panel=INPUT
    )
    memory: float = option(
        "GIB",
        "Memory for a log whose chunks overlap in time, GiB; a message of a server may take a "
        "16th.",
        default=1.0,
        min=0.25,
        panel=INPUT,
    )

    def parameters(self) -> dict[str, Table]:
        """Return the parameters that have options of their own, by option."""
        named = {name: getattr(self, name) for name in ("fixed_frame", "model", "unit", "negate")}
        tables: dict[str, Table] = {
            f"--{name.replace('_', '-')}": {"input": {name: value}}
            for name, value in named.items()
            if value is not None
        }
        if self.clock:
            clocks = by_camera("--clock", self.clock, "CAMERA=SECONDS")
            tables["--clock"] = {"clock": clocks}
        return tables


@dataclass(frozen=True, slots=True)
class OutputOptions:
    """Options on what is written and shown."""

    output: list[str] | None = option(
        "OUT",
        f"Output file, - for a pipe, ws://HOST:PORT to serve live results, ros2:// to publish "
        f"them; may be repeated for these; with many logs, the folder for all. Default: LOG's "
        f"name with {SUFFIX}.",
        "--output",
        "-o",
        panel=OUTPUT,
    )
    keep: list[str] | None = option(
        "GLOB",
        "Input channels to copy; may be repeated; '' copies none. Default: the cameras read, "
        "the transforms and /truth.",
        panel=OUTPUT,
    )
    save_limbs: Path | None = option("FILE", "Write the limb lengths to this file.", panel=OUTPUT)
    markers: bool = flag(
        "--markers",
        "Also write MarkerArray, JointState and Log for RViz and Foxglove.",
        panel=OUTPUT,
    )
    view: bool = flag("--view", "Show the run live in the Rerun viewer.", panel=OUTPUT)

    @property
    def one(self) -> str | None:
        """The only output of a run of files; None is the default one."""
        if len(self.output or ()) > 1:
            raise ConfigError("several -o are for live input; choose one")
        return self.output[0] if self.output else None


class _Run(NamedTuple):
    """Options of the command that hold for all logs."""

    parameters: Parameters
    stages: str
    reading: InputOptions
    writing: OutputOptions
    many: ManyLogs

    def settings(self, *, live: bool = False) -> Settings:
        """Return where the parameters come from."""
        return self.parameters.settings(self.reading.parameters(), live=live)

    def target(self, source: Path, settings: Settings, named: str | None) -> str:
        """Return where the result of one log goes; refuses what must not be written."""
        name = named or str(beside(source, SUFFIX))
        target = Path(name)
        inputs = (source, settings.file, self.reading.extrinsics, self.reading.limbs)
        saved = self.writing.save_limbs
        check_outputs((target, "log"), (saved, "limb table"), inputs=inputs, force=self.many.force)
        _refuse_other_formats(target)
        return name

    def options(self, settings: Settings) -> ProcessOptions:
        """Return what is read, run and written; refuses what has no effect."""
        reading, writing = self.reading, self.writing
        if reading.strict and reading.recover:
            raise ConfigError("--strict refuses what --recover accepts; choose one")
        with importing():
            prepare(quiet=self.many.quiet)
            from hiros_mcap.running.pipeline import ProcessOptions, check_limbs

        _check_assignments(settings.system, settings.assignments)
        options = ProcessOptions(
            system=settings.system,
            stages=self.stages,
            settings=settings.file,
            topics=tuple(reading.topic or ()),
            keep=None if writing.keep is None else tuple(filter(None, writing.keep)),
            extrinsics=reading.extrinsics,
            limbs_in=reading.limbs,
            limbs_out=writing.save_limbs,
            markers=writing.markers,
            calibrate=_calibration(reading.calibrate),
            strict=reading.strict,
            recover=reading.recover,
            memory=reading.memory,
        )
        check_limbs(options)
        return options


@grouped
def process(
    logs: list[str] = argument(
        "LOG", "Recordings: MCAP files, ROS bags, folders of them, globs; - is a pipe."
    ),
    writing: OutputOptions = GROUP,
    parameters: Parameters = GROUP,
    stages: str = option(
        "CHAIN",
        "Stages to run (track, merge, optimize, filter): T, TM, TO, TF, TMF, TMO or TMOF. "
        "Default: all stages of the system.",
        default="",
        panel=PARAMETERS,
    ),
    reading: InputOptions = GROUP,
    many: ManyLogs = GROUP,
) -> None:
    """Track, merge, optimize and filter the skeletons of a log.

    The output holds the input channels and the results: /hiros/tracked, /hiros/merged,
    /hiros/optimized and /hiros/filtered. The command prints a summary.
    """
    run, outputs = _Run(parameters, stages, reading, writing, many), writing.output or ()
    if reading.ros_args and not any(map(is_graph, (*logs, *outputs))):
        raise ConfigError("--ros-args: they are for ros2://, as input or as output")
    if is_live(logs, outputs, follow=reading.follow):
        many.refuse_alone()
        _live(run, logs)
    elif many.wanted(logs, writing.one or "", view=writing.view, save_limbs=writing.save_limbs):
        _many(run, logs)
    else:
        _one(run, one_log(logs[0]))


def _one(run: _Run, source: Path) -> None:
    """Process one log."""
    settings, many = run.settings(), run.many
    settings = settings_of(source, settings) if many.quiet else settings.of(source)
    named_output = run.writing.one
    target = run.target(source, settings, named_output)
    options = run.options(settings)
    if named_output is None:
        _refuse_result(source)
    from hiros_mcap.running.pipeline import process

    config = settings.load()
    with ExitStack() as stack:
        watcher = _viewer(source, target, stack) if run.writing.view else None
        with bar(source.name, quiet=many.quiet) as progress:
            summary = process(
                source,
                target,
                config=config,
                options=options,
                progress=progress,
                watcher=watcher,
                force=many.force,
            )
        _show(summary, json=many.json, quiet=many.quiet)
    if summary.losses:
        raise typer.Exit(LOSSES)


def _many(run: _Run, logs: Sequence[str]) -> None:
    """Process many logs, each with the parameters of its own folder."""
    folder = run.writing.one
    if folder is None:
        raise ConfigError("with many logs, name a folder for the results: -o FOLDER")
    settings = run.settings()
    options = run.options(settings)
    settings.load()  # what is wrong for all logs is said before the first one
    from hiros_mcap.many.jobs import ProcessJob

    files = {
        name: path.absolute()
        for name in ("extrinsics", "limbs_in")
        if (path := getattr(options, name)) is not None
    }
    if settings.file is not None:
        settings = replace(settings, file=settings.file.absolute())
    run_many(ProcessJob(settings, replace(options, **files)), logs, run.many, folder)


def _live(run: _Run, logs: Sequence[str]) -> None:
    """Process input that is still being written."""
    source, many = logs[0], run.many
    check_live(logs, run.writing.output or (), follow=run.reading.follow)
    settings = run.settings(live=True)
    settings = settings_of(source, settings) if many.quiet else settings.of(source)
    targets = [
        run.target(Path(source), settings, name) if name is None or is_file(name) else name
        for name in run.writing.output or (None,)
    ]
    options = run.options(settings)
    config = settings.load()
    with ExitStack() as stack:
        watcher = _viewer(Path(source), targets[0], stack) if run.writing.view else None
        if STREAM in targets:  # what is printed must not go into the output
            stack.enter_context(redirect_stdout(sys.stderr))
        ros = tuple(run.reading.ros_args or ())
        summary = run_live(source, targets, config, options, watcher, ros=ros, quiet=many.quiet)
        _show(summary, json=many.json, quiet=many.quiet)


def _refuse_result(source: Path) -> None:
    """Refuse what ``for log in *.mcap`` does by accident; with --output it is on purpose."""
    from hiros_mcap.io.result import content_of

    if content_of(source) == "result":
        raise ConfigError(
            f"{source}: is a result of hiros already; to process its recording again, name an "
            "output with -o"
        )


def _refuse_other_formats(target: Path) -> None:
    suffix = target.suffix.lower()
    if suffix == ".mcap":
        return
    from hiros_mcap.io.export.files import FORMATS

    if suffix in FORMATS:
        raise ConfigError(
            f"{target}: process writes MCAP; for {suffix}, run hiros export on its result"
        )
    if suffix or not target.exists():  # mktemp gives no suffix
        raise ConfigError(
            f"{target}: process writes MCAP, which ros2 bag plays, too; name it "
            f"{target.with_suffix('.mcap')}"
        )


def _viewer(source: Path, target: str, stack: ExitStack) -> Watcher | None:
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
    raise ConfigError(f"--calibrate: {text!r} is none of off, auto, require")


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


def _show(summary: Summary, *, json: bool, quiet: bool) -> None:
    for text in summary.warnings:
        warn(text)
    if json:
        print_json("process", summary.to_dict())
    elif not quiet:
        from hiros_cli.run_report import show

        show(summary)
