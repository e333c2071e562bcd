"""Kernels of the tracker: predict, compare, assign, update (Hi-ROS 2023, section 3.1).

A bank of tracks is a few arrays with one row per track:

- ``motion`` (T, M, 3, 3): position, velocity, acceleration of each marker; m, m/s, m/s2
- ``spread`` (T, M, 6): covariance of one coordinate (all three share it), upper triangle
- ``seen`` (T, M): stamp of the last update, ns; 0 = this marker was never seen
- ``turn`` (T, L, 4), ``spin`` (T, L, 2, 3), ``turn_spread`` (T, L, 6), ``turn_seen`` (T, L):
  the same for link orientations, angular velocities and angular accelerations
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from hiros_mcap.kernels.compile import kernel
from hiros_mcap.skeletons import Flags, Floats, Ints, Stamps

# What may be wrong with a detection.
USABLE, EMPTY, DOUBTFUL = 0, 1, 2

_INFINITE = 1e18
_NOT_MIRRORED = 0.1  # m: a body whose sides are swapped is farther than this from its track


Quaternion = tuple[float, float, float, float]


@kernel
def multiply(a: Quaternion, b: Quaternion) -> Quaternion:
    """Quaternion product; x y z w. Tuples, since a view of an array costs more than the product."""
    return (
        a[3] * b[0] + a[0] * b[3] + a[1] * b[2] - a[2] * b[1],
        a[3] * b[1] - a[0] * b[2] + a[1] * b[3] + a[2] * b[0],
        a[3] * b[2] + a[0] * b[1] - a[1] * b[0] + a[2] * b[3],
        a[3] * b[3] - a[0] * b[0] - a[1] * b[1] - a[2] * b[2],
    )


@kernel
def exponential(x: float, y: float, z: float) -> Quaternion:
    """Quaternion of a rotation vector, rad."""
    square = x * x + y * y + z * z
    if square < 0.25:  # nearly always; the series are exact to 1e-11 and need no sine
        s = 0.5 + square * (-1 / 48 + square * (1 / 3840 - square / 645120))
        c = 1.0 + square * (-1 / 8 + square * (1 / 384 + square * (-1 / 46080 + square / 10321920)))
        return s * x, s * y, s * z, c
    angle = math.sqrt(square)
    s = math.sin(0.5 * angle) / angle
    return s * x, s * y, s * z, math.cos(0.5 * angle)


@kernel
def angle_of(dot: float) -> float:
    """Rotation angle between unit quaternions of this scalar product, eq 10, in [0, pi]."""
    return 2.0 * math.acos(min(1.0, abs(dot)))


@kernel
def norm3(x: float, y: float, z: float) -> float:
    """Length of a vector."""
    return math.sqrt(x * x + y * y + z * z)


@kernel
def _predict_markers(
    stamp: int, rows: Stamps, motion: Floats, seen: Stamps, horizon: float, out: Floats
) -> None:
    """Positions of :func:`predict`."""
    for i in range(len(rows)):
        row = rows[i]
        for m in range(motion.shape[1]):
            if seen[row, m] == 0:
                for c in range(3):
                    out[i, m, c] = np.nan
                continue
            dt = min(max((stamp - seen[row, m]) * 1e-9, 0.0), horizon)
            for c in range(3):
                out[i, m, c] = motion[row, m, 0, c] + dt * motion[row, m, 1, c]


@kernel(
    "void(int64, int64[::1], float64[:,:,:,::1], int64[:,::1], float64[:,:,::1],"
    " float64[:,:,:,::1], int64[:,::1], float64, float64[:,:,::1], float64[:,:,::1])",
)
def predict(
    stamp: int,
    rows: Stamps,
    motion: Floats,
    seen: Stamps,
    turn: Floats,
    spin: Floats,
    turn_seen: Stamps,
    horizon: float,
    out_positions: Floats,
    out_turns: Floats,
) -> None:
    """Pose of each track in ``rows`` at ``stamp``, by constant velocity (eq 7).

    Velocities carry on for ``horizon`` seconds at most; from then on the track stands still.
    Unseen markers and links become NaN. Outputs are (len(rows), M, 3) and (len(rows), L, 4).
    """
    _predict_markers(stamp, rows, motion, seen, horizon, out_positions)
    for i in range(len(rows)):
        row = rows[i]
        for k in range(turn.shape[1]):
            if turn_seen[row, k] == 0:
                for c in range(4):
                    out_turns[i, k, c] = np.nan
                continue
            dt = min(max((stamp - turn_seen[row, k]) * 1e-9, 0.0), horizon)
            step = exponential(
                dt * spin[row, k, 0, 0], dt * spin[row, k, 0, 1], dt * spin[row, k, 0, 2]
            )
            q = (turn[row, k, 0], turn[row, k, 1], turn[row, k, 2], turn[row, k, 3])
            turned = multiply(step, q)
            for c in range(4):
                out_turns[i, k, c] = turned[c]


@kernel
def _slow_down(velocities: Floats, decay: float, out: Floats) -> None:
    """Velocity weight of eq 11 for each row."""
    for m in range(velocities.shape[0]):
        speed = 1.0 + norm3(velocities[m, 0], velocities[m, 1], velocities[m, 2])
        if decay == 0.25:  # two roots are five times quicker than a power
            out[m] = 1.0 / math.sqrt(math.sqrt(speed))
        else:
            out[m] = speed**-decay


@kernel
def _marker_distance(
    positions: Floats, motion: Floats, markers: Floats, confidences: Floats, weights: Floats,
    by_confidence: bool, velocity_weight: float, exponent: float, linear: Floats, gap: Floats,
) -> None:  # fmt: skip
    """Write eq 8 and the weighted mean distance; leave both where nothing is in common."""
    cost = 0.0
    total = 0.0
    norm = 0.0
    common = 0
    for m in range(positions.shape[0]):
        d = norm3(
            positions[m, 0] - markers[m, 0],
            positions[m, 1] - markers[m, 1],
            positions[m, 2] - markers[m, 2],
        )
        if math.isnan(d):
            continue
        weight = weights[m]
        if by_confidence and not math.isnan(confidences[m]):
            weight *= confidences[m]
        common += 1
        norm += weight
        total += weight * d
        if velocity_weight > 0.0 and not math.isnan(markers[m, 7]):
            d += velocity_weight * norm3(
                motion[m, 1, 0] - markers[m, 7],
                motion[m, 1, 1] - markers[m, 8],
                motion[m, 1, 2] - markers[m, 9],
            )
        cost += weight * d
    if norm > 0.0:
        linear[0] = cost / common**exponent
        gap[0] = total / norm


@kernel
def _mean_distance(
    positions: Floats, markers: Floats, confidences: Floats, weights: Floats, mirror: Ints,
    by_confidence: bool, most: float, limit: float,
) -> float:  # fmt: skip
    """Weighted mean distance to the detection with its slots changed as ``mirror`` says.

    Infinite if undefined, or as soon as it is known to be beyond ``limit``. ``most`` is at least 1
    and every confidence, of which none is negative; no weight is above 1.
    """
    total = norm = 0.0
    n = positions.shape[0]
    for m in range(n):
        other = mirror[m]
        d = norm3(
            positions[m, 0] - markers[other, 0],
            positions[m, 1] - markers[other, 1],
            positions[m, 2] - markers[other, 2],
        )
        if not math.isnan(d):
            weight = weights[m]
            if by_confidence and not math.isnan(confidences[other]):
                weight *= confidences[other]
            norm += weight
            total += weight * d
        if (m & 7) == 7 and total > limit * (norm + (n - 1 - m) * most):
            return np.inf
    return total / norm if norm > 0.0 else np.inf


@kernel
def _link_distance(
    turns: Floats, spin: Floats, links: Floats, confidences: Floats, weights: Floats,
    by_confidence: bool, velocity_weight: float, exponent: float,
) -> float:  # fmt: skip
    """Eq 9; 0 where no link is in common."""
    cost = 0.0
    common = 0
    for k in range(turns.shape[0]):
        if math.isnan(turns[k, 0]) or math.isnan(links[k, 3]):
            continue
        weight = weights[k]
        if by_confidence and not math.isnan(confidences[k]):
            weight *= confidences[k]
        d = angle_of(
            turns[k, 0] * links[k, 3]
            + turns[k, 1] * links[k, 4]
            + turns[k, 2] * links[k, 5]
            + turns[k, 3] * links[k, 6]
        )
        common += 1
        if velocity_weight > 0.0 and not math.isnan(links[k, 10]):
            d += velocity_weight * norm3(
                spin[k, 0, 0] - links[k, 10],
                spin[k, 0, 1] - links[k, 11],
                spin[k, 0, 2] - links[k, 12],
            )
        cost += weight * d
    return cost / common**exponent if common else 0.0


@kernel
def distances(
    positions: Floats,
    turns: Floats,
    rows: Stamps,
    motion: Floats,
    spin: Floats,
    markers: Floats,
    marker_confidences: Floats,
    links: Floats,
    link_confidences: Floats,
    mirror: Ints,
    by_confidence: bool,
    by_velocity: bool,
    velocity_decay: float,
    velocity_weight: float,
    angular_velocity_weight: float,
    exponent: float,
    gate: float,
    marker_weights: Floats,
    link_weights: Floats,
    linear: Floats,
    angular: Floats,
    gap: Floats,
    mirrored_gap: Floats,
) -> None:
    """Distances of every (predicted track, detection) pair; all outputs are (T, P).

    ``linear`` and ``angular`` are eq 8 and 9 with the weights of eq 11. ``gap`` is the weighted
    mean distance of the common markers, m (what gates are compared with: unlike eq 8 it does not
    depend on the exponent or on velocities); ``mirrored_gap`` the same with the detection's left
    and right swapped. Without a common marker all four are infinite (eq 8 has no value there).
    """
    n_tracks, n_people = positions.shape[0], markers.shape[0]
    for i in range(n_tracks):
        row = rows[i]
        if by_velocity:
            _slow_down(motion[row, :, 1], velocity_decay, marker_weights)
            _slow_down(spin[row, :, 0], velocity_decay, link_weights)
        for j in range(n_people):
            linear[i, j] = angular[i, j] = gap[i, j] = mirrored_gap[i, j] = np.inf
            _marker_distance(
                positions[i], motion[row], markers[j], marker_confidences[j], marker_weights,
                by_confidence, velocity_weight, exponent, linear[i, j : j + 1], gap[i, j : j + 1],
            )  # fmt: skip
            if gap[i, j] > _NOT_MIRRORED:
                mirrored_gap[i, j] = _mean_distance(
                    positions[i], markers[j], marker_confidences[j], marker_weights, mirror,
                    by_confidence, 1.0, np.inf,
                )  # fmt: skip
            if min(gap[i, j], mirrored_gap[i, j]) <= gate:
                angular[i, j] = _link_distance(
                    turns[i], spin[row], links[j], link_confidences[j], link_weights,
                    by_confidence, angular_velocity_weight, exponent,
                )  # fmt: skip


@kernel
def _pair_up(
    positions: Floats,
    rows: Stamps,
    motion: Floats,
    markers: Floats,
    confidences: Floats,
    mirror: Ints,
    numbers: Floats,
    wanted: Flags,
    weights: Floats,
    order: Ints,
    gap: Floats,
    match: Stamps,
    flipped: Flags,
) -> bool:
    """Do what :func:`associate` does where there is nothing to choose; False = there is.

    Then no track is near two detections, nor a detection near two tracks, and what a pair costs
    does not matter. ``weights`` and ``order`` (M,) are scratch.
    """
    gate, by_confidence = numbers[1], numbers[3] > 0.0
    reach = max(gate, numbers[10])
    for m in range(len(order)):
        order[m] = m
    for j in range(len(wanted)):
        match[j] = -1
        flipped[j] = False
    for i in range(len(rows)):
        if numbers[4] > 0.0:
            _slow_down(motion[rows[i], :, 1], numbers[5], weights)
        found = False
        for j in range(len(wanted)):
            most = 1.0
            for m in range(len(order)):
                if confidences[j, m] > most:
                    most = confidences[j, m]
            # Who is farther than twice the reach is certainly turned round if that brings him near.
            near = _mean_distance(
                positions[i], markers[j], confidences[j], weights, order, by_confidence, most,
                2.0 * reach,
            )  # fmt: skip
            turned = np.inf
            if near > _NOT_MIRRORED and numbers[9] > 0.0:
                turned = _mean_distance(
                    positions[i], markers[j], confidences[j], weights, mirror, by_confidence,
                    most, reach,
                )  # fmt: skip
            is_turned = turned < 0.5 * near
            gap[i, j] = turned if is_turned else near
            if gap[i, j] > gate or not wanted[j]:
                continue
            if found or match[j] >= 0:
                return False
            found = True
            match[j] = i
            flipped[j] = is_turned
    return True


@njit("int64[::1](float64[:,::1])", cache=True, nogil=True)
def assign(cost: Floats) -> Stamps:
    """Row assigned to each column with the least total cost; -1 = none.

    ``cost`` is (R, C); infinite entries are never assigned. Shortest augmenting paths with
    potentials, the modern form of the Munkres algorithm that section 3.1.2 names: as many finite
    pairs as possible, then the least sum.
    """
    n_rows, n_columns = cost.shape
    result = np.full(n_columns, -1, np.int64)
    if n_rows == 0 or n_columns == 0:
        return result
    size = max(n_rows, n_columns)
    # Forbidden pairs and padding cost more than any set of allowed ones together.
    largest = 0.0
    for i in range(n_rows):
        for j in range(n_columns):
            if cost[i, j] < _INFINITE:
                largest = max(largest, abs(cost[i, j]))
    forbidden = (2.0 * largest + 1.0) * (size + 1)
    u = np.zeros(size + 1)
    v = np.zeros(size + 1)
    row_of = np.zeros(size + 1, np.int64)
    way = np.zeros(size + 1, np.int64)
    for i in range(1, size + 1):
        row_of[0] = i
        j0 = 0
        least = np.full(size + 1, np.inf)
        used = np.zeros(size + 1, np.bool_)
        while True:
            used[j0] = True
            i0 = row_of[j0]
            delta = np.inf
            j1 = 0
            for j in range(1, size + 1):
                if used[j]:
                    continue
                entry = forbidden
                if i0 <= n_rows and j <= n_columns and cost[i0 - 1, j - 1] < _INFINITE:
                    entry = cost[i0 - 1, j - 1]
                reduced = entry - u[i0] - v[j]
                if reduced < least[j]:
                    least[j] = reduced
                    way[j] = j0
                if least[j] < delta:
                    delta = least[j]
                    j1 = j
            for j in range(size + 1):
                if used[j]:
                    u[row_of[j]] += delta
                    v[j] -= delta
                else:
                    least[j] -= delta
            j0 = j1
            if row_of[j0] == 0:
                break
        while j0 != 0:
            row_of[j0] = row_of[way[j0]]
            j0 = way[j0]
    for j in range(1, n_columns + 1):
        i = row_of[j]
        if i <= n_rows and cost[i - 1, j - 1] < _INFINITE:
            result[j - 1] = i - 1
    return result


@njit(
    "void(int64, int64[::1], float64[:,:,:,::1], int64[:,::1], float64[:,:,::1],"
    " float64[:,:,:,::1], int64[:,::1], float64[:,:,::1], float64[:,::1], float64[:,:,::1],"
    " float64[:,::1], int32[::1], float64[::1], boolean[::1], float64[:,::1], int64[::1],"
    " boolean[::1])",
    cache=True,
    nogil=True,
)
def associate(
    stamp: int,
    rows: Stamps,
    motion: Floats,
    seen: Stamps,
    turn: Floats,
    spin: Floats,
    turn_seen: Stamps,
    markers: Floats,
    marker_confidences: Floats,
    links: Floats,
    link_confidences: Floats,
    mirror: Ints,
    numbers: Floats,
    wanted: Flags,
    gap: Floats,
    match: Stamps,
    flipped: Flags,
) -> None:
    """Associate the ``wanted`` (P,) detections with the tracks in ``rows`` (eq 6 to 11).

    ``numbers``: horizon, gate, weight of the angular cost, by confidence, by velocity, velocity
    decay, velocity weight, angular velocity weight, exponent, flip aware, reach (as stages/track.py
    packs them). Outputs: ``gap`` (T, P) mean distance of each pair, the mirrored one where that is
    less than half, right within the gate and the reach, anything beyond them where it is beyond;
    ``match`` (P,) index into ``rows``, -1 = none within the gate; ``flipped`` (P,).
    """
    n_tracks, n_people = len(rows), len(wanted)
    positions = np.empty((n_tracks, motion.shape[1], 3))
    _predict_markers(stamp, rows, motion, seen, numbers[0], positions)
    if _pair_up(
        positions, rows, motion, markers, marker_confidences, mirror, numbers, wanted,
        np.ones(motion.shape[1]), np.empty(motion.shape[1], np.int32), gap, match, flipped,
    ):  # fmt: skip
        return
    turns = np.empty((n_tracks, turn.shape[1], 4))
    predict(stamp, rows, motion, seen, turn, spin, turn_seen, numbers[0], positions, turns)
    linear = np.empty((n_tracks, n_people))
    angular = np.empty((n_tracks, n_people))
    mirrored = np.empty((n_tracks, n_people))
    distances(
        positions, turns, rows, motion, spin, markers, marker_confidences, links,
        link_confidences, mirror, numbers[3] > 0.0, numbers[4] > 0.0, numbers[5], numbers[6],
        numbers[7], numbers[8], numbers[1], np.ones(motion.shape[1]), np.ones(turn.shape[1]),
        linear, angular, gap, mirrored,
    )  # fmt: skip
    turned = np.zeros((n_tracks, n_people), np.bool_)
    for i in range(n_tracks):
        for j in range(n_people):
            linear[i, j] += numbers[2] * angular[i, j]
            if numbers[9] > 0.0 and mirrored[i, j] < 0.5 * gap[i, j]:
                turned[i, j] = True
                linear[i, j] = mirrored[i, j]
                gap[i, j] = mirrored[i, j]
            if gap[i, j] > numbers[1] or not wanted[j]:
                linear[i, j] = np.inf
    found = assign(linear)
    for j in range(n_people):
        match[j] = found[j]
        flipped[j] = found[j] >= 0 and turned[found[j], j]


@kernel("void(float64[:,:,:,::1], int64[:,::1], int64, float64[::1])", nogil=False)
def centre(motion: Floats, seen: Stamps, row: int, out: Floats) -> None:
    """Write the mean position (3,) of a track's markers, m; NaN before any was seen."""
    count = x = y = z = 0.0
    for m in range(motion.shape[1]):
        if seen[row, m] > 0:
            count += 1.0
            x += motion[row, m, 0, 0]
            y += motion[row, m, 0, 1]
            z += motion[row, m, 0, 2]
    out[0], out[1], out[2] = x / count, y / count, z / count


