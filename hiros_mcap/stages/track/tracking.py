"""Kernels of the tracker: predict, compare, correct (Hi-ROS 2023, section 3.1.2).

:func:`associate` and :func:`correct` are the paper's steps for one message; ``track.py`` calls
them.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from hiros_mcap.kernels import kalman_filter
from hiros_mcap.kernels.array_types import B1, B2, F1, F2, F3, I1, I2, J1, J2, arrays
from hiros_mcap.kernels.assignment import AssignmentWork, solve
from hiros_mcap.kernels.compile import entry, inlined
from hiros_mcap.kernels.distance import weighted_mean_distance
from hiros_mcap.kernels.kalman_filter import Covariance
from hiros_mcap.kernels.points import norm3, point_distance
from hiros_mcap.kernels.quaternions import (
    Quaternion,
    Vector,
    angle_of,
    difference,
    dot,
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
    Stamps,
)

# What may be wrong with a detection.
USABLE, NO_MARKERS, LOW_CONFIDENCE = 0, 1, 2

_NOT_MIRRORED = 0.1  # m: a detection with swapped sides is farther than this from its track
_WIDEST_GATE = 2.0  # times the gate: how far it grows while a track is unseen
_FASTEST = 1.5  # m/s that a whole body may move besides its prediction
_USUAL_INTERVAL = 0.033  # s between two detections; longer ones leave more time to move
_TRUSTED = 0.5  # markers of less confidence are guessed: they say nothing about limb lengths
_MOST_LENGTHS = 600.0  # detections that a mean length remembers
_RESTART = 4.0  # horizons without a detection after which a marker or link starts anew
_JERK = 150.0  # m/s3/sqrt(Hz): how fast accelerations of markers may change
_ANGULAR_JERK = 500.0  # rad/s3/sqrt(Hz): the same of links
_ORIENTATION_NOISE = 0.15  # rad; SD of a link that one camera reports
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

    positions: F3  # (T, M, 3) m
    velocities: F3  # (T, M, 3) m/s
    accelerations: F3  # (T, M, 3) m/s2
    covariances: F3  # (T, M, 6)
    seen: I2  # (T, M) time of each marker's state, ns
    orientations: F3  # (T, L, 4) x y z w
    angular_velocities: F3  # (T, L, 3) rad/s
    angular_accelerations: F3  # (T, L, 3) rad/s2
    link_covariances: F3  # (T, L, 6)
    links_seen: I2  # (T, L) time of each link's state, ns
    lengths: F2
    """(T, L) mean distance of each link's markers, m; learned if SlotOrders names the markers."""
    length_counts: F2  # (T, L) detections that the mean length is of

    @classmethod
    def allocate(cls, n_tracks: int, n_markers: int, n_links: int) -> Tracks:
        """Arrays of zeros."""
        m, n = (n_tracks, n_markers), (n_tracks, n_links)
        markers, links = [(*m, k) for k in (3, 3, 3, 6)], [(*n, k) for k in (4, 3, 3, 6)]
        return arrays(cls, *markers, m, *links, n, n, n)


class TrackSettings(NamedTuple):
    """Parameters of the tracker that its kernels use; see TrackParams."""

    max_distance: float
    min_distance: float
    orientation_weight: float
    velocity_weight: float
    angular_velocity_weight: float
    velocity_decay: float
    horizon: float
    fade: float
    gate_growth: float
    max_jump: float
    position_noise: float
    innovation_gate: float
    max_speed: float
    min_skeleton_confidence: float
    min_marker_confidence: float
    flip_aware: bool


class PredictedTracks(NamedTuple):
    """Poses of T tracks at the time of a message (eq 7); NaN = never seen."""

    positions: F3  # (T, M, 3) m
    orientations: F3  # (T, L, 4) x y z w
    unseen: F1  # (T,) time since the last detection, s
    gates: F1  # (T,) largest distance of a detection, m


class TrackWeights(NamedTuple):
    """The two factors of eq 11, of T tracks and P detections."""

    marker_velocities: F2  # (T, M) w_v
    link_velocities: F2  # (T, L)
    marker_confidences: F2  # (P, M) kappa
    link_confidences: F2  # (P, L)


