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

Floats = npt.NDArray[np.float64]
Links = npt.NDArray[np.int32]

# Rows of a ring (R, ROWS, T). POSE to CONFIDENCE are common to every filter, POSE to BEND being
# what the filter predicted (state space) or filtered (Butterworth).
POSE = 0  # 3 numbers or a quaternion
RATE = 4  # velocity
BEND = 7  # acceleration
DELTA = 10  # innovation; Butterworth: step from the previous slot
CONTINUES = 13  # 1 where the track goes on from the previous slot, 0 where it starts or is not
AGE = 14  # s since the track was seen; inf = no track
CONFIDENCE = 15  # when it was last seen
GAIN = 16  # Kalman gain, 3
INFORMATION = 19  # 1 / innovation variance; 0 = not seen
COVARIANCE = 20  # predicted; 00 01 02 11 12 22
ROWS = 26

# Rows of what state_space_push carries on, (STATE_ROWS, T); POSE to BEND as in a ring, filtered.
NOW_COVARIANCE = 10
NOW_AGE = 16
NOW_CONFIDENCE = 17
STATE_ROWS = 18

DIFFUSE = 1e6  # initial variance over that of a measurement


@njit(cache=True, nogil=True)
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


@njit(cache=True, nogil=True)
def exp_times(v: Any, q: Any, out: Any) -> None:
    """Unit quaternion ``exp(v) * q`` into ``out`` (4), which may be ``q`` itself."""
    angle = np.sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2])
    factor = 0.5 if angle < 1e-9 else np.sin(0.5 * angle) / angle
    a, b, c, d = factor * v[0], factor * v[1], factor * v[2], np.cos(0.5 * angle)
    x = d * q[0] + a * q[3] + b * q[2] - c * q[1]
    y = d * q[1] + b * q[3] + c * q[0] - a * q[2]
    z = d * q[2] + c * q[3] + a * q[1] - b * q[0]
    w = d * q[3] - a * q[0] - b * q[1] - c * q[2]
    scale = 1.0 / np.sqrt(x * x + y * y + z * z + w * w)
    out[0], out[1], out[2], out[3] = x * scale, y * scale, z * scale, w * scale


@njit(cache=True, nogil=True)
def difference(z: Any, pose: Any, turning: bool, out: Any) -> None:
    """``z - pose`` in the track's tangent space."""
    if turning:
        log_between(z, pose, out)
    else:
        for c in range(3):
            out[c] = z[c] - pose[c]


@njit(cache=True, nogil=True)
def displace(v: Any, pose: Any, turning: bool, out: Any) -> None:
    """``pose + v`` in the track's tangent space."""
    if turning:
        exp_times(v, pose, out)
    else:
        for c in range(3):
            out[c] = pose[c] + v[c]


@njit(cache=True, nogil=True)
def locate(track: int, n_markers: int, n_links: int) -> tuple[bool, int, bool]:
    """Of a track: whether it is a marker's, the slot of the marker or link, whether it turns."""
    if track < n_markers:
        return True, track, False
    if track < n_markers + n_links:
        return False, track - n_markers, True
    if track < n_markers + 2 * n_links:
        return False, track - n_markers - n_links, False
    return True, track - n_markers - 2 * n_links, True


@njit(cache=True, nogil=True)
def measure(element: Any, turning: bool, z: Any) -> bool:
    """Copy a KinematicState's position or normalised orientation to ``z``; False if absent."""
    if not turning:
        for c in range(3):
            z[c] = element[c]
        return bool(np.isfinite(z[0] + z[1] + z[2]))
    norm = 0.0
    for c in range(4):
        z[c] = element[3 + c]
        norm += z[c] * z[c]
    if not (1e-12 < norm < np.inf):
        return False
    norm = np.sqrt(norm)
    for c in range(4):
        z[c] /= norm
    return True


@njit(cache=True, nogil=True)
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


@njit(cache=True, nogil=True)
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


