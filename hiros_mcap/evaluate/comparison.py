"""Several systems on the same log: who is nearest to the truth, or what each does without one.

A log is decoded once per process and kept in memory while all systems run on it.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations
from pathlib import Path

import numpy as np

from hiros_mcap.body.limb_table import LimbTable
from hiros_mcap.config import load_config
from hiros_mcap.errors import ConfigError
from hiros_mcap.evaluate.leave_one_out import leave_one_out
from hiros_mcap.evaluate.logs import find_truth, fused_topics
from hiros_mcap.evaluate.scores import Scores, evaluate
from hiros_mcap.evaluate.truth import Truth
from hiros_mcap.events import Events
from hiros_mcap.frames import Block, frames_of, join
from hiros_mcap.io.log import open_log
from hiros_mcap.running.pipeline import ProcessOptions, Progress, Silent, camera_positions
from hiros_mcap.skeletons import Floats, Frame, SkeletonModel
from hiros_mcap.systems import Run, chain_of, system
from hiros_mcap.workers import run_tasks

_BLOCK = 64  # messages
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
        load_config(None, assignments, "default", name)
        return cls(name, stages.upper(), tuple(assignments))

    @property
    def name(self) -> str:
        """The text that gives this entry."""
        head = f"{self.system}:{self.stages}" if self.stages else self.system
        return ",".join([head, *self.assignments])


@dataclass(frozen=True, slots=True)
class Outcome:
    """What a system made of a log."""

    log: str
    name: str
    cameras: tuple[str, ...]
    """That it was given."""
    milliseconds: float
    """CPU time of the stages per input message, without compiling or loading the kernels."""
    scores: Scores | None = None
    """Against the truth; None without one."""
    disagreement: float = float("nan")
    """Without a truth: distance of a camera left out from the result of the others, mm; median
    over joints, mean over cameras. Neither the error nor a bound on it."""
    spread: float = float("nan")
    """The same, mean over joints, without the constant displacement of each joint of a person."""
    coverage: float = float("nan")
    """Without a truth: share of the left-out cameras' skeletons that the others confirm."""
    ids: int = 0
    """Number of different ids in the result."""
    limb_variation: float = float("nan")
    jitter: float = float("nan")
    people: float = float("nan")
    """Mean number of people in the result."""

    @property
    def error(self) -> float:
        """Mean joint error, mm; NaN without a truth."""
        return float("nan") if self.scores is None else self.scores.mean


@dataclass(frozen=True, slots=True)
class Task:
    """One system on one log, with some of its cameras."""

    log: Path
    entry: Entry
    sources: tuple[str, ...] | None = None
    """Cameras to use; None = all."""
    truth: str | None = None


@dataclass(frozen=True, slots=True)
class _DecodedLog:
    frames: list[Frame]
    model: SkeletonModel
    cameras: dict[str, Floats]
    fixed_frame: str
    sources: tuple[str, ...]
    truth: Truth | None


@dataclass(slots=True)
class _Cache:
    """What this process keeps: the log that it has decoded last, and who is warmed up."""

    key: tuple[Path, str | None] | None = None
    log: _DecodedLog | None = None
    warm: set[tuple[str, str]] = field(default_factory=set)
    """Systems and chains that have run in this process."""


_CACHE = _Cache()


def comparison(
    tasks: Sequence[Task], *, jobs: int = 0, progress: Progress | None = None
) -> list[Outcome]:
    """Run tasks, several at once; outcomes in the order of the tasks.

    Raises HirosError if a log cannot be read, or its truth.
    """
    progress = progress or Silent()
    done: dict[int, Outcome] = {}
    for k, outcome in run_tasks(run_task, [(task,) for task in tasks], jobs):
        done[k] = outcome
        progress.update(len(done), len(tasks))
    return [done[k] for k in range(len(tasks))]


