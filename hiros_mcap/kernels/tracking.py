"""Kernels of the tracker: predict, compare, correct (Hi-ROS 2023, section 3.1.2).

``stages/track.py`` calls them in the paper's order for one message. :func:`follow` does the same
for many messages at once.
"""

# mypy: disable-error-code="no-any-return"

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import types

from hiros_mcap.kernels import kalman_filter
from hiros_mcap.kernels.assignment import ASSIGNMENT_WORK, AssignmentWork, solve
from hiros_mcap.kernels.compile import B1, B2, F2, F3, I1, I2, J1, PEOPLE, kernel, named_tuple
from hiros_mcap.kernels.distance import norm3, point_distance, weighted_mean_distance
from hiros_mcap.kernels.quaternions import (
    Quaternion,
    angle_of,
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
    Flags,
    Floats,
    Ints,
    People,
    Stamps,
)

# What may be wrong with a detection.
USABLE, NO_MARKERS, LOW_CONFIDENCE = 0, 1, 2

_NOT_MIRRORED = 0.1  # m: a detection with swapped sides is farther than this from its track
_RESTART = 4.0  # horizons without a detection after which a marker or link starts anew
_LEAST_CONFIDENCE = 0.05  # a marker of less counts as one of this confidence
# Variances of a new state: (m/s)2, (m/s2)2, (rad/s)2, (rad/s2)2.
_SPEED, _ACCELERATION, _ANGULAR_SPEED, _ANGULAR_ACCELERATION = 1.0, 25.0, 4.0, 100.0

# First columns of a KinematicState's parts.
_TO_ORIENTATION = ORIENTATION.start
_TO_VELOCITY, _TO_ANGULAR_VELOCITY = VELOCITY.start, ANGULAR_VELOCITY.start
_TO_ACCELERATION, _TO_ANGULAR_ACCELERATION = ACCELERATION.start, ANGULAR_ACCELERATION.start


class Tracks(NamedTuple):
    """State of T tracks with M markers and L links, in the fixed frame; NaN = never seen.

    A covariance is the upper triangle of :mod:`~hiros_mcap.kernels.kalman_filter`.
    """

    positions: Floats
    """(T, M, 3) m."""
    velocities: Floats
    """(T, M, 3) m/s."""
    accelerations: Floats
    """(T, M, 3) m/s2."""
    covariances: Floats
    """(T, M, 6)."""
    seen: Stamps
    """(T, M) time of each marker's state, ns."""
    orientations: Floats
    """(T, L, 4) x y z w."""
    angular_velocities: Floats
    """(T, L, 3) rad/s."""
    angular_accelerations: Floats
    """(T, L, 3) rad/s2."""
    link_covariances: Floats
    """(T, L, 6)."""
    links_seen: Stamps
    """(T, L) time of each link's state, ns."""

    @classmethod
    def room(cls, n_tracks: int, n_markers: int, n_links: int) -> Tracks:
        """Arrays of zeros."""
        t, m, n = n_tracks, n_markers, n_links
        markers = [np.zeros((t, m, k)) for k in (3, 3, 3, 6)]
        links = [np.zeros((t, n, k)) for k in (4, 3, 3, 6)]
        stamps = np.zeros((t, m), np.int64), np.zeros((t, n), np.int64)
        return cls._make([*markers, stamps[0], *links, stamps[1]])


class TrackSettings(NamedTuple):
    """Parameters of the tracker that its kernels use; see TrackParams."""

    max_distance: float
    min_distance: float
    orientation_weight: float
    velocity_weight: float
    angular_velocity_weight: float
    velocity_decay: float
    exponent: float
    horizon: float
    position_noise: float
    jerk: float
    orientation_noise: float
    angular_jerk: float
    innovation_gate: float
    max_speed: float
    min_skeleton_confidence: float
    min_marker_confidence: float
    weight_by_confidence: bool
    weight_by_velocity: bool
    flip_aware: bool