@njit(cache=True, nogil=True)
def solve(a: Any, b: Any) -> None:
    """Solve the small complex system ``a x = b`` in place (``b`` becomes ``x``), pivoting."""
    n = b.shape[0]
    for i in range(n):
        pivot = i
        for r in range(i + 1, n):
            if abs(a[r, i]) > abs(a[pivot, i]):
                pivot = r
        for c in range(n):
            a[i, c], a[pivot, c] = a[pivot, c], a[i, c]
        b[i], b[pivot] = b[pivot], b[i]
        for r in range(n):
            if r != i:
                factor = a[r, i] / a[i, i]
                for c in range(i, n):
                    a[r, c] -= factor * a[i, c]
                b[r] -= factor * b[i]
    for i in range(n):
        b[i] /= a[i, i]


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
    f = np.array([[1.0, dt, 0.5 * dt * dt], [0.0, 1.0, dt], [0.0, 0.0, 1.0]])
    system, state = np.zeros((order, order), np.complex128), np.zeros(order, np.complex128)
    for r in range(order):  # (z I - F (I - K H)) x = F K
        for c in range(order):
            system[r, c] = (z if r == c else 0.0) - f[r, c]
            state[r] += f[r, c] * gain[c]
    for r in range(order):
        system[r, 0] += state[r]
    solve(system, state)
    innovation = information * (1.0 - state[0])
    adjoint = np.zeros(3, np.complex128)
    for _ in range(ahead + 1):
        m0 = z * adjoint[0]
        m1 = z * (dt * adjoint[0] + adjoint[1])
        m2 = z * (0.5 * dt * dt * adjoint[0] + dt * adjoint[1] + adjoint[2])
        adjoint[0] = innovation + m0 - gain[0] * m0 - gain[1] * m1 - gain[2] * m2
        adjoint[1], adjoint[2] = m1, m2
    out = state[0]
    for c in range(order):
        out += before[c] * adjoint[c]
    return float(abs(out))


@njit("float64(int64, float64, float64, int64)", cache=True, nogil=True)
def state_space_noise(order: int, cutoff: float, dt: float, ahead: int) -> float:
    """Noise ratio that puts the -3 dB point of :func:`state_space_gain` at ``cutoff``, Hz."""
    middle = 2 * order * np.log(2.0 * np.pi * cutoff) + np.log(dt)
    low, high = middle - 14.0, middle + 28.0
    for _ in range(60):
        middle = 0.5 * (low + high)
        if state_space_gain(order, np.exp(middle), dt, ahead, cutoff) < np.sqrt(0.5):
            low = middle
        else:
            high = middle
    return float(np.exp(middle))


@njit(cache=True, nogil=True)
def start_covariance(p: Any, noise: float, order: int) -> None:
    """Diffuse prior: nothing is known of the first pose, its velocity and its acceleration."""
    rate = noise ** (1.0 / (2 * order - 1))
    for i in range(6):
        p[i] = 0.0
    p[0] = DIFFUSE
    p[3] = DIFFUSE * rate**2
    p[5] = DIFFUSE * rate**4 if order == 3 else 0.0


@njit(cache=True, nogil=True)
def predict_state(now: Any, t: int, dt: float, turning: bool, slot: Any) -> None:
    """Carry track ``t`` on by ``dt`` with constant acceleration, from ``now`` into ``slot``."""
    step, pose = np.empty(3), np.empty(4)
    for c in range(3):
        step[c] = dt * (now[RATE + c, t] + 0.5 * dt * now[BEND + c, t])
        slot[RATE + c, t] = now[RATE + c, t] + dt * now[BEND + c, t]
        slot[BEND + c, t] = now[BEND + c, t]
    for c in range(4):
        pose[c] = now[POSE + c, t]
    displace(step, pose, turning, pose)
    for c in range(4):
        slot[POSE + c, t] = pose[c]