class TrackPairs(NamedTuple):
    """T tracks compared with P detections."""

    wanted: B1  # (P,) whether a detection needs a track
    distances: F2
    """(T, P) weighted mean distance of the markers, m; right up to both distance parameters."""
    mirrored: B2  # (T, P) whether that is with the detection's left and right swapped
    cost: F2  # (T, P) eq 6; infinite where a pair is not allowed
    match: I1  # (P,) index of the track of each detection, -1 = none
    broken: B1  # (P,) whether a detection is too far from the track that ``match`` gives it


class TrackWork(NamedTuple):
    """Scratch for at most T tracks and P detections; its arrays are larger than what counts."""

    bounds: F2  # (P, 6) least and greatest x y z of each detection's markers, m
    predicted: PredictedTracks
    weights: TrackWeights
    pairs: TrackPairs
    assignment: AssignmentWork
    faults: I1  # (P,) USABLE, NO_MARKERS or LOW_CONFIDENCE

    @classmethod
    def allocate(cls, n_tracks: int, n_people: int, n_markers: int, n_links: int) -> TrackWork:
        """Arrays for at most that many tracks and detections."""
        t, p, m, n = n_tracks, n_people, n_markers, n_links
        predicted = arrays(PredictedTracks, (t, m, 3), (t, n, 4), t, t)
        weights = arrays(TrackWeights, (t, m), (t, n), (p, m), (p, n))
        pairs = arrays(TrackPairs, p, (t, p), (t, p), (t, p), p, p)
        return arrays(cls, (p, 6), predicted, weights, pairs, AssignmentWork.allocate(max(t, p)), p)


class SlotOrders(NamedTuple):
    """Which marker of a detection belongs to which of a track."""

    same: J1  # (M,) 0, 1, 2, ..
    mirror: J1  # (M,) where the detector swapped left and right
    ends: J2
    """(L, 2) the track's markers at the ends of each link whose length is learned; of no link if
    nobody asks for lengths."""


# Detections


@inlined
def _leave_out(states: Floats, confidences: Floats, least: float, person: int) -> bool:
    """Make a person's states of too little confidence absent; return whether any is left."""
    some = False
    for m in range(states.shape[1]):
        if confidences[person, m] < least:
            for c in range(states.shape[2]):
                states[person, m, c] = np.nan
        some = some or not math.isnan(states[person, m, 0])
    return some


@entry
def screen(people: People, min_marker: float, min_skeleton: float, faults: I1) -> None:
    """Make markers and links of too little confidence absent; fill ``faults`` (P,)."""
    for j in range(len(people.ids)):
        some = _leave_out(people.markers, people.marker_confidences, min_marker, j)
        _leave_out(people.links, people.link_confidences, min_marker, j)
        faults[j] = NO_MARKERS
        if some:
            faults[j] = LOW_CONFIDENCE if people.confidences[j] < min_skeleton else USABLE


# Prediction, eq 7


@inlined
def _faded(dt: float, settings: TrackSettings) -> float:
    """Time, s, for which the velocity at the horizon would carry on: it fades exponentially."""
    beyond = dt - settings.horizon
    if beyond <= 0.0 or settings.fade <= 0.0:
        return 0.0
    return settings.fade * (1.0 - math.exp(-beyond / settings.fade))


@inlined
def _mean_velocity(velocities: Floats) -> Vector:
    """Mean of the velocities (M, 3), m/s."""
    x = y = z = 0.0
    for m in range(len(velocities)):
        x, y, z = x + velocities[m, 0], y + velocities[m, 1], z + velocities[m, 2]
    n = max(len(velocities), 1)
    return x / n, y / n, z / n


