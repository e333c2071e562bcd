"""Butterworth low-pass of any order at the samples' own times, on R3 and SO(3).

The analogue filter is run by the bilinear rule at every sample's own interval. Its states are the
derivatives of the output, so velocity and acceleration come for free; all steps are functions of
one stable matrix, so any mixture of intervals is stable; and the corner is prewarped, so the
response at a steady rate is the digital Butterworth filter's. An interval much longer than usual
is taken in shorter steps along a straight line, which keeps it from ringing. On SO(3) all of it
happens in the tangent space at the last output.

With a look-ahead the same filter also runs backwards over the forward outputs, which cancels its
phase. Being linear, the backward run is one weight per step, the same for all tracks.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

from hiros_mcap.kernels.compile import kernel
from hiros_mcap.kernels.filtering import (
    AGE,
    BEND,
    CONFIDENCE,
    CONTINUES,
    DELTA,
    POSE,
    PUSH,
    RATE,
    RUN,
    Floats,
    Links,
    Stamps,
    block_of,
    clear,
    difference,
    displace,
    erase,
    follow_lengths,
    is_present,
    measure,
    restore_lengths,
    write,
)

# Columns of what butterworth_push carries on, (T, STATE + 3 * (order - 1)).
NOW_POSE = 0
NOW_INPUT = 4
NOW_AGE = 8
NOW_CONFIDENCE = 9
STATE = 10  # then the derivatives 1 to order - 1, the i-th divided by rate^i

COLUMNS = 16  # of a ring: POSE to CONFIDENCE
CACHED = 8  # sample times whose matrices are kept during one push


@kernel
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


@njit(cache=True, nogil=True, error_model="numpy")
def coefficients(order: int) -> Any:
    """Ascending coefficients of the normalised Butterworth polynomial, (order + 1)."""
    a = np.ones(order + 1)
    for i in range(order):
        angle = 0.5 * np.pi / order
        a[i + 1] = a[i] * np.cos(i * angle) / np.sin((i + 1) * angle)
    return a


@njit(cache=True, nogil=True, error_model="numpy")
def transition(a: Any, rate: float, dt: float, out: Any) -> None:
    """Into ``out`` (n, n + 1): ``s' = out[:, :n] s + out[:, n] (u + u')`` over ``dt``.

    ``rate`` is the corner in rad/s, state i the i-th derivative of the output over ``rate``^i. In
    these units a change of the rate is a change of the clock: the filter stays stable.
    """
    n, half = a.shape[0] - 1, 0.5 * rate * dt
    left, column = np.zeros((n, n)), np.zeros(n)
    for j in range(n + 1):  # (I - A half) s' = (I + A half) s + b half (u + u')
        for r in range(n):
            for c in range(n):
                left[r, c] = 1.0 if r == c else 0.0
            column[r] = 1.0 if r == j else 0.0
        for i in range(n - 1):
            left[i, i + 1] = -half
        for i in range(n):
            left[n - 1, i] += half * a[i]
        if 0 < j < n:
            column[j - 1] += half
        column[n - 1] += half if j == n else -half * a[j]
        solve(left, column)
        for r in range(n):
            out[r, j] = column[r]


@njit(cache=True, nogil=True, error_model="numpy")
def substeps(dt: float, period: float) -> int:
    """Into how many steps an interval is divided when ``period`` is the usual one."""
    return 1 if dt < 1.5 * period else int(np.ceil(dt / period - 0.1))


@njit(
    "float64(int64, float64, float64, int64, float64)", cache=True, nogil=True, error_model="numpy"
)
def butterworth_gain(order: int, rate: float, dt: float, ahead: int, frequency: float) -> float:
    """Magnitude response at a constant sample time ``dt``; ``ahead`` in samples, 0 = causal."""
    step = np.empty((order, order + 1))
    transition(coefficients(order), rate, dt, step)
    z = np.exp(2j * np.pi * frequency * dt)
    system = np.zeros((order, order), np.complex128)
    state = np.zeros(order, np.complex128)
    for r in range(order):
        for c in range(order):
            system[r, c] = (z if r == c else 0.0) - step[r, c]
        state[r] = (1.0 + z) * step[r, order]
    solve(system, state)
    forward = state[0]
    if ahead == 0:
        return float(abs(forward))
    for r in range(order):
        state[r] = forward if r == 0 else 0.0
    back = np.zeros(order, np.complex128)
    for _ in range(ahead):
        for r in range(order):
            back[r] = forward * (1.0 + z) * step[r, order]
            for c in range(order):
                back[r] += step[r, c] * z * state[c]
        for r in range(order):
            state[r] = back[r]
    return float(abs(state[0]))


@njit("float64(int64, float64, float64, int64)", cache=True, nogil=True, error_model="numpy")
def butterworth_rate(order: int, cutoff: float, dt: float, ahead: int) -> float:
    """Corner in rad/s that puts the -3 dB point of :func:`butterworth_gain` at ``cutoff``, Hz."""
    middle = np.log(2.0 * np.pi * cutoff)
    low, high = middle - 1.0, middle + 5.0
    for _ in range(50):
        middle = 0.5 * (low + high)
        if butterworth_gain(order, np.exp(middle), dt, ahead, cutoff) < np.sqrt(0.5):
            low = middle
        else:
            high = middle
    return float(np.exp(middle))


@njit(cache=True, nogil=True, error_model="numpy")
def matrix(a: Any, rate: float, dt: float, cache: Any, count: int) -> int:
    """Slot of ``cache`` (CACHED, n, n + 2) with the transition over ``dt``, made when missing.

    Element (0, n + 1) of a slot is its dt; ``count`` slots have been made before.
    """
    n = a.shape[0] - 1
    for i in range(min(count, CACHED)):
        if cache[i, 0, n + 1] == dt:
            return i
    i = count % CACHED
    transition(a, rate, dt, cache[i])
    cache[i, 0, n + 1] = dt
    return int(i)


@njit(cache=True, nogil=True, error_model="numpy")
def advance(step: Any, count: int, state: Any, u0: Any, u1: Any) -> None:
    """``count`` steps of the filter on ``state`` (n, 3) while the input goes from u0 to u1.

    Row 0 of the state is zero at first: everything is relative to the last output.
    """
    n = state.shape[0]
    new = np.empty(n)
    for i in range(count):
        middle = (i + 0.5) / count
        for c in range(3):
            u = 2.0 * (u0[c] + middle * (u1[c] - u0[c]))
            for r in range(n):
                new[r] = step[r, n] * u
                for j in range(n):
                    new[r] += step[r, j] * state[j, c]
            for r in range(n):
                state[r, c] = new[r]


@njit(cache=True, nogil=True, error_model="numpy")
def derive(a: Any, rate: float, state: Any, u: Any, dt: float, before: Any, row: Any) -> None:
    """Velocity and acceleration of the output into columns RATE and BEND of ``row``.

    ``state`` (n, 3) and the input ``u`` (3) are relative to the output. What the state does not
    hold follows from the differential equation, and an acceleration of order 1 from the row
    ``before``, ``dt`` ago (infinitely long ago where the track starts).
    """
    n = state.shape[0]
    for c in range(3):
        top = u[c]  # the n-th derivative
        for i in range(1, n):
            top -= a[i] * state[i, c]
        row[RATE + c] = rate * (state[1, c] if n > 1 else top)
        if n == 1:
            row[BEND + c] = (row[RATE + c] - before[RATE + c]) / dt
        else:
            row[BEND + c] = rate * rate * (state[2, c] if n > 2 else top)


@njit(cache=True, nogil=True, error_model="numpy")
def fill_gap(ring: Any, times: Any, step: int, t: int, turning: bool) -> None:
    """Let the outputs of the steps since track ``t`` was last seen lead evenly up to ``step``."""
    mask = ring.shape[0] - 1
    last = step - 1
    while last > 0 and last > step - mask and ring[last & mask, t, AGE] > 0.0:
        last -= 1
    start, whole, part = ring[last & mask, t], np.empty(3), np.empty(3)
    difference(ring[step & mask, t], start, turning, whole)
    total = times[step & mask] - times[last & mask]
    for i in range(last + 1, step + 1):
        row = ring[i & mask, t]
        share = (times[i & mask] - times[last & mask]) / total
        own = (times[i & mask] - times[(i - 1) & mask]) / total
        for c in range(3):
            part[c] = share * whole[c]
            row[DELTA + c] = own * whole[c]
        if i < step:
            displace(part, start, turning, row)


@njit(cache=True, nogil=True, error_model="numpy")
def coast(before: Any, row: Any, turning: bool, dt: float) -> None:
    """Carry a track on from its row in the previous slot, at its velocity."""
    for c in range(3):
        row[DELTA + c] = dt * before[RATE + c]
        row[RATE + c] = before[RATE + c]
        row[BEND + c] = 0.0
    displace(row[DELTA:], before, turning, row)
    row[CONFIDENCE] = before[CONFIDENCE]


@njit(
    "void(float64[:,:,::1], float64[:,:,::1], float64[:,::1], float64[:,::1], int64,"
    " float64[:,:,::1], float64[::1], int64, float64[:,::1], float64, float64[::1], int64)",
    cache=True,
    nogil=True,
    error_model="numpy",
)
def butterworth_push(
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
) -> None:
    """Run the tracks that are seen up to step ``step``; the others coast at their velocity.

    Arguments as of ``_state_space_push`` in ``kernels.filters``. A track that comes back within
    ``max_gap`` s takes the whole gap as one step, its input a straight line. ``tuning`` holds
    :func:`butterworth_rate` and the usual sample time.
    """
    n_markers, n_links, mask = markers.shape[1], links.shape[1], ring.shape[0] - 1
    slot, before = ring[step & mask], ring[(step - 1) & mask]
    dt = times[step & mask] - times[(step - 1) & mask] if step > 0 else 0.0
    a, rate = coefficients(order), tuning[0]
    cache, cached = np.zeros((CACHED, order, order + 2)), 0
    z, former, u0, u1 = np.zeros(4), np.zeros(4), np.zeros(3), np.zeros(3)
    state = np.zeros((order, 3))
    for block in range(4):
        of_markers, turning, start, size = block_of(block, n_markers, n_links)
        elements = markers[person] if of_markers else links[person]
        confidences = (marker_confidences if of_markers else link_confidences)[person]
        for k in range(size):
            t = start + k
            seen = measure(elements, k, turning, z)
            own, row = now[t], slot[t]
            elapsed = own[NOW_AGE] + dt
            active = elapsed <= max_gap
            if not seen and not active:
                own[NOW_AGE] = np.inf
                clear(slot, t)
                continue
            row[CONTINUES] = 1.0 if active else 0.0
            if not seen:
                own[NOW_AGE] = row[AGE] = elapsed
                coast(before[t], row, turning, dt)
                continue
            for c in range(4):
                former[c] = own[NOW_POSE + c] if active else z[c]
                row[POSE + c] = former[c]
            for i in range(3 * order):
                state[i // 3, i % 3] = own[STATE + i - 3] if active and i >= 3 else 0.0
            if active:
                count = substeps(elapsed, tuning[1])
                at = matrix(a, rate, elapsed / count, cache, cached)
                cached = max(cached, at + 1)
                difference(own[NOW_INPUT:], former, turning, u0)
                difference(z, former, turning, u1)
                advance(cache[at], count, state, u0, u1)
                displace(state[0], former, turning, row)
            difference(z, row, turning, u1)
            derive(a, rate, state, u1, dt if active else np.inf, before[t], row)
            difference(row, former, turning, row[DELTA:])
            for c in range(4):
                own[NOW_POSE + c], own[NOW_INPUT + c] = row[POSE + c], z[c]
            for i in range(3, 3 * order):
                own[STATE + i - 3] = state[i // 3, i % 3]
            own[NOW_CONFIDENCE] = confidences[k]
            row[CONFIDENCE] = own[NOW_CONFIDENCE]
            row[AGE] = 0.0
            if active and own[NOW_AGE] > 0.0:
                fill_gap(ring, times, step, t, turning)
            own[NOW_AGE] = 0.0


@njit(cache=True, nogil=True, error_model="numpy")
def backward_weights(times: Any, mask: int, first: int, end: int, tuning: Any, order: int) -> Any:
    """Weight of the forward output of each step in the backward output at ``first``; sum 1."""
    a, step = coefficients(order), np.empty((order, order + 1))
    weights, row, new = np.zeros(end - first), np.zeros(order), np.zeros(order)
    row[0] = 1.0
    done = -1.0
    for i in range(end - first - 1):
        dt = times[(first + i + 1) & mask] - times[(first + i) & mask]
        count = substeps(dt, tuning[1])
        if dt != done:
            transition(a, tuning[0], dt / count, step)
            done = dt
        for part in range(count):
            later = (part + 0.5) / count
            for c in range(order):
                new[c] = 0.0
                weights[i] += row[c] * step[c, order] * 2.0 * (1.0 - later)
                weights[i + 1] += row[c] * step[c, order] * 2.0 * later
                for r in range(order):
                    new[c] += row[r] * step[r, c]
            for c in range(order):
                row[c] = new[c]
    weights[end - first - 1] += row[0]  # it starts at rest on the last output
    return weights


@njit(cache=True, nogil=True, error_model="numpy")
def sum_backwards(ring: Any, first: int, t: int, weights: Any, shift: Any, motion: Any) -> None:
    """Weighted mean of a track's forward outputs, relative to that of ``first``, and motions.

    Where the track ends within the window, it is taken to stay as it was last.
    """
    mask = ring.shape[0] - 1
    row, rest = ring[first & mask, t], 1.0
    for c in range(3):
        shift[c] = motion[c] = motion[3 + c] = 0.0
    for i in range(len(weights)):
        if i > 0:
            later = ring[(first + i) & mask, t]
            if later[CONTINUES] == 0.0:
                break
            row = later
            for c in range(3):
                shift[c] += rest * row[DELTA + c]
        share = weights[i]
        rest -= share
        for c in range(6):
            motion[c] += share * row[RATE + c]
    else:
        rest = 0.0
    for c in range(6):
        motion[c] += rest * row[RATE + c]


@njit(
    "void(float64[:,:,::1], float64[::1], int64, int64, float64[::1], int64, float64,"
    " float64[:,:,::1], float64[:,:,::1], float64[:,::1], float64[:,::1], int64)",
    cache=True,
    nogil=True,
    error_model="numpy",
)
def butterworth_emit(
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
) -> None:
    """Write the estimate at step ``first``, given all steps before ``end``, into a frame.

    Velocity and acceleration are the forward filter's, filtered backwards like its output.
    """
    n_markers, n_links, mask = markers.shape[1], links.shape[1], ring.shape[0] - 1
    pose, shift, motion = np.zeros(4), np.zeros(3), np.zeros(6)
    weights = backward_weights(times, mask, first, end, tuning, order)
    for block in range(4):
        of_markers, turning, start, size = block_of(block, n_markers, n_links)
        elements = markers[person] if of_markers else links[person]
        confidences = (marker_confidences if of_markers else link_confidences)[person]
        for k in range(size):
            t = start + k
            row = ring[first & mask, t]
            if not row[AGE] < np.inf:
                continue
            if not is_present(ring, times, first, end, t, bridge):
                erase(elements, k, turning)
                continue
            sum_backwards(ring, first, t, weights, shift, motion)
            displace(shift, row, turning, pose)
            write(elements, k, pose, motion, turning)
            if row[AGE] > 0.0 and np.isnan(confidences[k]):
                confidences[k] = 0.5 * row[CONFIDENCE]


@njit(RUN, cache=True, error_model="numpy", nogil=True)
def run_butterworth(
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
    """Do the jobs of :func:`hiros_mcap.kernels.filtering.run_state_space` with this filter."""
    mask = ring.shape[1] - 1
    for j in range(len(jobs)):
        row, who, step = jobs[j, 1], jobs[j, 2], jobs[j, 3]
        if jobs[j, 0] == PUSH:
            times[who, step & mask] = numbers[j, 0]
            butterworth_push(
                markers, links, marker_confidences, link_confidences, row, ring[who], times[who],
                step, now[who], settings[0], numbers[j, 2:], order,
            )  # fmt: skip
            if settings[2] > 0.0:
                follow_lengths(markers, row, limbs, numbers[j, 1], settings[2], lengths[who])
        else:
            butterworth_emit(
                ring[who], times[who], step, jobs[j, 4], numbers[j, 2:], order, settings[1],
                out_markers, out_links, out_marker_confidences, out_link_confidences, row,
            )  # fmt: skip
            if settings[2] > 0.0:
                restore_lengths(
                    out_markers, row, limbs, lengths[who], int(settings[3]), settings[4]
                )
