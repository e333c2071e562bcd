"""Kalman filters that correct tracks by their detections (Hi-ROS 2023, section 3.1.2).

Each marker and each link moves, or turns, with constant acceleration. Finite differences would not
do: two cameras may see the same person 0.2 ms apart.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from hiros_mcap.kernels import kalman_filter
from hiros_mcap.kernels.array_types import F3, I1, I2
from hiros_mcap.kernels.compile import entry, inlined
from hiros_mcap.kernels.kalman_filter import Covariance
from hiros_mcap.kernels.points import point_distance
from hiros_mcap.kernels.quaternions import (
    Quaternion,
    Vector,
    difference,
    exponential,
    multiply,
    normalize,
)
from hiros_mcap.skeletons import (
    ACCELERATION,
    ANGULAR_ACCELERATION,
    ANGULAR_VELOCITY,
    ORIENTATION,
    VELOCITY,
    Floats,
    Ints,
    People,
)
from hiros_mcap.stages.detections.visibility import INVENTED
from hiros_mcap.stages.track.association import (
    MOSTLY_HIDDEN,
    Tracks,
    TrackSettings,
    TrackWork,
    quaternion,
)

_RESTART = 4.0  # horizons without a detection after which a marker or link starts anew
_JERK = 50.0  # m/s3/sqrt(Hz): how fast accelerations of markers may change
_ANGULAR_JERK = 100.0  # rad/s3/sqrt(Hz): the same of links, half a metre long
_MOST_TURNING = 25.0
"""rad/s. At 10 Hz, a state that turns faster predicts half a turn too much, and learns from the
difference to turn faster still."""
_ORIENTATION_NOISE = 0.15  # rad; SD of a link that one camera reports
_LEAST_CONFIDENCE = 0.05  # a marker of less counts as one of this confidence
# Variances of a new state: (m/s)2, (m/s2)2, (rad/s)2, (rad/s2)2.
_SPEED, _ACCELERATION, _ANGULAR_SPEED, _ANGULAR_ACCELERATION = 1.0, 25.0, 4.0, 100.0

# First columns of a KinematicState's parts.
_TO_ORIENTATION = ORIENTATION.start
_TO_VELOCITY, _TO_ANGULAR_VELOCITY = VELOCITY.start, ANGULAR_VELOCITY.start
_TO_ACCELERATION, _TO_ANGULAR_ACCELERATION = ACCELERATION.start, ANGULAR_ACCELERATION.start


# What markers and links have in common


class Motions(NamedTuple):
    """How the K markers, or links, of T tracks move, and how certain that is."""

    velocities: F3  # (T, K, 3) m/s or rad/s
    accelerations: F3  # (T, K, 3) m/s2 or rad/s2
    covariances: F3  # (T, K, 6)
    seen: I2  # (T, K) time of each state, ns


@inlined
def _store(motions: Motions, row: int, k: int, p: Covariance) -> None:
    # One by one: a tuple is slow to read at a place that varies.
    values = motions.covariances[row, k]
    values[0], values[1], values[2], values[3], values[4], values[5] = p


@inlined
def _start(motions: Motions, row: int, k: int, stamp: int, p: Covariance) -> None:
    """Start a state at rest with the covariance ``p``."""
    for c in range(3):
        motions.velocities[row, k, c] = motions.accelerations[row, k, c] = 0.0
    motions.seen[row, k] = stamp
    _store(motions, row, k, p)


@inlined
def _predict(
    motions: Motions, row: int, k: int, stamp: int, dt: float, density: float
) -> Covariance:
    """Predict the covariance, ``dt`` s on. A late message meets the state as it is."""
    p = motions.covariances[row, k]
    covariance = p[0], p[1], p[2], p[3], p[4], p[5]
    if dt <= 0.0:
        return covariance
    motions.seen[row, k] = stamp
    return kalman_filter.predict(covariance, dt, kalman_filter.white_jerk(dt, density))


@inlined
def _add(values: Floats, gain: float, innovation: Vector) -> None:
    values[0] += gain * innovation[0]
    values[1] += gain * innovation[1]
    values[2] += gain * innovation[2]


@inlined
def _correct(
    motions: Motions, row: int, k: int, p: Covariance, e: Vector, noise: float, gate: float
) -> float:
    """Kalman update by an innovation; return the gain of the position or orientation."""
    square = e[0] * e[0] + e[1] * e[1] + e[2] * e[2]
    gain = kalman_filter.gain(p, kalman_filter.innovation_variance(p, noise, square, gate))
    _add(motions.velocities[row, k], gain[1], e)
    _add(motions.accelerations[row, k], gain[2], e)
    _store(motions, row, k, kalman_filter.correct(p, gain))
    return gain[0]


@inlined
def _write(values: Floats, state: Floats, first: int) -> None:
    """Copy three numbers to where the detector left them open, if ``state`` has such columns."""
    if len(state) > first and math.isnan(state[first]):
        for c in range(3):
            state[first + c] = values[c]


@inlined
def _limit_speed(motions: Motions, row: int, k: int, most: float) -> None:
    velocity = motions.velocities[row, k]
    square = velocity[0] ** 2 + velocity[1] ** 2 + velocity[2] ** 2
    if square > most * most:
        speed = math.sqrt(square)
        for c in range(3):
            velocity[c] *= most / speed
            motions.accelerations[row, k, c] = 0.0


# Markers


@inlined
def _move_marker(tracks: Tracks, row: int, m: int, dt: float, settings: TrackSettings) -> None:
    """Predict a marker's state with constant acceleration up to the horizon; then it fades."""
    reach, left = min(dt, settings.horizon), 1.0
    if dt > settings.horizon and settings.fade > 0.0:
        left = math.exp((settings.horizon - dt) / settings.fade)
    for c in range(3):
        if dt > settings.horizon:
            tracks.accelerations[row, m, c] = 0.0
        a, v = tracks.accelerations[row, m, c], tracks.velocities[row, m, c]
        tracks.positions[row, m, c] += reach * (v + 0.5 * reach * a)
        tracks.velocities[row, m, c] = left * (v + reach * a)


