"""``hiros eval``: how good is it, against the truth or against the log itself."""

from __future__ import annotations

import tempfile
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from hiros_cli.options import Assignments, ConfigFile, Force, Json, Preset, QuietResult
from hiros_mcap.errors import ConfigError

if TYPE_CHECKING:
    from hiros_mcap.config import Config
    from hiros_mcap.evaluate import Truth
    from hiros_mcap.evaluate.logs import ChannelResult


def evaluate(
    log: Annotated[
        Path | None,
        typer.Argument(
            metavar="LOG", help="What `hiros process` wrote, or a recording: processed first."
        ),
    ] = None,
    truth: Annotated[
        str | None,
        typer.Option(
            metavar="FILE|TOPIC",
            help="MCAP, TRC or CSV file, or a channel of LOG. Default: LOG's /truth channel.",
        ),
    ] = None,
    channel: Annotated[
        list[str] | None,
        typer.Option(
            metavar="GLOB", help="Output channels to score; may be repeated. Default: all."
        ),
    ] = None,
    leave_one_out: Annotated[
        bool,
        typer.Option(
            "--leave-one-out",
            help="Without truth: score each camera against what the others give. The default "
            "when there is no truth.",
        ),
    ] = False,
    table: Annotated[
        str | None,
        typer.Option(
            metavar="NAME",
            help="Instead of LOG, run a paper's experiments on simulated logs: hiros.",
        ),
    ] = None,
    seconds: Annotated[
        float,
        typer.Option(min=3.0, max=600.0, help="With --table: length of every simulated log, s."),
    ] = 15.0,
    jobs: Annotated[
        int, typer.Option(min=0, help="With --table: processes at once; 0 = one per core.")
    ] = 0,
    match_distance: Annotated[
        float,
        typer.Option(
            min=0.01,
            metavar="M",
            help="Mean joint distance, m, from which a skeleton is of somebody else.",
        ),
    ] = 1.0,
    shift: Annotated[
        float,
        typer.Option(min=-4e9, max=4e9, metavar="S", help="Add this to the times of the truth, s."),
    ] = 0.0,
    up: Annotated[str, typer.Option(help="Vertical axis of the truth: z, or y (OpenSim).")] = "z",
    joints: Annotated[bool, typer.Option("--joints", help="Show every joint, too.")] = False,
    preset: Preset = "default",
    config: ConfigFile = None,
    assignments: Assignments = None,
    html: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Also write a report with plots, one file."),
    ] = None,
    force: Force = False,
    json: Json = False,
    quiet: QuietResult = False,
) -> None:
    """Score a result: joints, angles, limbs, jitter, lag, people; with truth or without.

    A recording that was not processed yet is processed first, with the given parameters.
    """
    from hiros_cli.compiling import prepare
    from hiros_cli.output import check_outputs

    if up not in ("z", "y"):
        raise ConfigError(f"--up: {up!r} is neither z nor y")
    check_outputs((html, "HTML page"), inputs=(log, truth, config), force=force)
    if table is None and log is None:
        raise ConfigError("eval needs a LOG, or --table hiros (see hiros eval --help)")
    if log is not None:
        log.stat()
    prepare(quiet=quiet or json)

    from hiros_mcap.config import load_config

    effective = load_config(config, list(assignments or ()), preset)
    if table is not None:
        _paper_table(table, effective, seconds, jobs, html=html, json=json, quiet=quiet)
        return
    if log is None:
        raise AssertionError("checked above")
    from hiros_mcap.evaluate.logs import find_truth

    true = None if leave_one_out else find_truth(log, truth)
    if true is None:
        _show_self(log, effective, html=html, json=json, quiet=quiet, joints=joints)
        return
    moved = true.moved(shift, start=_start(log), up=up)
    with ExitStack() as stack:
        processed = _processed(log, effective, stack, truth)
        from hiros_mcap.evaluate.logs import evaluate_log

        results = evaluate_log(processed, moved, channel or (), match_distance)
    _show_truth(log, moved, results, html=html, json=json, quiet=quiet, joints=joints)


def _start(log: Path) -> int:
    """Time at which a log starts, ns: what motion capture files count from."""
    from hiros_mcap.io.log import open_reader, span_of

    with open_reader(log) as reader:
        return span_of(reader)[0]


def _processed(log: Path, config: Config, stack: ExitStack, truth: str | None) -> Path:
    """Return the log itself if it holds outputs, else what processing makes of it."""
    from hiros_mcap.evaluate.logs import fused_topics, has_outputs

    if has_outputs(log):
        return log
    from hiros_mcap.running.pipeline import ProcessOptions, process

    out = Path(stack.enter_context(tempfile.TemporaryDirectory())) / "out.mcap"
    options = ProcessOptions(keep=(), topics=fused_topics(log, truth))
    process(log, out, config=config, options=options)
    return out


def _show_truth(
    log: Path,
    truth: Truth,
    results: dict[str, ChannelResult],
    *,
    html: Path | None,
    json: bool,
    quiet: bool,
    joints: bool,
) -> None:
    if html is not None:
        from hiros_viewer.evaluation_page import truth_page

        truth_page(str(log), truth, results).write(html)
    if json:
        _print_json(
            {
                "log": str(log),
                "true_people": list(truth.people),
                "channels": {topic: _plain(result.scores) for topic, result in results.items()},
            }
        )
    elif not quiet:
        from hiros_cli.evaluation import show_truth

        show_truth(log, truth, results, joints=joints)


def _show_self(
    log: Path, config: Config, *, html: Path | None, json: bool, quiet: bool, joints: bool
) -> None:
    from hiros_mcap.evaluate.leave_one_out import leave_one_out

    scores = leave_one_out(log, config=config)
    if html is not None:
        from hiros_viewer.evaluation_page import self_page

        self_page(str(log), scores).write(html)
    if json:
        pairs = [{"cameras": list(k), "mm": v} for k, v in scores.disagreement.items()]
        _print_json({"log": str(log), **_plain(scores), "disagreement": _finite(pairs)})
    elif not quiet:
        from hiros_cli.evaluation import show_self

        show_self(log, scores, joints=joints)


def _paper_table(
    name: str,
    config: Config,
    seconds: float,
    jobs: int,
    *,
    html: Path | None,
    json: bool,
    quiet: bool,
) -> None:
    if name != "hiros":
        raise ConfigError(f"--table: no table {name!r} (there is: hiros)")
    from hiros_cli.progress import bar
    from hiros_mcap.evaluate.paper import run_experiments

    with bar("16 actions, 1 to 4 people", quiet=quiet) as progress:
        results = run_experiments(config, seconds=seconds, jobs=jobs, progress=progress)
    if html is not None:
        from hiros_viewer.evaluation_page import paper_page

        paper_page(results).write(html)
    if json:
        _print_json(_plain(results))
    elif not quiet:
        from hiros_cli.evaluation import show_paper

        show_paper(results)


def _plain(record: Any) -> dict[str, Any]:
    from hiros_mcap.summary import plain

    return plain(record)


def _finite(value: Any) -> Any:
    from hiros_mcap.summary import plain_value

    return plain_value(value)


def _print_json(data: dict[str, Any]) -> None:
    from json import dumps

    print(dumps(data, indent=2, allow_nan=False))
