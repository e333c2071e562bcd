"""Compares two processed logs channel by channel."""

from __future__ import annotations

import os
from collections import Counter, defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from hiros_mcap.body.limb_table import LimbTable
from hiros_mcap.body.rotations import angle
from hiros_mcap.errors import ConfigError, LogError
from hiros_mcap.evaluate.logs import output_channels, read_channel
from hiros_mcap.evaluate.pairing import best_pairs, skeleton_distances
from hiros_mcap.io.channels import LIMBS_ATTACHMENT, OUTPUT_PREFIX
from hiros_mcap.io.container import McapReader
from hiros_mcap.regression.tolerances import Tolerances, beside
from hiros_mcap.skeletons import UNTRACKED, Floats, Frame, SkeletonModel

SAME_PERSON = 0.3
"""m, mean joint distance: closer skeletons of two results are of the same person."""
_SHOWN = 5


@dataclass(frozen=True, slots=True)
class Divergence:
    """The first frame in which two channels differ."""

    frame: int
    """Index in the golden channel."""
    stamp: int
    """ns since the epoch."""
    seconds: float
    """Since the golden channel's first frame."""
    what: str
    """What differs there: person, joint, by how much."""


@dataclass(slots=True)
class ChannelComparison:
    """A channel against its golden self. Lengths in m, angles in degrees."""

    topic: str
    frames: int = 0
    """In the golden channel."""
    skeletons: int = 0
    missing_frames: int = 0
    extra_frames: int = 0
    missing: Counter[int] = field(default_factory=Counter)
    """Golden person -> frames in which nobody is there instead."""
    extra: Counter[int] = field(default_factory=Counter)
    """New id -> frames in which the golden channel has nobody there."""
    renamed: Counter[tuple[int, int]] = field(default_factory=Counter)
    """(golden person, new id) -> frames in which the person has another id than usual."""
    vanished: Counter[str] = field(default_factory=Counter)
    """Joint or link -> frames in which it is absent now."""
    appeared: Counter[str] = field(default_factory=Counter)
    """Joint or link -> frames in which it was absent before."""
    position_max: float = 0.0
    position_rms: float = 0.0
    joints: dict[str, float] = field(default_factory=dict)
    """Joint -> largest distance."""
    orientation_max: float = 0.0
    links: dict[str, float] = field(default_factory=dict)
    """Link -> largest angle."""
    first: Divergence | None = None
    ids: dict[int, int] = field(default_factory=dict)
    """Golden person -> id now. Which ids people have does not matter."""

    def faults(self, tolerances: Tolerances) -> list[str]:
        """Say what differs by more than is tolerated, one line each; empty if nothing does."""
        lines = []
        if self.missing_frames + self.extra_frames > tolerances.frames * self.frames:
            lines.append(
                f"frames: {self.missing_frames} missing, {self.extra_frames} extra of {self.frames}"
            )
        wrong = sum((self.missing + self.extra).values()) + sum(self.renamed.values())
        if wrong > tolerances.people * self.skeletons:
            lines += self._people()
        lines += self._absent()
        if self.position_max > tolerances.positions:
            lines.append(
                f"positions: up to {_mm(self.position_max)}, RMS {_mm(self.position_rms)}; "
                f"worst {_worst(self.joints, _mm)}"
            )
        if self.orientation_max > tolerances.orientations:
            worst = _worst(self.links, _deg)
            lines.append(f"orientations: up to {_deg(self.orientation_max)}; worst {worst}")
        return lines

    def _people(self) -> list[str]:
        lines = [f"people: person {p} is missing in {n} frames" for p, n in self.missing.items()]
        lines += [f"people: id {i} is extra in {n} frames" for i, n in self.extra.items()]
        lines += [
            f"identity: person {p}, otherwise id {self.ids.get(p, '-')}, is id {i} in {n} frames"
            for (p, i), n in self.renamed.items()
        ]
        return lines

    def _absent(self) -> list[str]:
        return [
            f"joints: {what} in some frames: {_most(counts)}"
            for what, counts in (("absent", self.vanished), ("new", self.appeared))
            if counts
        ]


@dataclass(slots=True)
class Comparison:
    """An output against its golden log."""

    channels: list[ChannelComparison]
    missing_channels: list[str] = field(default_factory=list)
    """In the golden log only."""
    lengths: dict[tuple[int, str], float] = field(default_factory=dict)
    """(golden person, link) -> difference of the calibrated lengths, m; inf if one has none."""

    def faults(self, tolerances: Tolerances) -> dict[str, list[str]]:
        """Channel (or "calibration") -> what differs; empty if nothing does."""
        found = {c.topic: lines for c in self.channels if (lines := c.faults(tolerances))}
        found.update({topic: ["the channel is missing"] for topic in self.missing_channels})
        wrong = {key: d for key, d in self.lengths.items() if d > tolerances.lengths}
        if wrong:
            (person, link), worst = max(wrong.items(), key=lambda item: item[1])
            off = "calibrated in one log only" if np.isinf(worst) else f"off by {_mm(worst)}"
            found["calibration"] = [
                f"lengths: {len(wrong)} limbs differ; worst {link} of person {person}: {off}"
            ]
        return found


