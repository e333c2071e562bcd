"""Two processed logs, channel by channel, in the words of the field."""

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
from hiros_mcap.io.channels import OUTPUT_PREFIX
from hiros_mcap.io.container import McapReader
from hiros_mcap.kernels.assignment import assign
from hiros_mcap.regression.tolerances import Tolerances, beside
from hiros_mcap.running.pipeline import LIMBS_ATTACHMENT
from hiros_mcap.skeletons import UNTRACKED, Floats, Frame, SkeletonModel

SAME_BODY = 0.3
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
    """(golden person, new id) -> frames in which the body goes by another id than usual."""
    vanished: Counter[str] = field(default_factory=Counter)
    """Joint -> frames in which it is absent now."""
    appeared: Counter[str] = field(default_factory=Counter)
    """Joint -> frames in which it was absent before."""
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
        strange = sum((self.missing + self.extra).values()) + sum(self.renamed.values())
        if strange > tolerances.people * self.skeletons:
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
    tolerances : how far apart frames may be to be the same one, and from what on a frame counts
        as the first that diverges; None = those beside the golden log.

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
        fault = f"holds no channel {OUTPUT_PREFIX}/*, so there is nothing to compare"
        raise LogError(fault, path=output)
    for topic in topics:
        if topic in there:
            comparison.channels.append(_compare_channel(topic, output, golden, tolerances))
    ids = {k: v for channel in comparison.channels for k, v in channel.ids.items()}
    comparison.lengths = _compare_limbs(limbs_of(output), limbs_of(golden), ids)
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
    common = [(n, g) for n, g in pairs if n is not None and g is not None]
    result.ids = _match_people([(new[n], golden[g]) for n, g in common])
    tally = _Tally(model, tolerances, result)
    for n, g in pairs:
        if n is None or g is None:
            result.missing_frames += n is None
            result.extra_frames += g is None
            if g is not None:
                tally.diverge(g, golden[g], "the frame is missing")
            elif n is not None:
                tally.diverge(_index_before(golden, new[n].stamp), new[n], "an extra frame")
        else:
            tally.add(g, new[n], golden[g])
    tally.finish(golden)
    return result


def _pair_frames(
    new: Sequence[Frame], golden: Sequence[Frame], tolerance: int
) -> list[tuple[int | None, int | None]]:
    """Pair the indices of frames at the same time, by time; None where one side lacks it."""
    pairs: list[tuple[int | None, int | None]] = []
    n = g = 0
    while n < len(new) or g < len(golden):
        if n < len(new) and g < len(golden):
            apart = new[n].stamp - golden[g].stamp
        else:
            apart = -1 if n < len(new) else 1
            if abs(apart) <= tolerance:
                apart *= tolerance + 1
        if abs(apart) <= tolerance:
            pairs.append((n, g))
            n, g = n + 1, g + 1
        elif apart < 0:
            pairs.append((n, None))
            n += 1
        else:
            pairs.append((None, g))
            g += 1
    return pairs


def _index_before(golden: Sequence[Frame], stamp: int) -> int:
    return max(0, sum(frame.stamp <= stamp for frame in golden) - 1)


def _match_people(pairs: Sequence[tuple[Frame, Frame]]) -> dict[int, int]:
    """Golden person -> the id that is at the same place for most of the time."""
    closeness: defaultdict[tuple[int, int], float] = defaultdict(float)
    for new, old in pairs:
        distance = _mean_distances(old, new)
        for g, person in enumerate(old.ids.tolist()):
            for n, name in enumerate(new.ids.tolist()):
                if distance[g, n] < SAME_BODY and UNTRACKED not in (person, name):
                    closeness[person, name] += 1 - float(distance[g, n]) / SAME_BODY
    people = sorted({p for p, _ in closeness})
    names = sorted({i for _, i in closeness})
    if not people:
        return {}
    table = np.array([[closeness[p, i] for i in names] for p in people])
    cost = np.where(table > 0, table.max() - table, np.inf)
    rows = assign(np.ascontiguousarray(cost)).tolist()
    return {people[row]: names[k] for k, row in enumerate(rows) if row >= 0}


def _mean_distances(a: Frame, b: Frame) -> Floats:
    each = np.linalg.norm(a.positions[:, None] - b.positions[None], axis=-1)
    known = ~np.isnan(each)
    total = np.where(known, each, 0.0).sum(axis=-1)
    return np.where(known.any(axis=-1), total / np.maximum(known.sum(axis=-1), 1), np.inf)


