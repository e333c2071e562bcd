"""Kalman filter and fixed-lag smoother on R3 and SO(3), shared by markers and links.

A person has T tracks, in four blocks: the positions of the M markers, the orientations of the L
links, the positions of the links, the orientations of the markers. A track's state is its pose
(3 numbers, or a unit quaternion x y z w), velocity and acceleration, in the fixed frame. On SO(3)
the error is the rotation vector from the left, ``q = exp(error) * q_predicted``: the same linear
filter then serves both kinds, and a quaternion's sign is of no consequence.

The smoother is Bryson and Frazier's: where Rauch, Tung and Striebel go back over states, it
carries back an adjoint of the innovations, ``state = predicted + covariance @ adjoint``. It needs
no inverse and, on SO(3), a single exponential per output.

One ring of R slots per person (R a power of two) holds what the backward pass reads.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
from numba import njit

from hiros_mcap.kernels.compile import kernel

Floats = npt.NDArray[np.float64]
Links = npt.NDArray[np.int32]
Stamps = npt.NDArray[np.int64]

# Columns of a ring (R, T, COLUMNS). POSE to CONFIDENCE are common to every filter, POSE to BEND
# being what the filter predicted (state space) or filtered (Butterworth).
POSE = 0  # 3 numbers or a quaternion
RATE = 4  # velocity
BEND = 7  # acceleration
DELTA = 10  # innovation; Butterworth: step from the previous slot
CONTINUES = 13  # 1 where the track goes on from the previous slot, 0 where it starts or is not
AGE = 14  # s since the track was seen; inf = no track
CONFIDENCE = 15  # when it was last seen
INFORMATION = 16  # 1 / innovation variance; 0 = not seen
COVARIANCE = 17  # predicted; 00 01 02 11 12 22; its first three times INFORMATION are the gain
COLUMNS = 23

# Columns of what _state_space_push carries on, (T, STATE); POSE to BEND as in a ring, filtered.
NOW_COVARIANCE = 10
NOW_AGE = 16
NOW_CONFIDENCE = 17
STATE = 18

# Kinds of jobs, and the signature of what does them.
PUSH, EMIT = 0, 1
RUN = (
    "void(int64[:,::1], float64[:,::1], int64, float64[::1], int32[:,::1], float64[:,:,::1],"
    " float64[:,:,::1], float64[:,::1], float64[:,::1], float64[:,:,:,::1], float64[:,::1],"
    " float64[:,:,::1], float64[:,:,::1], float64[:,:,::1], float64[:,:,::1], float64[:,::1],"
    " float64[:,::1])"
)

DIFFUSE = 1e6  # initial variance over that of a measurement


@kernel
def log_between(q: Any, p: Any, out: Any) -> None:
    """Rotation vector of ``q * conj(p)``, the shorter way round, into ``out`` (3)."""
    w = q[3] * p[3] + q[0] * p[0] + q[1] * p[1] + q[2] * p[2]
    x = q[0] * p[3] - q[3] * p[0] - q[1] * p[2] + q[2] * p[1]
    y = q[1] * p[3] - q[3] * p[1] - q[2] * p[0] + q[0] * p[2]
    z = q[2] * p[3] - q[3] * p[2] - q[0] * p[1] + q[1] * p[0]
    if w < 0.0:
        w, x, y, z = -w, -x, -y, -z
    sine = np.sqrt(x * x + y * y + z * z)
    factor = 2.0 if sine < 1e-9 else 2.0 * np.arctan2(sine, w) / sine
    out[0], out[1], out[2] = factor * x, factor * y, factor * z


@kernel
def exp_times(v: Any, q: Any, out: Any) -> None:
    """Write the unit quaternion ``exp(v) * q`` into ``out`` (4), which may be ``q`` itself."""
    angle = np.sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2])
    factor = 0.5 if angle < 1e-9 else np.sin(0.5 * angle) / angle
    a, b, c, d = factor * v[0], factor * v[1], factor * v[2], np.cos(0.5 * angle)
    x = d * q[0] + a * q[3] + b * q[2] - c * q[1]
    y = d * q[1] + b * q[3] + c * q[0] - a * q[2]
    z = d * q[2] + c * q[3] + a * q[1] - b * q[0]
    w = d * q[3] - a * q[0] - b * q[1] - c * q[2]
    scale = 1.0 / np.sqrt(x * x + y * y + z * z + w * w)
    out[0], out[1], out[2], out[3] = x * scale, y * scale, z * scale, w * scale


@kernel
def difference(z: Any, pose: Any, turning: bool, out: Any) -> None:
    """``z - pose`` in the track's tangent space."""
    if turning:
        log_between(z, pose, out)
    else:
        for c in range(3):
            out[c] = z[c] - pose[c]