class TrackWork(NamedTuple):
    """What is worked out about T tracks and P detections; the arrays may have room for more."""

    positions: Floats
    """(T, M, 3) predicted, m."""
    orientations: Floats
    """(T, L, 4) predicted."""
    marker_weights: Floats
    """(T, M) part of eq 11 that a track's velocity gives."""
    link_weights: Floats
    """(T, L)."""
    marker_confidences: Floats
    """(P, M) part of eq 11 that a detection's confidence gives."""
    link_confidences: Floats
    """(P, L)."""
    distances: Floats
    """(T, P) weighted mean distance of the markers, m; right up to both distance parameters."""
    mirrored: Flags
    """(T, P) whether that is with the detection's left and right swapped."""
    cost: Floats
    """(T, P) eq 6; infinite where a pair is not allowed."""
    match: Stamps
    """(P,) index of the track of each detection, -1 = none."""
    wanted: Flags
    """(P,) whether a detection still needs a track."""
    faults: Stamps
    """(P,) USABLE, NO_MARKERS or LOW_CONFIDENCE."""
    slots: Ints
    """(M,) 0, 1, 2, ..."""
    assignment: AssignmentWork

    @classmethod
    def room(cls, n_tracks: int, n_people: int, n_markers: int, n_links: int) -> TrackWork:
        """Arrays for at most that many tracks and detections."""
        t, p, m, n = n_tracks, n_people, n_markers, n_links
        shapes = (t, m, 3), (t, n, 4), (t, m), (t, n), (p, m), (p, n), (t, p)
        return cls._make(
            [
                *[np.empty(shape) for shape in shapes],
                np.empty((t, p), np.bool_),
                np.empty((t, p)),
                np.empty(p, np.int64),
                np.empty(p, np.bool_),
                np.empty(p, np.int64),
                np.arange(m, dtype=np.int32),
                AssignmentWork.room(max(t, p)),
            ]
        )


class ConfirmedTracks(NamedTuple):
    """The tracks that :func:`follow` goes on with."""

    rows: Stamps
    """(T,) their rows in Tracks."""
    ids: Ints
    """(T,) their ids."""
    last_seen: Stamps
    """(T,) ns; brought up to date."""


class Followed(NamedTuple):
    """What :func:`follow` finds out about the P people of its messages."""

    match: Stamps
    """(P,) index into ConfirmedTracks."""
    centres: Floats
    """(P, 3) mean position of the track's markers after the message, m."""


_F, _I = types.float64, types.int64
_TRACKS = named_tuple(Tracks, F3, F3, F3, F3, I2, F3, F3, F3, F3, I2)
_SETTINGS = named_tuple(TrackSettings, *16 * [_F], *3 * [types.boolean])
_WORK = named_tuple(
    TrackWork, F3, F3, F2, F2, F2, F2, F2, B2, F2, I1, B1, I1, J1, ASSIGNMENT_WORK
)  # fmt: skip
_CONFIRMED = named_tuple(ConfirmedTracks, I1, J1, I1)
_FOLLOWED = named_tuple(Followed, I1, F2)


# Detections


@kernel
def _leave_out(states: Floats, confidences: Floats, least: float, person: int) -> bool:
    """Make a person's states of too little confidence absent; return whether any is left."""
    some = False
    for m in range(states.shape[1]):
        if confidences[person, m] < least:
            for c in range(states.shape[2]):
                states[person, m, c] = np.nan
        some = some or not math.isnan(states[person, m, 0])
    return some


@kernel(types.void(PEOPLE, _SETTINGS, _WORK))
def screen(people: People, settings: TrackSettings, work: TrackWork) -> None:
    """Make markers and links of too little confidence absent; fill ``faults`` and ``wanted``."""
    least = settings.min_marker_confidence
    for j in range(len(people.ids)):
        some = _leave_out(people.markers, people.marker_confidences, least, j)
        _leave_out(people.links, people.link_confidences, least, j)
        work.faults[j] = NO_MARKERS
        if some:
            doubtful = people.confidences[j] < settings.min_skeleton_confidence
            work.faults[j] = LOW_CONFIDENCE if doubtful else USABLE
        work.wanted[j] = work.faults[j] == USABLE


# Prediction, eq 7


@kernel
def _predict_positions(
    stamp: int, rows: Stamps, tracks: Tracks, horizon: float, out: Floats
) -> None:
    for i in range(len(rows)):
        row = rows[i]
        for m in range(out.shape[1]):
            dt = min(max((stamp - tracks.seen[row, m]) * 1e-9, 0.0), horizon)
            for c in range(3):
                out[i, m, c] = tracks.positions[row, m, c] + dt * tracks.velocities[row, m, c]


