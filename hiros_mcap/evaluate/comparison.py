"""Several systems on the same log: errors against a truth; without one, against left-out cameras.

A process reads a log once for all systems that prepare it alike, and keeps it in memory. Clocks and
poses are corrected as in ``hiros process``.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path

import numpy as np
import numpy.typing as npt

from hiros_mcap.config import Config, Settings
from hiros_mcap.errors import ConfigError
from hiros_mcap.evaluate.leave_one_out import Distances, frames_of_cameras, leave_each_out
from hiros_mcap.evaluate.logs import (
    Channel,
    consistency,
    evaluate_channels,
    find_truth,
    fused_topics,
    start_of,
)
from hiros_mcap.evaluate.match import Matches
from hiros_mcap.evaluate.scores import Scores
from hiros_mcap.evaluate.statistics import ErrorStats, block_interval, blocks_of, mean_of
from hiros_mcap.evaluate.truth import Truth
from hiros_mcap.io.channels import OUTPUT_PREFIX
from hiros_mcap.progress import Bar, Progress
from hiros_mcap.running.preparation import preparation_key
from hiros_mcap.running.process_options import ProcessOptions
from hiros_mcap.running.recording import Recording
from hiros_mcap.skeletons import SECOND, Flags, Frame, Stamps
from hiros_mcap.systems import chain_of
from hiros_mcap.workers import run_tasks

_WARM_UP = 150
"""Messages that a system is run on before it is timed: enough to confirm the first tracks."""
DEFAULT = (
    "fuse", "fuse-realtime", "hiros", "hiros-realtime", "malaguti", "lee", "openptrack", "maf",
    "average", "raw",
)  # fmt: skip
"""Systems that are compared unless others are named."""


@dataclass(frozen=True, slots=True)
class Entry:
    """A system with its chain and parameters, as it takes part."""

    system: str
    stages: str = ""
    assignments: tuple[str, ...] = ()

    @classmethod
    def parse(cls, text: str) -> Entry:
        """Read ``SYSTEM[:CHAIN][,stage.param=value...]``, such as ``lee:TM,cluster.radius=0.2``.

        Raises ConfigError if there is no such system, chain or parameter.
        """
        head, *assignments = text.split(",")
        name, _, stages = head.partition(":")
        chain_of(name, stages)
        Settings(name, assignments=tuple(assignments)).load()
        return cls(name, stages.upper(), tuple(assignments))

    def config(self, log: Path) -> Config:
        """Return the parameters on a log, with those of its hiros.toml; raises ConfigError."""
        return Settings(self.system, assignments=self.assignments).of(log).load()

    @property
    def name(self) -> str:
        """The text that gives this entry."""
        head = f"{self.system}:{self.stages}" if self.stages else self.system
        return ",".join([head, *self.assignments])


@dataclass(frozen=True, slots=True)
class MeanDifference:
    """Mean distance of a system less that of another, on what both have, mm."""

    against: str  # the other system
    mm: float  # Negative: this system is nearer
    low: float  # lower end of the 95 % interval, mm; NaN if there are fewer than two seconds
    high: float
    seconds: int  # blocks of a second that the interval is made of

    @property
    def is_sure(self) -> bool:
        """Whether the interval does not hold 0."""
        return self.low > 0 or self.high < 0

    @property
    def line(self) -> str:
        """Return it, unless there is too little time in common."""
        return "-: less than 2 s in common" if self.seconds < 2 else str(self)

    def __str__(self) -> str:
        ends = sorted((abs(self.low), abs(self.high)))
        if not self.is_sure:
            return f"no difference ({self.low:+.1f} to {self.high:+.1f})"
        word = "better" if self.mm < 0 else "worse"
        return f"{word} by {abs(self.mm):.1f} (95 % {ends[0]:.1f} to {ends[1]:.1f})"


@dataclass(frozen=True, slots=True)
class Outcome:
    """The result of a system on a log: with a truth its scores, else :data:`measures.SELF`."""

    log: str
    name: str
    cameras: tuple[str, ...]  # that it was given
    milliseconds: float  # without compiling or loading the kernels
    scores: Scores | None = None
    distance: ErrorStats | None = None
    """Of the detections where all systems have somebody; neither the error nor a bound on it."""
    spread: float = float("nan")  # mean of the varying distances, mm
    misses: int = 0  # detections at which the system has nobody, but another one has
    detections: int = 0  # detections at which some system has somebody
    difference: MeanDifference | None = None  # from the first system; None for the first itself
    coverage: float = float("nan")
    ids: int = 0
    limb_variation: float = float("nan")
    jitter: float = float("nan")
    people: float = float("nan")  # mean number of people in the result

    @property
    def error(self) -> float:
        """Mean joint error, mm; NaN without a truth."""
        return float("nan") if self.scores is None else self.scores.mean


@dataclass(frozen=True, slots=True)
class Task:
    """One system on one log, with some of its cameras."""

    log: Path
    entry: Entry
    sources: tuple[str, ...] | None = None  # cameras to use; None = all
    truth: str | None = None


_READ: dict[tuple[object, ...], tuple[Recording, Truth | None]] = {}
"""The recording that this process has read last, and its truth."""
_WARM: set[tuple[str, str]] = set()  # systems and chains that have run in this process


def comparison(
    tasks: Sequence[Task], *, jobs: int = 0, progress: Progress | None = None
) -> list[Outcome]:
    """Run tasks, several at once; outcomes in the order of the tasks.

    Raises HirosError if a log cannot be read, or its truth.
    """
    progress = progress or Bar()
    done: dict[int, tuple[Outcome, list[Distances]]] = {}
    for k, scored in run_tasks(_run, [(task,) for task in tasks], jobs):
        done[k] = scored
        progress.update(len(done), len(tasks))
    outcomes = [done[k][0] for k in range(len(tasks))]
    groups: dict[tuple[Path, tuple[str, ...]], list[int]] = {}
    for k, (task, outcome) in enumerate(zip(tasks, outcomes, strict=True)):
        groups.setdefault((task.log, outcome.cameras), []).append(k)
    for group in groups.values():
        rescored = on_same_detections([done[k] for k in group])
        for k, outcome in zip(group, rescored, strict=True):
            outcomes[k] = outcome
    return outcomes


def on_same_detections(done: Sequence[tuple[Outcome, list[Distances]]]) -> list[Outcome]:
    """Score S systems on the joints that all of them have at the same detections of a log.

    A system that has nobody anywhere does not count for what the others have. With a truth, only
    the differences are added.

    Parameters
    ----------
    done : of each system, and the cameras' distances, for all systems in the same order.

    Raises ConfigError if the systems were given different detections.
    """
    (first, cameras), *_ = done
    distances_of = [np.concatenate([d.joints for d in distances]) for _, distances in done]
    if len({joints.shape for joints in distances_of}) > 1:
        raise ConfigError(f"{first.log}: the systems were given different detections")
    varying = (np.concatenate([d.varying for d in distances]) for _, distances in done)
    stamps = np.concatenate([d.stamps for d in cameras])
    present: Flags = ~np.isnan(np.stack(distances_of))  # (S, D, M)
    there = np.any(present, axis=2)
    anybody = there.any(axis=0)
    # Without any that has somebody, all is common: nothing is present.
    common = present[there.any(axis=1)].all(axis=0)
    outcomes = []
    for k, (joints, rest) in enumerate(zip(distances_of, varying, strict=True)):
        outcome, scored = done[k][0], common & present[k]
        if k:
            difference = _difference(joints, distances_of[0], stamps, first.name)
            outcome = replace(outcome, difference=difference)
        if outcome.scores is None:
            outcome = replace(
                outcome,
                distance=ErrorStats.of(joints[scored].astype(np.float64)),
                spread=mean_of(rest[scored].astype(np.float64)),
                misses=int((anybody & ~there[k]).sum()),
                detections=int(anybody.sum()),
            )
        outcomes.append(outcome)
    return outcomes


def _difference(
    mine: npt.NDArray[np.float32], other: npt.NDArray[np.float32], stamps: Stamps, name: str
) -> MeanDifference:
    """MeanDifference of two systems where both have a joint, with an interval over seconds."""
    apart = mine.astype(np.float64) - other
    rows, columns = np.nonzero(~np.isnan(apart))
    return MeanDifference(name, *block_interval(apart[rows, columns], blocks_of(stamps[rows])))


def _run(task: Task) -> tuple[Outcome, list[Distances]]:
    recording, truth = _read(task)
    config, options = _settings(task)
    chosen = task.sources or tuple(sorted(recording.sources))
    kind = task.entry.system, task.entry.stages
    if kind not in _WARM:
        # Some kernels are compiled or loaded when they are first called.
        recording.head(_WARM_UP).run(config, options, chosen)
        _WARM.add(kind)
    start = time.process_time()
    ((stage, frames),) = recording.run(config, options, chosen, last=True).items()
    seconds = time.process_time() - start
    messages = sum(frame.source in chosen for frame in recording.frames())
    outcome = Outcome(task.log.name, task.entry.name, chosen, 1000 * seconds / max(messages, 1))
    if truth is None:
        return _without_truth(task, outcome, recording, frames)
    topic, channel = f"{OUTPUT_PREFIX}/{stage}", Channel(task.log, frames, recording.model)
    (result,) = evaluate_channels({topic: channel}, truth).values()
    scores = result.scores
    scored = replace(
        outcome,
        scores=scores,
        limb_variation=scores.limb_variation,
        jitter=scores.jitter,
        ids=len({ident for frame in frames for _, ident in frame.tracked()}),
        people=float(np.mean([frame.n_people for frame in frames])) if frames else 0.0,
    )
    return scored, [_by_second(result.matches, truth)]


def _by_second(matches: Matches, truth: Truth) -> Distances:
    """Mean distance of each true person in each second, mm; NaN where the result lacks him."""
    seconds = np.arange(truth.stamps[0], truth.stamps[-1] + 1, SECOND)
    shape = (len(truth.people), len(seconds))
    sums, counts = np.zeros(shape), np.zeros(shape)
    distances = 1000 * np.linalg.norm(matches.poses - matches.true_poses, axis=-1)
    cells = matches.people, (matches.stamps - truth.stamps[0]) // SECOND
    np.add.at(sums, cells, np.nansum(distances, axis=-1))
    np.add.at(counts, cells, (~np.isnan(distances)).sum(axis=-1))
    means = np.where(counts > 0, sums / np.maximum(counts, 1), np.nan).astype(np.float32)
    joints = means.reshape(-1, 1)
    return Distances(np.tile(seconds, len(truth.people)), joints, np.full_like(joints, np.nan))


def _settings(task: Task) -> tuple[Config, ProcessOptions]:
    """Return the settings with which ``hiros process`` would run a system on a log."""
    entry = task.entry
    config = entry.config(task.log)
    topics = fused_topics(task.log, task.truth)
    return config, ProcessOptions(system=entry.system, stages=entry.stages, topics=topics)


def _read(task: Task) -> tuple[Recording, Truth | None]:
    """Return the log as the task's system reads it, and its truth."""
    config, options = _settings(task)
    key = task.log, task.truth, preparation_key(config, options)
    if key not in _READ:
        _READ.clear()  # two recordings may be too large
        truth = find_truth(task.log, task.truth)
        recording = Recording.read(task.log, config, options)
        _READ[key] = recording, None if truth is None else truth.moved(start=start_of(task.log))
    return _READ[key]