@kernel
def displace(v: Any, pose: Any, turning: bool, out: Any) -> None:
    """``pose + v`` in the track's tangent space."""
    if turning:
        exp_times(v, pose, out)
    else:
        for c in range(3):
            out[c] = pose[c] + v[c]


@kernel
def block_of(block: int, n_markers: int, n_links: int) -> tuple[bool, bool, int, int]:
    """Of block 0 to 3: whether it is the markers', whether it turns, its first track, its size."""
    if block == 0:
        return True, False, 0, n_markers
    if block == 1:
        return False, True, n_markers, n_links
    if block == 2:
        return False, False, n_markers + n_links, n_links
    return True, True, n_markers + 2 * n_links, n_markers


@kernel
def measure(elements: Any, k: int, turning: bool, z: Any) -> bool:
    """Copy a KinematicState's position or normalised orientation to ``z``; False if absent."""
    if not turning:
        for c in range(3):
            z[c] = elements[k, c]
        z[3] = 0.0
        return bool(np.isfinite(z[0] + z[1] + z[2]))
    norm = 0.0
    for c in range(4):
        z[c] = elements[k, 3 + c]
        norm += z[c] * z[c]
    if not (1e-12 < norm < np.inf):
        return False
    norm = np.sqrt(norm)
    for c in range(4):
        z[c] /= norm
    return True


@kernel
def predict_covariance(p: Any, dt: float, noise: float, order: int) -> None:
    """``F P F' + Q`` of integrated white noise in place, for ``p`` = 00 01 02 11 12 22."""
    a, b = dt, 0.5 * dt * dt
    p00, p01, p02, p11, p12, p22 = p[0], p[1], p[2], p[3], p[4], p[5]
    p[0] = p00 + a * (2.0 * p01 + a * p11 + 2.0 * b * p12) + b * (2.0 * p02 + b * p22)
    p[1] = p01 + a * (p02 + p11) + (a * a + b) * p12 + a * b * p22
    p[2] = p02 + a * p12 + b * p22
    p[3] = p11 + a * (2.0 * p12 + a * p22)
    p[4] = p12 + a * p22
    if order == 2:
        p[0] += noise * dt**3 / 3.0
        p[1] += noise * dt * dt / 2.0
        p[3] += noise * dt
        return
    p[0] += noise * dt**5 / 20.0
    p[1] += noise * dt**4 / 8.0
    p[2] += noise * dt**3 / 6.0
    p[3] += noise * dt**3 / 3.0
    p[4] += noise * dt * dt / 2.0
    p[5] += noise * dt


@kernel
def update_covariance(p: Any, gain: Any) -> float:
    """Gain into ``gain`` (3), ``(I - K H) P`` into ``p``; returns 1 / innovation variance."""
    information = 1.0 / (p[0] + 1.0)
    p0, p1, p2 = p[0], p[1], p[2]
    gain[0], gain[1], gain[2] = p0 * information, p1 * information, p2 * information
    p[0] = p0 * information  # = (1 - K0) p0, without the cancellation
    p[1] = p1 * information
    p[2] = p2 * information
    p[3] -= gain[1] * p1
    p[4] -= gain[1] * p2
    p[5] -= gain[2] * p2
    return float(information)