@inlined
def _predict_positions(
    stamp: int, rows: Stamps, tracks: Tracks, settings: TrackSettings, out: PredictedTracks
) -> None:
    for i in range(len(rows)):
        row, unseen = rows[i], np.inf
        for m in range(out.positions.shape[1]):
            dt = (stamp - tracks.seen[row, m]) * 1e-9
            unseen = min(unseen, dt)
            steady = min(max(dt, 0.0), settings.horizon)
            for c in range(3):
                moved = steady * tracks.velocities[row, m, c]
                out.positions[i, m, c] = tracks.positions[row, m, c] + moved
        faded = _faded(unseen, settings)
        if faded > 0.0:  # the limbs of somebody unseen stop, the body goes on for a while
            velocity = _mean_velocity(tracks.velocities[row])
            for m in range(out.positions.shape[1]):
                out.positions[i, m, 0] += faded * velocity[0]
                out.positions[i, m, 1] += faded * velocity[1]
                out.positions[i, m, 2] += faded * velocity[2]
        growth = settings.gate_growth * max(unseen - settings.horizon, 0.0)
        out.unseen[i] = unseen
        out.gates[i] = min(settings.max_distance + growth, _WIDEST_GATE * settings.max_distance)


@inlined
def _quaternion(values: Floats) -> Quaternion:
    return values[0], values[1], values[2], values[3]


@entry
def predict(
    stamp: int, rows: I1, tracks: Tracks, settings: TrackSettings, predicted: PredictedTracks
) -> None:
    """Predict the pose of each track in ``rows`` at ``stamp`` by constant velocity (eq 7).

    Velocities carry on for ``horizon`` seconds and then fade. From then on the gate grows, up to
    twice its size: nobody knows where an unseen person goes.
    """
    _predict_positions(stamp, rows, tracks, settings, predicted)
    out = predicted.orientations
    for i in range(len(rows)):
        row = rows[i]
        for k in range(out.shape[1]):
            dt = min(max((stamp - tracks.links_seen[row, k]) * 1e-9, 0.0), settings.horizon)
            omega = tracks.angular_velocities[row, k]
            step = exponential(dt * omega[0], dt * omega[1], dt * omega[2])
            q = multiply(step, _quaternion(tracks.orientations[row, k]))
            out[i, k, 0], out[i, k, 1], out[i, k, 2], out[i, k, 3] = q


# Cost, eq 6 and 8 to 11


@inlined
def _velocity_weights(velocities: Floats, settings: TrackSettings, out: Floats) -> None:
    for m in range(len(velocities)):
        speed = 1.0 + norm3(velocities[m, 0], velocities[m, 1], velocities[m, 2])
        if settings.velocity_decay == 0.25:  # two roots are five times quicker than a power
            out[m] = 1.0 / math.sqrt(math.sqrt(speed))  # eq 11: w_v
        else:
            out[m] = speed**-settings.velocity_decay  # eq 11: w_v


@inlined
def _confidence_weights(confidences: Floats, out: Floats) -> None:
    for j in range(len(confidences)):
        for m in range(confidences.shape[1]):
            unknown = math.isnan(confidences[j, m])
            out[j, m] = 1.0 if unknown else confidences[j, m]  # eq 11: kappa


@inlined
def _bound(states: Floats) -> tuple[float, float, float, float, float, float]:
    """Least and greatest x y z of markers (M, >= 3); of none inf and -inf."""
    x0 = y0 = z0 = np.inf
    x1 = y1 = z1 = -np.inf
    for m in range(len(states)):
        x, y, z = states[m, 0], states[m, 1], states[m, 2]
        x0, y0, z0 = min(x0, x), min(y0, y), min(z0, z)
        x1, y1, z1 = max(x1, x), max(y1, y), max(z1, z)
    return x0, y0, z0, x1, y1, z1