Noise = tuple[float, float, float, float, float, float]


@kernel
def _noise(dt: float, jerk: float) -> Noise:
    """Covariance that white jerk adds to a constant-acceleration state in ``dt`` s."""
    q = jerk * jerk
    dt2 = dt * dt
    dt3 = dt2 * dt
    return q * dt3 * dt2 / 20, q * dt2 * dt2 / 8, q * dt3 / 6, q * dt3 / 3, q * dt2 / 2, q * dt


@kernel
def _grow(spread: Floats, row: int, m: int, dt: float, noise: Noise) -> None:
    """Covariance prediction of a constant-acceleration state; ``noise`` of that interval."""
    p00, p01, p02 = spread[row, m, 0], spread[row, m, 1], spread[row, m, 2]
    p11, p12, p22 = spread[row, m, 3], spread[row, m, 4], spread[row, m, 5]
    h = 0.5 * dt * dt
    dt2 = dt * dt
    spread[row, m, 0] = (
        p00 + 2 * dt * p01 + 2 * h * p02 + dt2 * p11 + 2 * dt * h * p12 + h * h * p22 + noise[0]
    )
    spread[row, m, 1] = p01 + dt * p02 + dt * p11 + (dt2 + h) * p12 + dt * h * p22 + noise[1]
    spread[row, m, 2] = p02 + dt * p12 + h * p22 + noise[2]
    spread[row, m, 3] = p11 + 2 * dt * p12 + dt2 * p22 + noise[3]
    spread[row, m, 4] = p12 + dt * p22 + noise[4]
    spread[row, m, 5] = p22 + noise[5]