@kernel
def _orientation(states: Floats, row: int, k: int, first: int) -> Quaternion:
    return (
        states[row, k, first],
        states[row, k, first + 1],
        states[row, k, first + 2],
        states[row, k, first + 3],
    )


@kernel
def _predict_orientations(
    stamp: int, rows: Stamps, tracks: Tracks, horizon: float, out: Floats
) -> None:
    for i in range(len(rows)):
        row = rows[i]
        for k in range(out.shape[1]):
            dt = min(max((stamp - tracks.links_seen[row, k]) * 1e-9, 0.0), horizon)
            omega = tracks.angular_velocities[row, k]
            step = exponential(dt * omega[0], dt * omega[1], dt * omega[2])
            turned = multiply(step, _orientation(tracks.orientations, row, k, 0))
            for c in range(4):
                out[i, k, c] = turned[c]


@kernel(types.void(_I, I1, _TRACKS, _SETTINGS, _WORK))
def predict(
    stamp: int, rows: Stamps, tracks: Tracks, settings: TrackSettings, work: TrackWork
) -> None:
    """Predict the pose of each track in ``rows`` at ``stamp`` by constant velocity (eq 7).

    Velocities carry on for ``horizon`` seconds at most; from then on the track stands still.
    """
    _predict_positions(stamp, rows, tracks, settings.horizon, work.positions)
    _predict_orientations(stamp, rows, tracks, settings.horizon, work.orientations)


# Cost, eq 6 and 8 to 11


@kernel
def _weigh_by_velocity(velocities: Floats, settings: TrackSettings, out: Floats) -> None:
    for m in range(len(velocities)):
        if not settings.weight_by_velocity:
            out[m] = 1.0
            continue
        speed = 1.0 + norm3(velocities[m, 0], velocities[m, 1], velocities[m, 2])
        if settings.velocity_decay == 0.25:  # two roots are five times quicker than a power
            out[m] = 1.0 / math.sqrt(math.sqrt(speed))  # eq 11: w_v
        else:
            out[m] = speed**-settings.velocity_decay  # eq 11: w_v


@kernel
def _weigh_by_confidence(confidences: Floats, settings: TrackSettings, out: Floats) -> None:
    for j in range(len(confidences)):
        for m in range(confidences.shape[1]):
            given = settings.weight_by_confidence and not math.isnan(confidences[j, m])
            out[j, m] = confidences[j, m] if given else 1.0  # eq 11: kappa


@kernel
def _compare(
    rows: Stamps,
    people: People,
    tracks: Tracks,
    mirror: Ints,
    settings: TrackSettings,
    work: TrackWork,
) -> None:
    """Fill ``distances`` and ``mirrored``: a detection is mirrored if that halves its distance."""
    _weigh_by_confidence(people.marker_confidences, settings, work.marker_confidences)
    reach = max(settings.max_distance, settings.min_distance)
    for i in range(len(rows)):
        weights = work.marker_weights[i]
        _weigh_by_velocity(tracks.velocities[rows[i]], settings, weights)
        for j in range(len(people.ids)):
            pose, confidences = people.markers[j], work.marker_confidences[j]
            # Beyond twice the reach a detection is mirrored if that brings it within the reach.
            distance = weighted_mean_distance(
                work.positions[i], pose, work.slots, weights, confidences, 2.0 * reach
            )
            swapped = np.inf
            if settings.flip_aware and distance > _NOT_MIRRORED:
                swapped = weighted_mean_distance(
                    work.positions[i], pose, mirror, weights, confidences, reach
                )
            work.mirrored[i, j] = swapped < 0.5 * distance
            work.distances[i, j] = swapped if work.mirrored[i, j] else distance


