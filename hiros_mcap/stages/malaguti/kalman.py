"""One Kalman filter per person, updated by every camera's message (Malaguti 2019, III-B to III-D).

Nothing is buffered: each message moves its people at once, whenever it comes. A detection counts by
its confidence, and less if it lies farther from the prediction than others lately did.

No noise of the paper's 6M-state filter couples two joints or two axes. Its covariance therefore
stays block-diagonal, and the three axes of a joint share one block: the filter is computed joint by
joint, all joints at once. The result is the same.

The difference d of equations 9 and 10 has two forms (``consecutive``):

- As printed, it is the distance between consecutive positions of the joint: of a detection, the
  distance from the joint's previous position; in the history, the steps that the joint has made.
- By default it is the length of the innovation, the distance from the predicted to the measured
  position. This departs from the paper. The cameras share no clock, so their messages come 1 to
  33 ms after each other. The printed form measures these intervals times the speed: a joint in
  steady motion would be an outlier after every longer interval. The prediction covers the motion in
  the interval, so the innovation depends on neither. Innovations of outliers do not enter the
  history; the first one would raise the threshold for the next N measurements.

The paper replaces a rejected joint by its prediction (III-C). Here the correction is left out. A
correction by the prediction would not move the joint; it would only lower the covariance, as if the
joint had been measured.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from typing import NamedTuple

import numpy as np

from hiros_mcap.events import TOO_LATE, Events
from hiros_mcap.kernels.array_types import B2, F1, F2, F3, F4, I1, I2, arrays
from hiros_mcap.skeletons import (
    POSITION,
    STATE,
    UNTRACKED,
    VELOCITY,
    Flags,
    Floats,
    Frame,
    People,
    SkeletonModel,
    Stamps,
)
from hiros_mcap.stages.bank import Bank
from hiros_mcap.stages.malaguti.associate import centroids_of
from hiros_mcap.stages.malaguti.malaguti_params import NOISE_RATE, STARTING_SPEED, KalmanParams
from hiros_mcap.stages.point_filter import correct, predict, seconds, white_acceleration

_LEAST_CONFIDENCE = 1e-3  # keeps eq 8 finite where every confidence is accepted


def kalman(
    frames: Iterable[Frame], model: SkeletonModel, params: KalmanParams | None = None,
    events: Events | None = None, fixed_frame: str = "",
    cameras: Mapping[str, Floats] | None = None,
) -> Iterator[Frame]:  # fmt: skip
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
    Everybody detected within ``hold``, at the time of each message, with velocities.
    Link orientations and confidences are those of the person's newest detection.
    """
    fusion = _Fusion(model, params or KalmanParams(), fixed_frame, cameras or {})
    events = Events() if events is None else events
    newest = 0
    for frame in frames:
        if frame.stamp < newest:
            events.count(TOO_LATE, frame.source)
            continue
        newest = frame.stamp
        events.count("outlier", frame.source, fusion.update(frame))
        yield fusion.detected_lately(frame)


class FilteredPeople(NamedTuple):
    """The filters of all people: R rows, M joints, L links."""

    stamps: I1  # (R,) time of the state, ns
    started: B2  # (R, M) joints that were measured at least once
    states: F4  # (R, M, 2, 3) position, m, and velocity, m/s (eq 4)
    covariances: F4  # (R, M, 2, 2) of position and velocity along an axis
    distances: F3  # (R, M, N) the last N d of eq 9, m: innovations accepted, or steps made
    remembered: I2  # (R, M) distances so far
    outliers: I2  # (R, M) consecutive ones
    confidences: F1  # (R,) of the newest detection, as are the next three
    marker_confidences: F2  # (R, M)
    links: F3  # (R, L, 19)
    link_confidences: F2  # (R, L)

    @classmethod
    def empty(cls, markers: int, links: int, history: int) -> FilteredPeople:
        """Return the filters of nobody, with ``history`` distances (N) per joint."""
        m, n = (0, markers), (0, links)
        return arrays(
            cls, 0, m, (*m, 2, 3), (*m, 2, 2), (*m, history), m, m, 0, m, (*n, STATE), n
        )  # fmt: skip


class _Fusion:
    """The filters of all people."""

    def __init__(
        self, model: SkeletonModel, params: KalmanParams, fixed_frame: str,
        cameras: Mapping[str, Floats],
    ) -> None:  # fmt: skip
        self._params, self._model = params, model
        self._fixed, self._cameras = fixed_frame, cameras
        empty = FilteredPeople.empty(model.n_markers, model.n_links, params.history)
        self._bank = Bank(empty, params.max_gap)

    def update(self, frame: Frame) -> int:
        """Take a message; return how many joints of those whom it shows are outliers."""
        self._bank.expire(frame.stamp)
        if (frame.ids == UNTRACKED).any():
            frame = frame.select(frame.ids != UNTRACKED)
        rows = [self._bank.row(person, frame.stamp) for person in frame.ids.tolist()]
        ranges = self._range_variances(frame)
        return update(self._bank.past, rows, frame.people, frame.stamp, ranges, self._params)

    def _range_variances(self, frame: Frame) -> Floats:
        """(P,) Variance that the distance from the camera adds, m2, as in OpenPTrack."""
        if not self._params.range_noise or frame.source not in self._cameras:
            return np.zeros(frame.n_people)
        apart = centroids_of(frame) - self._cameras[frame.source]
        return (self._params.range_noise * np.nan_to_num((apart**2).sum(axis=1))) ** 2

    def detected_lately(self, cause: Frame) -> Frame:
        """Return everybody who was, predicted to the time of the message that was taken."""
        stamp = cause.stamp
        hold, last_seen = self._params.hold * 1e9, self._bank.last_seen
        people = sorted(p for p, seen in last_seen.items() if stamp - seen <= hold)
        fixed = self._fixed or cause.frame_id
        out = Frame.empty(
            len(people), self._model, stamp=stamp, log_time=cause.log_time, source=fixed,
            frame_id=fixed,
        )  # fmt: skip
        out.ids[:] = people
        past, rows = self._bank.past, [self._bank.rows[person] for person in people]
        positions, velocities = np.moveaxis(past.states[rows], 2, 0)
        dt = seconds(stamp - past.stamps[rows])
        started = past.started[rows][..., None]
        moved = positions + dt[:, None, None] * velocities
        out.markers[..., POSITION] = np.where(started, moved, np.nan)
        out.markers[..., VELOCITY] = np.where(started, velocities, np.nan)
        for name in ("confidences", "marker_confidences", "links", "link_confidences"):
            getattr(out, name)[:] = getattr(past, name)[rows]
        return out