@kernel
def _start(spread: Floats, row: int, m: int, noise: float, speed: float, boost: float) -> None:
    """Covariance of a state of which only the position is known."""
    for c in range(6):
        spread[row, m, c] = 0.0
    spread[row, m, 0], spread[row, m, 3], spread[row, m, 5] = noise, speed, boost


@kernel
def _absorb(
    spread: Floats, row: int, m: int, noise: float, square: float, gate: float
) -> tuple[float, float, float]:
    """Kalman gain for an innovation of that squared length; the covariance becomes the posterior.

    An innovation beyond ``gate`` standard deviations gets its noise inflated until it lies on the
    gate (as eq 10 of Malaguti 2019 does): a guessed joint moves the track a little, not at all a
    real fast motion, whose innovations agree with each other.
    """
    p00, p01, p02 = spread[row, m, 0], spread[row, m, 1], spread[row, m, 2]
    total = max(p00 + noise, square / (gate * gate))
    part = 1.0 / total  # quicker than three quotients
    k0, k1, k2 = p00 * part, p01 * part, p02 * part
    spread[row, m, 0] -= k0 * p00
    spread[row, m, 1] -= k0 * p01
    spread[row, m, 2] -= k0 * p02
    spread[row, m, 3] -= k1 * p01
    spread[row, m, 4] -= k1 * p02
    spread[row, m, 5] -= k2 * p02
    return k0, k1, k2