@inlined
def _compare(
    rows: Stamps, people: People, tracks: Tracks, slots: SlotOrders, settings: TrackSettings,
    work: TrackWork,
) -> None:  # fmt: skip
    """Fill ``distances`` and ``mirrored``: a detection is mirrored if that halves its distance.

    Where all markers of a detection are beyond the reach of all markers of the track, so is any
    mean of their distances. Among many people most pairs need no more than that.
    """
    weights, pairs, bounds = work.weights, work.pairs, work.bounds
    _confidence_weights(people.marker_confidences, weights.marker_confidences)
    for j in range(len(people.ids)):
        low_high = _bound(people.markers[j])
        for c in range(6):
            bounds[j, c] = low_high[c]
    for i in range(len(rows)):
        pose, weight = work.predicted.positions[i], weights.marker_velocities[i]
        reach = max(work.predicted.gates[i], settings.min_distance)
        margin = 1.001 * reach  # rounding must not leave out a pair on the edge
        x0, y0, z0, x1, y1, z1 = _bound(pose)
        x0, y0, z0, x1, y1, z1 = (
            x0 - margin, y0 - margin, z0 - margin, x1 + margin, y1 + margin, z1 + margin,
        )  # fmt: skip
        weighed = False
        for j in range(len(people.ids)):
            pairs.mirrored[i, j], pairs.distances[i, j] = False, np.inf
            low_high = bounds[j]
            if not (
                low_high[0] <= x1 and low_high[3] >= x0
                and low_high[1] <= y1 and low_high[4] >= y0
                and low_high[2] <= z1 and low_high[5] >= z0
            ):  # fmt: skip
                continue
            if not weighed:
                _velocity_weights(tracks.velocities[rows[i]], settings, weight)
                weighed = True
            seen, confidence = people.markers[j], weights.marker_confidences[j]
            # Beyond twice the reach a detection is mirrored if that brings it within the reach.
            distance = weighted_mean_distance(
                pose, seen, slots.same, weight, confidence, 2.0 * reach
            )
            swapped = np.inf
            if settings.flip_aware and distance > _NOT_MIRRORED:
                swapped = weighted_mean_distance(
                    pose, seen, slots.mirror, weight, confidence, reach
                )
            pairs.mirrored[i, j] = swapped < 0.5 * distance
            pairs.distances[i, j] = swapped if pairs.mirrored[i, j] else distance
    _leave_to_nearest(len(rows), len(people.ids), settings, work)


@inlined
def _leave_to_nearest(
    n_tracks: int, n_people: int, settings: TrackSettings, work: TrackWork
) -> None:
    """Keep a gate that has grown from taking a second view of somebody else."""
    distances, gates = work.pairs.distances, work.predicted.gates
    for i in range(n_tracks):
        if gates[i] <= settings.max_distance:
            continue
        for j in range(n_people):
            if not settings.max_distance < distances[i, j] <= gates[i]:
                continue
            for k in range(n_tracks):
                if k != i and distances[k, j] < settings.min_distance:
                    distances[i, j] = np.inf


@inlined
def _linear_distance(
    i: int, j: int, people: People, velocities: Floats, settings: TrackSettings, work: TrackWork
) -> float:
    """Eq 8; ``velocities`` (M, 3) of the track."""
    total, common, markers = 0.0, 0, people.markers[j]
    weights, confidences = work.weights.marker_velocities[i], work.weights.marker_confidences[j]
    for m in range(len(markers)):
        d = point_distance(work.predicted.positions[i, m], markers[m])
        if math.isnan(d):
            continue
        common += 1
        if settings.velocity_weight > 0.0 and not math.isnan(markers[m, _TO_VELOCITY]):
            d += settings.velocity_weight * point_distance(velocities[m], markers[m, _TO_VELOCITY:])
        total += weights[m] * confidences[m] * d
    return total / common  # eq 8


@inlined
def _angular_distance(
    i: int, j: int, people: People, velocities: Floats, settings: TrackSettings, work: TrackWork
) -> float:
    """Eq 9, 0 where no link is in common; ``velocities`` (L, 3) of the track."""
    total, common, links = 0.0, 0, people.links[j]
    weights, confidences = work.weights.link_velocities[i], work.weights.link_confidences[j]
    for k in range(len(links)):
        product = dot(
            _quaternion(work.predicted.orientations[i, k]), _quaternion(links[k, _TO_ORIENTATION:])
        )
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
        total += weights[k] * confidences[k] * d
    return total / common if common else 0.0  # eq 9


