"""``hiros eval``: how good a result is, against the truth or against the log itself."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn

from hiros_cli.compiling import prepare
from hiros_cli.many_logs import ManyLogs, one_log, run
from hiros_cli.options import (
    GROUP,
    HTML,
    TABLE,
    Parameters,
    argument,
    flag,
    grouped,
    option,
    settings_of,
)
from hiros_cli.output import check_outputs
from hiros_mcap.errors import ConfigError
from hiros_mcap.progress import bar

if TYPE_CHECKING:
    from hiros_cli.evaluation import Output
    from hiros_mcap.config import Settings
    from hiros_mcap.many.jobs import EvalJob


@dataclass(frozen=True, slots=True)
class Scoring:
    """Options on how a result is scored."""

    truth: str | None = option(
        "FILE|TOPIC",
        "MCAP, TRC, C3D or CSV file, or a channel of LOG. Default: LOG's /truth channel. With many "
        "logs: a channel, or a folder of files with the logs' names.",
    )
    channel: list[str] | None = option(
        "GLOB", "Output channels to score; may be repeated. Default: all."
    )
    leave_one_out: bool = flag(
        "--leave-one-out",
        "Score each camera against the result of the others. Default if LOG has no truth.",
    )
    truth_covers: str = option(
        "all|partial",
        "Whether the truth has everybody: skeletons of nobody in a partial truth don't count.",
        default="all",
    )
    match_distance: float = option(
        "M",
        "Largest mean joint distance, m, at which a skeleton matches a true person.",
        default=1.0,
        min=0.01,
    )
    shift: float = option(
        "S", "Seconds to add to the times of the truth.", default=0.0, min=-4e9, max=4e9
    )
    up: str = option("AXIS", "Axis of the truth that points up: z or y.", default="z")
    align: bool = flag(
        "--align", "Turn and move the truth as a whole to where the result has the people."
    )
    align_time: bool = flag("--align-time", "--align, and find the shift of the truth's times.")

    def __post_init__(self) -> None:
        if self.leave_one_out and self.truth is not None:
            raise ConfigError("--leave-one-out takes no --truth: it compares the cameras")
        if self.up not in ("z", "y"):
            raise ConfigError(f"--up: {self.up!r} is neither z nor y")
        if self.truth_covers not in ("all", "partial"):
            raise ConfigError(f"--truth-covers: {self.truth_covers!r} is neither all nor partial")

    @property
    def alignment(self) -> tuple[str, ...]:
        """In what the truth is brought to the result."""
        asked = {"pose": self.align, "time": self.align_time}
        return tuple(name for name, is_asked in asked.items() if is_asked)


@grouped
def evaluate(
    logs: list[str] = argument(
        "LOG",
        "Outputs of `hiros process`, or recordings to process first: files, folders, globs.",
    ),
    scoring: Scoring = GROUP,
    joints: bool = flag("--joints", "Also show every joint and the signed angles."),
    parameters: Parameters = GROUP,
    html: Path | None = HTML,
    table: Path | None = TABLE,
    many: ManyLogs = GROUP,
) -> None:
    """Score a result: joints, angles, limbs, jitter, lag, people.

    A recording is first processed with the given parameters. Without a truth, hiros scores each
    camera against the result of the others.
    """
    if many.wanted(logs, html=html, joints=joints, table=table):
        _many(scoring, parameters, logs, many)
    log = one_log(logs[0])
    inputs = (log, scoring.truth, parameters.config)
    check_outputs((html, "HTML page"), (table, "table of scores"), inputs=inputs, force=many.force)
    settings = settings_of(logs[0], parameters.settings())
    prepare(quiet=many.quiet or many.json)
    from hiros_cli.evaluation import Output

    shown = Output(log, html, table, json=many.json, quiet=many.quiet, joints=joints)
    _one(_job(scoring, settings, asked=parameters.asked), shown)


def _job(scoring: Scoring, settings: Settings, *, asked: bool) -> EvalJob:
    """Return what is done with each log."""
    from hiros_mcap.many.jobs import EvalJob

    settings.load()  # what is wrong for all logs is said before the first one
    return EvalJob(
        settings,
        scoring.truth,
        tuple(scoring.channel or ()),
        scoring.leave_one_out,
        scoring.truth_covers,
        scoring.match_distance,
        scoring.shift,
        scoring.up,
        scoring.alignment,
        asked=asked,
    )


def _one(job: EvalJob, shown: Output) -> None:
    """Score one log against the truth, or without one each camera against the others."""
    from hiros_cli.evaluation import show_self, show_truth
    from hiros_mcap.io.log import open_reader

    with open_reader(shown.log) as reader:
        scored = job.against(reader, job.truth)
        if scored is None:
            title = f"leaving each camera of {shown.log.name} out"
            with bar(title, quiet=shown.quiet) as progress:
                scores = job.by_itself(reader, progress)
            show_self(shown, scores)
            return
    show_truth(shown, *scored)


def _many(
    scoring: Scoring, parameters: Parameters, logs: Sequence[str], many: ManyLogs
) -> NoReturn:
    """Score many logs, each with the parameters of its own folder."""
    settings, truth = parameters.settings(), scoring.truth
    prepare(quiet=many.quiet or many.json)
    if settings.file is not None:
        settings = replace(settings, file=settings.file.absolute())
    if truth is not None and Path(truth).is_dir():
        scoring = replace(scoring, truth=str(Path(truth).absolute()))
    run(_job(scoring, settings, asked=parameters.asked), logs, many)
