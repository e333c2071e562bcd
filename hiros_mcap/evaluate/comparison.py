"""Several systems on the same log: who is nearest to the truth, or to the camera left out.

A log is decoded once per process and kept in memory while all systems run on it.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations, pairwise
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

_TOGETHER = 64  # messages
_WARM_UP = 150
"""Messages that a system is run on before it is timed: enough that people are found."""
DEFAULT = ("hiros", "hiros-realtime", "malaguti", "lee", "openptrack", "maf", "average", "raw")
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

        Raises
        ------
        ConfigError
            There is no such system, chain or parameter.
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
    distance: float = float("nan")
    """Without a truth: mean over cameras of the median distance of the one left out, mm."""
    limb_variation: float = float("nan")
    jitter: float = float("nan")
    people: float = float("nan")
    """Mean number of people in the result."""

    @property
    def rank(self) -> float:
        """What outcomes are ordered by: mean joint error, or distance of the camera left out."""
        return self.distance if self.scores is None else self.scores.mean


@dataclass(slots=True)
class _Room:
    """A decoded log."""

    frames: list[Frame]
    model: SkeletonModel
    cameras: dict[str, Floats]
    fixed_frame: str
    sources: tuple[str, ...]
    truth: Truth | None


@dataclass(frozen=True, slots=True)
class Task:
    """One system on one log, with some of its cameras."""

    log: Path
    entry: Entry
    sources: tuple[str, ...] | None = None
    """Cameras to use; None = all."""
    truth: str | None = None


@dataclass(slots=True)
class _Cache:
    """The log that this process has decoded last."""

    key: tuple[Path, str | None] | None = None
    room: _Room | None = field(default=None)
    warm: set[tuple[str, str]] = field(default_factory=set)
    """Systems and chains that have run in this process."""


_CACHE = _Cache()


def comparison(
    tasks: Sequence[Task], *, jobs: int = 0, progress: Progress | None = None
) -> list[Outcome]:
    """Run tasks, several at once; outcomes in the order of the tasks.

    Raises
    ------
    HirosError
        A log cannot be read, or its truth.
    """
    progress = progress or Silent()
    done: dict[int, Outcome] = {}
    for k, outcome in run_tasks(run_task, [(task,) for task in tasks], jobs):
        done[k] = outcome
        progress.update(len(done), len(tasks))
    return [done[k] for k in range(len(tasks))]


def run_task(task: Task) -> Outcome:
    """Run one system on one log and score what comes out."""
    room = _room(task)
    chosen = task.sources or room.sources
    if room.truth is None:
        return _without_truth(task, room, chosen)
    frames = [frame for frame in room.frames if frame.source in chosen]
    found, seconds = _fuse(task.entry, room, frames)
    scores = evaluate(found, room.truth, room.model)
    return Outcome(
        task.log.name,
        task.entry.name,
        chosen,
        1000 * seconds / max(len(frames), 1),
        scores,
        limb_variation=scores.limb_variation,
        jitter=scores.jitter,
        people=float(np.mean([frame.n_people for frame in found])) if found else 0.0,
    )


def _room(task: Task) -> _Room:
    key = (task.log, task.truth)
    if _CACHE.key != key or _CACHE.room is None:
        truth = find_truth(task.log, task.truth)
        with open_log(task.log, topics=fused_topics(task.log, task.truth) or None) as log:
            fixed = log.detections()
            frames = list(fixed)
            start = log.span[0]
            _CACHE.room = _Room(
                frames,
                log.model,
                camera_positions(log),
                log.fixed_frame,
                tuple(sorted({frame.source for frame in frames})),
                None if truth is None else truth.moved(start=start),
            )
        _CACHE.key = key
    return _CACHE.room


def _fuse(entry: Entry, room: _Room, frames: list[Frame]) -> tuple[list[Frame], float]:
    """Run the stages in memory; return the last one's frames and the CPU time, s."""
    if (entry.system, entry.stages) not in _CACHE.warm:
        # Some kernels are compiled or loaded when they are first called.
        _run_stages(entry, room, frames[:_WARM_UP])
        _CACHE.warm.add((entry.system, entry.stages))
    return _run_stages(entry, room, frames)


def _run_stages(entry: Entry, room: _Room, frames: list[Frame]) -> tuple[list[Frame], float]:
    config = load_config(None, entry.assignments, "default", entry.system)
    run = Run(
        room.model, config, Events(), LimbTable(), room.cameras, room.fixed_frame, entry.system
    )
    table = system(entry.system).stages(run)
    parts = [(Block.of(frame), 0) for frame in frames]
    # In blocks, as a run over a log has them.
    blocks = [join(parts[k : k + _TOGETHER]) for k in range(0, len(parts), _TOGETHER)]
    start = time.process_time()
    stream: Iterator[Block] = iter(blocks)
    for stage in chain_of(entry.system, entry.stages):
        stream = table[stage](stream)
    result = list(stream)
    seconds = time.process_time() - start
    return list(frames_of(result)), seconds