@njit(cache=True, nogil=True)
def covariance_step(work: Any, dt: float, noise: float, order: int, case: int) -> None:
    """Fill rows 1 to 3 of ``work`` (4, 6) from row 0: predicted, gain and information, filtered.

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


@njit(
    "void(float64[:,::1], float64[:,::1], float64[::1], float64[::1], float64[:,:,::1],"
    " float64[::1], int64, float64[:,::1], float64, float64[::1], int64)",
    cache=True,
    nogil=True,
)
def state_space_push(
    markers: Floats,
    links: Floats,
    marker_confidences: Floats,
    link_confidences: Floats,
    ring: Floats,
    times: Floats,
    step: int,
    now: Floats,
    max_gap: float,
    tuning: Floats,
    order: int,
) -> None:
    """Predict every track to step ``step``, update those that are seen, start those that are new.

    ``times`` (R,) are the slots' times in s, ``now`` (STATE_ROWS, T) goes on from call to call,
    the step's slot of ``ring`` is filled for :func:`state_space_emit`. A track unseen for more
    than ``max_gap`` s starts anew. ``tuning`` holds :func:`state_space_noise`.
    """
    n_markers, n_links, mask, noise = markers.shape[0], links.shape[0], len(ring) - 1, tuning[0]
    slot = ring[step & mask]
    dt = times[step & mask] - times[(step - 1) & mask] if step > 0 else 0.0
    z, pose, error = np.zeros(4), np.zeros(4), np.zeros(3)
    work, twin = np.zeros((4, 6)), -1  # tracks with one history share one covariance: work's
    for t in range(slot.shape[1]):
        of_marker, k, turning = locate(t, n_markers, n_links)
        seen = measure(markers[k] if of_marker else links[k], turning, z)
        active = now[NOW_AGE, t] + dt <= max_gap
        if not active and not seen:
            now[NOW_AGE, t] = np.inf
            for r in range(DELTA, ROWS):
                slot[r, t] = 0.0
            slot[AGE, t] = np.inf
            continue
        if active:
            predict_state(now, t, dt, turning, slot)
        else:
            for c in range(10):
                slot[c, t] = z[c] if c < 3 or (turning and c == 3) else 0.0
        case = 0 if not active else 2 if seen else 1
        same = twin == case
        for i in range(6):
            same = same and (case == 0 or work[0, i] == now[NOW_COVARIANCE + i, t])
        if not same:
            for i in range(6):
                work[0, i] = now[NOW_COVARIANCE + i, t]
            covariance_step(work, dt, noise, order, case)
            twin = case
        if seen:
            now[NOW_AGE, t] = 0.0
            now[NOW_CONFIDENCE, t] = marker_confidences[k] if of_marker else link_confidences[k]
        else:
            now[NOW_AGE, t] += dt
        for c in range(4):
            pose[c] = slot[POSE + c, t]
        for c in range(3):
            error[c] = 0.0
        if case == 2:
            difference(z, pose, turning, error)
        for c in range(3):
            slot[DELTA + c, t] = error[c]
            slot[GAIN + c, t] = work[2, c]
            now[RATE + c, t] = slot[RATE + c, t] + work[2, 1] * error[c]
            now[BEND + c, t] = slot[BEND + c, t] + work[2, 2] * error[c]
            error[c] *= work[2, 0]
        displace(error, pose, turning, pose)
        for c in range(4):
            now[POSE + c, t] = pose[c]
        slot[CONTINUES, t] = 1.0 if active else 0.0
        slot[AGE, t] = now[NOW_AGE, t]
        slot[CONFIDENCE, t] = now[NOW_CONFIDENCE, t]
        slot[INFORMATION, t] = work[2, 3]
        for i in range(6):
            slot[COVARIANCE + i, t] = work[1, i]
            now[NOW_COVARIANCE + i, t] = work[3, i]


@njit(cache=True, nogil=True)
def is_present(ring: Any, times: Any, first: int, end: int, t: int, bridge: float) -> bool:
    """Whether track ``t`` is seen at step ``first``, or in a gap no longer than ``bridge`` s.

    The gap ends at the next sighting among the steps before ``end``, or else at the last of them.
    """
    mask = ring.shape[0] - 1
    age = ring[first & mask, AGE, t]
    if age == 0.0 or not age <= bridge:
        return bool(age == 0.0)
    last = first
    for step in range(first + 1, end):
        if ring[step & mask, CONTINUES, t] == 0.0:
            break
        last = step
        if ring[step & mask, AGE, t] == 0.0:
            break
    return bool(age + times[last & mask] - times[first & mask] <= bridge)


@njit(cache=True, nogil=True)
def write(element: Any, pose: Any, motion: Any, turning: bool) -> None:
    """Pose, velocity and acceleration (``motion``, 6) into a KinematicState."""
    if turning:
        for c in range(4):
            element[3 + c] = pose[c]
    else:
        for c in range(3):
            element[c] = pose[c]
    shift = 3 if turning else 0
    for c in range(3):
        element[7 + shift + c] = motion[c]
        element[13 + shift + c] = motion[3 + c]


@njit(cache=True, nogil=True)
def erase(element: Any, turning: bool) -> None:
    """Make a position or orientation, its velocity and its acceleration absent."""
    for c in range(3):
        element[(10 if turning else 7) + c] = np.nan
        element[(16 if turning else 13) + c] = np.nan
    for c in range(4 if turning else 3):
        element[(3 if turning else 0) + c] = np.nan


@njit(cache=True, nogil=True)
def adjoints(ring: Any, times: Any, first: int, end: int, lo: int, hi: int, out: Any) -> None:
    """Adjoint of the innovations of steps ``first`` to ``end`` - 1, tracks ``lo`` to ``hi``.

    ``out`` (9, T): for each component of position, velocity and acceleration. Rows are walked
    across tracks so that the compiler can use vector instructions.
    """
    mask = ring.shape[0] - 1
    for r in range(9):
        for t in range(lo, hi):
            out[r, t] = 0.0
    dt = 0.0
    for step in range(end - 1, first - 1, -1):
        slot, later = step & mask, (step + 1) & mask
        if step < end - 1:
            dt = times[later] - times[slot]
        half = 0.5 * dt * dt
        go_on, known = ring[later, CONTINUES], ring[slot, INFORMATION]
        k0, k1, k2 = ring[slot, GAIN], ring[slot, GAIN + 1], ring[slot, GAIN + 2]
        for c in range(3):
            e, a0, a1, a2 = ring[slot, DELTA + c], out[c], out[3 + c], out[6 + c]
            for t in range(lo, hi):
                m0 = go_on[t] * a0[t]
                m1 = go_on[t] * (dt * a0[t] + a1[t])
                m2 = go_on[t] * (half * a0[t] + dt * a1[t] + a2[t])
                a0[t] = known[t] * e[t] + m0 - k0[t] * m0 - k1[t] * m1 - k2[t] * m2
                a1[t] = m1
                a2[t] = m2


@njit(
    "void(float64[:,:,::1], float64[::1], int64, int64, float64[::1], int64, float64,"
    " float64[:,::1], float64[:,::1], float64[::1], float64[::1])",
    cache=True,
    nogil=True,
)
def state_space_emit(
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
) -> None:
    """Write the estimate at step ``first``, given all steps before ``end``, into a person's rows.

    Order 2 has no acceleration in its state: with a
    look-ahead it is the smoothed process noise, without one the rate at which the velocity
    changed.
    """
    n_markers, n_links, mask = markers.shape[0], links.shape[0], ring.shape[0] - 1
    slot = ring[first & mask]
    adjoint = np.empty((9, ring.shape[2]))
    pose, shift, motion = np.zeros(4), np.zeros(3), np.zeros(6)
    dt = times[first & mask] - times[(first - 1) & mask] if first > 0 else 0.0
    edges = (0, n_markers, n_markers + n_links, n_markers + 2 * n_links, ring.shape[2])
    for block in range(4):
        lo, hi = edges[block], edges[block + 1]
        adjoints(ring, times, first, end, lo, hi, adjoint)
        for t in range(lo, hi):
            if not slot[AGE, t] < np.inf:
                continue
            of_marker, k, turning = locate(t, n_markers, n_links)
            element = markers[k] if of_marker else links[k]
            if not is_present(ring, times, first, end, t, bridge):
                erase(element, turning)
                continue
            p00, p01, p02 = slot[COVARIANCE, t], slot[COVARIANCE + 1, t], slot[COVARIANCE + 2, t]
            p11, p12, p22 = (
                slot[COVARIANCE + 3, t],
                slot[COVARIANCE + 4, t],
                slot[COVARIANCE + 5, t],
            )
            for c in range(3):
                a0, a1, a2 = adjoint[c, t], adjoint[3 + c, t], adjoint[6 + c, t]
                shift[c] = p00 * a0 + p01 * a1 + p02 * a2
                motion[c] = slot[RATE + c, t] + p01 * a0 + p11 * a1 + p12 * a2
                motion[3 + c] = slot[BEND + c, t] + p02 * a0 + p12 * a1 + p22 * a2
                if order == 2 and end > first + 1:
                    motion[3 + c] = tuning[0] * a1
                elif order == 2 and dt > 0.0:
                    motion[3 + c] = slot[GAIN + 1, t] * slot[DELTA + c, t] / dt
            for c in range(4):
                pose[c] = slot[POSE + c, t]
            displace(shift, pose, turning, pose)
            write(element, pose, motion, turning)
            confidences = marker_confidences if of_marker else link_confidences
            if slot[AGE, t] > 0.0 and np.isnan(confidences[k]):
                confidences[k] = 0.5 * slot[CONFIDENCE, t]


@njit(
    "void(float64[:,::1], int32[:,::1], float64, float64, float64[:,::1])",
    cache=True,
    nogil=True,
)
def follow_lengths(
    markers: Floats, links: Links, dt: float, time_constant: float, lengths: Floats
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
            square += (markers[b, c] - markers[a, c]) ** 2
        if np.isfinite(square):
            lengths[k, 1] = min(lengths[k, 1] + dt, time_constant)
            lengths[k, 0] += (np.sqrt(square) - lengths[k, 0]) * dt / lengths[k, 1]


@njit("int64(float64[:,::1], int32[:,::1], float64[:,::1], int64, float64)", cache=True, nogil=True)
def restore_lengths(
    markers: Floats, links: Links, lengths: Floats, sweeps: int, tolerance: float
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
                square += (markers[b, c] - markers[a, c]) ** 2
            if not 1e-12 < square < np.inf:
                continue
            length = np.sqrt(square)
            worst = max(worst, abs(length - lengths[k, 0]) / lengths[k, 0])
            factor = 0.5 * (length - lengths[k, 0]) / length
            for c in range(3):
                move = factor * (markers[b, c] - markers[a, c])
                markers[a, c] += move
                markers[b, c] -= move
        if worst <= tolerance:
            return sweep + 1
    return sweeps