@inlined
def _correct_marker(
    stamp: int, tracks: Tracks, row: int, m: int, state: Floats, noise: float,
    settings: TrackSettings,
) -> None:  # fmt: skip
    """Bring a marker to ``stamp`` by a ``state`` (19,) that is measured with ``noise``, m2."""
    motions = Motions(tracks.velocities, tracks.accelerations, tracks.covariances, tracks.seen)
    position, dt = tracks.positions[row, m], (stamp - tracks.seen[row, m]) * 1e-9
    if math.isnan(position[0]) or dt > _RESTART * settings.horizon:
        position[0], position[1], position[2] = state[0], state[1], state[2]
        _start(motions, row, m, stamp, kalman_filter.prior(noise, _SPEED, _ACCELERATION))
    else:
        p = _predict(motions, row, m, stamp, dt, _JERK * _JERK)
        if dt > 0.0:
            _move_marker(tracks, row, m, dt, settings)
        e = state[0] - position[0], state[1] - position[1], state[2] - position[2]
        gain = _correct(motions, row, m, p, e, noise, settings.innovation_gate)
        _add(position, gain, e)
        _limit_speed(motions, row, m, settings.max_speed)
    _write(tracks.velocities[row, m], state, _TO_VELOCITY)
    _write(tracks.accelerations[row, m], state, _TO_ACCELERATION)


# Links


@inlined
def _set_orientation(tracks: Tracks, row: int, k: int, q: Quaternion) -> None:
    tracks.orientations[row, k, 0], tracks.orientations[row, k, 1] = q[0], q[1]
    tracks.orientations[row, k, 2], tracks.orientations[row, k, 3] = q[2], q[3]


@inlined
def _move_link(tracks: Tracks, row: int, k: int, dt: float, horizon: float) -> None:
    """Predict a link's state with constant angular acceleration, for ``horizon`` s at most."""
    reach = min(dt, horizon)
    omega, alpha = tracks.angular_velocities[row, k], tracks.angular_accelerations[row, k]
    step = exponential(
        reach * (omega[0] + 0.5 * reach * alpha[0]),
        reach * (omega[1] + 0.5 * reach * alpha[1]),
        reach * (omega[2] + 0.5 * reach * alpha[2]),
    )
    _set_orientation(tracks, row, k, multiply(step, quaternion(tracks.orientations[row, k])))
    for c in range(3):
        omega[c] += reach * alpha[c]