@kernel
def _linear_distance(
    i: int, j: int, people: People, velocities: Floats, settings: TrackSettings, work: TrackWork
) -> float:
    """Eq 8; ``velocities`` (M, 3) of the track."""
    total, common, markers = 0.0, 0, people.markers[j]
    for m in range(len(markers)):
        d = point_distance(work.positions[i, m], markers[m])
        if math.isnan(d):
            continue
        common += 1
        if settings.velocity_weight > 0.0 and not math.isnan(markers[m, _TO_VELOCITY]):
            d += settings.velocity_weight * point_distance(velocities[m], markers[m, _TO_VELOCITY:])
        total += work.marker_weights[i, m] * work.marker_confidences[j, m] * d
    return total / common**settings.exponent  # eq 8


@kernel
def _angular_distance(
    i: int, j: int, people: People, velocities: Floats, settings: TrackSettings, work: TrackWork
) -> float:
    """Eq 9, 0 where no link is in common; ``velocities`` (L, 3) of the track."""
    total, common, links = 0.0, 0, people.links[j]
    for k in range(len(links)):
        product = 0.0
        for c in range(4):
            product += work.orientations[i, k, c] * links[k, _TO_ORIENTATION + c]
        if math.isnan(product):
            continue
        common += 1
        d = angle_of(product)  # eq 10
        if settings.angular_velocity_weight > 0.0 and not math.isnan(
            links[k, _TO_ANGULAR_VELOCITY]
        ):
            d += settings.angular_velocity_weight * point_distance(
                velocities[k], links[k, _TO_ANGULAR_VELOCITY:]
            )
        total += work.link_weights[i, k] * work.link_confidences[j, k] * d
    return total / common**settings.exponent if common else 0.0  # eq 9


@kernel
def _fill_cost(
    rows: Stamps, people: People, tracks: Tracks, settings: TrackSettings, work: TrackWork
) -> None:
    """Fill ``cost`` of the pairs within the gate (eq 6), where a detection wants a track."""
    _weigh_by_confidence(people.link_confidences, settings, work.link_confidences)
    for i in range(len(rows)):
        velocities = tracks.velocities[rows[i]]
        angular_velocities = tracks.angular_velocities[rows[i]]
        _weigh_by_velocity(angular_velocities, settings, work.link_weights[i])
        for j in range(len(people.ids)):
            if not work.wanted[j] or work.distances[i, j] > settings.max_distance:
                work.cost[i, j] = np.inf
            elif work.mirrored[i, j]:
                work.cost[i, j] = work.distances[i, j]
            else:
                linear = _linear_distance(i, j, people, velocities, settings, work)
                angular = _angular_distance(i, j, people, angular_velocities, settings, work)
                work.cost[i, j] = linear + settings.orientation_weight * angular  # eq 6


@kernel(types.void(I1, PEOPLE, _TRACKS, J1, _SETTINGS, _WORK))
def association_cost(
    rows: Stamps,
    people: People,
    tracks: Tracks,
    mirror: Ints,
    settings: TrackSettings,
    work: TrackWork,
) -> None:
    """Compare every predicted track with every detection (eq 6 and 8 to 11).

    Fills ``distances``, which the gate is for, since unlike eq 8 they depend neither on the
    exponent nor on velocities; ``mirrored``; and ``cost``. The orientations of a mirrored detection
    are wrong, so its cost is its distance.
    """
    _compare(rows, people, tracks, mirror, settings, work)
    _fill_cost(rows, people, tracks, settings, work)


@kernel(types.void(_I, PEOPLE, _WORK))
def assign(n_tracks: int, people: People, work: TrackWork) -> None:
    """Fill ``match``: as many allowed pairs as possible, then the least cost (Munkres)."""
    solve(work.cost, n_tracks, len(people.ids), work.assignment, work.match)


# Correction


@kernel
def _load(covariances: Floats, row: int, m: int) -> kalman_filter.Covariance:
    p = covariances[row, m]
    return p[0], p[1], p[2], p[3], p[4], p[5]


@kernel
def _store(covariances: Floats, row: int, m: int, p: kalman_filter.Covariance) -> None:
    for c in range(6):
        covariances[row, m, c] = p[c]


@kernel
def _limit_speed(tracks: Tracks, row: int, m: int, max_speed: float) -> None:
    velocity = tracks.velocities[row, m]
    square = velocity[0] ** 2 + velocity[1] ** 2 + velocity[2] ** 2
    if square > max_speed * max_speed:
        speed = math.sqrt(square)
        for c in range(3):
            velocity[c] *= max_speed / speed
            tracks.accelerations[row, m, c] = 0.0


