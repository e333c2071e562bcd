"""Compares two processed logs channel by channel, and how they came about."""

from __future__ import annotations

import os
from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from hiros_mcap.errors import LogError
from hiros_mcap.evaluate.logs import has_outputs, output_channels, read_channel
from hiros_mcap.evaluate.match import skeleton_distances
from hiros_mcap.evaluate.mot import best_pairs
from hiros_mcap.io.channels import OUTPUT_PREFIX, PROVENANCE
from hiros_mcap.io.log import open_reader
from hiros_mcap.io.result import stored_parameters
from hiros_mcap.regression.quantities import (
    QUANTITIES,
    Pair,
    QuantityComparison,
    Tolerances,
    beside,
    most,
    worst,
)
from hiros_mcap.skeletons import UNTRACKED, Frame, SkeletonModel

SAME_PERSON = 0.3
"""m, mean joint distance: closer skeletons of two results are of the same person."""


@dataclass(frozen=True, slots=True)
class Difference:
    """Something that was, and is not any more."""

    where: str  # channel, or "configuration", "calibration", "metrics", ...
    what: str  # a parameter, a quantity, a metric
    was: str  # in the golden file
    now: str
    detail: str = ""

    def __str__(self) -> str:
        """One line."""
        detail = f" ({self.detail})" if self.detail else ""
        return f"{self.where}: {self.what}: was {self.was}, is {self.now}{detail}"


@dataclass(frozen=True, slots=True)
class Divergence:
    """The first frame in which two channels differ."""

    frame: int  # index in the golden channel
    stamp: int  # ns since the epoch
    seconds: float  # since the golden channel's first frame
    what: str  # the difference there: person, joint, by how much


@dataclass(slots=True)
class ChannelComparison:
    """A channel against its golden self."""

    topic: str
    frames: int = 0  # in the golden channel
    start: int = 0  # first stamp of the golden channel, ns
    skeletons: int = 0
    joints: tuple[str, str] | None = None
    """Markers and links that only the golden channel has, and only the new one, in words; None if
    both have the same ones."""
    missing_frames: int = 0
    extra_frames: int = 0
    frame_ids: Counter[tuple[str, str]] = field(default_factory=Counter)
    """(golden coordinate frame, another one) -> frames."""
    missing: Counter[int] = field(default_factory=Counter)
    """Golden person -> frames in which nobody is there instead."""
    extra: Counter[int] = field(default_factory=Counter)
    """New id -> frames in which the golden channel has nobody there."""
    renamed: Counter[tuple[int, int]] = field(default_factory=Counter)
    """(golden person, new id) -> frames in which the person has another id than usual."""
    seen: Counter[int] = field(default_factory=Counter)  # golden person -> frames
    quantities: dict[str, QuantityComparison] = field(default_factory=dict)
    """By name, in the order of :data:`hiros_mcap.regression.quantities.QUANTITIES`."""
    first: Divergence | None = None
    ids: dict[int, int] = field(default_factory=dict)
    """Golden person -> id now. Which ids people have does not matter."""

    def diverge(self, index: int, stamp: int, what: str) -> None:
        """Note a difference in a frame; only the first is kept."""
        if self.first is None or (stamp, index) < (self.first.stamp, self.first.frame):
            self.first = Divergence(index, stamp, (stamp - self.start) / 1e9, what)

    def differences(self, tolerances: Tolerances) -> list[Difference]:
        """Return what differs by more than is tolerated; empty if nothing does."""
        return [Difference(self.topic, *texts) for texts in self._texts(tolerances)]

    def _texts(self, tolerances: Tolerances) -> Iterator[Sequence[str]]:
        """Yield what differs, what was, what is, and a detail."""
        if self.missing_frames + self.extra_frames > tolerances.frames * self.frames:
            now = self.frames - self.missing_frames + self.extra_frames
            detail = f"{self.missing_frames} missing, {self.extra_frames} extra"
            yield "frames", str(self.frames), str(now), detail
        if self.joints is not None:
            yield "joints", *self.joints, "that only one has; numbers are not compared"
        for (frame, other), n in self.frame_ids.items():
            yield "coordinate frame", frame, other, f"in {n} frames"
        wrong = sum((self.missing + self.extra).values()) + sum(self.renamed.values())
        if wrong > tolerances.people * self.skeletons:
            for p, n in self.missing.items():
                yield f"person {p}", f"in {self.seen[p]} frames", f"missing in {n} of them"
            for i, n in self.extra.items():
                yield f"id {i}", "not there", f"in {n} frames"
            for (p, i), n in self.renamed.items():
                was = f"id {self.ids.get(p, '-')}"
                yield f"identity of person {p}", was, f"id {i}", f"in {n} frames"
        for compared in self.quantities.values():
            name, shown = compared.quantity.name, compared.quantity.shown
            if compared.vanished:
                yield name, "there", "absent", f"skeletons: {most(compared.vanished)}"
            if compared.appeared:
                yield name, "absent", "there", f"skeletons: {most(compared.appeared)}"
            if compared.largest > tolerances.of(compared.quantity):
                detail = (
                    f"{compared.place}; up to {shown(compared.largest)}, RMS {shown(compared.rms)};"
                    f" worst {worst(compared.worst, shown)}"
                )
                yield name, compared.was, compared.now, detail


