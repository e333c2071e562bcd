"""Jobs: the work of a command on one of many logs, a class per command.

A job has the settings of its command. It is sent to the worker processes, with the paths of one log
after the other. It imports what it needs when it runs.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, ClassVar, Self

import numpy as np

from hiros_mcap.config import Settings
from hiros_mcap.defaults import LEAST_CONFIDENCE
from hiros_mcap.errors import ConfigError
from hiros_mcap.evaluate.alignment import aligned
from hiros_mcap.evaluate.leave_one_out import SelfScores, leave_one_out
from hiros_mcap.evaluate.logs import (
    ChannelResult,
    check_scorable,
    evaluate_channels,
    find_truth,
    has_outputs,
    results_of,
    settings_of,
    start_of,
)
from hiros_mcap.evaluate.measures import CONSISTENCY, MEASURES
from hiros_mcap.evaluate.remarks import warnings_of
from hiros_mcap.evaluate.truth import Truth
from hiros_mcap.io.container import McapReader
from hiros_mcap.io.log import open_reader
from hiros_mcap.io.result import content_of, open_result
from hiros_mcap.many.find import base_name
from hiros_mcap.many.manifest import Verdict
from hiros_mcap.outputs import Kind
from hiros_mcap.progress import Progress
from hiros_mcap.running.pipeline import ProcessOptions, process, skeletons_read

ScoresAgainst = tuple[Truth, dict[str, ChannelResult], Sequence[str]]
"""The truth as it was compared, the result of each channel, and warnings."""
TRUTH_SUFFIXES = (".truth.mcap", ".mcap", ".trc", ".c3d", ".csv")


@dataclass(frozen=True, slots=True)
class Finding:
    """Outcome of a job on one log."""

    values: Mapping[str, Any] = field(default_factory=dict)
    """Name of a column, with its unit -> the value that was measured."""
    verdict: Verdict = "done"
    error: str = ""  # why the log was skipped
    warnings: tuple[str, ...] = ()
    losses: str = ""
    files: tuple[Path, ...] = ()  # files that were written


class Job:
    """Does the work of a command for one log."""

    command: ClassVar[str]
    kind: ClassVar[Kind] = "log"  # of the output
    suffix: str = ""  # suffix of the output, "" if there is none
    settings: Settings | None = None  # where the parameters come from; None = the job needs none

    def of(self, log: str) -> Self:
        """Return the job as it is done for a log, which may have parameters of its own."""
        return self

    def sides(self, name: str) -> tuple[Path, ...]:
        """Return further files that the result depends on; ``name`` is the base name of the log."""
        return ()

    def run(self, log: Path, target: Path) -> Finding:
        """Do it, and write ``target`` if the job has a suffix.

        Raises HirosError or OSError if the log cannot be used.
        """
        raise NotImplementedError


@dataclass(frozen=True, slots=True)
class ProcessJob(Job):
    """Turns recordings into clean motion."""

    settings: Settings
    options: ProcessOptions = field(default_factory=ProcessOptions)

    command: ClassVar[str] = "process"
    suffix = ".hiros.mcap"

    def of(self, log: str) -> ProcessJob:
        """Return the job with the parameters of a log."""
        settings = self.settings.of(log)
        return replace(
            self, settings=settings, options=replace(self.options, settings=settings.file)
        )

    def sides(self, name: str) -> tuple[Path, ...]:
        """Return the files of parameters, poses and limb lengths."""
        files = (self.settings.file, self.options.extrinsics, self.options.limbs_in)
        return tuple(file for file in files if file is not None)

    def run(self, log: Path, target: Path) -> Finding:
        """Process a recording. A result of hiros and a truth are skipped."""
        if content := content_of(log):
            what = "result of hiros" if content == "result" else content
            return Finding(verdict="skipped", error=f"is a {what}, not a recording")
        # Which files may be replaced was asked before the first log.
        summary = process(
            log, target, config=self.settings.load(), options=self.options, force=True
        )
        values = {
            "people": len(summary.people),
            "cameras": len(summary.cameras),
            "log_s": summary.log_s,
            "messages": sum(camera.messages for camera in summary.cameras),
            "skipped": summary.skipped,
        }
        return Finding(values, "done", "", summary.warnings, summary.losses, (target,))


@dataclass(frozen=True, slots=True)
class EvalJob(Job):
    """Scores results, or recordings after a run on them."""

    settings: Settings  # system and parameters by which recordings are processed
    truth: str | None = None
    """Folder with a file of the same name for each log, or a channel; None = the log's own."""
    channels: tuple[str, ...] = ()
    leave_one_out: bool = False
    covers: str = "all"
    match_distance: float = 1.0
    shift: float = 0.0
    up: str = "z"
    align: tuple[str, ...] = ()
    """In what the truth is brought to the result: "pose", "time"."""
    asked: bool = False
    """Whether the user named the system or a parameter; otherwise results keep their own."""

    command: ClassVar[str] = "eval"

    def of(self, log: str) -> EvalJob:
        """Return the job with the parameters of a log."""
        return replace(self, settings=self.settings.of(log))

    def sides(self, name: str) -> tuple[Path, ...]:
        """Return the files of parameters and of the truth."""
        files = (self.settings.file, self._truth_file(name))
        return tuple(file for file in files if file is not None)

    def _truth_file(self, name: str) -> Path | None:
        if self.truth is None or (self.truth.startswith("/") and not Path(self.truth).is_dir()):
            return None
        return beside(Path(self.truth), name, TRUTH_SUFFIXES, "truth")

    def against(self, log: McapReader, file: str | None) -> ScoresAgainst | None:
        """Score what a log holds, or a run on it, against the truth; None without one.

        ``file`` : of the truth, or a channel; None = the log's own.
        """
        truth = None if self.leave_one_out else find_truth(log, file)
        check_scorable(log, self.truth, has_truth=truth is not None)
        if truth is None:
            return None
        if self.asked and has_outputs(log):
            raise ConfigError(
                f"{Path(log.path).name} is a result, and is scored as it is; --system, --preset, "
                "--config and --set are for recordings"
            )
        truth = truth.moved(self.shift, start=start_of(log), up=self.up)
        config, system = self.settings.load(), self.settings.system
        channels = results_of(log, config, self.truth, self.channels, system)
        truth = aligned(truth, channels, self.align)
        truth = replace(truth, partial=self.covers == "partial")
        results = evaluate_channels(channels, truth, self.match_distance)
        return truth, results, warnings_of(results)

    def by_itself(self, log: McapReader, progress: Progress | None = None) -> SelfScores:
        """Score each camera of a log against what the system makes of the others."""
        settings = self.settings
        config, options = settings_of(log, settings.load(), settings.system, asked=self.asked)
        return leave_one_out(log, config=config, options=options, progress=progress)

    def run(self, log: Path, target: Path) -> Finding:
        """Score the last channel against the truth, or each camera against the others' result."""
        named = self._truth_file(base_name(log.name)) or self.truth
        with open_reader(log) as reader:
            scored = self.against(reader, None if named is None else str(named))
            if scored is None:
                alone = self.by_itself(reader)
                medians = [camera.distance.median for camera in alone.cameras]
                values = {m.name: m.compared(alone.consistency) for m in CONSISTENCY}
                return Finding({**values, "left_out_camera": float(np.median(medians))})
        truth, results, warnings = scored
        scores = list(results.values())[-1].scores
        values = {name: m.compared(scores) for name, m in MEASURES.items()}
        values |= {"people": len(truth.people)}
        if truth.alignment is not None:
            pose, seconds = truth.alignment
            values |= {"turned_deg": truth.alignment.degrees, "shifted_s": seconds}
            values |= {"moved_m": float(np.linalg.norm(pose.translation))}
        return Finding(values, warnings=tuple(warnings))