def run_task(task: Task) -> Outcome:
    """Run one system on one log and score what comes out."""
    log, entry = _decoded(task), task.entry
    chosen = task.sources or log.sources
    frames = [frame for frame in log.frames if frame.source in chosen]
    if (entry.system, entry.stages) not in _CACHE.warm:
        # Some kernels are compiled or loaded when they are first called.
        _run_stages(entry, log, frames[:_WARM_UP])
        _CACHE.warm.add((entry.system, entry.stages))
    found, seconds = _run_stages(entry, log, frames)
    outcome = Outcome(task.log.name, entry.name, chosen, 1000 * seconds / max(len(frames), 1))
    if log.truth is None:
        return _without_truth(task, outcome)
    scores = evaluate(found, log.truth, log.model)
    return replace(
        outcome,
        scores=scores,
        limb_variation=scores.limb_variation,
        jitter=scores.jitter,
        ids=len({ident for frame in found for _, ident in frame.tracked()}),
        people=float(np.mean([frame.n_people for frame in found])) if found else 0.0,
    )


def _decoded(task: Task) -> _DecodedLog:
    key = (task.log, task.truth)
    if _CACHE.key != key or _CACHE.log is None:
        truth = find_truth(task.log, task.truth)
        with open_log(task.log, topics=fused_topics(task.log, task.truth) or None) as log:
            detections = log.detections()
            frames = list(detections)
            _CACHE.log = _DecodedLog(
                frames,
                log.model,
                camera_positions(log),
                log.fixed_frame,
                tuple(sorted({frame.source for frame in frames})),
                None if truth is None else truth.moved(start=log.span[0]),
            )
        _CACHE.key = key
    return _CACHE.log


def _run_stages(entry: Entry, log: _DecodedLog, frames: list[Frame]) -> tuple[list[Frame], float]:
    """Run the stages in memory; return the last one's frames and the CPU time, s."""
    config = load_config(None, entry.assignments, "default", entry.system)
    run = Run(log.model, config, Events(), LimbTable(), log.cameras, log.fixed_frame, entry.system)
    table = system(entry.system).stages(run)
    parts = [(Block.of(frame), 0) for frame in frames]
    # In blocks, as a run over a log has them.
    blocks = [join(parts[k : k + _BLOCK]) for k in range(0, len(parts), _BLOCK)]
    start = time.process_time()
    stream: Iterator[Block] = iter(blocks)
    for stage in chain_of(entry.system, entry.stages):
        stream = table[stage](stream)
    result = list(stream)
    seconds = time.process_time() - start
    return list(frames_of(result)), seconds


def _without_truth(task: Task, outcome: Outcome) -> Outcome:
    entry = task.entry
    config = load_config(None, entry.assignments, "default", entry.system)
    options = ProcessOptions(system=entry.system, stages=entry.stages)
    scores = leave_one_out(task.log, config=config, options=options)
    detections = sum(camera.detections for camera in scores.cameras)
    unmatched = sum(camera.unmatched for camera in scores.cameras)
    return replace(
        outcome,
        disagreement=float(np.mean([camera.median for camera in scores.cameras])),
        spread=float(np.mean([camera.spread for camera in scores.cameras])),
        coverage=1 - unmatched / detections if detections else float("nan"),
        ids=len(scores.consistency.people),
        limb_variation=scores.consistency.limb_variation,
        jitter=scores.consistency.jitter,
    )


def camera_subsets(task: Task) -> list[Task]:
    """Return the task once per subset of its log's cameras, the smallest first.

    Raises ConfigError if the log has no truth to compare with.
    """
    log = _decoded(task)
    if log.truth is None:
        raise ConfigError(f"{task.log}: --study cameras needs a truth")
    sizes = range(1, len(log.sources) + 1)
    subsets = [subset for size in sizes for subset in combinations(log.sources, size)]
    return [replace(task, sources=subset) for subset in subsets]


def by_number_of_cameras(outcomes: Sequence[Outcome]) -> dict[str, dict[int, tuple[float, float]]]:
    """System -> number of cameras -> error and SD, mm, each the mean over all subsets."""
    groups: dict[str, dict[int, list[Scores]]] = {}
    for o in sorted(outcomes, key=lambda o: len(o.cameras)):
        if o.scores is not None:
            groups.setdefault(o.name, {}).setdefault(len(o.cameras), []).append(o.scores)
    return {
        name: {size: _mean_error(scores) for size, scores in sizes.items()}
        for name, sizes in groups.items()
    }


def _mean_error(scores: Sequence[Scores]) -> tuple[float, float]:
    return (
        float(np.nanmean([s.mean for s in scores])),
        float(np.nanmean([s.deviation for s in scores])),
    )