@inlined
def _fill_cost(
    rows: Stamps, people: People, tracks: Tracks, settings: TrackSettings, work: TrackWork
) -> None:
    """Fill ``cost`` of the pairs within the gate (eq 6), where a detection wants a track."""
    weights, pairs = work.weights, work.pairs
    _confidence_weights(people.link_confidences, weights.link_confidences)
    for i in range(len(rows)):
        velocities = tracks.velocities[rows[i]]
        angular_velocities = tracks.angular_velocities[rows[i]]
        weighed = False
        for j in range(len(people.ids)):
            if not pairs.wanted[j] or pairs.distances[i, j] > work.predicted.gates[i]:
                pairs.cost[i, j] = np.inf
            elif pairs.mirrored[i, j]:
                pairs.cost[i, j] = pairs.distances[i, j]
            else:
                if not weighed:
                    _velocity_weights(angular_velocities, settings, weights.link_velocities[i])
                    weighed = True
                linear = _linear_distance(i, j, people, velocities, settings, work)
                angular = _angular_distance(i, j, people, angular_velocities, settings, work)
                pairs.cost[i, j] = linear + settings.orientation_weight * angular  # eq 6


@entry
def association_cost(
    rows: I1, people: People, tracks: Tracks, slots: SlotOrders, settings: TrackSettings,
    work: TrackWork,
) -> None:  # fmt: skip
    """Compare every predicted track with every detection (eq 6 and 8 to 11).

    Eq 8 and 9 are means (alpha = 1, as in the published code). Fills the ``distances`` of
    ``work.pairs``, which the gate is for, since they depend on no velocities; ``mirrored``; and
    ``cost``, for the ``wanted`` detections. The orientations of a mirrored detection are wrong, so
    its cost is its distance.
    """
    _compare(rows, people, tracks, slots, settings, work)
    _fill_cost(rows, people, tracks, settings, work)


# Assignment


@inlined
def _breaks(i: int, j: int, work: TrackWork, settings: TrackSettings) -> bool:
    """Whether a detection is farther from a track that was just seen than a person can move."""
    unseen, distance = work.predicted.unseen[i], work.pairs.distances[i, j]
    if unseen > settings.horizon:
        return False
    return distance > settings.max_jump + _FASTEST * max(unseen - _USUAL_INTERVAL, 0.0)


@entry
def associate(
    stamp: int, rows: I1, people: People, tracks: Tracks, slots: SlotOrders,
    settings: TrackSettings, work: TrackWork,
) -> None:  # fmt: skip
    """Give the ``wanted`` detections of a message to the tracks in ``rows``.

    Fills ``match``, and ``broken``: a detector distorts a person who is about to be hidden.
    """
    pairs, n_people = work.pairs, len(people.ids)
    predict(stamp, rows, tracks, settings, work.predicted)  # eq 7
    association_cost(rows, people, tracks, slots, settings, work)  # eq 6 and 8 to 11
    solve(pairs.cost, len(rows), n_people, work.assignment, pairs.match)  # Munkres
    for j in range(n_people):
        i = pairs.match[j]
        pairs.broken[j] = i >= 0 and _breaks(i, j, work, settings)


# Correction


@inlined
def _load(covariances: Floats, row: int, m: int) -> Covariance:
    p = covariances[row, m]
    return p[0], p[1], p[2], p[3], p[4], p[5]


@inlined
def _store(covariances: Floats, row: int, m: int, p: Covariance) -> None:
    # One by one: a tuple is slow to read at a place that varies.
    covariances[row, m, 0], covariances[row, m, 1], covariances[row, m, 2] = p[0], p[1], p[2]
    covariances[row, m, 3], covariances[row, m, 4], covariances[row, m, 5] = p[3], p[4], p[5]


@inlined
def _add(values: Floats, row: int, m: int, gain: float, innovation: Vector) -> None:
    values[row, m, 0] += gain * innovation[0]
    values[row, m, 1] += gain * innovation[1]
    values[row, m, 2] += gain * innovation[2]