@kernel
def _update_markers(
    stamp: int,
    row: int,
    person: int,
    motion: Floats,
    spread: Floats,
    seen: Stamps,
    markers: Floats,
    confidences: Floats,
    flipped: bool,
    mirror: Ints,
    numbers: Floats,
) -> None:
    horizon, position_noise, jerk = numbers[0], numbers[1], numbers[2]
    gate, fastest = numbers[5], numbers[6]
    interval, growth = 0.0, _noise(0.0, jerk)
    for m in range(motion.shape[1]):
        slot = mirror[m] if flipped else m
        if math.isnan(markers[person, slot, 0]):
            continue
        dt = (stamp - seen[row, m]) * 1e-9
        noise = position_noise * position_noise
        if not math.isnan(confidences[person, slot]):
            noise /= max(confidences[person, slot], 0.05)
        if seen[row, m] == 0 or dt > 4.0 * horizon:
            for c in range(3):
                motion[row, m, 0, c] = markers[person, slot, c]
                motion[row, m, 1, c] = motion[row, m, 2, c] = 0.0
            _start(spread, row, m, noise, 1.0, 25.0)
            seen[row, m] = stamp
        else:
            if dt > 0.0:
                reach = min(dt, horizon)
                for c in range(3):
                    if dt > horizon:
                        motion[row, m, 2, c] = 0.0
                    boost = motion[row, m, 2, c]
                    motion[row, m, 0, c] += reach * (motion[row, m, 1, c] + 0.5 * reach * boost)
                    motion[row, m, 1, c] += reach * boost
                if dt != interval:  # markers are mostly seen together
                    interval, growth = dt, _noise(dt, jerk)
                _grow(spread, row, m, dt, growth)
                seen[row, m] = stamp
            ex = markers[person, slot, 0] - motion[row, m, 0, 0]
            ey = markers[person, slot, 1] - motion[row, m, 0, 1]
            ez = markers[person, slot, 2] - motion[row, m, 0, 2]
            k = _absorb(spread, row, m, noise, ex * ex + ey * ey + ez * ez, gate)
            for order in range(3):
                motion[row, m, order, 0] += k[order] * ex
                motion[row, m, order, 1] += k[order] * ey
                motion[row, m, order, 2] += k[order] * ez
            square = motion[row, m, 1, 0] ** 2 + motion[row, m, 1, 1] ** 2
            square += motion[row, m, 1, 2] ** 2
            if square > fastest * fastest:
                speed = math.sqrt(square)
                for c in range(3):
                    motion[row, m, 1, c] *= fastest / speed
                    motion[row, m, 2, c] = 0.0
        if math.isnan(markers[person, slot, 7]):
            for c in range(3):
                markers[person, slot, 7 + c] = motion[row, m, 1, c]
        if math.isnan(markers[person, slot, 13]):
            for c in range(3):
                markers[person, slot, 13 + c] = motion[row, m, 2, c]