@njit("float64(int64, float64, float64, int64, float64)", cache=True, nogil=True)
def state_space_gain(order: int, noise: float, dt: float, ahead: int, frequency: float) -> float:
    """Magnitude response of the steady filter (``ahead`` = 0) or fixed-lag smoother.

    ``noise`` is the spectral density of the integrated white noise over the variance of a
    measurement, ``dt`` the sample time in s, ``ahead`` the look-ahead in samples.
    """
    p, before, gain = np.zeros(6), np.zeros(6), np.zeros(3)
    rate = (noise / dt) ** (0.5 / order)
    for i in range(3):
        p[(0, 3, 5)[i]] = rate ** (2 * i) if i < order else 0.0
    information = 0.0
    for _ in range(100000):
        last = gain[0] + gain[order - 1] / rate ** (order - 1)
        predict_covariance(p, dt, noise, order)
        for i in range(6):
            before[i] = p[i]
        information = update_covariance(p, gain)
        if abs(gain[0] + gain[order - 1] / rate ** (order - 1) - last) < 1e-13:
            break
    z = np.exp(2j * np.pi * frequency * dt)
    # (z I - F (I - K H)) x = F K: F is triangular, so x0 = y0 / (1 + y0) with (z I - F) y = F K.
    y2 = gain[2] / (z - 1.0)
    y1 = (gain[1] + dt * (gain[2] + y2)) / (z - 1.0)
    y0 = (gain[0] + dt * (gain[1] + y1) + 0.5 * dt * dt * (gain[2] + y2)) / (z - 1.0)
    state = y0 / (1.0 + y0)
    innovation = information * (1.0 - state)
    a0 = a1 = a2 = 0j
    for _ in range(ahead + 1):
        m0 = z * a0
        m1 = z * (dt * a0 + a1)
        m2 = z * (0.5 * dt * dt * a0 + dt * a1 + a2)
        a0 = innovation + m0 - gain[0] * m0 - gain[1] * m1 - gain[2] * m2
        a1, a2 = m1, m2
    return float(abs(state + before[0] * a0 + before[1] * a1 + before[2] * a2))


@njit("float64(int64, float64, float64, int64)", cache=True, nogil=True)
def state_space_noise(order: int, cutoff: float, dt: float, ahead: int) -> float:
    """Noise ratio that puts the -3 dB point of :func:`state_space_gain` at ``cutoff``, Hz."""
    low = 2 * order * np.log(2.0 * np.pi * cutoff) + np.log(dt)
    while state_space_gain(order, np.exp(low), dt, ahead, cutoff) > np.sqrt(0.5):
        low -= 2.0
    high = low + 2.0
    while state_space_gain(order, np.exp(high), dt, ahead, cutoff) < np.sqrt(0.5):
        high += 2.0
    for _ in range(30):
        middle = 0.5 * (low + high)
        if state_space_gain(order, np.exp(middle), dt, ahead, cutoff) < np.sqrt(0.5):
            low = middle
        else:
            high = middle
    return float(np.exp(0.5 * (low + high)))


@kernel
def start_covariance(p: Any, noise: float, order: int) -> None:
    """Diffuse prior: nothing is known of the first pose, its velocity and its acceleration."""
    rate = noise ** (1.0 / (2 * order - 1))
    for i in range(6):
        p[i] = 0.0
    p[0] = DIFFUSE
    p[3] = DIFFUSE * rate**2
    p[5] = DIFFUSE * rate**4 if order == 3 else 0.0


@kernel
def clear(slot: Any, t: int) -> None:
    """Say that a slot has no track ``t``."""
    if slot[t, AGE] < np.inf:
        for c in range(slot.shape[1]):
            slot[t, c] = 0.0
        slot[t, AGE] = np.inf