@inlined
def _correct_link(
    stamp: int, tracks: Tracks, row: int, k: int, state: Floats, settings: TrackSettings
) -> None:
    """Bring a link to ``stamp`` by a ``state`` (19,); the innovation is a rotation vector."""
    motions = Motions(
        tracks.angular_velocities, tracks.angular_accelerations, tracks.link_covariances,
        tracks.links_seen,
    )  # fmt: skip
    measured, noise = quaternion(state[_TO_ORIENTATION:]), _ORIENTATION_NOISE * _ORIENTATION_NOISE
    dt = (stamp - tracks.links_seen[row, k]) * 1e-9
    if math.isnan(tracks.orientations[row, k, 0]) or dt > _RESTART * settings.horizon:
        _set_orientation(tracks, row, k, measured)
        prior = kalman_filter.prior(noise, _ANGULAR_SPEED, _ANGULAR_ACCELERATION)
        _start(motions, row, k, stamp, prior)
    else:
        p = _predict(motions, row, k, stamp, dt, _ANGULAR_JERK * _ANGULAR_JERK)
        if dt > 0.0:
            _move_link(tracks, row, k, dt, settings.horizon)
        q = quaternion(tracks.orientations[row, k])
        e = difference(measured, q)
        gain = _correct(motions, row, k, p, e, noise, settings.innovation_gate)
        step = exponential(gain * e[0], gain * e[1], gain * e[2])
        _set_orientation(tracks, row, k, normalize(multiply(step, q)))
        _limit_speed(motions, row, k, _MOST_TURNING)
    _write(tracks.angular_velocities[row, k], state, _TO_ANGULAR_VELOCITY)
    _write(tracks.angular_accelerations[row, k], state, _TO_ANGULAR_ACCELERATION)


# Tracks


@inlined
def _variance(confidence: float, settings: TrackSettings) -> float:
    """Variance, m2, of a marker's measured position."""
    noise = settings.position_noise * settings.position_noise
    return noise if math.isnan(confidence) else noise / max(confidence, _LEAST_CONFIDENCE)


@inlined
def _learn_lengths(
    row: int, tracks: Tracks, markers: Floats, hidden: Floats, slots: Ints, ends: Ints
) -> None:
    """Average the limb lengths of a detection (M, 19), whose slots are ``slots``.

    Limbs that the camera does not see (``hidden``) are guesses.
    """
    for k in range(len(ends)):
        a, b = ends[k, 0], ends[k, 1]
        if a < 0 or b < 0 or max(hidden[slots[a]], hidden[slots[b]]) >= MOSTLY_HIDDEN:
            continue
        length = point_distance(markers[slots[a]], markers[slots[b]])
        if not math.isnan(length):
            tracks.length_counts[row, k] += 1.0
            n = tracks.length_counts[row, k]
            tracks.lengths[row, k] += (length - tracks.lengths[row, k]) / n


@entry
def correct(
    stamp: int, rows: I1, work: TrackWork, people: People, tracks: Tracks,
    settings: TrackSettings,
) -> None:  # fmt: skip
    """Bring the tracks in ``rows`` to ``stamp`` with the detections that ``match`` gives them.

    The velocities and accelerations that the detector left open are written into ``people``. A
    mirrored detection corrects the track with its sides swapped; its orientations are wrong and are
    left alone. What others hide of a detection is a guess, and so is a marker of little confidence:
    its variance is larger, so that it does not pull the track away from what cameras see.
    """
    for j in range(len(people.ids)):
        i = work.match[j]
        if i < 0:
            continue
        row, swapped = rows[i], work.mirrored[i, j]
        markers, confidences = people.markers[j], people.marker_confidences[j]
        which = settings.mirror if swapped else settings.same
        for m in range(len(which)):
            if not math.isnan(markers[which[m], 0]):
                noise = _variance(confidences[which[m]], settings)
                noise += (INVENTED * work.hidden[j, which[m]]) ** 2
                _correct_marker(stamp, tracks, row, m, markers[which[m]], noise, settings)
        _learn_lengths(row, tracks, markers, work.hidden[j], which, settings.ends)
        for k in range(0 if swapped else len(people.links[j])):
            if not math.isnan(people.links[j, k, _TO_ORIENTATION]):
                _correct_link(stamp, tracks, row, k, people.links[j, k], settings)
