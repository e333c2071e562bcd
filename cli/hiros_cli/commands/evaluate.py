"""``hiros eval``: how good a result is, against the truth or against the log itself."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from hiros_cli.completing import topics
from hiros_cli.many_logs import ManyLogs, one_log, run
from hiros_cli.options import (
    ASSIGNMENTS,
    CLUSTER,
    CONFIG,
    FORCE,
    HTML,
    JOBS,
    JSON,
    MANY,
    PRESET,
    QUIET_RESULT,
    SYSTEM,
    TABLE,
    argument,
    chosen_system,
    config_file,
    flag,
    option,
)
from hiros_mcap.errors import ConfigError

if TYPE_CHECKING:
    from hiros_mcap.config import Config
    from hiros_mcap.evaluate import Truth
    from hiros_mcap.evaluate.logs import ChannelResult
    from hiros_mcap.io.container import McapReader
    from hiros_mcap.running.process_options import ProcessOptions


def evaluate(
    context: typer.Context,
    logs: list[str] = argument(
        "LOG",
        "Outputs of `hiros process`, or recordings to process first: files, folders, globs, URLs.",
    ),
    truth: str | None = option(
        "FILE|TOPIC",
        "MCAP, TRC or CSV file, or a channel of LOG. Default: LOG's /truth channel. With many "
        "logs: a channel, or a folder of files with the logs' names.",
    ),
    channel: list[str] | None = option(
        "GLOB", "Output channels to score; may be repeated. Default: all.", autocompletion=topics
    ),
    leave_one_out: bool = flag(
        "--leave-one-out",
        "Score each camera against the result of the others. Default if LOG has no truth.",
    ),
    truth_covers: str = option(
        "all|partial|auto",
        "Whether the truth has everybody: skeletons of nobody in a partial truth don't count. "
        "auto: partial only if the result shows people walking whom it lacks.",
        default="auto",
    ),
    match_distance: float = option(
        "M",
        "Largest mean joint distance, m, at which a skeleton matches a true person.",
        default=1.0,
        min=0.01,
    ),
    shift: float = option(
        "S", "Seconds to add to the times of the truth.", default=0.0, min=-4e9, max=4e9
    ),
    up: str = option("AXIS", "Axis of the truth that points up: z or y.", default="z"),
    joints: bool = flag("--joints", "Also show every joint and the signed angles."),
    system: str | None = SYSTEM,
    preset: str = PRESET,
    config: Path | None = CONFIG,
    assignments: list[str] | None = ASSIGNMENTS,
    html: Path | None = HTML,
    output: str = option(
        "FOLDER",
        "Keep the scores of many logs there; the same command goes on where it stopped.",
        "--output",
        "-o",
        default="",
        panel=MANY,
    ),
    jobs: int | None = JOBS,
    cluster: str | None = CLUSTER,
    csv: Path | None = TABLE,
    force: bool = FORCE,
    json: bool = JSON,
    quiet: bool = QUIET_RESULT,
) -> None:
    """Score a result: joints, angles, limbs, jitter, lag, people.

    A recording is first processed with the given parameters. Without a truth, hiros scores each
    camera against the result of the others.
    """
    from hiros_cli.compiling import prepare
    from hiros_cli.output import check_outputs

    if up not in ("z", "y"):
        raise ConfigError(f"--up: {up!r} is neither z nor y")
    if truth_covers not in ("all", "partial", "auto"):
        raise ConfigError(f"--truth-covers: {truth_covers!r} is none of all, partial, auto")
    many = ManyLogs(logs, output, jobs, cluster, csv, force, json, quiet)
    is_many, log = many.wanted, Path(logs[0])
    if is_many:
        many.refuse(html=html, joints=joints)
    else:
        many.refuse_alone()
        if output:
            raise ConfigError("--output is for many logs; for one, use --json or --html")
        log = one_log(context, logs[0])
        check_outputs((html, "HTML page"), inputs=(log, truth, config), force=force)
    default = chosen_system(system, preset)
    prepare(quiet=quiet or json, everything=is_many)

    from hiros_mcap.config import load_config
    from hiros_mcap.evaluate.logs import covered_by, evaluate_channels, find_truth, start_of
    from hiros_mcap.evaluate.remarks import warnings_of
    from hiros_mcap.evaluate.scored import check_scorable, results_of, settings_of
    from hiros_mcap.io.log import open_reader

    asked = config is not None or assignments or system is not None or preset != "default"
    effective = load_config(config_file(config, logs), list(assignments or ()), preset, default)
    if is_many:
        from hiros_mcap.many.jobs import EvalJob

        folder = truth if truth is None or not Path(truth).is_dir() else str(Path(truth).absolute())
        job = EvalJob(
            effective,
            folder,
            tuple(channel or ()),
            leave_one_out,
            truth_covers,
            match_distance,
            shift,
            up,
            default,
            asked=bool(asked),
        )
        raise typer.Exit(run(job, many))
    shown = _Output(log, html, json=json, quiet=quiet, joints=joints)
    with open_reader(log) as reader:
        true = None if leave_one_out else find_truth(reader, truth)
        check_scorable(reader, truth, has_truth=true is not None)
        if true is None:
            _show_self(shown, reader, settings_of(reader, effective, default, asked=bool(asked)))
            return
        true = true.moved(shift, start=start_of(reader), up=up)
        channels = results_of(reader, effective, truth, channel or (), default)
    true, others = covered_by(channels, true, truth_covers, match_distance)
    results = evaluate_channels(channels, true, match_distance)
    named = truth_covers != "auto"
    _show_truth(shown, true, results, others, warnings_of(true, results, others, asked=named))


@dataclass(frozen=True, slots=True)
class _Output:
    """Where the scores of a log go."""

    log: Path
    html: Path | None
    json: bool
    quiet: bool
    joints: bool


def _show_truth(
    output: _Output,
    truth: Truth,
    results: dict[str, ChannelResult],
    others: tuple[int, ...],
    warnings: list[str],
) -> None:
    from hiros_cli.output import print_json, warn
    from hiros_mcap.evaluate.remarks import notes_of

    notes = notes_of(truth, results)
    if output.html is not None:
        from hiros_viewer.evaluation_page import truth_page

        truth_page(output.log, truth, results, [*warnings, *notes]).write(output.html)
    if output.json:
        from hiros_mcap.summary import plain

        data = {
            "log": str(output.log),
            "true_people": list(truth.people),
            "truth_covers": "partial" if truth.partial else "all",
            "people_without_truth": list(others),
            "channels": {topic: plain(result.scores) for topic, result in results.items()},
            "warnings": warnings,
            "notes": notes,
        }
        print_json("eval", data)
    elif not output.quiet:
        from hiros_cli.evaluation import show_truth

        show_truth(output.log, truth, results, notes, joints=output.joints)
    for text in warnings:
        warn(text)


def _show_self(
    output: _Output, reader: McapReader, settings: tuple[Config, ProcessOptions]
) -> None:
    from hiros_mcap.evaluate.leave_one_out import leave_one_out
    from hiros_mcap.running.progress_bar import bar

    config, options = settings
    with bar(f"leaving each camera of {output.log.name} out", quiet=output.quiet) as progress:
        scores = leave_one_out(reader, config=config, options=options, progress=progress)
    if output.html is not None:
        from hiros_viewer.evaluation_page import self_page

        self_page(output.log, scores).write(output.html)
    if output.json:
        from hiros_cli.output import print_json
        from hiros_mcap.evaluate.score_tables import notes_without_truth
        from hiros_mcap.summary import plain, plain_value

        pairs = [{"cameras": list(k), "mm": v} for k, v in scores.disagreement.items()]
        notes = notes_without_truth(scores)
        data = {"log": str(output.log), **plain(scores), "notes": notes}
        data["disagreement"] = plain_value(pairs)
        print_json("eval.self", data)
    elif not output.quiet:
        from hiros_cli.evaluation import show_self

        show_self(output.log, scores, joints=output.joints)