@kernel
def _rotation_vector(q: Quaternion) -> tuple[float, float, float]:
    """Rotation vector, rad, along the shortest path, of a unit quaternion."""
    sign = 1.0 if q[3] >= 0.0 else -1.0
    square = q[0] * q[0] + q[1] * q[1] + q[2] * q[2]
    if square < 0.01:  # the series of the arc sine, exact to 1e-11
        scale = 2.0 * sign * (1.0 + square * (1 / 6 + square * (3 / 40 + square * (
            5 / 112 + square * 35 / 1152))))  # fmt: skip
    else:
        sine = math.sqrt(square)
        scale = 2.0 * sign * math.atan2(sine, abs(q[3])) / sine
    return scale * q[0], scale * q[1], scale * q[2]


@kernel
def _update_links(
    stamp: int,
    row: int,
    person: int,
    turn: Floats,
    spin: Floats,
    spread: Floats,
    seen: Stamps,
    links: Floats,
    numbers: Floats,
) -> None:
    horizon, orientation_noise, angular_jerk, gate = numbers[0], numbers[3], numbers[4], numbers[5]
    noise = orientation_noise * orientation_noise
    interval, growth = 0.0, _noise(0.0, angular_jerk)
    for k in range(turn.shape[1]):
        if math.isnan(links[person, k, 3]):
            continue
        z = (links[person, k, 3], links[person, k, 4], links[person, k, 5], links[person, k, 6])
        dt = (stamp - seen[row, k]) * 1e-9
        if seen[row, k] == 0 or dt > 4.0 * horizon:
            for c in range(4):
                turn[row, k, c] = z[c]
            for c in range(3):
                spin[row, k, 0, c] = spin[row, k, 1, c] = 0.0
            _start(spread, row, k, noise, 4.0, 100.0)
            seen[row, k] = stamp
        else:
            q = (turn[row, k, 0], turn[row, k, 1], turn[row, k, 2], turn[row, k, 3])
            if dt > 0.0:
                reach = min(dt, horizon)
                q = multiply(
                    exponential(
                        reach * (spin[row, k, 0, 0] + 0.5 * reach * spin[row, k, 1, 0]),
                        reach * (spin[row, k, 0, 1] + 0.5 * reach * spin[row, k, 1, 1]),
                        reach * (spin[row, k, 0, 2] + 0.5 * reach * spin[row, k, 1, 2]),
                    ),
                    q,
                )
                for c in range(3):
                    spin[row, k, 0, c] += reach * spin[row, k, 1, c]
                if dt != interval:
                    interval, growth = dt, _noise(dt, angular_jerk)
                _grow(spread, row, k, dt, growth)
                seen[row, k] = stamp
            e = _rotation_vector(multiply(z, (-q[0], -q[1], -q[2], q[3])))
            square = e[0] * e[0] + e[1] * e[1] + e[2] * e[2]
            gain = _absorb(spread, row, k, noise, square, gate)
            q = multiply(exponential(gain[0] * e[0], gain[0] * e[1], gain[0] * e[2]), q)
            scale = 1.0 / math.sqrt(q[0] ** 2 + q[1] ** 2 + q[2] ** 2 + q[3] ** 2)
            for c in range(4):
                turn[row, k, c] = q[c] * scale
            for c in range(3):
                spin[row, k, 0, c] += gain[1] * e[c]
                spin[row, k, 1, c] += gain[2] * e[c]
        if math.isnan(links[person, k, 10]):
            for c in range(3):
                links[person, k, 10 + c] = spin[row, k, 0, c]
        if math.isnan(links[person, k, 16]):
            for c in range(3):
                links[person, k, 16 + c] = spin[row, k, 1, c]


