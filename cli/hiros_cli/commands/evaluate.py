"""``hiros eval``: how good a result is, against the truth or against the log itself."""

from __future__ import annotations

import tempfile
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from hiros_cli.completing import topics
from hiros_cli.options import Assignments, ConfigFile, Force, Json, Preset, QuietResult
from hiros_mcap.errors import ConfigError

if TYPE_CHECKING:
    from hiros_mcap.config import Config
    from hiros_mcap.evaluate import Truth
    from hiros_mcap.evaluate.logs import ChannelResult


def evaluate(
    log: Annotated[
        Path,
        typer.Argument(
            metavar="LOG", help="Output of `hiros process`, or a recording to process first."
        ),
    ],
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
            metavar="GLOB",
            help="Output channels to score; may be repeated. Default: all.",
            autocompletion=topics,
        ),
    ] = None,
    leave_one_out: Annotated[
        bool,
        typer.Option(
            "--leave-one-out",
            help="Score each camera against the result of the others. Default if LOG has no truth.",
        ),
    ] = False,
    match_distance: Annotated[
        float,
        typer.Option(
            min=0.01,
            metavar="M",
            help="Largest mean joint distance, m, at which a skeleton matches a true person.",
        ),
    ] = 1.0,
    shift: Annotated[
        float,
        typer.Option(
            min=-4e9, max=4e9, metavar="S", help="Seconds to add to the times of the truth."
        ),
    ] = 0.0,
    up: Annotated[
        str, typer.Option(metavar="AXIS", help="Axis of the truth that points up: z or y.")
    ] = "z",
    joints: Annotated[bool, typer.Option("--joints", help="Also show every joint.")] = False,
    preset: Preset = "default",
    config: ConfigFile = None,
    assignments: Assignments = None,
    html: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Also write an HTML report with plots."),
    ] = None,
    force: Force = False,
    json: Json = False,
    quiet: QuietResult = False,
) -> None:
    """Score a result: joints, angles, limbs, jitter, lag, people.

    A recording is first processed with the given parameters. Without a truth, hiros scores each
    camera against the result of the others.
    """
    from hiros_cli.compiling import prepare
    from hiros_cli.output import check_outputs

    if up not in ("z", "y"):
        raise ConfigError(f"--up: {up!r} is neither z nor y")
    check_outputs((html, "HTML page"), inputs=(log, truth, config), force=force)
    log.stat()
    prepare(quiet=quiet or json)

    from hiros_mcap.config import load_config
    from hiros_mcap.evaluate.logs import evaluate_log, find_truth

    effective = load_config(config, list(assignments or ()), preset)
    output = _Output(log, html, json=json, quiet=quiet, joints=joints)
    true = None if leave_one_out else find_truth(log, truth)
    if true is None:
        _show_self(output, effective)
        return
    moved = true.moved(shift, start=_start(log), up=up)
    with ExitStack() as stack:
        processed = _processed(log, effective, stack, truth)
        results = evaluate_log(processed, moved, channel or (), match_distance)
    _show_truth(output, moved, results)


@dataclass(frozen=True, slots=True)
class _Output:
    """Where the scores of a log go."""

    log: Path
    html: Path | None
    json: bool
    quiet: bool
    joints: bool


def _start(log: Path) -> int:
    """Time at which a log starts, ns; motion capture files count from there."""
    from hiros_mcap.io.log import open_reader, span_of

    with open_reader(log) as reader:
        return span_of(reader)[0]


def _processed(log: Path, config: Config, stack: ExitStack, truth: str | None) -> Path:
    """Return the log itself if it holds outputs, else its output in a temporary folder."""
    from hiros_mcap.evaluate.logs import fused_topics, has_outputs
    from hiros_mcap.running.pipeline import ProcessOptions, process

    if has_outputs(log):
        return log

    out = Path(stack.enter_context(tempfile.TemporaryDirectory())) / "out.mcap"
    options = ProcessOptions(keep=(), topics=fused_topics(log, truth))
    process(log, out, config=config, options=options)
    return out


def _show_truth(output: _Output, truth: Truth, results: dict[str, ChannelResult]) -> None:
    if output.html is not None:
        from hiros_viewer.evaluation_page import truth_page

        truth_page(str(output.log), truth, results).write(output.html)
    if output.json:
        from hiros_cli.output import print_json
        from hiros_mcap.summary import plain

        channels = {topic: plain(result.scores) for topic, result in results.items()}
        people = list(truth.people)
        data = {"log": str(output.log), "true_people": people, "channels": channels}
        print_json("eval", data)
    elif not output.quiet:
        from hiros_cli.evaluation import show_truth

        show_truth(output.log, truth, results, joints=output.joints)


def _show_self(output: _Output, config: Config) -> None:
    from hiros_mcap.evaluate.leave_one_out import leave_one_out

    scores = leave_one_out(output.log, config=config)
    if output.html is not None:
        from hiros_viewer.evaluation_page import self_page

        self_page(str(output.log), scores).write(output.html)
    if output.json:
        from hiros_cli.output import print_json
        from hiros_mcap.summary import plain, plain_value

        pairs = [{"cameras": list(k), "mm": v} for k, v in scores.disagreement.items()]
        data = {"log": str(output.log), **plain(scores), "disagreement": plain_value(pairs)}
        print_json("eval.self", data)
    elif not output.quiet:
        from hiros_cli.evaluation import show_self

        show_self(output.log, scores, joints=output.joints)
