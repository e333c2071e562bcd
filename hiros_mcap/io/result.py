"""Results of hiros as tables: one motion per person, and the parameters and events of the run.

::

    result = hiros_mcap.open_result("lab.hiros.mcap")
    result.joints().loc[0, "KNEE_LEFT"].plot()      # person 0
    result.angles()["left knee flexion"].groupby("person").max()
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from glob import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from pydantic import BaseModel

from hiros_mcap.body.anatomy import ANGLE_NAMES, anatomical_angles
from hiros_mcap.body.segments import LinkAxes, link_axes
from hiros_mcap.defaults import LEAST_CONFIDENCE
from hiros_mcap.errors import ConfigError, LogError
from hiros_mcap.events import Event, events_from_json
from hiros_mcap.io.bag_files import kind_of
from hiros_mcap.io.channels import (
    CONFIG_ATTACHMENT,
    EVENTS_ATTACHMENT,
    OUTPUT_TOPICS,
    REPORT_ATTACHMENT,
    TRUTH_PREFIX,
    channels_of,
    skeleton_channels,
)
from hiros_mcap.io.container import McapReader
from hiros_mcap.io.log import open_log, open_reader, span_of
from hiros_mcap.io.marker_uncertainty import UNCERTAIN_TOPIC, read_uncertainty
from hiros_mcap.outside import parse
from hiros_mcap.skeletons import Floats, SkeletonModel

if TYPE_CHECKING:
    import pandas as pd


GAP_S = 0.25
"""Pauses longer than this stay pauses when a motion is resampled."""
_MOST = 1_000_000
"""Instants, nine hours at 30 Hz. A wrong stamp would make more of a short log than memory holds."""


@dataclass(frozen=True, slots=True, eq=False)
class Motion:
    """One person over T instants; M markers, L links. NaN means absent."""

    person: int
    times: Floats
    """(T,) s from the log time of the first skeleton; the data may be a little older."""
    positions: Floats
    """(T, M, 3) m, in the fixed frame."""
    confidences: Floats
    """(T, M) 0..1."""
    orientations: Floats | None = None
    """(T, L, 4) x y z w of the links; None if the channel has none."""
    axes: LinkAxes = field(default_factory=dict)
    """How the segments lie in their links, measured on the whole motion."""
    deviations: Floats | None = None
    """(T, M) m, standard deviations along each axis; None if the result states none."""

    def __repr__(self) -> str:
        if not len(self.times):
            return f"<Motion person {self.person}: nothing>"
        span = f"{self.times[0]:.1f} to {self.times[-1]:.1f} s, {len(self.times)} instants"
        return f"<Motion person {self.person}: {span}, {self.positions.shape[1]} markers>"

    @property
    def rate(self) -> float:
        """Median number of instants per second; NaN for fewer than two."""
        return 1.0 / float(np.median(np.diff(self.times))) if len(self.times) > 1 else np.nan

    def between(self, start: float, end: float) -> Motion:
        """Return the instants from ``start`` to ``end``, s from the log's first skeleton."""
        inside = (self.times >= start) & (self.times <= end)
        names = ("times", "positions", "confidences", "orientations", "deviations")
        arrays = ((name, getattr(self, name)) for name in names)
        part: dict[str, Any] = {name: a[inside] for name, a in arrays if a is not None}
        return replace(self, **part)

    def at(self, times: Floats) -> Motion:
        """Interpolate by cubic splines to ``times``, s; NaN in pauses longer than GAP_S."""
        turns, sd = self.orientations, self.deviations
        return replace(
            self,
            times=times,
            positions=_interpolated_all(times, self.times, self.positions),
            confidences=np.clip(_interpolated_all(times, self.times, self.confidences), 0, 1),
            orientations=None if turns is None else _interpolated_turns(times, self.times, turns),
            deviations=None if sd is None else np.abs(_interpolated_all(times, self.times, sd)),
        )

    def trusted(self, least: float) -> Motion:
        """Return a gap for each marker whose confidence is below ``least``, and for its links.

        A marker without a confidence stays.
        """
        positions = self.positions.copy()
        positions[self.confidences < least] = np.nan
        return replace(self, positions=positions)


def _interpolated_all(times: Floats, samples: Floats, values: Floats) -> Floats:
    """(N, ...) each column of (T, ...) at N times."""
    flat = values.reshape(len(values), -1)
    columns = [_interpolated(times, samples, column) for column in flat.T]
    return np.stack(columns, axis=-1).reshape(len(times), *values.shape[1:])