@kernel(
    "void(int64, int64[::1], float64[:,:,:,::1], float64[:,:,::1], int64[:,::1],"
    " float64[:,:,::1], float64[:,:,:,::1], float64[:,:,::1], int64[:,::1],"
    " float64[:,:,::1], float64[:,::1], float64[:,:,::1], boolean[::1],"
    " int32[::1], float64[::1])",
)
def update(
    stamp: int,
    row_of: Stamps,
    motion: Floats,
    spread: Floats,
    seen: Stamps,
    turn: Floats,
    spin: Floats,
    turn_spread: Floats,
    turn_seen: Stamps,
    markers: Floats,
    marker_confidences: Floats,
    links: Floats,
    flipped: Flags,
    mirror: Ints,
    numbers: Floats,
) -> None:
    """Bring the tracks to ``stamp`` with their detections; fill the detections' velocities.

    ``row_of`` (P,) is the track of each detection, -1 = none; ``numbers``: horizon, position
    noise, jerk, orientation noise, angular jerk, innovation gate, greatest speed.

    Constant-acceleration Kalman filter per marker, driven by white jerk; a filter, not finite
    differences, because two cameras may see the same person 0.2 ms apart (a quotient by that
    explodes). ``markers`` and ``links`` are the frame's own copy: where the detector left
    velocities and accelerations open, the track's are written. A flipped detection moves the track
    with its sides swapped and leaves orientations alone.
    """
    for person in range(len(row_of)):
        if row_of[person] >= 0:
            _update_markers(
                stamp, row_of[person], person, motion, spread, seen, markers,
                marker_confidences, flipped[person], mirror, numbers,
            )  # fmt: skip
            if not flipped[person]:
                _update_links(
                    stamp, row_of[person], person, turn, spin, turn_spread, turn_seen, links,
                    numbers,
                )  # fmt: skip