def compare_logs(
    output: str | os.PathLike[str],
    golden: str | os.PathLike[str],
    tolerances: Tolerances | None = None,
) -> Comparison:
    """Compare every output channel of a golden log with the same channel of another log.

    Parameters
    ----------
    output, golden : logs that ``hiros process`` wrote; the golden one may be compact.
    tolerances : of the times that make two frames the same one, and of the first frame that
        differs; None = those beside the golden log.

    Raises
    ------
    LogError
        A log cannot be read, or the golden log holds no output channel.
    ConfigError
        The skeleton models differ: there is nothing to compare.
    """
    tolerances = beside(Path(golden)) if tolerances is None else tolerances
    topics = output_channels(golden)
    try:
        there = set(output_channels(output))
    except LogError:
        there = set()
    comparison = Comparison([], [topic for topic in topics if topic not in there])
    if not there:
        fault = f"holds no channel {OUTPUT_PREFIX}/*; there is nothing to compare"
        raise LogError(fault, path=output)
    for topic in topics:
        if topic in there:
            comparison.channels.append(_compare_channel(topic, output, golden, tolerances))
    ids = {k: v for channel in comparison.channels for k, v in channel.ids.items()}
    comparison.lengths = compare_limbs(limbs_of(output), limbs_of(golden), ids)
    return comparison


def _compare_channel(
    topic: str,
    output: str | os.PathLike[str],
    golden: str | os.PathLike[str],
    tolerances: Tolerances,
) -> ChannelComparison:
    new, model, _ = read_channel(output, topic)
    old, golden_model, _ = read_channel(golden, topic)
    if (fault := _model_fault(model, golden_model)) and new and old:
        raise ConfigError(f"{output}: {topic}: cannot be compared with {golden}: {fault}")
    return compare_frames(new, old, golden_model, tolerances, topic)


def _model_fault(new: SkeletonModel, old: SkeletonModel) -> str:
    for what, a, b in (
        ("markers", new.marker_names, old.marker_names),
        ("links", new.link_names, old.link_names),
    ):
        if a != b:
            return f"{what} {', '.join(a[:_SHOWN])}, ... against {', '.join(b[:_SHOWN])}, ..."
    return ""


def compare_frames(
    new: Sequence[Frame],
    golden: Sequence[Frame],
    model: SkeletonModel,
    tolerances: Tolerances | None = None,
    topic: str = "",
) -> ChannelComparison:
    """Compare frames of one channel; people are matched by where they are, not by their ids."""
    tolerances = tolerances or Tolerances()
    result = ChannelComparison(topic, frames=len(golden))
    pairs = _pair_frames(new, golden, round(tolerances.times * 1e9))
    common = [(new[n], golden[g]) for n, g in pairs if n is not None and g is not None]
    result.ids = _match_people(common)
    start = golden[0].stamp if golden else None
    collector = _DifferenceCollector(model, tolerances, result, start)
    index = 0
    for n, g in pairs:
        index = index if g is None else g
        if n is None and g is not None:
            result.missing_frames += 1
            collector.diverge(index, golden[g], "the frame is missing")
        elif g is None and n is not None:
            result.extra_frames += 1
            collector.diverge(index, new[n], "an extra frame")
        elif n is not None and g is not None:
            collector.add(index, new[n], golden[g])
    collector.finish()
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
    people = sorted({p for p, _ in closeness})
    ids = sorted({i for _, i in closeness})
    table = np.array([[closeness[p, i] for i in ids] for p in people]).reshape(
        len(people), len(ids)
    )
    matched = best_pairs(np.where(table > 0, table.max(initial=0) - table, np.inf))
    return {people[row]: ids[column] for row, column in matched}