@dataclass(slots=True)
class Comparison:
    """An output against its golden log."""

    channels: list[ChannelComparison]
    missing_channels: list[str] = field(default_factory=list)  # in the golden log only

    def differences(self, tolerances: Tolerances) -> dict[str, list[Difference]]:
        """Channel -> what differs; empty if nothing does."""
        by_channel = {c.topic: lines for c in self.channels if (lines := c.differences(tolerances))}
        for topic in self.missing_channels:
            by_channel[topic] = [Difference(topic, "channel", "there", "missing")]
        return by_channel


def compare_logs(
    output: str | os.PathLike[str],
    golden: str | os.PathLike[str],
    tolerances: Tolerances | None = None,
    *,
    log_times: bool = True,
) -> Comparison:
    """Compare every output channel of a golden log with the same channel of another log.

    Parameters
    ----------
    output, golden : logs that ``hiros process`` wrote; the golden one may be compact.
    tolerances : of the times that make two frames the same one, and of the first frame that
        differs; None = those beside the golden log.
    log_times : whether they are compared, too.

    Raises LogError if a log cannot be read, or the golden log holds no output channel.
    """
    tolerances = beside(Path(golden)) if tolerances is None else tolerances
    if not has_outputs(golden):
        fault = "is no golden log: it holds no results (for a truth, use `hiros eval --truth`)"
        raise LogError(fault, path=golden)
    topics = output_channels(golden)
    try:
        there = set(output_channels(output))
    except LogError:
        fault = f"holds no channel {OUTPUT_PREFIX}/*; there is nothing to compare"
        raise LogError(fault, path=output) from None
    both = [topic for topic in topics if topic in there]
    logs = output, golden
    channels = [_compare_channel(t, *logs, tolerances, log_times=log_times) for t in both]
    return Comparison(channels, [topic for topic in topics if topic not in there])


def _compare_channel(
    topic: str,
    output: str | os.PathLike[str],
    golden: str | os.PathLike[str],
    tolerances: Tolerances,
    *,
    log_times: bool,
) -> ChannelComparison:
    new, now, _ = read_channel(output, topic)
    old, model, _ = read_channel(golden, topic)
    if not log_times:
        new, old = ([replace(f, log_time=f.stamp) for f in frames] for frames in (new, old))
    if (now.marker_names, now.link_names) != (model.marker_names, model.link_names):
        joints = _beyond(model, now), _beyond(now, model)
        start = next((frame.stamp for frame in (*old, *new)), 0)
        result = ChannelComparison(topic, len(old), start, joints=joints)
        result.diverge(0, result.start, "it has other joints")
        return result
    return compare_frames(new, old, model, tolerances, topic)


