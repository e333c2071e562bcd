"""Butterworth low-pass of any order at the samples' own times, on R3 and SO(3).

The analogue filter ``y^(n) = -a_0 w^n y - ... + w^n u`` is run exactly between samples (matrix
exponential), its input going straight from one sample to the next. So a varying sample time is
no approximation, every step is stable whatever its length, and the states are the derivatives of
the output: velocity and acceleration come for free. On SO(3) all of it happens in the tangent
space at the last output.

With a look-ahead the same filter also runs backwards over the forward outputs, which cancels its
phase. Being linear, the backward run is one weight per step, the same for all tracks.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

from hiros_mcap.kernels.filters import (
    AGE,
    BEND,
    CONFIDENCE,
    CONTINUES,
    DELTA,
    POSE,
    RATE,
    Floats,
    block_of,
    clear,
    difference,
    displace,
    erase,
    is_present,
    measure,
    solve,
    write,
)

# Columns of what butterworth_push carries on, (T, STATE + 3 * (order - 1)).
NOW_POSE = 0
NOW_INPUT = 4
NOW_AGE = 8
NOW_CONFIDENCE = 9
STATE = 10  # then the derivatives 1 to order - 1, the i-th divided by scale^i

COLUMNS = 16  # of a ring: POSE to CONFIDENCE
CACHED = 8  # sample times whose matrices are kept during one push


@njit(cache=True, nogil=True, error_model="numpy")
def coefficients(order: int) -> Any:
    """Ascending coefficients of the normalised Butterworth polynomial, (order + 1)."""
    a = np.ones(order + 1)
    for i in range(order):
        angle = 0.5 * np.pi / order
        a[i + 1] = a[i] * np.cos(i * angle) / np.sin((i + 1) * angle)
    return a


@njit(cache=True, nogil=True, error_model="numpy")
def multiply(a: Any, b: Any, out: Any) -> None:
    """``out = a @ b`` for small square matrices."""
    n = a.shape[0]
    for i in range(n):
        for j in range(n):
            total = 0.0
            for k in range(n):
                total += a[i, k] * b[k, j]
            out[i, j] = total


@njit(cache=True, nogil=True, error_model="numpy")
def exponential(m: Any) -> Any:
    """Matrix exponential by scaling, Taylor's series and squaring."""
    n = m.shape[0]
    norm = 0.0
    for i in range(n):
        row = 0.0
        for j in range(n):
            row += abs(m[i, j])
        norm = max(norm, row)
    squarings = 0
    while norm > 0.25:
        norm *= 0.5
        squarings += 1
    scaled, term = m * 0.5**squarings, np.eye(n)
    out, product = np.eye(n), np.empty((n, n))
    for i in range(1, 13):
        multiply(term, scaled, product)
        for r in range(n):
            for c in range(n):
                term[r, c] = product[r, c] / i
                out[r, c] += term[r, c]
    for _ in range(squarings):
        multiply(out, out, product)
        out, product = product, out
    return out


@njit(cache=True, nogil=True, error_model="numpy")
def transition(a: Any, rate: float, scale: float, dt: float, out: Any) -> None:
    """Into ``out`` (n, n + 2): ``s' = out[:, :n] s + out[:, n] u + out[:, n + 1] u'`` over dt.

    ``rate`` is the filter's corner in rad/s; state i is the i-th derivative over ``scale``^i.
    """
    n = a.shape[0] - 1
    m = np.zeros((n + 2, n + 2))
    for i in range(n - 1):
        m[i, i + 1] = scale * dt
    for i in range(n):
        m[n - 1, i] = -a[i] * (rate / scale) ** (n - i) * scale * dt
    m[n - 1, n] = (rate / scale) ** n * scale * dt
    m[n, n + 1] = 1.0
    whole = exponential(m)
    for i in range(n):
        for j in range(n):
            out[i, j] = whole[i, j]
        out[i, n] = whole[i, n] - whole[i, n + 1]
        out[i, n + 1] = whole[i, n + 1]


@njit(
    "float64(int64, float64, float64, int64, float64)", cache=True, nogil=True, error_model="numpy"
)
def butterworth_gain(order: int, rate: float, dt: float, ahead: int, frequency: float) -> float:
    """Magnitude response at a constant sample time ``dt``; ``ahead`` in samples, 0 = causal."""
    step = np.empty((order, order + 2))
    transition(coefficients(order), rate, rate, dt, step)
    z = np.exp(2j * np.pi * frequency * dt)
    system = np.zeros((order, order), np.complex128)
    state = np.zeros(order, np.complex128)
    for r in range(order):
        for c in range(order):
            system[r, c] = (z if r == c else 0.0) - step[r, c]
        state[r] = step[r, order] + z * step[r, order + 1]
    solve(system, state)
    forward = state[0]
    if ahead == 0:
        return float(abs(forward))
    for r in range(order):
        state[r] = forward if r == 0 else 0.0
    back = np.zeros(order, np.complex128)
    for _ in range(ahead):
        for r in range(order):
            back[r] = forward * (step[r, order] * z + step[r, order + 1])
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
def matrix(a: Any, rate: float, scale: float, dt: float, cache: Any, count: int) -> int:
    """Slot of ``cache`` (CACHED, n, n + 3) with the transition over ``dt``, made when missing.

    Element (0, n + 2) of a slot is its dt; ``count`` slots have been made before.
    """
    n = a.shape[0] - 1
    for i in range(min(count, CACHED)):
        if cache[i, 0, n + 2] == dt:
            return i
    i = count % CACHED
    transition(a, rate, scale, dt, cache[i])
    cache[i, 0, n + 2] = dt
    return int(i)