@kernel
def predict_state(
    now: Any, t: int, dt: float, turning: bool, step: Any, pose: Any, slot: Any
) -> None:
    """Carry track ``t`` on by ``dt`` with constant acceleration, from ``now`` to ``slot``.

    The predicted pose comes in ``pose``; ``step`` (3) is scratch.
    """
    for c in range(3):
        step[c] = dt * (now[t, RATE + c] + 0.5 * dt * now[t, BEND + c])
        slot[t, RATE + c] = now[t, RATE + c] + dt * now[t, BEND + c]
        slot[t, BEND + c] = now[t, BEND + c]
    for c in range(4):
        pose[c] = now[t, POSE + c]
    displace(step, pose, turning, pose)


@kernel
def covariance_step(work: Any, dt: float, noise: float, order: int, case: int) -> None:
    """Fill rows 1 to 3 of ``work`` from row 0: predicted, gain and information, filtered.

    ``case``: 0 = the track starts, 1 = it goes on unseen, 2 = it goes on and is seen.
    """
    p, gain = work[3], work[2]
    for i in range(6):
        p[i] = work[0, i]
        gain[i] = 0.0
    if case == 0:
        start_covariance(p, noise, order)
    else:
        predict_covariance(p, dt, noise, order)
    for i in range(6):
        work[1, i] = p[i]
    if case != 1:
        gain[3] = update_covariance(p, gain)


@kernel
def update_state(
    now: Any, t: int, error: Any, pose: Any, turning: bool, work: Any, slot: Any
) -> None:
    """Correct the prediction in ``pose`` and ``slot`` by innovation ``error``, into ``now``.

    ``work`` is of :func:`covariance_step`. What the smoother needs stays in ``slot``.
    """
    for c in range(4):
        slot[t, POSE + c] = pose[c]
    for c in range(3):
        slot[t, DELTA + c] = error[c]
        now[t, RATE + c] = slot[t, RATE + c] + work[2, 1] * error[c]
        now[t, BEND + c] = slot[t, BEND + c] + work[2, 2] * error[c]
        error[c] *= work[2, 0]
    displace(error, pose, turning, pose)
    for c in range(4):
        now[t, POSE + c] = pose[c]
    slot[t, INFORMATION] = work[2, 3]
    for i in range(6):
        slot[t, COVARIANCE + i] = work[1, i]
        now[t, NOW_COVARIANCE + i] = work[3, i]


@kernel
def _state_space_push(
    markers: Floats,
    links: Floats,
    marker_confidences: Floats,
    link_confidences: Floats,
    person: int,
    ring: Floats,
    times: Floats,
    step: int,
    now: Floats,
    max_gap: float,
    tuning: Floats,
    order: int,
    work: Floats,
) -> None:
    """Predict every track to step ``step``, update those that are seen, start those that are new.

    ``times`` (R,) are the slots' times in s, ``now`` (T, STATE) goes on from call to call,
    the step's slot of ``ring`` is filled for :func:`_state_space_emit`. A track unseen for more
    than ``max_gap`` s starts anew. ``tuning`` holds :func:`state_space_noise`, ``work`` is scratch.
    """
    n_markers, n_links, mask, noise = markers.shape[1], links.shape[1], len(ring) - 1, tuning[0]
    slot = ring[step & mask]
    dt = times[step & mask] - times[(step - 1) & mask] if step > 0 else 0.0
    z, pose, error = work[4], work[5], work[6]
    twin = -1  # tracks with one history share one covariance: that in the first rows of work
    for block in range(4):
        of_markers, turning, start, size = block_of(block, n_markers, n_links)
        elements = markers[person] if of_markers else links[person]
        confidences = (marker_confidences if of_markers else link_confidences)[person]
        for k in range(size):
            t = start + k
            seen = measure(elements, k, turning, z)
            active = now[t, NOW_AGE] + dt <= max_gap
            if not active and not seen:
                now[t, NOW_AGE] = np.inf
                clear(slot, t)
                continue
            if active:
                predict_state(now, t, dt, turning, error, pose, slot)
            else:
                for c in range(RATE, DELTA):
                    slot[t, c] = 0.0
                for c in range(4):
                    pose[c] = z[c]
            case = 0 if not active else 2 if seen else 1
            same = twin == case
            for i in range(6):
                same = same and (case == 0 or work[0, i] == now[t, NOW_COVARIANCE + i])
            if not same:
                for i in range(6):
                    work[0, i] = now[t, NOW_COVARIANCE + i]
                covariance_step(work, dt, noise, order, case)
                twin = case
            if seen:
                now[t, NOW_AGE] = 0.0
                now[t, NOW_CONFIDENCE] = confidences[k]
            else:
                now[t, NOW_AGE] += dt
            for c in range(3):
                error[c] = 0.0
            if case == 2:
                difference(z, pose, turning, error)
            update_state(now, t, error, pose, turning, work, slot)
            slot[t, CONTINUES] = 1.0 if active else 0.0
            slot[t, AGE] = now[t, NOW_AGE]
            slot[t, CONFIDENCE] = now[t, NOW_CONFIDENCE]


