"""One Kalman filter per person, updated by every camera's message (Malaguti 2019, III-B to III-D).

Nothing is buffered: each message moves its people at once, whenever it comes. A detection weighs
by its confidence, and less if it jumps farther than the joint has lately moved.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping

import numpy as np
from pydantic import Field

from hiros_mcap.events import Events
from hiros_mcap.params import Params
from hiros_mcap.skeletons import (
    POSITION,
    UNTRACKED,
    VELOCITY,
    Floats,
    Frame,
    SkeletonModel,
)


class KalmanParams(Params):
    """Parameters of the filter of all joints."""

    measurement_noise: float = Field(
        0.03,
        gt=0,
        description="m, sigma_r: SD per axis of a detected joint. `hiros calibrate` measures it on "
        "a log of people who stand still (III-B).",
    )
    process_noise: float = Field(
        8.0,
        gt=0,
        description="m/s2, sigma_q: SD per axis of a joint's acceleration over 1/30 s. Tuned by "
        "hand in the paper, not given; least error on simulated walks and gestures.",
    )
    step: float = Field(
        0.0,
        ge=0,
        description="s: predict in whole steps of this length (the paper: 0.033); 0 = exactly to "
        "each message's time, which cameras without a common clock need.",
    )
    use_confidence: bool = Field(True, description="Divide sigma_r^2 by the confidence (eq 8).")
    min_confidence: float = Field(
        0.5,
        ge=0,
        le=1,
        description="A joint below this is not used, the prediction stands in (III-C).",
    )
    history: int = Field(
        15,
        ge=0,
        description="N of eq 9: distances that the threshold of outliers is taken from; 0 = "
        "nothing is an outlier.",
    )
    outlier_factor: float = Field(1.25, ge=1, description="w of eq 9.")
    max_outliers: int = Field(
        2, ge=0, description="o_max: after so many outliers in a row the next one is believed."
    )
    range_noise: float = Field(
        0.0,
        ge=0,
        description="1/m: adds (this x distance^2)^2 to sigma_r^2, as OpenPTrack does for a "
        "camera's distance in m (there 0.0026).",
    )
    max_gap: float = Field(
        1.0, gt=0, description="s after which a person's filter starts anew (not in the paper)."
    )
    hold: float = Field(
        0.2,
        ge=0,
        description="s for which somebody whom other cameras' messages do not show is carried on "
        "in the output.",
    )
    rate: float = Field(
        0.0,
        ge=0,
        description="Hz: output at this rate, predicted to its times; 0 = at every message.",
    )


class _Filters:
    """The filters of all people: rows of arrays."""

    def __init__(self, model: SkeletonModel, params: KalmanParams) -> None:
        from hiros_mcap.kernels import kalman as kernels

        self._kernels = kernels
        self._params = params
        self._shape = model.n_markers
        self.rows: dict[int, int] = {}
        self.stamps: dict[int, int] = {}
        self.seen: dict[int, int] = {}
        self._free: list[int] = []
        m, n = model.n_markers, params.history
        self.states = np.zeros((0, m, kernels.STATE))
        self.known = np.zeros((0, m), np.bool_)
        self._history = np.zeros((0, m, n))
        self._filled = np.zeros((0, m), np.int64)
        self._strikes = np.zeros((0, m), np.int64)
        self._numbers = np.array([
            params.measurement_noise**2, params.process_noise**2, params.step,
            params.min_confidence, params.outlier_factor, params.max_outliers,
            params.use_confidence,
        ], np.float64)  # fmt: skip

    def row(self, person: int, stamp: int) -> int:
        """Row of a person, predicted to ``stamp``; a new one if they were long away."""
        if person in self.rows and stamp - self.seen[person] > self._params.max_gap * 1e9:
            self.forget(person)
        if person not in self.rows:
            self.rows[person] = self._new_row()
            self.stamps[person] = stamp
        row = self.rows[person]
        dt = (stamp - self.stamps[person]) * 1e-9
        if dt > 0:
            self._kernels.predict(
                self.states, self.known, row, dt, self._numbers[1], self._params.step
            )
            self.stamps[person] = stamp
        return row

    def correct(self, person: int, stamp: int, frame: Frame, index: int, extra: float) -> int:
        """Update a person with a detection; return the number of outliers."""
        row = self.row(person, stamp)
        self.seen[person] = stamp
        return int(
            self._kernels.correct(
                self.states, self.known, self._history, self._filled, self._strikes, row,
                np.ascontiguousarray(frame.positions[index]), frame.marker_confidences[index],
                extra, self._numbers,
            )
        )  # fmt: skip

    def at(self, person: int, stamp: int) -> tuple[Floats, Floats]:
        """(M, 3) positions and velocities of a person, carried on to ``stamp``; NaN if unknown."""
        row = self.rows[person]
        state, unknown = self.states[row], ~self.known[row]
        dt = (stamp - self.stamps[person]) * 1e-9
        positions, velocities = state[:, :3] + dt * state[:, 3:6], state[:, 3:6].copy()
        positions[unknown] = velocities[unknown] = np.nan
        return positions, velocities

    def forget(self, person: int) -> None:
        """Free a person's row."""
        self._free.append(self.rows.pop(person))
        del self.stamps[person], self.seen[person]

    def _new_row(self) -> int:
        if not self._free:
            size = len(self.states)
            for name in ("states", "known", "_history", "_filled", "_strikes"):
                old = getattr(self, name)
                bigger = np.zeros((max(8, 2 * size), *old.shape[1:]), old.dtype)
                bigger[:size] = old
                setattr(self, name, bigger)
            self._free = list(range(len(self.states) - 1, size - 1, -1))
        row = self._free.pop()
        self.known[row] = False
        self._history[row] = 0
        return row


