"""One Kalman filter per person, updated by every camera's message (Malaguti 2019, III-B to III-D).

Nothing is buffered: each message moves its people at once, whenever it comes. A detection weighs
by its confidence, and less if it jumps farther than the joint has lately moved.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping

import numpy as np
from pydantic import Field

from hiros_mcap.events import TOO_LATE, Events
from hiros_mcap.params import Params
from hiros_mcap.skeletons import (
    UNTRACKED,
    Floats,
    Frame,
    SkeletonModel,
)
from hiros_mcap.stages.bank import ArrayBank


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


class _Filters(ArrayBank):
    """The filters of all people."""

    ARRAYS = ("states", "known", "_history", "_filled", "_strikes")

    def __init__(self, model: SkeletonModel, params: KalmanParams) -> None:
        from hiros_mcap.kernels import joint_filter as kernels

        super().__init__()
        self._kernels = kernels
        self._params = params
        self._shape = model.n_markers
        self.rows: dict[int, int] = {}
        self.stamps: dict[int, int] = {}
        self.seen: dict[int, int] = {}
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

    def update(self, frame: Frame, extra: Floats) -> int:
        """Predict and correct everybody with an id whom a message shows; return the outliers."""
        gap = self._params.max_gap * 1e9
        rows, people, dts = [], [], []
        for index, person in enumerate(frame.ids.tolist()):
            if person == UNTRACKED:
                continue
            if person in self.rows and frame.stamp - self.seen[person] > gap:
                self.forget(person)
            if person not in self.rows:
                self.rows[person] = self.take()
                self.stamps[person] = frame.stamp
            rows.append(self.rows[person])
            people.append(index)
            dts.append((frame.stamp - self.stamps[person]) * 1e-9)
            self.stamps[person] = self.seen[person] = frame.stamp
        return int(
            self._kernels.update(
                self.states, self.known, self._history, self._filled, self._strikes,
                np.array(rows, np.int64), np.array(people, np.int64), np.array(dts, np.float64),
                frame.markers, frame.marker_confidences, extra[people], self._numbers,
            )
        )  # fmt: skip

    def write(self, people: list[int], stamp: int, markers: Floats) -> None:
        """Put people's positions and velocities, carried on to ``stamp``, into (P, M, 19)."""
        rows = np.array([self.rows[person] for person in people], np.int64)
        dts = np.array([(stamp - self.stamps[person]) * 1e-9 for person in people], np.float64)
        self._kernels.emit(self.states, self.known, rows, dts, markers)

    def forget(self, person: int) -> None:
        """Free a person's row."""
        self.give_back(self.rows.pop(person))
        del self.stamps[person], self.seen[person]

    def take(self) -> int:
        """Return a row for a person whom nobody has seen yet."""
        row = super().take()
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
            events.count(TOO_LATE, frame.source)
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
        self._events.count(
            "outlier", frame.source, self._filters.update(frame, self._range_noise(frame))
        )
        for index, person in enumerate(frame.ids.tolist()):
            if person != UNTRACKED:
                self._latest[person] = (frame, index)
        if not self._period:
            yield self._output(frame.stamp, frame)

    def _range_noise(self, frame: Frame) -> Floats:
        """(P,) Variance that grows with the distance from the camera, m2."""
        if not self._params.range_noise or frame.source not in self._cameras:
            return np.zeros(frame.n_people)
        away = frame.positions - self._cameras[frame.source]
        known = np.asarray(~np.isnan(away).any(axis=-1))
        total = np.where(known[:, :, np.newaxis], away, 0.0).sum(axis=1)
        middle = total / np.maximum(known.sum(axis=1), 1)[:, np.newaxis]
        return np.asarray((self._params.range_noise * (middle**2).sum(axis=1)) ** 2)

    def _output(self, stamp: int, cause: Frame) -> Frame:
        """Everybody who was seen lately, at ``stamp``."""
        hold, filters = self._params.hold * 1e9, self._filters
        for person in [p for p, seen in filters.seen.items() if stamp - seen > 10e9]:
            filters.forget(person)
            self._latest.pop(person, None)
        people = sorted(p for p, seen in filters.seen.items() if stamp - seen <= hold)
        fixed = self._fixed or cause.frame_id
        latest = [self._latest[person] for person in people]
        if people and all(frame is cause for frame, _ in latest):
            out = cause.select([index for _, index in latest])
            out.stamps[:], out.boxes[:] = stamp, np.nan
            out = out.replace(stamp=stamp, source=fixed, frame_id=fixed)
        else:
            out = Frame.empty(
                len(people),
                self._model,
                stamp=stamp,
                log_time=cause.log_time,
                source=fixed,
                frame_id=fixed,
            )
            for row, (frame, index) in enumerate(latest):
                out.links[row] = frame.links[index]
                out.link_confidences[row] = frame.link_confidences[index]
                out.marker_confidences[row] = frame.marker_confidences[index]
                out.confidences[row] = frame.confidences[index]
        out.ids[:] = people
        out.markers[:] = np.nan
        filters.write(people, stamp, out.markers)
        return out
