"""Which detection is of which track: predict, compare, assign (Hi-ROS 2023, section 3.1.2)."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from hiros_mcap.kernels.array_types import B1, B2, F1, F2, F3, I1, I2, I3, J1, J2, arrays
from hiros_mcap.kernels.assignment import AssignmentWork
from hiros_mcap.kernels.compile import entry, inlined, kernel
from hiros_mcap.kernels.distance import weighted_mean_distance
from hiros_mcap.kernels.line_of_sight import OUTLINE, Capsules
from hiros_mcap.kernels.points import norm3, point_distance
from hiros_mcap.kernels.quaternions import Quaternion, Vector, angle_of, dot, exponential, multiply
from hiros_mcap.skeletons import (
    ANGULAR_VELOCITY,
    ORIENTATION,
    VELOCITY,
    Floats,
    People,
    Stamps,
)

_NOT_MIRRORED = 0.1  # m: a detection with swapped sides is farther than this from its track
_WIDEST_GATE = 2.0  # times the gate: how far it grows while a track is unseen
_FASTEST = 3.0  # m/s that a whole body may move besides its prediction
MOSTLY_HIDDEN = 0.5  # share of a joint from which on it is taken for guessed
_FEWEST_SEEN = 4  # markers that tell how far a detection is from its track
_USUAL_INTERVAL = 0.033  # s between two detections; longer ones leave more time to move

# First columns of a KinematicState's parts.
_TO_ORIENTATION = ORIENTATION.start
_TO_VELOCITY, _TO_ANGULAR_VELOCITY = VELOCITY.start, ANGULAR_VELOCITY.start


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
    """(T, L) mean distance of each link's markers, m; learned if TrackSettings names their ends."""
    length_counts: F2  # (T, L) detections that the mean length is of
    last_seen: I1  # (T,) time of the last detection, ns
    leaps: I3  # (T, C, 2) times, ns, of the first and last of each camera's latest leaps
    leapt_to: F3  # (T, C, 3) where the last of them was, m

    @classmethod
    def allocate(cls, n_tracks: int, n_markers: int, n_links: int) -> Tracks:
        """Arrays of zeros; of no camera yet."""
        m, n = (n_tracks, n_markers), (n_tracks, n_links)
        markers, links = [(*m, k) for k in (3, 3, 3, 6)], [(*n, k) for k in (4, 3, 3, 6)]
        return arrays(
            cls, *markers, m, *links, n, n, n, n_tracks, (n_tracks, 0, 2), (n_tracks, 0, 3)
        )


class TrackSettings(NamedTuple):
    """Parameters of the tracker that its kernels use, see TrackParams; and its skeleton."""

    max_distance: float
    min_distance: float
    max_gap: float
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
    # Which marker of a detection belongs to which of a track.
    same: J1  # (M,) 0, 1, 2, ..
    mirror: J1  # (M,) where the detector swapped left and right
    ends: J2
    """(L, 2) the track's markers at the ends of each link whose length is learned; of no link if
    nobody asks for lengths."""
    capsules: Capsules  # how thick limbs are


class TrackWork(NamedTuple):
    """Scratch for at most T tracks and P detections; its arrays are larger than what counts."""

    # The tracks at the time of a message (eq 7); NaN = never seen.
    positions: F3  # (T, M, 3) m
    orientations: F3  # (T, L, 4) x y z w
    unseen: F1  # (T,) time since the last detection, s
    gates: F1  # (T,) largest distance of a detection, m
    # The two factors of eq 11.
    marker_velocities: F2  # (T, M) w_v
    side_weights: F2
    """(T, M) the same; 0 for markers that do not tell whether a detector swapped the sides."""
    link_velocities: F2  # (T, L)
    marker_confidences: F2  # (P, M) kappa
    link_confidences: F2  # (P, L)
    # The tracks compared with the detections.
    wanted: B1  # (P,) whether a detection needs a track
    distances: F2
    """(T, P) weighted mean distance of the markers, m; right up to both distance parameters."""
    mirrored: B2  # (T, P) whether that is with the detection's left and right swapped
    cost: F2  # (T, P) eq 6; infinite where a pair is not allowed
    match: I1  # (P,) index of the track of each detection, -1 = none
    # The detections.
    hidden: F2  # (P, M) 0 to 1, how far a joint is hidden from its camera; 1 = guessed
    bounds: F2  # (P, 6) least and greatest x y z of each detection's markers, m
    outlines: F2  # (P, OUTLINE) of the detections, seen from their camera
    faults: I1  # (P,) why a detection is left out, 0 = it is not; see tracking.py
    track_rows: I1  # (P,) row of each detection's track, -1 = none
    assignment: AssignmentWork

    @classmethod
    def allocate(cls, n_tracks: int, n_people: int, n_markers: int, n_links: int) -> TrackWork:
        """Arrays for at most that many tracks and detections."""
        t, p, m, n = n_tracks, n_people, n_markers, n_links
        tracks = (t, m, 3), (t, n, 4), t, t
        weights = (t, m), (t, m), (t, n), (p, m), (p, n)
        pairs = p, (t, p), (t, p), (t, p), p
        detections = (p, m), (p, 6), (p, OUTLINE), p, p
        assignment = AssignmentWork.allocate(max(t, p))
        return arrays(cls, *tracks, *weights, *pairs, *detections, assignment)


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
    stamp: int, rows: Stamps, tracks: Tracks, settings: TrackSettings, out: TrackWork
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
def quaternion(values: Floats) -> Quaternion:
    """Read a quaternion."""
    return values[0], values[1], values[2], values[3]


