"""``hiros eval``: how good a result is, against the truth or against the log itself."""

from __future__ import annotations

from pathlib import Path

import typer

from hiros_cli import options as shared
from hiros_cli.compiling import prepare
from hiros_cli.completing import topics
from hiros_cli.many_logs import ManyLogs, one_log, run
from hiros_cli.options import argument, chosen_system, config_file, flag, option
from hiros_cli.output import check_outputs
from hiros_mcap.errors import ConfigError
from hiros_mcap.running.progress_bar import bar


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
    system: str | None = shared.SYSTEM,
    preset: str = shared.PRESET,
    config: Path | None = shared.CONFIG,
    assignments: list[str] | None = shared.ASSIGNMENTS,
    html: Path | None = shared.HTML,
    output: str = option(
        "FOLDER",
        "Keep the scores of many logs there; the same command goes on where it stopped.",
        "--output",
        "-o",
        default="",
        panel=shared.MANY,
    ),
    jobs: int | None = shared.JOBS,
    cluster: str | None = shared.CLUSTER,
    csv: Path | None = shared.TABLE,
    force: bool = shared.FORCE,
    json: bool = shared.JSON,
    quiet: bool = shared.QUIET_RESULT,
) -> None:
    """Score a result: joints, angles, limbs, jitter, lag, people.

    A recording is first processed with the given parameters. Without a truth, hiros scores each
    camera against the result of the others.
    """
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
    from hiros_mcap.evaluate.logs import (
        check_scorable,
        covered_by,
        evaluate_channels,
        find_truth,
        results_of,
        settings_of,
        start_of,
    )
    from hiros_mcap.evaluate.remarks import warnings_of
    from hiros_mcap.io.log import open_reader

    asked = config is not None or assignments or system is not None or preset != "default"
    effective = load_config(config_file(config, logs), list(assignments or ()), preset, default)
    if is_many:
        from hiros_mcap.many.jobs import EvalJob

        folder = truth if truth is None or not Path(truth).is_dir() else str(Path(truth).absolute())
        scoring = (leave_one_out, truth_covers, match_distance, shift, up)
        scored = tuple(channel or ())
        job = EvalJob(effective, folder, scored, *scoring, default, asked=bool(asked))
        raise typer.Exit(run(job, many))
    from hiros_cli.evaluation import Output, show_self, show_truth
    from hiros_mcap.evaluate.leave_one_out import leave_one_out as score_cameras

    shown = Output(log, html, json=json, quiet=quiet, joints=joints)
    with open_reader(log) as reader:
        true = None if leave_one_out else find_truth(reader, truth)
        check_scorable(reader, truth, has_truth=true is not None)
        if true is None:
            used, options = settings_of(reader, effective, default, asked=bool(asked))
            with bar(f"leaving each camera of {log.name} out", quiet=quiet) as progress:
                scores = score_cameras(reader, config=used, options=options, progress=progress)
            show_self(shown, scores)
            return
        true = true.moved(shift, start=start_of(reader), up=up)
        channels = results_of(reader, effective, truth, channel or (), default)
    true, others = covered_by(channels, true, truth_covers, match_distance)
    results = evaluate_channels(channels, true, match_distance)
    named = truth_covers != "auto"
    show_truth(shown, true, results, others, warnings_of(true, results, others, asked=named))