@kernel
def is_present(ring: Any, times: Any, first: int, end: int, t: int, bridge: float) -> bool:
    """Whether track ``t`` is seen at step ``first``, or in a gap no longer than ``bridge`` s.

    The gap ends at the next sighting among the steps before ``end``, or else at the last of them.
    """
    mask = ring.shape[0] - 1
    age = ring[first & mask, t, AGE]
    if age == 0.0 or not age <= bridge:
        return bool(age == 0.0)
    last = first
    for step in range(first + 1, end):
        if ring[step & mask, t, CONTINUES] == 0.0:
            break
        last = step
        if ring[step & mask, t, AGE] == 0.0:
            break
    return bool(age + times[last & mask] - times[first & mask] <= bridge)


@kernel
def write(elements: Any, k: int, pose: Any, motion: Any, turning: bool) -> None:
    """Pose, velocity and acceleration (``motion``, 6) into a KinematicState."""
    at = 3 if turning else 0
    for c in range(4 if turning else 3):
        elements[k, at + c] = pose[c]
    for c in range(3):
        elements[k, 7 + at + c] = motion[c]
        elements[k, 13 + at + c] = motion[3 + c]


@kernel
def erase(elements: Any, k: int, turning: bool) -> None:
    """Make a position or orientation, its velocity and its acceleration absent."""
    at = 3 if turning else 0
    for c in range(4 if turning else 3):
        elements[k, at + c] = np.nan
    for c in range(3):
        elements[k, 7 + at + c] = elements[k, 13 + at + c] = np.nan


@kernel
def adjoint(ring: Any, times: Any, first: int, end: int, t: int, out: Any) -> None:
    """Adjoint of a track's innovations of the steps from ``first`` to ``end``, excluded.

    ``out`` (3, 3): for position, velocity and acceleration, their components.
    """
    mask = ring.shape[0] - 1
    for i in range(3):
        for c in range(3):
            out[i, c] = 0.0
    stop = first + 1
    while stop < end and ring[stop & mask, t, CONTINUES] == 1.0:
        stop += 1
    dt = 0.0
    for step in range(stop - 1, first - 1, -1):
        s = step & mask
        if step < stop - 1:
            dt = times[(step + 1) & mask] - times[s]
        half, information = 0.5 * dt * dt, ring[s, t, INFORMATION]
        p0, p1, p2 = ring[s, t, COVARIANCE], ring[s, t, COVARIANCE + 1], ring[s, t, COVARIANCE + 2]
        for c in range(3):
            m0, m1, m2 = out[0, c], out[1, c], out[2, c]
            m2 += dt * m1 + half * m0
            m1 += dt * m0
            error = ring[s, t, DELTA + c] - p0 * m0 - p1 * m1 - p2 * m2
            out[0, c] = m0 + information * error
            out[1, c] = m1
            out[2, c] = m2