@inlined
def _limit_speed(tracks: Tracks, row: int, m: int, max_speed: float) -> None:
    velocity = tracks.velocities[row, m]
    square = velocity[0] ** 2 + velocity[1] ** 2 + velocity[2] ** 2
    if square > max_speed * max_speed:
        speed = math.sqrt(square)
        for c in range(3):
            velocity[c] *= max_speed / speed
            tracks.accelerations[row, m, c] = 0.0


@inlined
def _start_marker(tracks: Tracks, row: int, m: int, seen_at: Floats, noise: float) -> None:
    for c in range(3):
        tracks.positions[row, m, c] = seen_at[c]
        tracks.velocities[row, m, c] = tracks.accelerations[row, m, c] = 0.0
    _store(tracks.covariances, row, m, kalman_filter.prior(noise, _SPEED, _ACCELERATION))


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
    tracks: Tracks, row: int, m: int, p: Covariance, seen_at: Floats, noise: float, gate: float
) -> None:
    """Kalman update by a position that is seen with variance ``noise``, m2; ``p`` is predicted."""
    position = tracks.positions[row, m]
    ex, ey, ez = seen_at[0] - position[0], seen_at[1] - position[1], seen_at[2] - position[2]
    square = ex * ex + ey * ey + ez * ez
    variance = kalman_filter.innovation_variance(p, noise, square, gate)
    gain = kalman_filter.gain(p, variance)
    _add(tracks.positions, row, m, gain[0], (ex, ey, ez))
    _add(tracks.velocities, row, m, gain[1], (ex, ey, ez))
    _add(tracks.accelerations, row, m, gain[2], (ex, ey, ez))
    _store(tracks.covariances, row, m, kalman_filter.correct(p, gain))


@inlined
def _write(values: Floats, state: Floats, first: int) -> None:
    """Copy three numbers to where the detector left them open."""
    if math.isnan(state[first]):
        for c in range(3):
            state[first + c] = values[c]


@inlined
def _correct_markers(
    stamp: int, row: int, tracks: Tracks, markers: Floats, confidences: Floats, slots: Ints,
    settings: TrackSettings,
) -> None:  # fmt: skip
    """Bring a track's markers to ``stamp`` by a detection (M, 19), whose slots are ``slots``."""
    density = _JERK * _JERK
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
            p = _load(tracks.covariances, row, m)
            if dt > 0.0:
                _move_marker(tracks, row, m, dt, settings)
                if dt != interval:  # markers are mostly seen together
                    interval, process = dt, kalman_filter.white_jerk(dt, density)
                p = kalman_filter.predict(p, dt, process)
                tracks.seen[row, m] = stamp
            _correct_marker(tracks, row, m, p, state, noise, settings.innovation_gate)
            _limit_speed(tracks, row, m, settings.max_speed)
        _write(tracks.velocities[row, m], state, _TO_VELOCITY)
        _write(tracks.accelerations[row, m], state, _TO_ACCELERATION)


@inlined
def _set_orientation(tracks: Tracks, row: int, k: int, q: Quaternion) -> None:
    tracks.orientations[row, k, 0], tracks.orientations[row, k, 1] = q[0], q[1]
    tracks.orientations[row, k, 2], tracks.orientations[row, k, 3] = q[2], q[3]


@inlined
def _start_link(tracks: Tracks, row: int, k: int, seen_at: Quaternion, noise: float) -> None:
    _set_orientation(tracks, row, k, seen_at)
    for c in range(3):
        tracks.angular_velocities[row, k, c] = tracks.angular_accelerations[row, k, c] = 0.0
    prior = kalman_filter.prior(noise, _ANGULAR_SPEED, _ANGULAR_ACCELERATION)
    _store(tracks.link_covariances, row, k, prior)


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
    _set_orientation(tracks, row, k, multiply(step, _quaternion(tracks.orientations[row, k])))
    for c in range(3):
        omega[c] += reach * alpha[c]