@dataclass(frozen=True, slots=True)
class ExportJob(Job):
    """Writes results as files of other programs."""

    suffix: str
    what: str = ""
    person: int | None = None
    channel: str = ""
    rate: float | None = None
    start: float = float("-inf")
    end: float = float("inf")
    marker_set: str = ""
    least_confidence: float = LEAST_CONFIDENCE

    command: ClassVar[str] = "export"
    kind: ClassVar[Kind] = "export"

    def sides(self, name: str) -> tuple[Path, ...]:
        """Return the file with marker names."""
        return (Path(self.marker_set),) if Path(self.marker_set).is_file() else ()

    def run(self, log: Path, target: Path) -> Finding:
        """Write a result in the format."""
        from hiros_mcap.io.export.files import export, load_marker_set, renamed

        result = open_result(log, self.channel)
        result, what = result.select(self.person, self.start, self.end, self.rate), self.what
        if self.marker_set:
            result, what = renamed(result, load_marker_set(self.marker_set, result.model)), "joints"
        warnings: list[str] = []
        files = export(
            result,
            target,
            what,
            self.least_confidence,
            warn=warnings.append,
        )
        values = {"people": len(result.people), "files": len(files)}
        return Finding(values, warnings=tuple(warnings), files=tuple(files))


@dataclass(frozen=True, slots=True)
class InfoJob(Job):
    """Looks at what logs hold."""

    topics: tuple[str, ...] = ()
    extrinsics: Path | None = None
    settings: Settings = field(default_factory=Settings)

    command: ClassVar[str] = "info"

    def of(self, log: str) -> InfoJob:
        """Return the job with the parameters of a log."""
        return replace(self, settings=self.settings.of(log))

    def run(self, log: Path, target: Path) -> Finding:
        """Look at a log."""
        from hiros_mcap.running.overview import overview_of

        skeletons = skeletons_read(self.settings.load())
        overview = overview_of(
            log, topics=self.topics or None, extrinsics=self.extrinsics, skeletons=skeletons
        )
        values = {
            "kind": overview.kind,
            "seconds": overview.seconds,
            "megabytes": overview.megabytes,
            "cameras": len(overview.cameras),
            "people": max((row.most_people for row in overview.cameras), default=None)
            if overview.cameras
            else len({row.id for row in overview.people}),
        }
        return Finding(values, warnings=tuple(overview.warnings))


def beside(folder: Path, name: str, suffixes: tuple[str, ...], what: str) -> Path:
    """Return the file of a folder that belongs to a log, by its base name.

    Raises ConfigError if there is none.
    """
    for suffix in suffixes:
        if (path := folder / (name + suffix)).is_file():
            return path
    raise ConfigError(f"{folder}: has no {what} {name}{suffixes[0]} (or {', '.join(suffixes[1:])})")