@kernel
def apply_adjoint(slot: Any, t: int, carried: Any, shift: Any, motion: Any) -> None:
    """``covariance @ adjoint`` of track ``t``: the shift of its pose, and its motion with it."""
    p00, p01, p02 = slot[t, COVARIANCE], slot[t, COVARIANCE + 1], slot[t, COVARIANCE + 2]
    p11, p12, p22 = slot[t, COVARIANCE + 3], slot[t, COVARIANCE + 4], slot[t, COVARIANCE + 5]
    for c in range(3):
        a0, a1, a2 = carried[0, c], carried[1, c], carried[2, c]
        shift[c] = p00 * a0 + p01 * a1 + p02 * a2
        motion[c] = slot[t, RATE + c] + p01 * a0 + p11 * a1 + p12 * a2
        motion[3 + c] = slot[t, BEND + c] + p02 * a0 + p12 * a1 + p22 * a2


@kernel
def _state_space_emit(
    ring: Floats,
    times: Floats,
    first: int,
    end: int,
    tuning: Floats,
    order: int,
    bridge: float,
    markers: Floats,
    links: Floats,
    marker_confidences: Floats,
    link_confidences: Floats,
    person: int,
    work: Floats,
) -> None:
    """Write the estimate at step ``first``, given all steps before ``end``, into a frame.

    ``person`` is the row, ``work`` is scratch. Order 2 has no acceleration in its state: with a
    look-ahead it is the smoothed process noise, without one the rate at which the velocity changed.
    """
    n_markers, n_links, mask = markers.shape[1], links.shape[1], ring.shape[0] - 1
    slot = ring[first & mask]
    carried, pose, shift, motion = work[:3], work[3], work[4], work[5]
    dt = times[first & mask] - times[(first - 1) & mask] if first > 0 else 0.0
    for block in range(4):
        of_markers, turning, start, size = block_of(block, n_markers, n_links)
        elements = markers[person] if of_markers else links[person]
        confidences = (marker_confidences if of_markers else link_confidences)[person]
        for k in range(size):
            t = start + k
            if not slot[t, AGE] < np.inf:
                continue
            if not is_present(ring, times, first, end, t, bridge):
                erase(elements, k, turning)
                continue
            adjoint(ring, times, first, end, t, carried)
            apply_adjoint(slot, t, carried, shift, motion)
            for c in range(3 if order == 2 else 0):
                if end > first + 1:
                    motion[3 + c] = tuning[0] * carried[1, c]
                elif dt > 0.0:
                    gain = slot[t, COVARIANCE + 1] * slot[t, INFORMATION]
                    motion[3 + c] = gain * slot[t, DELTA + c] / dt
            for c in range(4):
                pose[c] = slot[t, POSE + c]
            displace(shift, pose, turning, pose)
            write(elements, k, pose, motion, turning)
            if slot[t, AGE] > 0.0 and np.isnan(confidences[k]):
                confidences[k] = 0.5 * slot[t, CONFIDENCE]


@kernel
def follow_lengths(
    markers: Floats, person: int, links: Links, dt: float, time_constant: float, lengths: Floats
) -> None:
    """Low-pass each link's length: ``lengths`` (L, 2) holds the mean and the seconds in it.

    The plain mean while there is less than ``time_constant`` of it, then a first-order low-pass:
    no start transient and the least variance that the data seen so far allow.
    """
    for k in range(links.shape[0]):
        a, b = links[k, 0], links[k, 1]
        if a < 0 or b < 0:
            continue
        square = 0.0
        for c in range(3):
            square += (markers[person, b, c] - markers[person, a, c]) ** 2
        if np.isfinite(square):
            lengths[k, 1] = min(lengths[k, 1] + dt, time_constant)
            lengths[k, 0] += (np.sqrt(square) - lengths[k, 0]) * dt / lengths[k, 1]