def _interpolated_turns(times: Floats, samples: Floats, xyzw: Floats) -> Floats:
    """(N, L, 4) unit quaternions at N times: their components interpolated, made of length 1.

    q and -q are the same rotation; neighbours are given the same sign before.
    """
    turns = xyzw.copy()
    for link in range(turns.shape[1]):
        present = np.flatnonzero(~np.isnan(turns[:, link, 0]))
        steps = np.sum(turns[present[1:], link] * turns[present[:-1], link], axis=-1)
        turns[present[1:], link] *= np.cumprod(np.where(steps < 0, -1.0, 1.0))[:, None]
    xyzw_at = _interpolated_all(times, samples, turns)
    return np.asarray(xyzw_at / np.linalg.norm(xyzw_at, axis=-1, keepdims=True))


def _interpolated(times: Floats, samples: Floats, values: Floats) -> Floats:
    from scipy.interpolate import CubicSpline

    present = ~np.isnan(values)
    t, v = samples[present], values[present]
    if len(t) < 2:
        return np.full(len(times), np.nan)
    after = np.clip(np.searchsorted(t, times), 1, len(t) - 1)
    outside = (times < t[0]) | (times > t[-1])
    pause = (t[after] - t[after - 1] > GAP_S) & ~np.isin(times, t)
    return np.where(outside | pause, np.nan, CubicSpline(t, v)(times))


@dataclass(frozen=True, eq=False)
class Result:
    """A channel that hiros wrote; made by :func:`open_result`."""

    path: Path
    channel: str
    model: SkeletonModel
    fixed_frame: str
    start: int
    """ns since the epoch, from which times count: log time of the log's first detection. In a log
    without detections, stamp of the channel's first message."""
    motions: Mapping[int, Motion]
    """By the person's id, ids increasing."""
    happened: tuple[Event, ...] = ()

    def __repr__(self) -> str:
        people = f"{len(self.motions)} " + ("person" if len(self.motions) == 1 else "people")
        return (
            f"<Result {self.path.name} {self.channel}: {people}, "
            f"{self.seconds:.1f} s, {self.model.n_markers} markers>"
        )

    @property
    def people(self) -> tuple[int, ...]:
        """Ids, increasing."""
        return tuple(self.motions)

    @cached_property
    def seconds(self) -> float:
        """Time of the last instant, s from the start."""
        return max((float(m.times[-1]) for m in self.motions.values()), default=0.0)

    def select(
        self,
        person: int | None = None,
        start: float = -np.inf,
        end: float = np.inf,
        rate: float | None = None,
    ) -> Result:
        """Return a part: one person, some seconds, or instants at a fixed rate, Hz.

        Raises ConfigError if there is no such person, nobody in these seconds, the rate is not
        positive, or the instants have none.
        """
        if person is not None and person not in self.motions:
            raise ConfigError(f"no person {person} (there are: {_listed(self.people)})")
        chosen = self.motions if person is None else {person: self.motions[person]}
        cut = {p: m.between(start, end) for p, m in chosen.items()}
        cut = {p: m for p, m in cut.items() if len(m.times)}
        if not cut:
            raise ConfigError(f"{self.path}: there is nobody in {self.channel}{_part(start, end)}")
        if rate is not None:
            if not 0 < rate <= 1000:
                raise ConfigError(f"a rate of {rate:g} Hz is not above 0 and at most 1000")
            cut = {p: m.at(self._grid(m.times, rate)) for p, m in cut.items()}
        return replace(self, motions=cut)

    def _grid(self, times: Floats, rate: float) -> Floats:
        """Return times at a fixed rate; raises ConfigError if the instants have none."""
        if (np.diff(times) <= 0).any():
            raise ConfigError(
                f"{self.path}: {self.channel} shows a person twice at one time, as several cameras "
                "do, so it has no rate; choose another --channel"
            )
        n = (times[-1] - times[0]) * rate
        if n > max(_MOST, 100 * len(times)):
            raise ConfigError(
                f"{self.path}: {len(times)} instants in {times[-1] - times[0]:.3g} s would be "
                f"{n:.3g} at {rate:g} Hz; choose a part with --start and --end"
            )
        return grid(times, rate)

    def trusted(self, least: float) -> Result:
        """Return the result with a gap for each marker whose confidence is below ``least``."""
        motions = {person: motion.trusted(least) for person, motion in self.motions.items()}
        return replace(self, motions=motions)

    def joints(self, least_confidence: float = LEAST_CONFIDENCE) -> pd.DataFrame:
        """Marker positions, m: a row per person and time (s), columns (marker, x y z).

        NaN where a marker's confidence is below ``least_confidence``, as in exported files: hiros
        predicted it there, and nobody saw it. 0 gives them all.
        """
        import pandas as pd

        columns = pd.MultiIndex.from_product(
            [self.model.marker_names, ["x", "y", "z"]], names=["marker", "axis"]
        )
        rows = [
            m.positions.reshape(len(m.times), -1)
            for m in self.trusted(least_confidence).motions.values()
        ]
        return pd.DataFrame(_stacked(rows, len(columns)), self._index(), columns)

    def confidences(self) -> pd.DataFrame:
        """Confidences of the markers, 0 to 1: a row per person and time (s), columns by marker."""
        import pandas as pd

        rows = [m.confidences for m in self.motions.values()]
        columns = pd.Index(self.model.marker_names, name="marker")
        return pd.DataFrame(_stacked(rows, len(columns)), self._index(), columns)

    def angles(self, least_confidence: float = LEAST_CONFIDENCE) -> pd.DataFrame:
        """Signed joint angles, degrees: a row per person and time (s), columns by angle.

        NaN where an angle cannot be known, also because a marker's confidence is below
        ``least_confidence``. :mod:`hiros_mcap.body.anatomy` says what the angles mean.
        """
        import pandas as pd

        rows = [
            np.degrees(anatomical_angles(self.model, m.positions, m.orientations, m.axes))
            for m in self.trusted(least_confidence).motions.values()
        ]
        return pd.DataFrame(_stacked(rows, len(ANGLE_NAMES)), self._index(), list(ANGLE_NAMES))

    def events(self) -> pd.DataFrame:
        """Return what happened: time (s), kind, person (-1 = nobody), source and detail."""
        import pandas as pd

        rows = [
            ((e.stamp - self.start) * 1e-9, e.kind, e.person, e.source, e.detail)
            for e in self.happened
        ]
        return pd.DataFrame(rows, columns=["time", "kind", "person", "source", "detail"])

    def _index(self) -> pd.MultiIndex:
        import pandas as pd

        whose = [np.full(len(m.times), p) for p, m in self.motions.items()]
        when = [m.times for m in self.motions.values()]
        empty = [np.zeros(0)]
        return pd.MultiIndex.from_arrays(
            [np.concatenate(whose or empty), np.concatenate(when or empty)],
            names=["person", "time"],
        )