@inlined
def _correct_link(
    tracks: Tracks, row: int, k: int, p: Covariance, seen_at: Quaternion, noise: float, gate: float
) -> None:
    """Kalman update by an orientation; the innovation is a rotation vector."""
    q = _quaternion(tracks.orientations[row, k])
    e = difference(seen_at, q)
    square = e[0] * e[0] + e[1] * e[1] + e[2] * e[2]
    gain = kalman_filter.gain(p, kalman_filter.innovation_variance(p, noise, square, gate))
    step = exponential(gain[0] * e[0], gain[0] * e[1], gain[0] * e[2])
    _set_orientation(tracks, row, k, normalize(multiply(step, q)))
    _add(tracks.angular_velocities, row, k, gain[1], e)
    _add(tracks.angular_accelerations, row, k, gain[2], e)
    _store(tracks.link_covariances, row, k, kalman_filter.correct(p, gain))


@inlined
def _correct_links(
    stamp: int, row: int, tracks: Tracks, links: Floats, settings: TrackSettings
) -> None:
    """Bring a track's links to ``stamp`` by a detection (L, 19)."""
    noise = _ORIENTATION_NOISE * _ORIENTATION_NOISE
    density = _ANGULAR_JERK * _ANGULAR_JERK
    interval, process = 0.0, kalman_filter.white_jerk(0.0, density)
    for k in range(len(links)):
        if math.isnan(links[k, _TO_ORIENTATION]):
            continue
        seen_at = _quaternion(links[k, _TO_ORIENTATION:])
        dt = (stamp - tracks.links_seen[row, k]) * 1e-9
        if math.isnan(tracks.orientations[row, k, 0]) or dt > _RESTART * settings.horizon:
            _start_link(tracks, row, k, seen_at, noise)
            tracks.links_seen[row, k] = stamp
        else:
            p = _load(tracks.link_covariances, row, k)
            if dt > 0.0:
                _move_link(tracks, row, k, dt, settings.horizon)
                if dt != interval:
                    interval, process = dt, kalman_filter.white_jerk(dt, density)
                p = kalman_filter.predict(p, dt, process)
                tracks.links_seen[row, k] = stamp
            _correct_link(tracks, row, k, p, seen_at, noise, settings.innovation_gate)
        _write(tracks.angular_velocities[row, k], links[k], _TO_ANGULAR_VELOCITY)
        _write(tracks.angular_accelerations[row, k], links[k], _TO_ANGULAR_ACCELERATION)


@inlined
def _learn_lengths(
    row: int, tracks: Tracks, markers: Floats, confidences: Floats, slots: Ints, ends: Ints
) -> None:
    """Average the limb lengths of a detection (M, 19), whose slots are ``slots``."""
    for k in range(len(ends)):
        a, b = ends[k, 0], ends[k, 1]
        if a < 0 or b < 0 or confidences[slots[a]] < _TRUSTED or confidences[slots[b]] < _TRUSTED:
            continue
        length = point_distance(markers[slots[a]], markers[slots[b]])
        if not math.isnan(length):
            n = min(tracks.length_counts[row, k] + 1.0, _MOST_LENGTHS)
            tracks.length_counts[row, k] = n
            tracks.lengths[row, k] += (length - tracks.lengths[row, k]) / n


@entry
def correct(
    stamp: int, rows: I1, pairs: TrackPairs, people: People, tracks: Tracks, slots: SlotOrders,
    settings: TrackSettings,
) -> None:  # fmt: skip
    """Bring the tracks in ``rows`` to ``stamp`` with the detections that ``match`` gives them.

    A Kalman filter of constant acceleration for each marker and link. Finite differences would
    not do: two cameras may see the same person 0.2 ms apart. The velocities and accelerations that
    the detector left open are written into ``people``. A mirrored detection corrects the track
    with its sides swapped; its orientations are wrong and are left alone.
    """
    for j in range(len(people.ids)):
        i = pairs.match[j]
        if i < 0:
            continue
        row, swapped = rows[i], pairs.mirrored[i, j]
        markers, confidences = people.markers[j], people.marker_confidences[j]
        which = slots.mirror if swapped else slots.same
        _correct_markers(stamp, row, tracks, markers, confidences, which, settings)
        _learn_lengths(row, tracks, markers, confidences, which, slots.ends)
        if not swapped:
            _correct_links(stamp, row, tracks, people.links[j], settings)