@kernel
def _start_marker(tracks: Tracks, row: int, m: int, seen_at: Floats, noise: float) -> None:
    for c in range(3):
        tracks.positions[row, m, c] = seen_at[c]
        tracks.velocities[row, m, c] = tracks.accelerations[row, m, c] = 0.0
    _store(tracks.covariances, row, m, kalman_filter.prior(noise, _SPEED, _ACCELERATION))


@kernel
def _move_marker(tracks: Tracks, row: int, m: int, dt: float, horizon: float) -> None:
    """Predict a marker's state with constant acceleration, for ``horizon`` s at most."""
    reach = min(dt, horizon)
    for c in range(3):
        if dt > horizon:
            tracks.accelerations[row, m, c] = 0.0
        a, v = tracks.accelerations[row, m, c], tracks.velocities[row, m, c]
        tracks.positions[row, m, c] += reach * (v + 0.5 * reach * a)
        tracks.velocities[row, m, c] += reach * a


@kernel
def _correct_marker(
    tracks: Tracks, row: int, m: int, seen_at: Floats, noise: float, gate: float
) -> None:
    """Kalman update by a position that is seen with variance ``noise``, m2."""
    position, p = tracks.positions[row, m], _load(tracks.covariances, row, m)
    ex, ey, ez = seen_at[0] - position[0], seen_at[1] - position[1], seen_at[2] - position[2]
    square = ex * ex + ey * ey + ez * ez
    variance = kalman_filter.innovation_variance(p, noise, square, gate)
    gain = kalman_filter.gain(p, variance)
    innovation = (ex, ey, ez)
    for c in range(3):
        tracks.positions[row, m, c] += gain[0] * innovation[c]
        tracks.velocities[row, m, c] += gain[1] * innovation[c]
        tracks.accelerations[row, m, c] += gain[2] * innovation[c]
    _store(tracks.covariances, row, m, kalman_filter.correct(p, gain))


@kernel
def _write(values: Floats, state: Floats, first: int) -> None:
    """Copy three numbers to where the detector left them open."""
    if math.isnan(state[first]):
        for c in range(3):
            state[first + c] = values[c]


@kernel
def _correct_markers(
    stamp: int,
    row: int,
    markers: Floats,
    confidences: Floats,
    slots: Ints,
    tracks: Tracks,
    settings: TrackSettings,
) -> None:
    """Bring a track's markers to ``stamp`` by a detection (M, 19), whose slots are ``slots``."""
    density = settings.jerk * settings.jerk
    interval, process = 0.0, kalman_filter.white_jerk(0.0, density)
    for m in range(len(slots)):
        state, confidence = markers[slots[m]], confidences[slots[m]]
        if math.isnan(state[0]):
            continue
        dt = (stamp - tracks.seen[row, m]) * 1e-9
        noise = settings.position_noise * settings.position_noise
        if not math.isnan(confidence):
            noise /= max(confidence, _LEAST_CONFIDENCE)
        if math.isnan(tracks.positions[row, m, 0]) or dt > _RESTART * settings.horizon:
            _start_marker(tracks, row, m, state, noise)
            tracks.seen[row, m] = stamp
        else:
            if dt > 0.0:
                _move_marker(tracks, row, m, dt, settings.horizon)
                if dt != interval:  # markers are mostly seen together
                    interval, process = dt, kalman_filter.white_jerk(dt, density)
                p = kalman_filter.predict(_load(tracks.covariances, row, m), dt, process)
                _store(tracks.covariances, row, m, p)
                tracks.seen[row, m] = stamp
            _correct_marker(tracks, row, m, state, noise, settings.innovation_gate)
            _limit_speed(tracks, row, m, settings.max_speed)
        _write(tracks.velocities[row, m], state, _TO_VELOCITY)
        _write(tracks.accelerations[row, m], state, _TO_ACCELERATION)


@kernel
def _set_orientation(tracks: Tracks, row: int, k: int, q: Quaternion) -> None:
    for c in range(4):
        tracks.orientations[row, k, c] = q[c]