@entry
def predict(stamp: int, rows: I1, tracks: Tracks, settings: TrackSettings, work: TrackWork) -> None:
    """Predict the pose of each track in ``rows`` at ``stamp`` by constant velocity (eq 7).

    Velocities carry on for ``horizon`` seconds and then fade. From then on the gate grows, up to
    twice its size: nobody knows where an unseen person goes.
    """
    _predict_positions(stamp, rows, tracks, settings, work)
    out = work.orientations
    for i in range(len(rows)):
        row = rows[i]
        for k in range(out.shape[1]):
            dt = min(max((stamp - tracks.links_seen[row, k]) * 1e-9, 0.0), settings.horizon)
            omega = tracks.angular_velocities[row, k]
            step = exponential(dt * omega[0], dt * omega[1], dt * omega[2])
            q = multiply(step, quaternion(tracks.orientations[row, k]))
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
def _leave_out_older(row: int, since: int, tracks: Tracks, weights: Floats, out: Floats) -> None:
    """Write weights (M,) of a track's markers, 0 for those that were not seen after ``since``, ns.

    If too few were, all count.
    """
    n = 0
    for m in range(len(weights)):
        n += tracks.seen[row, m] > since
    for m in range(len(weights)):
        counts = n < _FEWEST_SEEN or tracks.seen[row, m] > since
        out[m] = weights[m] if counts else 0.0


@inlined
def _weigh_markers(
    row: int, since: int, tracks: Tracks, settings: TrackSettings, weights: Floats, sides: Floats
) -> None:
    """Fill the weights (M,) of a track's markers, and those of the markers that tell the sides.

    Markers that were not seen for long while others were are guesses: of a track that another
    detector follows now, which does not have them. Joints that no other camera has shown after
    ``since``, the camera's latest message, confirm that camera's own mistake.
    """
    _velocity_weights(tracks.velocities[row], settings, weights)
    latest = np.int64(tracks.seen[row, 0])
    for m in range(len(weights)):
        latest = max(latest, tracks.seen[row, m])
    oldest = latest - np.int64(settings.horizon * 1e9)
    _leave_out_older(row, oldest - 1, tracks, weights, weights)
    _leave_out_older(row, since, tracks, weights, sides)


@inlined
def _compare(
    rows: Stamps, since: int, people: People, tracks: Tracks, settings: TrackSettings,
    work: TrackWork,
) -> None:  # fmt: skip
    """Fill ``distances`` and ``mirrored``: a detection is mirrored if that halves its distance.

    Where all markers of a detection are beyond the reach of all markers of the track, so is any
    mean of their distances. Among many people most pairs need no more than that.
    """
    bounds = work.bounds
    _confidence_weights(people.marker_confidences, work.marker_confidences)
    for j in range(len(people.ids)):
        low_high = _bound(people.markers[j])
        for c in range(6):
            bounds[j, c] = low_high[c]
    for i in range(len(rows)):
        pose, weight, sides = work.positions[i], work.marker_velocities[i], work.side_weights[i]
        reach = max(work.gates[i], settings.min_distance)
        margin = 1.001 * reach  # rounding must not leave out a pair on the edge
        x0, y0, z0, x1, y1, z1 = _bound(pose)
        x0, y0, z0, x1, y1, z1 = (
            x0 - margin, y0 - margin, z0 - margin, x1 + margin, y1 + margin, z1 + margin,
        )  # fmt: skip
        weighed = False
        for j in range(len(people.ids)):
            work.mirrored[i, j], work.distances[i, j] = False, np.inf
            low_high = bounds[j]
            if not (
                low_high[0] <= x1 and low_high[3] >= x0
                and low_high[1] <= y1 and low_high[4] >= y0
                and low_high[2] <= z1 and low_high[5] >= z0
            ):  # fmt: skip
                continue
            if not weighed:
                _weigh_markers(rows[i], since, tracks, settings, weight, sides)
                weighed = True
            seen, confidence = people.markers[j], work.marker_confidences[j]
            # Beyond twice the reach a detection is mirrored if that brings it within the reach.
            distance = weighted_mean_distance(
                pose, seen, settings.same, weight, confidence, 2.0 * reach
            )
            swapped = straight = np.inf
            if settings.flip_aware and distance > _NOT_MIRRORED:
                swapped = weighted_mean_distance(
                    pose, seen, settings.mirror, sides, confidence, reach
                )
                straight = weighted_mean_distance(
                    pose, seen, settings.same, sides, confidence, 2.0 * reach
                )
            work.mirrored[i, j] = swapped < 0.5 * straight
            work.distances[i, j] = swapped if work.mirrored[i, j] else distance
    _leave_to_nearest(len(rows), len(people.ids), settings, work)