def _without_truth(task: Task, room: _Room, chosen: tuple[str, ...]) -> Outcome:
    config = load_config(None, task.entry.assignments, "default", task.entry.system)
    options = ProcessOptions(system=task.entry.system, stages=task.entry.stages)
    frames = [frame for frame in room.frames if frame.source in chosen]
    _, seconds = _fuse(task.entry, room, frames)
    scores = leave_one_out(task.log, config=config, options=options)
    medians = [camera.median for camera in scores.cameras]
    return Outcome(
        task.log.name,
        task.entry.name,
        chosen,
        1000 * seconds / max(len(frames), 1),
        distance=float(np.mean(medians)),
        limb_variation=scores.consistency.limb_variation,
        jitter=scores.consistency.jitter,
    )


def camera_subsets(task: Task) -> list[Task]:
    """Return the task once per subset of its log's cameras, the smallest first.

    Raises
    ------
    ConfigError
        The log has no truth to compare with.
    """
    room = _room(task)
    if room.truth is None:
        raise ConfigError(f"{task.log}: comparing numbers of cameras needs a truth")
    sizes = range(1, len(room.sources) + 1)
    subsets = [subset for size in sizes for subset in combinations(room.sources, size)]
    return [replace(task, sources=subset) for subset in subsets]


def by_number_of_cameras(outcomes: Sequence[Outcome]) -> dict[str, dict[int, tuple[float, float]]]:
    """System -> number of cameras -> error and SD, mm, each the mean over all subsets."""
    table: dict[str, dict[int, tuple[float, float]]] = {}
    for name in dict.fromkeys(o.name for o in outcomes):
        mine = [o for o in outcomes if o.name == name and o.scores is not None]
        for size in sorted({len(o.cameras) for o in mine}):
            each = [o.scores for o in mine if len(o.cameras) == size and o.scores is not None]
            table.setdefault(name, {})[size] = (
                float(np.nanmean([s.mean for s in each])),
                float(np.nanmean([s.deviation for s in each])),
            )
    return table


@dataclass(frozen=True, slots=True)
class Ordering:
    """An order that a paper reports, and whether it holds here."""

    text: str
    holds: bool
    detail: str


def check_orderings(outcomes: Sequence[Outcome]) -> Iterator[Ordering]:
    """Compare with the orders that Malaguti 2019 and Lee 2022 report, where the systems ran."""
    names = list(dict.fromkeys(o.name for o in outcomes))
    errors = {n: _mean(o.scores.mean for o in outcomes if o.name == n and o.scores) for n in names}
    upper = {
        n: _mean(
            o.scores.parts["upper limbs"].mean
            for o in outcomes
            if o.name == n and o.scores and "upper limbs" in o.scores.parts
        )
        for n in names
    }
    yield from _order(
        "Malaguti 2019, Table I: malaguti < raw < openptrack < maf",
        errors,
        ("malaguti", "raw", "openptrack", "maf"),
    )
    yield from _order(
        "Lee 2022, upper limbs: A5 <= A4 <= A3 <= A1",
        upper,
        ("lee-a5", "lee-a4", "lee-a3", "lee-a1"),
    )
    radii = {n: e for n, e in errors.items() if "cluster.radius=" in n}
    if len(radii) > 2:
        best = min(radii, key=lambda n: radii[n])
        yield Ordering(
            "Lee 2022, Table of radii: the least error is at 10 cm (+-5 cm)",
            any(best.endswith(f"cluster.radius={r}") for r in ("0.05", "0.1", "0.15")),
            ", ".join(f"{n.rpartition('=')[2]} m: {e:.1f} mm" for n, e in radii.items()),
        )


def camera_orderings(table: Mapping[str, Mapping[int, tuple[float, float]]]) -> Iterator[Ordering]:
    """Whether the error falls with every camera that is added (Malaguti Fig. 4, Lee TNOS)."""
    for name, sizes in table.items():
        errors = [error for _, (error, _) in sorted(sizes.items())]
        if len(errors) < 2:
            continue
        yield Ordering(
            f"{name}: the error falls with every camera added",
            all(a > b for a, b in pairwise(errors)),
            ", ".join(f"{n}: {e:.1f} mm" for n, e in zip(sorted(sizes), errors, strict=True)),
        )


def _order(text: str, values: Mapping[str, float], names: Sequence[str]) -> Iterator[Ordering]:
    if not set(names) <= set(values) or any(np.isnan(values[n]) for n in names):
        return
    mine = [values[n] for n in names]
    allowed = 0.0 if "<=" not in text else 0.05  # equal within what is printed
    holds = all(a <= b + allowed for a, b in pairwise(mine))
    detail = ", ".join(f"{n} {v:.1f} mm" for n, v in zip(names, mine, strict=True))
    yield Ordering(text, holds, detail)


def _mean(values: Iterator[float]) -> float:
    numbers = list(values)
    return float(np.mean(numbers)) if numbers else float("nan")