@njit(cache=True, nogil=True, error_model="numpy")
def advance(step: Any, state: Any, u0: Any, u1: Any) -> None:
    """One step of the filter on ``state`` (n, 3), whose row 0 is zero: relative to the output."""
    n = state.shape[0]
    new = np.empty(n)
    for c in range(3):
        for i in range(n):
            new[i] = step[i, n] * u0[c] + step[i, n + 1] * u1[c]
            for j in range(1, n):
                new[i] += step[i, j] * state[j, c]
        for i in range(n):
            state[i, c] = new[i]


@njit(cache=True, nogil=True, error_model="numpy")
def derive(a: Any, rate: float, scale: float, state: Any, u: Any, slope: Any, row: Any) -> None:
    """Velocity and acceleration of the output into columns RATE and BEND of ``row``.

    ``state`` (n, 3) and the input ``u`` (3) are relative to the output, ``slope`` (3) is the
    input's. What the state does not hold follows from the differential equation.
    """
    n, ratio = state.shape[0], rate / scale
    for c in range(3):
        top = ratio**n * u[c]  # the n-th derivative
        for i in range(1, n):
            top -= a[i] * ratio ** (n - i) * state[i, c]
        if n == 1:
            velocity, acceleration = scale * top, scale * (slope[c] - scale * top) * ratio
        else:
            velocity = scale * state[1, c]
            acceleration = scale * scale * (top if n == 2 else state[2, c])
        row[RATE + c] = velocity
        row[BEND + c] = acceleration


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
    "void(float64[:,::1], float64[:,::1], float64[::1], float64[::1], float64[:,:,::1],"
    " float64[::1], int64, float64[:,::1], float64, float64[::1], int64)",
    cache=True,
    nogil=True,
    error_model="numpy",
)
def butterworth_push(
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
    """Run the tracks that are seen up to step ``step``; the others coast at their velocity.

    Arguments as of :func:`state_space_push`. A track that comes back within ``max_gap`` s takes
    the whole gap as one step, its input a straight line. ``tuning`` holds
    :func:`butterworth_rate` and the constant scale of the states, both in rad/s.
    """
    n_markers, n_links, mask = markers.shape[0], links.shape[0], ring.shape[0] - 1
    slot, before = ring[step & mask], ring[(step - 1) & mask]
    dt = times[step & mask] - times[(step - 1) & mask] if step > 0 else 0.0
    a, rate, scale = coefficients(order), tuning[0], tuning[1]
    cache, cached = np.zeros((CACHED, order, order + 3)), 0
    z, former, u0, u1, slope = np.zeros(4), np.zeros(4), np.zeros(3), np.zeros(3), np.zeros(3)
    state = np.zeros((order, 3))
    for block in range(4):
        of_markers, turning, start, size = block_of(block, n_markers, n_links)
        elements = markers if of_markers else links
        confidences = marker_confidences if of_markers else link_confidences
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
            for c in range(3):
                slope[c] = 0.0
            if active:
                at = matrix(a, rate, scale, elapsed, cache, cached)
                cached = max(cached, at + 1)
                difference(own[NOW_INPUT:], former, turning, u0)
                difference(z, former, turning, u1)
                advance(cache[at], state, u0, u1)
                displace(state[0], former, turning, row)
                for c in range(3):
                    slope[c] = (u1[c] - u0[c]) / (scale * elapsed)
            difference(z, row, turning, u1)
            derive(a, rate, scale, state, u1, slope, row)
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
    a, step = coefficients(order), np.empty((order, order + 2))
    weights, row, new = np.zeros(end - first), np.zeros(order), np.zeros(order)
    row[0] = 1.0
    done = -1.0
    for i in range(end - first - 1):
        dt = times[(first + i + 1) & mask] - times[(first + i) & mask]
        if dt != done:
            transition(a, tuning[0], tuning[1], dt, step)
            done = dt
        for c in range(order):
            new[c] = 0.0
            weights[i] += row[c] * step[c, order + 1]
            weights[i + 1] += row[c] * step[c, order]
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
    " float64[:,::1], float64[:,::1], float64[::1], float64[::1])",
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
) -> None:
    """Write the estimate at step ``first``, given all steps before ``end``, into a person's rows.

    Velocity and acceleration are the forward filter's, filtered backwards like its output.
    """
    n_markers, n_links, mask = markers.shape[0], links.shape[0], ring.shape[0] - 1
    pose, shift, motion = np.zeros(4), np.zeros(3), np.zeros(6)
    weights = backward_weights(times, mask, first, end, tuning, order)
    for block in range(4):
        of_markers, turning, start, size = block_of(block, n_markers, n_links)
        elements = markers if of_markers else links
        confidences = marker_confidences if of_markers else link_confidences
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