@inlined
def _leave_to_nearest(
    n_tracks: int, n_people: int, settings: TrackSettings, work: TrackWork
) -> None:
    """Keep a gate that has grown from taking a second view of somebody else."""
    distances, gates = work.distances, work.gates
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
    weights, confidences = work.marker_velocities[i], work.marker_confidences[j]
    weighs_velocities = settings.velocity_weight > 0.0 and markers.shape[1] > _TO_VELOCITY
    for m in range(len(markers)):
        d = point_distance(work.positions[i, m], markers[m])
        if math.isnan(d) or weights[m] == 0.0:
            continue
        common += 1
        if weighs_velocities and not math.isnan(markers[m, _TO_VELOCITY]):
            d += settings.velocity_weight * point_distance(velocities[m], markers[m, _TO_VELOCITY:])
        total += weights[m] * confidences[m] * d
    return total / common if common else np.inf  # eq 8


@inlined
def _angular_distance(
    i: int, j: int, people: People, velocities: Floats, settings: TrackSettings, work: TrackWork
) -> float:
    """Eq 9, 0 where no link is in common; ``velocities`` (L, 3) of the track."""
    total, common, links = 0.0, 0, people.links[j]
    weights, confidences = work.link_velocities[i], work.link_confidences[j]
    has_velocities = links.shape[1] > _TO_ANGULAR_VELOCITY
    weighs_velocities = settings.angular_velocity_weight > 0.0 and has_velocities
    for k in range(len(links)):
        product = dot(quaternion(work.orientations[i, k]), quaternion(links[k, _TO_ORIENTATION:]))
        if math.isnan(product):
            continue
        common += 1
        d = angle_of(product)  # eq 10
        if weighs_velocities and not math.isnan(links[k, _TO_ANGULAR_VELOCITY]):
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
    _confidence_weights(people.link_confidences, work.link_confidences)
    for i in range(len(rows)):
        velocities = tracks.velocities[rows[i]]
        angular_velocities = tracks.angular_velocities[rows[i]]
        weighed = False
        for j in range(len(people.ids)):
            if not work.wanted[j] or work.distances[i, j] > work.gates[i]:
                work.cost[i, j] = np.inf
            elif work.mirrored[i, j]:
                work.cost[i, j] = work.distances[i, j]
            else:
                if not weighed:
                    _velocity_weights(angular_velocities, settings, work.link_velocities[i])
                    weighed = True
                linear = _linear_distance(i, j, people, velocities, settings, work)
                angular = _angular_distance(i, j, people, angular_velocities, settings, work)
                work.cost[i, j] = linear + settings.orientation_weight * angular  # eq 6


@kernel
def association_cost(
    rows: Stamps, since: int, people: People, tracks: Tracks, settings: TrackSettings,
    work: TrackWork,
) -> None:  # fmt: skip
    """Compare every predicted track with every detection (eq 6 and 8 to 11).

    Eq 8 and 9 are means (alpha = 1, as in the published code). Fills the ``distances`` of
    ``work``, which the gate is for, since they depend on no velocities; ``mirrored``; and
    ``cost``, for the ``wanted`` detections. The orientations of a mirrored detection are wrong, so
    its cost is its distance. ``since`` is the time of the camera's message before, ns.
    """
    _compare(rows, since, people, tracks, settings, work)
    _fill_cost(rows, people, tracks, settings, work)


# Detections that are too far from their track


@inlined
def _distance_of_seen(
    i: int, j: int, people: People, settings: TrackSettings, work: TrackWork
) -> float:
    """Mean distance, m, of the markers that the detector sees; of all if it sees few.

    Those that it guesses may be half a metre off.
    """
    total, n, markers = 0.0, 0, people.markers[j]
    which, weights = settings.same, work.marker_velocities[i]
    if work.mirrored[i, j]:
        which, weights = settings.mirror, work.side_weights[i]
    for m in range(len(which)):
        distance = point_distance(work.positions[i, m], markers[which[m]])
        is_seen = weights[m] > 0.0 and work.hidden[j, which[m]] < MOSTLY_HIDDEN
        if is_seen and not math.isnan(distance):
            total, n = total + distance, n + 1
    return total / n if n >= _FEWEST_SEEN else work.distances[i, j]


@inlined
def breaks(i: int, j: int, people: People, settings: TrackSettings, work: TrackWork) -> bool:
    """Whether a detection is farther from a track that was just seen than a person can move."""
    unseen = work.unseen[i]
    if unseen > settings.horizon:
        return False
    distance = _distance_of_seen(i, j, people, settings, work)
    return distance > settings.max_jump + _FASTEST * max(unseen - _USUAL_INTERVAL, 0.0)