@kernel
def _start_link(tracks: Tracks, row: int, k: int, seen_at: Quaternion, noise: float) -> None:
    _set_orientation(tracks, row, k, seen_at)
    for c in range(3):
        tracks.angular_velocities[row, k, c] = tracks.angular_accelerations[row, k, c] = 0.0
    prior = kalman_filter.prior(noise, _ANGULAR_SPEED, _ANGULAR_ACCELERATION)
    _store(tracks.link_covariances, row, k, prior)


@kernel
def _move_link(tracks: Tracks, row: int, k: int, dt: float, horizon: float) -> None:
    """Predict a link's state with constant angular acceleration, for ``horizon`` s at most."""
    reach = min(dt, horizon)
    omega, alpha = tracks.angular_velocities[row, k], tracks.angular_accelerations[row, k]
    step = exponential(
        reach * (omega[0] + 0.5 * reach * alpha[0]),
        reach * (omega[1] + 0.5 * reach * alpha[1]),
        reach * (omega[2] + 0.5 * reach * alpha[2]),
    )
    _set_orientation(tracks, row, k, multiply(step, _orientation(tracks.orientations, row, k, 0)))
    for c in range(3):
        omega[c] += reach * alpha[c]


@kernel
def _correct_link(
    tracks: Tracks, row: int, k: int, seen_at: Quaternion, noise: float, gate: float
) -> None:
    """Kalman update by an orientation; the innovation is a rotation vector."""
    q, p = _orientation(tracks.orientations, row, k, 0), _load(tracks.link_covariances, row, k)
    e = difference(seen_at, q)
    square = e[0] * e[0] + e[1] * e[1] + e[2] * e[2]
    gain = kalman_filter.gain(p, kalman_filter.innovation_variance(p, noise, square, gate))
    step = exponential(gain[0] * e[0], gain[0] * e[1], gain[0] * e[2])
    _set_orientation(tracks, row, k, normalize(multiply(step, q)))
    for c in range(3):
        tracks.angular_velocities[row, k, c] += gain[1] * e[c]
        tracks.angular_accelerations[row, k, c] += gain[2] * e[c]
    _store(tracks.link_covariances, row, k, kalman_filter.correct(p, gain))


@kernel
def _correct_links(
    stamp: int, row: int, links: Floats, tracks: Tracks, settings: TrackSettings
) -> None:
    """Bring a track's links to ``stamp`` by a detection (L, 19)."""
    noise = settings.orientation_noise * settings.orientation_noise
    density = settings.angular_jerk * settings.angular_jerk
    interval, process = 0.0, kalman_filter.white_jerk(0.0, density)
    for k in range(len(links)):
        if math.isnan(links[k, _TO_ORIENTATION]):
            continue
        seen_at = (
            links[k, _TO_ORIENTATION],
            links[k, _TO_ORIENTATION + 1],
            links[k, _TO_ORIENTATION + 2],
            links[k, _TO_ORIENTATION + 3],
        )
        dt = (stamp - tracks.links_seen[row, k]) * 1e-9
        if math.isnan(tracks.orientations[row, k, 0]) or dt > _RESTART * settings.horizon:
            _start_link(tracks, row, k, seen_at, noise)
            tracks.links_seen[row, k] = stamp
        else:
            if dt > 0.0:
                _move_link(tracks, row, k, dt, settings.horizon)
                if dt != interval:
                    interval, process = dt, kalman_filter.white_jerk(dt, density)
                p = kalman_filter.predict(_load(tracks.link_covariances, row, k), dt, process)
                _store(tracks.link_covariances, row, k, p)
                tracks.links_seen[row, k] = stamp
            _correct_link(tracks, row, k, seen_at, noise, settings.innovation_gate)
        _write(tracks.angular_velocities[row, k], links[k], _TO_ANGULAR_VELOCITY)
        _write(tracks.angular_accelerations[row, k], links[k], _TO_ANGULAR_ACCELERATION)