class _Tally:
    """Collects the differences of one channel, frame by frame."""

    def __init__(
        self, model: SkeletonModel, tolerances: Tolerances, result: ChannelComparison
    ) -> None:
        self.model = model
        self.tolerances = tolerances
        self.result = result
        self._distances: list[Floats] = []
        self._angles: list[Floats] = []
        self._first: tuple[int, Frame, str] | None = None

    def diverge(self, index: int, frame: Frame, what: str) -> None:
        """Note a difference; only the first is kept."""
        if self._first is None:
            self._first = (index, frame, what)

    def add(self, index: int, new: Frame, old: Frame) -> None:
        """Compare two frames of the same time."""
        rows = {name: k for k, name in enumerate(new.ids.tolist())}
        taken = set()
        distance = _mean_distances(old, new)
        for g, person in enumerate(old.ids.tolist()):
            self.result.skeletons += 1
            row = rows.get(self.result.ids.get(person, UNTRACKED), -1)
            if row < 0 or distance[g, row] >= SAME_BODY:
                row = self._find_elsewhere(index, old, person, distance[g], new)
            if row >= 0:
                taken.add(row)
                self._compare_bodies(index, old, g, new, row)
        for row, name in enumerate(new.ids.tolist()):
            if row not in taken:
                self.result.extra[name] += 1
                self.diverge(index, old, f"id {name} is extra")

    def _find_elsewhere(
        self, index: int, old: Frame, person: int, distance: Floats, new: Frame
    ) -> int:
        """Row of the body that is where the person was, under another id; -1 if there is none."""
        row = int(np.argmin(distance)) if len(distance) else -1
        if row < 0 or distance[row] >= SAME_BODY:
            self.result.missing[person] += 1
            self.diverge(index, old, f"person {person} is missing")
            return -1
        name = int(new.ids[row])
        self.result.renamed[person, name] += 1
        self.diverge(index, old, f"person {person} is now id {name}")
        return row

    def _compare_bodies(self, index: int, old: Frame, g: int, new: Frame, n: int) -> None:
        person, names = int(old.ids[g]), self.model.marker_names
        was, now = old.positions[g], new.positions[n]
        gone = ~np.isnan(was[:, 0]) & np.isnan(now[:, 0])
        came = np.isnan(was[:, 0]) & ~np.isnan(now[:, 0])
        for counts, mask, what in (
            (self.result.vanished, gone, "is absent"),
            (self.result.appeared, came, "is new"),
        ):
            for k in np.nonzero(mask)[0]:
                counts[names[k]] += 1
                self.diverge(index, old, f"{names[k]} of person {person} {what}")
        distance = np.linalg.norm(now - was, axis=-1)
        self._distances.append(distance)
        if (distance > self.tolerances.positions).any():
            worst = int(np.nanargmax(distance))
            self.diverge(
                index, old, f"{names[worst]} of person {person} is off by {_mm(distance[worst])}"
            )
        turn = np.degrees(angle(old.orientations[g], new.orientations[n]))
        self._angles.append(turn)
        if (turn > self.tolerances.orientations).any():
            worst = int(np.nanargmax(turn))
            name = self.model.link_names[worst]
            self.diverge(
                index, old, f"link {name} of person {person} is turned by {_deg(turn[worst])}"
            )

    def finish(self, golden: Sequence[Frame]) -> None:
        """Sum up."""
        if self._distances:
            table = np.stack(self._distances)
            known = table[~np.isnan(table)]
            if known.size:
                self.result.position_max = float(known.max())
                self.result.position_rms = float(np.sqrt((known * known).mean()))
            self.result.joints = _largest(self.model.marker_names, table)
            turns = np.stack(self._angles)
            self.result.links = _largest(self.model.link_names, turns)
            self.result.orientation_max = max(self.result.links.values(), default=0.0)
        if self._first is not None:
            index, frame, what = self._first
            start = golden[0].stamp if golden else frame.stamp
            seconds = (frame.stamp - start) / 1e9
            self.result.first = Divergence(index, frame.stamp, seconds, what)


def _largest(names: Sequence[str], table: Floats) -> dict[str, float]:
    """Name -> largest number of its column; columns without any are left out."""
    known = np.nonzero(~np.isnan(table).all(axis=0))[0].tolist()
    return {names[k]: float(np.nanmax(table[:, k])) for k in known}


def limbs_of(path: str | os.PathLike[str]) -> LimbTable:
    """Limb lengths that a log carries as an attachment; empty if it has none."""
    with McapReader(path) as reader:
        for attachment in reader.contents.attachments:
            if attachment.name == LIMBS_ATTACHMENT:
                return LimbTable.from_toml(reader.attachment(attachment).decode(), str(path))
    return LimbTable()


def _compare_limbs(
    new: LimbTable, golden: LimbTable, ids: Mapping[int, int]
) -> dict[tuple[int, str], float]:
    """Differences of the lengths of every person and link that either has calibrated."""
    differences: dict[tuple[int, str], float] = {}
    if not golden.people:
        return differences
    for person, limbs in golden.people.items():
        other = new.people.get(ids.get(person, person), {})
        for link, limb in limbs.items():
            now = other.get(link)
            differences[person, link] = np.inf if now is None else abs(now.length - limb.length)
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