def _beyond(model: SkeletonModel, other: SkeletonModel) -> str:
    """Return what only the first of two models has, in words."""
    markers = [name for name in model.marker_names if name not in other.marker_names]
    links = [f"link {name}" for name in model.link_names if name not in other.link_names]
    return ", ".join([*markers, *links]) or "none"


def compare_frames(
    new: Sequence[Frame],
    golden: Sequence[Frame],
    model: SkeletonModel,
    tolerances: Tolerances | None = None,
    topic: str = "",
) -> ChannelComparison:
    """Compare frames of one channel; people are matched by where they are, not by their ids."""
    tolerances = tolerances or Tolerances()
    start = golden[0].stamp if golden else new[0].stamp if new else 0
    result = ChannelComparison(topic, len(golden), start)
    pairs = _pair_frames(new, golden, round(tolerances.times * 1e9))
    common = [(new[n], golden[g]) for n, g in pairs if n is not None and g is not None]
    result.ids = _match_people(common)
    people: list[Pair] = []
    index = 0
    for n, g in pairs:
        index = index if g is None else g
        if n is None and g is not None:
            result.missing_frames += 1
            result.diverge(index, golden[g].stamp, "the frame is missing")
        elif g is None and n is not None:
            result.extra_frames += 1
            result.diverge(index, new[n].stamp, "an extra frame")
        elif n is not None and g is not None:
            people += _compare_people(result, index, new[n], golden[g])
    for quantity in QUANTITIES if people else ():
        compared = QuantityComparison.of(quantity, people, model, tolerances.of(quantity), start)
        result.quantities[quantity.name] = compared
        if compared.first is not None:
            pair, what = compared.first
            result.diverge(pair.index, pair.was.stamp, what)
    return result


def _pair_frames(
    new: Sequence[Frame], golden: Sequence[Frame], tolerance: int
) -> list[tuple[int | None, int | None]]:
    """Pair the indices of frames at the same time, by time; None where one side lacks it."""
    pairs: list[tuple[int | None, int | None]] = []
    n = g = 0
    while n < len(new) and g < len(golden):
        late = new[n].stamp - golden[g].stamp
        extra, missing = late < -tolerance, late > tolerance
        pairs.append((None if missing else n, None if extra else g))
        n, g = n + (not missing), g + (not extra)
    pairs += [(k, None) for k in range(n, len(new))]
    pairs += [(None, k) for k in range(g, len(golden))]
    return pairs


def _match_people(pairs: Sequence[tuple[Frame, Frame]]) -> dict[int, int]:
    """Golden person -> the id that is at the same place for most of the time."""
    closeness: defaultdict[tuple[int, int], float] = defaultdict(float)
    for new, old in pairs:
        distance = skeleton_distances(old.positions, new.positions)
        for g, person in enumerate(old.ids.tolist()):
            for n, ident in enumerate(new.ids.tolist()):
                if distance[g, n] < SAME_PERSON and UNTRACKED not in (person, ident):
                    closeness[person, ident] += 1 - float(distance[g, n]) / SAME_PERSON
    if not closeness:
        return {}
    people, ids = (sorted(set(names)) for names in zip(*closeness, strict=True))
    table = np.array([[closeness[p, i] for i in ids] for p in people])
    matched = best_pairs(np.where(table > 0, table.max(initial=0) - table, np.inf))
    return {people[row]: ids[column] for row, column in matched}