@kernel
def _leave_out(states: Floats, confidences: Floats, least: float, person: int) -> bool:
    """Make a person's states of too little confidence absent; whether any is there."""
    some = False
    for m in range(states.shape[1]):
        if confidences[person, m] < least:
            for c in range(states.shape[2]):
                states[person, m, c] = np.nan
        some = some or not math.isnan(states[person, m, 0])
    return some


@njit(inline="always")
def _follow(
    stamp: int,
    rows: Stamps,
    motion: Floats,
    spread: Floats,
    seen: Stamps,
    turn: Floats,
    spin: Floats,
    turn_spread: Floats,
    turn_seen: Stamps,
    confidences: Floats,
    markers: Floats,
    marker_confidences: Floats,
    links: Floats,
    link_confidences: Floats,
    mirror: Ints,
    association: Floats,
    dynamics: Floats,
    least: Floats,
    gap: Floats,
    match: Stamps,
    fault: Stamps,
) -> None:
    """Take over a message: find the track of each person among ``rows``, and move it."""
    n_people = len(confidences)
    wanted, flipped = np.empty(n_people, np.bool_), np.empty(n_people, np.bool_)
    for j in range(n_people):
        some = _leave_out(markers, marker_confidences, least[1], j)
        _leave_out(links, link_confidences, least[1], j)
        fault[j] = EMPTY
        if some:
            fault[j] = DOUBTFUL if confidences[j] < least[0] else USABLE
        wanted[j] = fault[j] == USABLE
        match[j] = -1
    if len(rows):
        associate(
            stamp, rows, motion, seen, turn, spin, turn_seen, markers, marker_confidences,
            links, link_confidences, mirror, association, wanted, gap, match, flipped,
        )  # fmt: skip
    row_of = np.empty(n_people, np.int64)
    for j in range(n_people):
        row_of[j] = rows[match[j]] if match[j] >= 0 else -1
    update(
        stamp, row_of, motion, spread, seen, turn, spin, turn_spread, turn_seen, markers,
        marker_confidences, links, flipped, mirror, dynamics,
    )  # fmt: skip