@kernel("int64(float64[:,:,::1], int64, int32[:,::1], float64[:,::1], int64, float64)")
def restore_lengths(
    markers: Floats, person: int, links: Links, lengths: Floats, sweeps: int, tolerance: float
) -> int:
    """Move markers by as little as it takes to give every link its length; return the sweeps.

    Projection onto one constraint after the other (Gauss-Seidel; the displacements of both ends
    are equal and opposite) until no length is off by more than ``tolerance`` of itself. Any
    graph; links without both ends or without a known length are left alone.
    """
    for sweep in range(sweeps):
        worst = 0.0
        for k in range(links.shape[0]):
            a, b = links[k, 0], links[k, 1]
            if a < 0 or b < 0 or lengths[k, 1] == 0.0 or lengths[k, 0] == 0.0:
                continue
            square = 0.0
            for c in range(3):
                square += (markers[person, b, c] - markers[person, a, c]) ** 2
            if not 1e-12 < square < np.inf:
                continue
            length = np.sqrt(square)
            worst = max(worst, abs(length - lengths[k, 0]) / lengths[k, 0])
            factor = 0.5 * (length - lengths[k, 0]) / length
            for c in range(3):
                move = factor * (markers[person, b, c] - markers[person, a, c])
                markers[person, a, c] += move
                markers[person, b, c] -= move
        if worst <= tolerance:
            return sweep + 1
    return sweeps


@njit(RUN, cache=True, error_model="numpy", nogil=True)
def run_state_space(
    jobs: Stamps,
    numbers: Floats,
    order: int,
    settings: Floats,
    limbs: Links,
    markers: Floats,
    links: Floats,
    marker_confidences: Floats,
    link_confidences: Floats,
    ring: Floats,
    times: Floats,
    now: Floats,
    lengths: Floats,
    out_markers: Floats,
    out_links: Floats,
    out_marker_confidences: Floats,
    out_link_confidences: Floats,
) -> None:
    """Do one job after the other: take over people's poses, write estimates.

    Parameters
    ----------
    jobs : (J, 5) PUSH or EMIT; row of the person's pose in ``markers`` or in ``out_markers``; row
        in the bank; number of the step; at EMIT, the step before which the data end.
    numbers : (J, 4) at PUSH, time of the step and since the person's last one, s; the two numbers
        of the tuning.
    settings : max_gap, bridge, time constant of the lengths (0 = lengths are not kept), s; sweeps
        and tolerance of :func:`restore_lengths`.
    limbs : (L, 2). The bank, by row: ``ring``, ``times``, ``now``, ``lengths``.
    markers, ..., out_link_confidences : (P, ...) poses to take over; and to be replaced.
    """
    mask, work = ring.shape[1] - 1, np.zeros((7, 6))
    for j in range(len(jobs)):
        row, who, step = jobs[j, 1], jobs[j, 2], jobs[j, 3]
        if jobs[j, 0] == PUSH:
            times[who, step & mask] = numbers[j, 0]
            _state_space_push(
                markers, links, marker_confidences, link_confidences, row, ring[who], times[who],
                step, now[who], settings[0], numbers[j, 2:], order, work,
            )  # fmt: skip
            if settings[2] > 0.0:
                follow_lengths(markers, row, limbs, numbers[j, 1], settings[2], lengths[who])
        else:
            _state_space_emit(
                ring[who], times[who], step, jobs[j, 4], numbers[j, 2:], order, settings[1],
                out_markers, out_links, out_marker_confidences, out_link_confidences, row, work,
            )  # fmt: skip
            if settings[2] > 0.0:
                restore_lengths(
                    out_markers, row, limbs, lengths[who], int(settings[3]), settings[4]
                )