def _compare_people(
    result: ChannelComparison, index: int, new: Frame, old: Frame
) -> Iterator[Pair]:
    """Note whom two frames of the same time lack, and yield those whom both have."""
    if new.frame_id != old.frame_id:
        result.frame_ids[old.frame_id, new.frame_id] += 1
        result.diverge(index, old.stamp, f"the coordinate frame is {new.frame_id!r}")
    result.skeletons += old.n_people
    result.seen.update(old.ids.tolist())
    rows = _rows(new, old, result.ids)
    for g, row in enumerate(rows):
        person = int(old.ids[g])
        if row < 0:
            result.missing[person] += 1
            result.diverge(index, old.stamp, f"person {person} is missing")
            continue
        ident = int(new.ids[row])
        if ident != result.ids.get(person, person):
            result.renamed[person, ident] += 1
            result.diverge(index, old.stamp, f"person {person} is now id {ident}")
        yield Pair(index, old, g, new, row)
    for row in set(range(new.n_people)) - set(rows):
        ident = int(new.ids[row])
        result.extra[ident] += 1
        result.diverge(index, old.stamp, f"id {ident} is extra")


def _rows(new: Frame, old: Frame, ids: Mapping[int, int]) -> list[int]:
    """Row in ``new`` of every person of ``old``, -1 if there is none.

    First those who have the expected id, then those who are where the person was.
    """
    distance = skeleton_distances(old.positions, new.positions)
    # Of two skeletons without any marker, only the id is left to compare.
    somewhere = [(~np.isnan(f.positions)).any(axis=(1, 2)) for f in (old, new)]
    nowhere = ~np.logical_or.outer(*somewhere)
    distance[nowhere] = 0.0
    expected = np.array([ids.get(p, p) for p in old.ids.tolist()])
    same = expected[:, None] == new.ids[None]
    near = distance < SAME_PERSON
    rows = [-1] * old.n_people
    for allowed in (near & same, near & ~nowhere):
        free = ~np.isin(np.arange(new.n_people), rows)
        cost = np.where(allowed & free & (np.array(rows) < 0)[:, None], distance, np.inf)
        for g, n in best_pairs(cost):
            rows[g] = n
    return rows


_RUN = {
    "system": "system",
    "stages": "stages",
    "fixed_frame": "fixed frame",
    "topics": "topics",
    "extrinsics_sha256": "extrinsics file, SHA-256",
    "limbs_sha256": "limb lengths file, SHA-256",
    "version": "hiros version",
    "input_sha256": "input, SHA-256",
}
"""Key of the metadata -> what reports call it, in their order."""
_NONE = "none"


@dataclass(frozen=True, slots=True)
class Provenance:
    """Input, version and parameters of a result."""

    run: Mapping[str, str] = field(default_factory=dict)
    """Version, system, stages, hash of the input, ..., as the metadata have them."""
    parameters: Mapping[str, str] = field(default_factory=dict)
    """``stage.param`` -> its value as text; what is not set is left out."""

    def __bool__(self) -> bool:
        """Whether anything is known; golden files of former versions tell nothing."""
        return bool(self.run or self.parameters)

    @classmethod
    def of_log(cls, path: str | os.PathLike[str]) -> Provenance:
        """Read what a log that hiros wrote says; raises LogError if it is damaged."""
        with open_reader(path) as reader:
            run = dict(reader.contents.metadata).get(PROVENANCE, {})
            parameters = stored_parameters(reader)
        return cls({name: value for name, value in run.items() if name in _RUN}, parameters)


def changes(now: Provenance, was: Provenance) -> list[Difference]:
    """Return what changed, parameters first; nothing if the golden file does not tell."""
    if not was:
        return []
    if not now:
        return [Difference("run", "version and configuration", "known", _NONE)]
    names = dict.fromkeys([*was.parameters, *now.parameters])
    rows = [("configuration", k, was.parameters.get(k), now.parameters.get(k)) for k in names]
    rows += [("run", name, was.run.get(key), now.run.get(key)) for key, name in _RUN.items()]
    return [
        Difference(
            where, what, _NONE if before is None else before, _NONE if after is None else after
        )
        for where, what, before, after in rows
        if before != after
    ]