@njit(
    "UniTuple(int64, 2)(int64[::1], int64[:,::1], boolean[::1], int64, int64[::1], int32[::1],"
    " float64[:,:,:,::1], float64[:,:,::1], int64[:,::1], float64[:,:,::1], float64[:,:,:,::1],"
    " float64[:,:,::1], int64[:,::1], float64[::1], float64[:,:,::1], float64[:,::1],"
    " float64[:,:,::1], float64[:,::1], int32[::1], float64[::1], float64[::1], float64[::1],"
    " int32[::1], int64[::1], float64[:,::1], float64[::1], int64[::1], int64[::1])",
    cache=True,
    nogil=True,
)
def follow(
    stamps: Stamps,
    places: Stamps,
    teaches: Flags,
    expiry: int,
    rows: Stamps,
    persons: Ints,
    motion: Floats,
    spread: Floats,
    seen: Stamps,
    turn: Floats,
    spin: Floats,
    turn_spread: Floats,
    turn_seen: Stamps,
    confidences: Floats,
    markers: Floats,
    marker_confidences: Floats,
    links: Floats,
    link_confidences: Floats,
    mirror: Ints,
    association: Floats,
    dynamics: Floats,
    least: Floats,
    ids: Ints,
    latest: Stamps,
    centres: Floats,
    gap: Floats,
    match: Stamps,
    fault: Stamps,
) -> tuple[int, int]:
    """Take over messages: find the track of each person among ``rows``, and move it.

    Stops before a message, not the first, that is not older than ``expiry``, ns; and after one
    that has somebody who is of no track.

    Parameters
    ----------
    stamps, places, teaches : (K,), (K, 2), (K,) time of each message, ns, the first row of its
        people and the one after the last, and whether ``centres`` are wanted.
    rows, persons : (T,) bank row and id of each track.
    confidences, markers, marker_confidences, links, link_confidences : (P, ...) of everybody;
        ``markers`` and ``links`` get the tracks' velocities.
    association, dynamics : the numbers of :func:`associate` and :func:`update`.
    least : confidences below which a skeleton is left out, and a marker or link absent.
    ids : (P,) written where somebody is of a track.
    centres : (P, 3) mean position of the tracks' markers after the message, m.
    latest : (T,) last time at which each track was seen, where that is later.
    gap : room for T times the people of any message; those of the last one, as (T, P) numbers of
        :func:`associate`.
    match, fault : (P,) as in :func:`associate`; USABLE, EMPTY or DOUBTFUL.

    Returns
    -------
    How many messages were taken over, and 1 if the last of them made it stop.
    """
    for i in range(len(stamps)):
        stamp, a, b = stamps[i], places[i, 0], places[i, 1]
        if i > 0 and stamp >= expiry:
            return i, 0
        _follow(
            stamp, rows, motion, spread, seen, turn, spin, turn_spread, turn_seen,
            confidences[a:b], markers[a:b], marker_confidences[a:b], links[a:b],
            link_confidences[a:b], mirror, association, dynamics, least,
            gap[: len(rows) * (b - a)].reshape((len(rows), b - a)), match[a:b],
            fault[a:b],
        )  # fmt: skip
        stop = False
        for j in range(a, b):
            k = match[j]
            if k < 0:
                stop = True
                continue
            ids[j] = persons[k]
            latest[k] = max(latest[k], stamp)
            if teaches[i]:
                centre(motion, seen, rows[k], centres[j])
        if stop:
            return i + 1, 1
    return len(stamps), 0