@kernel(types.void(_I, I1, PEOPLE, _TRACKS, J1, _SETTINGS, _WORK))
def correct(
    stamp: int,
    rows: Stamps,
    people: People,
    tracks: Tracks,
    mirror: Ints,
    settings: TrackSettings,
    work: TrackWork,
) -> None:
    """Bring the tracks in ``rows`` to ``stamp`` with the detections that ``match`` gives them.

    A Kalman filter of constant acceleration for each marker and link. Finite differences would
    not do: two cameras may see the same person 0.2 ms apart. The velocities and accelerations that
    the detector left open are written into ``people``. A mirrored detection corrects the track
    with its sides swapped; its orientations are wrong and are left alone.
    """
    for j in range(len(people.ids)):
        i = work.match[j]
        if i < 0:
            continue
        swapped = work.mirrored[i, j]
        slots = mirror if swapped else work.slots
        _correct_markers(
            stamp, rows[i], people.markers[j], people.marker_confidences[j], slots, tracks, settings
        )
        if not swapped:
            _correct_links(stamp, rows[i], people.links[j], tracks, settings)


@kernel("void(float64[:,:,::1], int64, float64[::1])")
def centre(positions: Floats, row: int, out: Floats) -> None:
    """Write the mean position (3,) of a track's markers, m; NaN before any was seen."""
    count = x = y = z = 0.0
    for m in range(positions.shape[1]):
        if not math.isnan(positions[row, m, 0]):
            count += 1.0
            x += positions[row, m, 0]
            y += positions[row, m, 1]
            z += positions[row, m, 2]
    out[0], out[1], out[2] = x / count, y / count, z / count


# Many messages at once


@kernel
def _match_without_choice(
    n_tracks: int, n_people: int, settings: TrackSettings, work: TrackWork
) -> bool:
    """Fill ``match`` if nobody has a choice; return whether that is so.

    Then no track is near two detections, nor a detection near two tracks, and what a pair costs
    does not matter.
    """
    for i in range(n_tracks):
        found = False
        for j in range(n_people):
            if not work.wanted[j] or work.distances[i, j] > settings.max_distance:
                continue
            if found or work.match[j] >= 0:
                return False
            found = True
            work.match[j] = i
    return True


@kernel
def _rows(people: People, begin: int, end: int) -> People:
    """People from row ``begin`` on and before row ``end``, as views."""
    return People(
        people.ids[begin:end],
        people.stamps[begin:end],
        people.confidences[begin:end],
        people.markers[begin:end],
        people.marker_confidences[begin:end],
        people.links[begin:end],
        people.link_confidences[begin:end],
        people.boxes[begin:end],
    )


@kernel(types.int64(I1, I2, PEOPLE, _TRACKS, _CONFIRMED, J1, _SETTINGS, _WORK, _FOLLOWED))
def follow(
    stamps: Stamps,
    spans: Stamps,
    people: People,
    tracks: Tracks,
    confirmed: ConfirmedTracks,
    mirror: Ints,
    settings: TrackSettings,
    work: TrackWork,
    followed: Followed,
) -> int:
    """Take messages in which everybody is of a confirmed track; return how many.

    Stops before the first message with anybody else. Ids and velocities are written into
    ``people``. The results are those of the steps in stages/track.py.

    Parameters
    ----------
    stamps, spans : (K,), (K, 2) time of each message, ns; first row of its people, row after the
        last.
    people : of all messages, and others.
    """
    n_tracks = len(confirmed.rows)
    for k in range(len(stamps)):
        begin, end = spans[k, 0], spans[k, 1]
        group = _rows(people, begin, end)
        screen(group, settings, work)
        _predict_positions(stamps[k], confirmed.rows, tracks, settings.horizon, work.positions)
        _compare(confirmed.rows, group, tracks, mirror, settings, work)
        for j in range(end - begin):
            work.match[j] = -1
        if not _match_without_choice(n_tracks, end - begin, settings, work):
            predict(stamps[k], confirmed.rows, tracks, settings, work)
            _fill_cost(confirmed.rows, group, tracks, settings, work)
            assign(n_tracks, group, work)
        for j in range(end - begin):
            if work.match[j] < 0:
                return k
        correct(stamps[k], confirmed.rows, group, tracks, mirror, settings, work)
        for j in range(end - begin):
            i = work.match[j]
            group.ids[j] = confirmed.ids[i]
            confirmed.last_seen[i] = max(confirmed.last_seen[i], stamps[k])
            followed.match[begin + j] = i
            centre(tracks.positions, confirmed.rows[i], followed.centres[begin + j])
    return len(stamps)