class _DifferenceCollector:
    """Collects the differences of one channel, frame by frame."""

    def __init__(
        self,
        model: SkeletonModel,
        tolerances: Tolerances,
        result: ChannelComparison,
        start: int | None,
    ) -> None:
        self.model = model
        self.links = tuple(f"link {name}" for name in model.link_names)
        self.tolerances = tolerances
        self.result = result
        self.start = start
        self._distances: list[Floats] = []
        self._angles: list[Floats] = []

    def diverge(self, index: int, frame: Frame, what: str) -> None:
        """Note a difference; only the first is kept."""
        if self.result.first is None:
            start = frame.stamp if self.start is None else self.start
            seconds = (frame.stamp - start) / 1e9
            self.result.first = Divergence(index, frame.stamp, seconds, what)

    def add(self, index: int, new: Frame, old: Frame) -> None:
        """Compare two frames of the same time."""
        rows = {ident: k for k, ident in enumerate(new.ids.tolist())}
        compared = set()
        distance = skeleton_distances(old.positions, new.positions)
        for g, person in enumerate(old.ids.tolist()):
            self.result.skeletons += 1
            row = rows.get(self.result.ids.get(person, UNTRACKED), -1)
            if row < 0 or distance[g, row] >= SAME_PERSON:
                row = self._find_elsewhere(index, old, person, distance[g], new)
            if row >= 0:
                compared.add(row)
                self._compare_skeletons(index, old, g, new, row)
        for row, ident in enumerate(new.ids.tolist()):
            if row not in compared:
                self.result.extra[ident] += 1
                self.diverge(index, old, f"id {ident} is extra")

    def _find_elsewhere(
        self, index: int, old: Frame, person: int, distance: Floats, new: Frame
    ) -> int:
        """Row of the skeleton where the person was, under another id; -1 if there is none."""
        row = int(np.argmin(distance)) if len(distance) else -1
        if row < 0 or distance[row] >= SAME_PERSON:
            self.result.missing[person] += 1
            self.diverge(index, old, f"person {person} is missing")
            return -1
        ident = int(new.ids[row])
        self.result.renamed[person, ident] += 1
        self.diverge(index, old, f"person {person} is now id {ident}")
        return row

    def _compare_skeletons(self, index: int, old: Frame, g: int, new: Frame, n: int) -> None:
        of = f"of person {int(old.ids[g])}"
        distance = np.linalg.norm(new.positions[n] - old.positions[g], axis=-1)
        degrees = np.degrees(angle(old.orientations[g], new.orientations[n]))
        for names, was, now in (
            (self.model.marker_names, old.positions[g], new.positions[n]),
            (self.links, old.orientations[g], new.orientations[n]),
        ):
            before, after = ~np.isnan(was[:, 0]), ~np.isnan(now[:, 0])
            for counts, mask, what in (
                (self.result.vanished, before & ~after, "is absent"),
                (self.result.appeared, after & ~before, "is new"),
            ):
                for k in np.nonzero(mask)[0]:
                    counts[names[k]] += 1
                    self.diverge(index, old, f"{names[k]} {of} {what}")
        if (distance > self.tolerances.positions).any():
            worst = int(np.nanargmax(distance))
            name, off = self.model.marker_names[worst], _mm(distance[worst])
            self.diverge(index, old, f"{name} {of} is off by {off}")
        if (degrees > self.tolerances.orientations).any():
            worst = int(np.nanargmax(degrees))
            self.diverge(index, old, f"{self.links[worst]} {of} is off by {_deg(degrees[worst])}")
        self._distances.append(distance)
        self._angles.append(degrees)

    def finish(self) -> None:
        """Sum up."""
        if not self._distances:
            return
        distances, result = np.stack(self._distances), self.result
        known = distances[~np.isnan(distances)]
        if known.size:
            result.position_max = float(known.max())
            result.position_rms = float(np.sqrt((known * known).mean()))
        result.joints = _largest(self.model.marker_names, distances)
        result.links = _largest(self.model.link_names, np.stack(self._angles))
        result.orientation_max = max(result.links.values(), default=0.0)


def _largest(names: Sequence[str], table: Floats) -> dict[str, float]:
    """Name -> largest number of its column; columns without any are left out."""
    known = np.nonzero(~np.isnan(table).all(axis=0))[0].tolist()
    return {names[k]: float(np.nanmax(table[:, k])) for k in known}


def limbs_of(path: str | os.PathLike[str]) -> LimbTable:
    """Limb lengths that a log carries as an attachment; empty if it has none."""
    with McapReader(path) as reader:
        text = (reader.attachment(LIMBS_ATTACHMENT) or b"").decode()
        return LimbTable.from_toml(text, str(path)) if text else LimbTable()


def compare_limbs(
    new: LimbTable, golden: LimbTable, ids: Mapping[int, int]
) -> dict[tuple[int, str], float]:
    """Difference of the lengths of every link of a golden person that either log has calibrated.

    A golden log without any calibration expects none.
    """
    differences: dict[tuple[int, str], float] = {}
    for person, limbs in golden.people.items():
        others = new.people.get(ids.get(person, person), {})
        for link in {**limbs, **others}:
            was, now = limbs.get(link), others.get(link)
            difference = np.inf if was is None or now is None else abs(now.length - was.length)
            differences[person, link] = difference
    return differences


def _mm(metres: float) -> str:
    return f"{1000 * metres:.4g} mm"


def _deg(degrees: float) -> str:
    return f"{degrees:.4g} deg"


def _worst(values: Mapping[str, float], unit: Callable[[float], str]) -> str:
    ordered = sorted(values.items(), key=lambda item: -item[1])[:_SHOWN]
    return ", ".join(f"{name} {unit(value)}" for name, value in ordered)


def _most(counts: Counter[str]) -> str:
    rest = f" and {len(counts) - _SHOWN} more" if len(counts) > _SHOWN else ""
    return ", ".join(f"{name} ({n})" for name, n in counts.most_common(_SHOWN)) + rest