def _without_truth(
    task: Task, outcome: Outcome, recording: Recording, frames: Sequence[Frame]
) -> tuple[Outcome, list[Distances]]:
    cameras, distances = leave_each_out(recording, frames_of_cameras(recording), *_settings(task))
    detections = sum(camera.detections for camera in cameras)
    unmatched = sum(camera.unmatched for camera in cameras)
    result = consistency(frames, recording.model)
    scored = replace(
        outcome,
        coverage=1 - unmatched / detections if detections else float("nan"),
        ids=result.n_people,
        limb_variation=result.limb_variation,
        jitter=result.jitter,
    )
    return scored, distances


def camera_subsets(task: Task) -> list[Task]:
    """Return the task once per subset of its log's cameras, the smallest first.

    Raises ConfigError if the log has no truth to compare with.
    """
    recording, truth = _read(task)
    if truth is None:
        raise ConfigError(f"{task.log}: --study cameras needs a truth")
    names = sorted(recording.sources)
    subsets = [subset for size in range(1, len(names) + 1) for subset in combinations(names, size)]
    return [replace(task, sources=subset) for subset in subsets]


def by_number_of_cameras(outcomes: Sequence[Outcome]) -> dict[str, dict[int, tuple[float, float]]]:
    """System -> number of cameras -> error and SD, mm, each the mean over all subsets."""
    groups: dict[tuple[str, int], list[Scores]] = {}
    for o in sorted(outcomes, key=lambda o: len(o.cameras)):
        if o.scores is not None:
            groups.setdefault((o.name, len(o.cameras)), []).append(o.scores)
    errors: dict[str, dict[int, tuple[float, float]]] = {}
    for (name, size), scores in groups.items():
        error, deviation = ([s.mean for s in scores], [s.deviation for s in scores])
        means = float(np.nanmean(error)), float(np.nanmean(deviation))
        errors.setdefault(name, {})[size] = means
    return errors