def update(
    past: FilteredPeople, rows: list[int], people: People, now: int, range_variances: Floats,
    params: KalmanParams,
) -> int:  # fmt: skip
    """Predict and correct the people of one message; return how many joints are outliers.

    Parameters
    ----------
    rows : row of each of the P people in ``past``. now : ns.
    range_variances : (P,) what the distance from the camera adds to eq 8, m2.
    """
    x, p, started = past.states[rows], past.covariances[rows], past.started[rows]
    before, measured = x[:, :, 0], people.markers[..., POSITION]
    dt = seconds(now - past.stamps[rows])
    dt[~started.any(axis=1)] = 0.0  # who is new has no state to be carried on
    x, p = _predicted(x, p, dt, params)  # eq 5
    variances = _variances(people.marker_confidences, range_variances, params)  # eq 8
    valid = ~np.isnan(variances + measured[..., 0])  # else the prediction stands (III-C)
    known, first = valid & started, valid & ~started  # (P, M) joints to correct, and to start
    innovations = _norm(measured - x[:, :, 0])
    d = _norm(measured - before) if params.consecutive else innovations
    outlier, factors = _outliers(past, rows, d, known, params)  # eq 9 and 10
    corrected = correct(x, p, measured, variances * factors)  # eq 6 and 7
    x, p = (np.where(known[..., None, None], z, a) for z, a in zip(corrected, (x, p), strict=True))
    x[first], x[first, 0] = 0.0, measured[first]
    p[first], p[first, 0, 0], p[first, 1, 1] = 0.0, variances[first], STARTING_SPEED**2
    if params.consecutive:
        _remember(past, rows, _norm(x[:, :, 0] - before), known)
    else:
        _remember(past, rows, innovations, known & ~outlier)
    past.states[rows], past.covariances[rows], past.started[rows] = x, p, started | valid
    past.stamps[rows] = now
    for name in ("confidences", "marker_confidences", "links", "link_confidences"):
        getattr(past, name)[rows] = getattr(people, name)
    return int(outlier.sum())


def _predicted(x: Floats, p: Floats, dt: Floats, params: KalmanParams) -> tuple[Floats, Floats]:
    """Carry people on by ``dt`` (P,), s: in whole steps as the paper does, or exactly."""
    q, step = params.process_noise**2, params.step
    if not step:
        return predict(x, p, dt[:, None], white_acceleration(dt, q / NOISE_RATE)[:, None])
    g = np.array([step**2 / 2, step])
    times = np.round(dt / step)
    for n in range(int(times.max(initial=0))):  # "computed n times" (III-B)
        moving = times > n
        x[moving], p[moving] = predict(x[moving], p[moving], step, q * np.outer(g, g))
    return x, p


def _variances(confidences: Floats, ranges: Floats, params: KalmanParams) -> Floats:
    """(P, M) Variance of measured positions, m2; NaN where the joint is rejected."""
    if not params.use_confidence:
        confidences = np.ones_like(confidences)
    known = np.where(np.isnan(confidences), 1.0, confidences)
    accepted = np.where(known < params.min_confidence, np.nan, known)  # th (III-C)
    sigma_r = params.measurement_noise
    return sigma_r**2 / np.maximum(accepted, _LEAST_CONFIDENCE) + ranges[:, None]  # eq 8


def _outliers(
    past: FilteredPeople, rows: list[int], d: Floats, known: Flags, params: KalmanParams
) -> tuple[Flags, Floats]:
    """(P, M) which measurements at distances ``d``, m, are outliers, and factors of their variance.

    Only those of joints that are ``known`` are looked at.
    """
    threshold = params.outlier_factor * past.distances[rows].max(axis=2, initial=0.0)  # eq 9
    is_full = past.remembered[rows] >= params.history
    in_a_row = past.outliers[rows]
    far = known & is_full & (d > threshold) & (threshold > 0)
    outlier = far & (in_a_row < params.max_outliers)  # o_max
    past.outliers[rows] = np.where(known, np.where(outlier, in_a_row + 1, 0), in_a_row)
    return outlier, np.divide(d, threshold, out=np.ones_like(d), where=outlier)  # eq 10


def _remember(past: FilteredPeople, rows: list[int], d: Floats, which: Flags) -> None:
    """Put some of the distances (P, M) into the history, each in place of the oldest."""
    size = past.distances.shape[2]
    if size:
        p, m = np.nonzero(which)
        r: Stamps = np.array(rows, np.int64)[p]
        past.distances[r, m, past.remembered[r, m] % size] = d[p, m]
        past.remembered[r, m] += 1


def _norm(vectors: Floats) -> Floats:
    return np.sqrt((vectors**2).sum(axis=-1))
