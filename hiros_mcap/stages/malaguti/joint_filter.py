"""Malaguti's Kalman filter, computed joint by joint (Malaguti et al. 2019, III-B to III-D).

No noise of the paper's 6M-state filter couples two joints or two axes. Its covariance therefore
stays block-diagonal, and the three axes of a joint share one block. The result is the same, and two
thousand times faster.

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

from typing import NamedTuple

import numpy as np

from hiros_mcap.kernels.array_types import B2, F1, F2, F3, F4, I1, I3, arrays
from hiros_mcap.kernels.averaging import copy_row
from hiros_mcap.kernels.compile import entry, kernel
from hiros_mcap.kernels.kalman_filter import prior, white_acceleration
from hiros_mcap.kernels.point_filter import TRIANGLE, correct, predict, start
from hiros_mcap.kernels.points import point_distance
from hiros_mcap.skeletons import POSITION, STATE, VELOCITY, Floats, People, Stamps
from hiros_mcap.stages.malaguti.centroid_filter import NOISE_RATE, STARTING_SPEED

_LEAST_CONFIDENCE = 1e-3  # keeps eq 8 finite where every confidence is accepted
_DISTANCES, _OUTLIERS = 0, 1  # columns of the counts
_X, _VX = POSITION.start, VELOCITY.start

Position = tuple[float, float, float]  # m


class FilteredPeople(NamedTuple):
    """The filters of all people: R rows, M joints, L links."""

    stamps: I1  # (R,) time of the state, ns
    started: B2  # (R, M) joints that were measured at least once
    states: F4  # (R, M, 2, 3) position, m, and velocity, m/s (eq 4)
    covariances: F3  # (R, M, 6) of ``kalman_filter``
    distances: F3  # (R, M, N) the last N d of eq 9, m: innovations accepted, or steps made
    counts: I3  # (R, M, 2) distances so far, consecutive outliers
    confidences: F1  # (R,) of the newest detection, as are the next three
    marker_confidences: F2  # (R, M)
    links: F3  # (R, L, 19)
    link_confidences: F2  # (R, L)

    @classmethod
    def empty(cls, markers: int, links: int, history: int) -> FilteredPeople:
        """Return the filters of nobody, with ``history`` distances (N) per joint."""
        m, n = (0, markers), (0, links)
        return arrays(
            cls, 0, m, (*m, 2, 3), (*m, TRIANGLE), (*m, history), (*m, 2), 0, m, (*n, STATE), n
        )


class JointFilterSettings(NamedTuple):
    """Parameters of ``kalman`` that the kernels need."""

    measurement_noise: float
    process_noise: float
    step: float
    use_confidence: bool
    min_confidence: float
    outlier_factor: float
    max_outliers: int
    consecutive: bool


@kernel
def _predict_joint(x: Floats, p: Floats, dt: float, settings: JointFilterSettings) -> None:
    """Carry a joint on by ``dt`` s: in whole steps as the paper does, or exactly."""
    q, step = settings.process_noise**2, settings.step
    if step > 0:  # G = (step^2 / 2, step)
        process = q * step**4 / 4, q * step**3 / 2, 0.0, q * step**2, 0.0, 0.0
        for _ in range(int(np.round(dt / step))):  # "computed n times" (III-B)
            predict(x, p, step, process)  # eq 5
    else:
        predict(x, p, dt, white_acceleration(dt, q / NOISE_RATE))  # eq 5


@kernel
def _measurement_variance(
    confidence: float, range_variance: float, settings: JointFilterSettings
) -> float:
    """Variance of a measured position, m2; NaN if the joint is rejected."""
    if not settings.use_confidence or np.isnan(confidence):
        confidence = 1.0
    elif confidence < settings.min_confidence:
        return np.nan  # th (III-C)
    sigma_r = settings.measurement_noise
    return float(sigma_r**2 / max(confidence, _LEAST_CONFIDENCE) + range_variance)  # eq 8


@kernel
def _outlier_factor(
    history: Floats, counts: Stamps, d: float, settings: JointFilterSettings
) -> float:
    """Factor of the variance of a measurement at distance ``d``, m; 1 = no outlier."""
    size = len(history)
    highest = 0.0
    for i in range(size):
        highest = max(highest, history[i])
    threshold = settings.outlier_factor * highest  # eq 9
    is_outlier = 0 < size <= counts[_DISTANCES] and d > threshold > 0
    if is_outlier and counts[_OUTLIERS] < settings.max_outliers:  # o_max
        counts[_OUTLIERS] += 1
        return d / threshold  # eq 10
    counts[_OUTLIERS] = 0
    return 1.0


@kernel
def _remember(history: Floats, counts: Stamps, d: float) -> None:
    """Put a distance into the history (N,), in place of the oldest."""
    if len(history) > 0:
        history[counts[_DISTANCES] % len(history)] = d
        counts[_DISTANCES] += 1


@kernel
def _correct_joint(
    past: FilteredPeople, row: int, m: int, before: Position, measured: Floats, variance: float,
    settings: JointFilterSettings,
) -> bool:  # fmt: skip
    """Correct a predicted joint, which was at ``before``; whether the measurement is an outlier."""
    x, p = past.states[row, m], past.covariances[row, m]
    history, counts = past.distances[row, m], past.counts[row, m]
    innovation = point_distance(measured, x[0])
    d = point_distance(measured, before) if settings.consecutive else innovation
    factor = _outlier_factor(history, counts, d, settings)  # eq 9 and 10
    is_outlier: bool = factor > 1.0
    correct(x, p, measured, variance * factor)  # eq 6 and 7
    if settings.consecutive:
        _remember(history, counts, point_distance(x[0], before))
    elif not is_outlier:
        _remember(history, counts, innovation)
    return is_outlier


@entry
def update(
    past: FilteredPeople, people: People, rows: I1, now: int, range_variances: F1,
    settings: JointFilterSettings,
) -> int:  # fmt: skip
    """Predict and correct the people of one message; return how many joints are outliers.

    Parameters
    ----------
    rows : (P,) row of each person in ``past``; -1 = left out. now : ns.
    range_variances : (P,) what the distance from the camera adds to eq 8, m2.
    """
    outliers = 0
    for k in range(len(rows)):
        row = rows[k]
        if row < 0:
            continue
        dt = (now - past.stamps[row]) * 1e-9
        for m in range(people.markers.shape[1]):
            x, p = past.states[row, m], past.covariances[row, m]
            before = x[0, 0], x[0, 1], x[0, 2]
            if past.started[row, m]:
                _predict_joint(x, p, dt, settings)  # eq 5
            confidence, measured = people.marker_confidences[k, m], people.markers[k, m, POSITION]
            variance = _measurement_variance(confidence, range_variances[k], settings)  # eq 8
            if np.isnan(variance + measured[0]):
                continue  # the prediction stands (III-C)
            if past.started[row, m]:
                outliers += _correct_joint(past, row, m, before, measured, variance, settings)
            else:
                start(x, p, measured, prior(variance, STARTING_SPEED**2, 0.0))
                past.started[row, m] = True
        past.stamps[row], past.confidences[row] = now, people.confidences[k]
        copy_row(past.marker_confidences, row, people.marker_confidences, k)
        copy_row(past.links, row, people.links, k)
        copy_row(past.link_confidences, row, people.link_confidences, k)
    return outliers


@entry
def write(past: FilteredPeople, rows: I1, now: int, people: People) -> None:
    """Write the people in ``rows``, carried on to ``now``, ns, into people without markers."""
    for i in range(len(rows)):
        row = rows[i]
        dt = (now - past.stamps[row]) * 1e-9
        for m in range(people.markers.shape[1]):
            if past.started[row, m]:
                for c in range(3):
                    position, velocity = past.states[row, m, 0, c], past.states[row, m, 1, c]
                    people.markers[i, m, _X + c] = position + dt * velocity
                    people.markers[i, m, _VX + c] = velocity
        people.confidences[i] = past.confidences[row]
        copy_row(people.marker_confidences, i, past.marker_confidences, row)
        copy_row(people.links, i, past.links, row)
        copy_row(people.link_confidences, i, past.link_confidences, row)