def kalman(
    frames: Iterable[Frame],
    model: SkeletonModel,
    params: KalmanParams | None = None,
    events: Events | None = None,
    fixed_frame: str = "",
    cameras: Mapping[str, Floats] | None = None,
) -> Iterator[Frame]:
    """Fuse tracked detections, one message at a time (Malaguti 2019, III-B to III-D).

    Parameters
    ----------
    frames : with ids, in the fixed frame, in the order of their times. A frame that is older than
        the one before is counted and left out.
    model : of the frames. params, events : parameters; where counts go.
    fixed_frame : source of the output; empty = that of the frames.
    cameras : source -> (3,) position, m; for ``range_noise``.

    Yields
    ------
    Everybody seen within ``hold``, at the time of each message or at ``rate``, with velocities.
    Link orientations and confidences are those of the person's newest detection.
    """
    params = params or KalmanParams()
    events = Events() if events is None else events
    fusion = _Fusion(model, params, events, fixed_frame, cameras or {})
    newest = 0
    for frame in frames:
        if frame.stamp < newest:
            events.count("too late to be merged", frame.source)
            continue
        newest = frame.stamp
        yield from fusion.step(frame)


class _Fusion:
    def __init__(
        self,
        model: SkeletonModel,
        params: KalmanParams,
        events: Events,
        fixed_frame: str,
        cameras: Mapping[str, Floats],
    ) -> None:
        self._model, self._params, self._events = model, params, events
        self._fixed, self._cameras = fixed_frame, cameras
        self._filters = _Filters(model, params)
        self._latest: dict[int, tuple[Frame, int]] = {}
        self._period = round(1e9 / params.rate) if params.rate else 0
        self._due = 0

    def step(self, frame: Frame) -> Iterator[Frame]:
        """Take a message; yield what is due, before it if that is earlier."""
        if self._period:
            if not self._due:
                self._due = frame.stamp
            while self._due < frame.stamp:
                yield self._output(self._due, frame)
                self._due += self._period
        for index, person in enumerate(frame.ids.tolist()):
            if person != UNTRACKED:
                self._take(frame, index, person)
        if not self._period:
            yield self._output(frame.stamp, frame)

    def _take(self, frame: Frame, index: int, person: int) -> None:
        extra = 0.0
        if self._params.range_noise and frame.source in self._cameras:
            away = frame.positions[index] - self._cameras[frame.source]
            known = away[~np.isnan(away).any(axis=1)]
            if len(known):
                square = float((known.mean(axis=0) ** 2).sum())
                extra = (self._params.range_noise * square) ** 2
        outliers = self._filters.correct(person, frame.stamp, frame, index, extra)
        self._events.count("outlier", frame.source, outliers)
        self._latest[person] = (frame, index)

    def _output(self, stamp: int, cause: Frame) -> Frame:
        """Everybody who was seen lately, at ``stamp``."""
        hold, filters = self._params.hold * 1e9, self._filters
        for person in [p for p, seen in filters.seen.items() if stamp - seen > 10e9]:
            filters.forget(person)
            self._latest.pop(person, None)
        people = sorted(p for p, seen in filters.seen.items() if stamp - seen <= hold)
        fixed = self._fixed or cause.frame_id
        out = Frame.empty(
            len(people),
            self._model,
            stamp=stamp,
            log_time=cause.log_time,
            source=fixed,
            frame_id=fixed,
        )
        out.ids[:] = people
        for row, person in enumerate(people):
            frame, index = self._latest[person]
            out.links[row] = frame.links[index]
            out.link_confidences[row] = frame.link_confidences[index]
            out.marker_confidences[row] = frame.marker_confidences[index]
            out.confidences[row] = frame.confidences[index]
            positions, velocities = filters.at(person, stamp)
            out.markers[row, :, POSITION] = positions
            out.markers[row, :, VELOCITY] = velocities
        return out