def _part(start: float, end: float) -> str:
    """Return the seconds in words; nothing if they are all."""
    if np.isfinite(end):
        return f" from {max(start, 0.0):g} to {end:g} s"
    return f" from {start:g} s on" if np.isfinite(start) else ""


def safe_name(name: str) -> str:
    r"""Return a name that is one cell of a table: no control characters, no formula.

    >>> safe_name("=HEAD\tX")
    '_HEAD_X'
    """
    plain = "".join(c if c.isprintable() else "_" for c in name)
    return re.sub(r"^[=+\-@]", "_", plain)


def grid(times: Floats, rate: float) -> Floats:
    """Return times at a fixed rate from the first to the last of ``times``, s."""
    return np.asarray(times[0] + np.arange(int((times[-1] - times[0]) * rate + 1e-6) + 1) / rate)


def open_result(path: str | os.PathLike[str], channel: str = "") -> Result:
    """Read what hiros wrote, or a truth.

    Parameters
    ----------
    path : a log that ``hiros process`` wrote, a golden log, or a log with a /truth channel.
    channel : topic of the skeletons; "" is the last stage, /hiros/filtered if it is there, or
        the truth of a log that holds nothing else.

    Raises
    ------
    LogError
        The file is damaged, or holds neither results nor a truth.
    ConfigError
        It has no such channel.
    """
    with open_reader(path) as reader:
        results, truths, detections = _hiros_channels(reader)
        if not (channel or results or (truths and not detections)):
            raise LogError("holds no results of hiros; run `hiros process` first", path=path)
        chosen = channel or [*truths[:1], *results][-1]
        topics = [info.topic for info in channels_of(reader)]
        if chosen not in topics:
            raise ConfigError(f"{path}: no channel {chosen!r} (there are: {_listed(topics)})")
        start, events = span_of(reader)[0], stored_events(reader)
        with open_log(reader, topics=[escape(chosen)], output_prefix="/none") as log:
            frames, model = list(log.frames()), log.model
        deviations = read_uncertainty(reader) if chosen == UNCERTAIN_TOPIC else {}
    if detections == 0 and frames:
        start = frames[0].stamp  # results are logged later than the data that they belong to
    rows: dict[int, list[_Row]] = {}
    for frame in frames:
        for k, person in frame.tracked():
            of_marker = deviations.get((frame.stamp, person), {})
            row = (
                frame.stamp,
                frame.positions[k],
                frame.marker_confidences[k],
                frame.orientations[k],
                np.array([of_marker.get(marker, np.nan) for marker in model.marker_ids]),
            )
            rows.setdefault(person, []).append(row)
    motions = {person: _motion(person, rows[person], start, model) for person in sorted(rows)}
    fixed = frames[0].frame_id if frames else ""
    return Result(Path(path), chosen, model, fixed, start, motions, events)


def content_of(path: str | os.PathLike[str]) -> Literal["result", "truth", ""]:
    """Return "result" for a file with channels that hiros wrote, "truth" for one of truths alone.

    "" for any other, if it cannot be read, and for bags that would have to be converted first.
    """
    if kind_of(Path(path)) and len(list(Path(path).glob("*.mcap"))) != 1:
        return ""
    try:
        with open_reader(path) as reader:
            results, truths, detections = _hiros_channels(reader)
    except LogError:
        return ""
    if results:
        return "result"
    return "truth" if truths and not detections else ""


def _hiros_channels(reader: McapReader) -> tuple[list[str], list[str], int]:
    """Return the topics of results and of truths, and how many other skeleton channels there are.

    Results are in the order of the stages, and may be without messages if no camera sent any. All
    others have messages.
    """
    skeletons = skeleton_channels(reader)
    topics = {info.topic for info in skeletons}
    results = [topic for topic in OUTPUT_TOPICS if topic in topics]
    others = sorted({info.topic for info in skeletons if info.count} - {*results})
    truths = [topic for topic in others if topic.startswith(f"{TRUTH_PREFIX}/")]
    return results, truths, len(others) - len(truths)


_Row = tuple[int, Floats, Floats, Floats, Floats]
"""One person at one instant: stamp, positions, confidences, orientations, deviations."""


def _motion(person: int, rows: Sequence[_Row], start: int, model: SkeletonModel) -> Motion:
    rows = sorted(rows, key=lambda row: row[0])
    columns = (np.stack(column) for column in zip(*rows, strict=True))
    stamps, positions, confidences, turns, deviations = columns
    seconds: Floats = (stamps.astype(np.int64) - start) / 1e9
    motion = Motion(person, seconds, positions, confidences)
    if not np.isnan(deviations).all():
        motion = replace(motion, deviations=deviations)
    if np.isnan(turns).all():
        return motion
    return replace(motion, orientations=turns, axes=link_axes(model, positions, turns))


def _stacked(rows: Sequence[Floats], columns: int) -> Floats:
    return np.concatenate(rows) if rows else np.zeros((0, columns))


def _listed(names: Sequence[object]) -> str:
    return ", ".join(map(str, names)) or "none"


def stored_parameters(reader: McapReader) -> dict[str, str]:
    """Return ``section.parameter`` -> its value as JSON; nothing if the file holds none.

    Raises ConfigError if they are not TOML.
    """
    text = (reader.attachment(CONFIG_ATTACHMENT) or b"").decode(errors="replace")
    return values_of(text, f"{reader.path}: {CONFIG_ATTACHMENT}")


def values_of(text: str, origin: str) -> dict[str, str]:
    """Read a configuration in TOML like :func:`stored_parameters`; ``origin`` names it."""
    return {
        f"{section}.{name}": json.dumps(value, default=str)
        for section, values in parse(text, "TOML", origin).items()
        if isinstance(values, Mapping)
        for name, value in values.items()
    }


def stored_events(reader: McapReader) -> tuple[Event, ...]:
    """Return what the stages did; nothing if the file does not tell. Raises LogError."""
    try:
        return tuple(events_from_json((reader.attachment(EVENTS_ATTACHMENT) or b"[]").decode()))
    except ValueError:
        raise LogError(f"attachment {EVENTS_ATTACHMENT} is damaged", path=reader.path) from None


class StoredReport(BaseModel):
    """Part of a run's summary that is read back, :class:`hiros_mcap.running.summary.Summary`."""

    warnings: tuple[str, ...] = ()


def stored_report(reader: McapReader) -> StoredReport:
    """Return the summary of the run, empty if the file holds none. Raises LogError."""
    try:
        return StoredReport.model_validate_json(reader.attachment(REPORT_ATTACHMENT) or b"{}")
    except ValueError:
        raise LogError(f"attachment {REPORT_ATTACHMENT} is damaged", path=reader.path) from None
