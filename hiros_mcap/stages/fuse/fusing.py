"""Asynchronous Kalman filter and smoother of one person's joints, with an offset per camera.

The state of a joint is [x, v, b_1 ... b_C]: position, velocity and the slow offset of each camera.
    x' = x + v dt, white acceleration (Bar-Shalom et al. 2001, section 6.2.2)
    b' = e^(-dt/tau) b, driven so that its variance stays the same (Gauss-Markov)
A joint that no camera has seen for _GOES_ON s slows down: v' = e^(-dt/_STOPS) v.
    z = x + b_c + white noise, at the camera's own time
All offsets fade alike. So the filter holds b / s, where s = e^(-dt/tau) over all that has passed:
then nothing fades, and z = x + s (b_c / s). Once s is small, it starts from 1 again.
The three axes share the covariance. The noise is Student's t, and of some measurements it is
uniform: they may lie anywhere (:mod:`.outliers`). So a joint that two cameras see at two places
stays where it was.
The smoother is modified Bryson-Frazier (Bierman 1977, section X.4): it carries back an adjoint of
the innovations and its covariance, and needs no inverse.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from hiros_mcap.kernels.array_types import F1, F2, F3, F4, I1, arrays
from hiros_mcap.kernels.compile import inlined, kernel
from hiros_mcap.skeletons import Floats, Ints, Stamps
from hiros_mcap.stages.fuse.outliers import CameraDoubts, outlier_odds

POSITION, VELOCITY, OFFSETS = 0, 1, 2  # rows of the state of a joint
REFERENCE = 2.0
"""m; distance at which the white noise of a joint is stated, and of a camera without a place."""
POSE = -1  # the camera of a step at which a pose is wanted and nothing is measured

_POSITION_VARIANCE, _VELOCITY_VARIANCE = 0.05, 1.0  # of a joint that is seen first, m2 and m2/s2
_UNKNOWN = -1.0  # interval of a step that a joint takes no part in
_EARLY = 0.1  # s before its first measurement at which a joint may be wanted
_LEVELS = (1.0, 10.0, 100.0)
"""Factors of the density of the acceleration: a joint at rest, in a walk, in a kick or a fall."""
LEVELS = len(_LEVELS)
_GOES_ON, _STOPS = 0.2, 0.15
"""s that an unseen joint keeps its velocity, as in the tracker; time constant of the stop, s.

People whom nobody sees are as likely to turn as to go on."""
_LEAST_SCALE = 0.01  # of s, above: an offset's variance is at most 10 000 times as large then
_CHANGES = 3.0  # 1/s: how often a joint goes over to another level


class Sightings(NamedTuple):
    """What the cameras saw of people: N views, each of one person, in the order of instants."""

    instants: I1  # (N,) number of the instant that the view belongs to
    people: I1  # (N,) id
    cameras: I1  # (N,) index of the camera
    stamps: I1  # (N,) time of the camera's message, ns
    positions: F3  # (N, M, 3) m, sides corrected; NaN = not seen
    confidences: F2  # (N, M) 0..1; NaN = not given
    distances: F1  # (N,) of the person from the camera, m; REFERENCE where that is not known
    hidden: F2  # (N, M) m2, by which the variance is larger where the camera cannot see
    outvoted: F2  # (N, M) m2, the same where most cameras see the joint elsewhere

    @classmethod
    def allocate(cls, views: int, markers: int) -> Sightings:
        """Return arrays whose numbers are still to be set."""
        joints = views, markers
        return arrays(cls, *4 * [views], (*joints, 3), joints, views, joints, joints)


def joined_out_of(parts: list[Sightings]) -> Sightings:
    """Return all parts as one; the list is empty then. One array at a time lies in memory twice."""
    columns = [list(arrays) for arrays in zip(*parts, strict=True)][::-1]
    parts.clear()
    return Sightings(*[np.concatenate(columns.pop()) for _ in Sightings._fields])


def rows_of(views: Sightings, instants: Stamps, people: Ints) -> Stamps:
    """(N,) Row of each view's person and instant among ``instants`` and ``people``; -1 = none."""
    if not len(people):
        return np.full(len(views.people), -1)
    keys = _key(instants, people)
    order = np.argsort(keys)
    wanted = _key(views.instants, views.people)
    rows = order[np.minimum(np.searchsorted(keys, wanted, sorter=order), len(keys) - 1)]
    return np.where(keys[rows] == wanted, rows, -1)


def _key(instants: Stamps, people: Stamps | Ints) -> Stamps:
    """One number for an instant and a person, whose id has 32 bits."""
    return instants * (1 << 32) + people


class Steps(NamedTuple):
    """T steps of one person, in the order of time: measurements, of N, and wanted poses."""

    times: F1  # (T,) s
    cameras: I1  # (T,) which camera measured, POSE = a pose is wanted
    rows: I1  # (T,) row of the measurement among the N, or of the wanted pose among those
    positions: F3  # (N, M, 3) measured, m; NaN = not measured
    variances: F2  # (N, M) of the white noise of a measurement along each axis, m2


class JointNoise(NamedTuple):
    """How joints move and how offsets wander."""

    accelerations: F1  # (M,) spectral density of the acceleration, m2/s3
    offsets: F1  # (M,) variance of a camera's offset, m2
    time: float  # time constant of the offsets, s
    freedom: int  # degrees of freedom of Student's t
    elsewhere: float  # density of outliers, 1/m3, but for the factor of :func:`_likelihood`
    lasting: float  # mean time for which a camera stays wrong about a joint, s
    order: I1  # (M,) joints, parents first
    parents: I1  # (M,) the joint's parent; -1 = none


class JointStates(NamedTuple):
    """Filtered states of R people, from which the next window starts."""

    means: F4  # (R, M, 2 + C, 3)
    covariances: F4  # (R, M, 2 + C, 2 + C); 0 = the joint was never seen
    times: F2  # (R, M) s
    seen: F2  # (R, M) time of the last measurement, s
    levels: F3  # (R, M, LEVELS) probability of each level of the acceleration
    wrong: F3
    measured: F3
    agreed: F3  # (R, M, C) each camera's last measurement, as in :class:`~.outliers.CameraDoubts`

    @classmethod
    def unknown(cls, people: int, markers: int, cameras: int) -> JointStates:
        """Return states of joints that nobody has seen."""
        r, m, c = people, markers, cameras
        n, joints, doubts = OFFSETS + c, (people, markers), 3 * [(r, m, c)]
        return arrays(cls, (r, m, n, 3), (r, m, n, n), joints, joints, (r, m, LEVELS), *doubts)


class FusedPoses(NamedTuple):
    """Smoothed joints at K times; NaN = unknown."""

    positions: F3  # (K, M, 3) m
    velocities: F3  # (K, M, 3) m/s
    variances: F2  # (K, M) of the position along each axis, m2

    @classmethod
    def absent(cls, poses: int, markers: int) -> FusedPoses:
        """Return poses of which nothing is known."""
        shapes = (poses, markers, 3), (poses, markers, 3), (poses, markers)
        return cls(*[np.full(shape, np.nan) for shape in shapes])


class FusionWork(NamedTuple):
    """Scratch for one joint with states of length N over T steps."""

    intervals: F1  # (T,) s since the step before for which the velocity lasts; _UNKNOWN = no part
    slows: F1  # (T,) share of the velocity that is left after the interval
    fades: F1  # (T,) factor of the held offsets after the interval; mostly 1
    scales: F1  # (T,) of the held offsets
    gains: F2  # (T, N) gain of a measurement; the covariances of x at a pose
    velocities: F2  # (T, N) the covariances of v at a pose
    innovations: F2  # (T, 3); the predicted x at a pose
    speeds: F2  # (T, 3) the predicted v at a pose
    information: F1  # (T,) 1 / variance of the innovation; the variance of x at a pose
    mean: F2
    covariance: F2  # (N, 3) and (N, N) state; the adjoint and its covariance on the way back
    row: F1  # (N,)
    levels: F2
    """(T, LEVELS) likelihood of a measurement by level; then the probability of the level."""
    stays: F1  # (T,) probability that a level lasts from the step before
    factors: F1  # (T,) of the density of the acceleration in the interval before a step
    rated: F2  # (LEVELS, 9) x, v and their covariances xx, xv, vv, where the joint stays at a level
    places: F2  # (T, 3) measured, m; NaN = the step does not measure the joint
    variances: F1  # (T,) of the white noise of a measurement, m2
    doubts: CameraDoubts  # by level; the filter has the first row

    @classmethod
    def of(cls, steps: int, size: int, markers: int) -> FusionWork:
        """Make room."""
        t, n = steps, size
        doubts = CameraDoubts.of(LEVELS, steps, size - OFFSETS, markers)
        many, levels = ((t, n), (t, n), (t, 3), (t, 3)), ((t, LEVELS), t, t, (LEVELS, 9))
        return arrays(cls, t, t, t, t, *many, t, (n, 3), (n, n), n, *levels, (t, 3), t, doubts)


# Rows of a covariance.


@inlined
def _add_multiple(row: Floats, factor: float, to: Floats) -> None:
    """Add a multiple of a row to another one."""
    for j in range(len(row)):
        to[j] += factor * row[j]


@inlined
def _multiply(row: Floats, factor: float) -> None:
    """Multiply a row by a factor."""
    for j in range(len(row)):
        row[j] *= factor


@kernel
def _copy(source: Floats, to: Floats) -> None:
    """Copy a row; slices would take long to compile."""
    for i in range(len(to)):
        to[i] = source[i]


@kernel
def _load(states: JointStates, row: int, m: int, work: FusionWork) -> None:
    """Fetch the state of a joint."""
    for i in range(len(work.mean)):
        _copy(states.means[row, m, i], work.mean[i])
        _copy(states.covariances[row, m, i], work.covariance[i])
    _load_doubts(states, row, m, 0, work.doubts)


@kernel
def _load_doubts(states: JointStates, row: int, m: int, level: int, doubts: CameraDoubts) -> None:
    """Fetch what is known of the cameras' last measurements of a joint."""
    _copy(states.wrong[row, m], doubts.wrong[level])
    _copy(states.measured[row, m], doubts.times[level])
    _copy(states.agreed[row, m], doubts.agreed[level])


@kernel
def _save(
    states: JointStates, row: int, m: int, times: tuple[float, float], scale: float,
    work: FusionWork,
) -> None:  # fmt: skip
    """Store the state of a joint, with its time and that of the last measurement, s.

    ``scale`` : of the offsets that the filter holds.
    """
    means, covariances = states.means[row, m], states.covariances[row, m]
    for i in range(len(work.mean)):
        _copy(work.mean[i], means[i])
        _copy(work.covariance[i], covariances[i])
    for i in range(OFFSETS, len(work.mean)):
        _fade(means, covariances, i, scale)
    _copy(work.doubts.wrong[0], states.wrong[row, m])
    _copy(work.doubts.times[0], states.measured[row, m])
    _copy(work.doubts.agreed[0], states.agreed[row, m])
    states.times[row, m], states.seen[row, m] = times


@inlined
def _slowed(unseen: float, dt: float) -> tuple[float, float]:
    """Return how long a velocity lasts within ``dt`` s, and the share of it that is left then.

    ``unseen`` : s since the last measurement before them.
    """
    slowing = min(max(unseen + dt - _GOES_ON, 0.0), dt)
    if slowing <= 0.0:
        return dt, 1.0
    left = math.exp(-slowing / _STOPS)
    return dt - slowing + _STOPS * (1.0 - left), left


@kernel
def _start(z: Floats, offset_variance: float, mean: Floats, covariance: Floats) -> None:
    """Prior of a joint that is seen first at ``z`` (3,)."""
    mean[:] = 0.0
    covariance[:] = 0.0
    for c in range(3):
        mean[POSITION, c] = z[c]
    covariance[POSITION, POSITION] = _POSITION_VARIANCE
    covariance[VELOCITY, VELOCITY] = _VELOCITY_VARIANCE
    for k in range(OFFSETS, len(mean)):
        covariance[k, k] = offset_variance


@inlined
def _fade(mean: Floats, covariance: Floats, i: int, remains: float) -> None:
    """Let an offset, row ``i`` of a state, or of its adjoint, keep a share."""
    for c in range(3):
        mean[i, c] *= remains
    row = covariance[i]
    with_position, with_velocity = remains * row[POSITION], remains * row[VELOCITY]
    _multiply(row, remains * remains)
    row[POSITION], row[VELOCITY] = with_position, with_velocity
    covariance[POSITION, i] *= remains
    covariance[VELOCITY, i] *= remains


@inlined
def _predict(t: int, dt: float, q: float, driven: float, work: FusionWork) -> None:
    """Carry the state on by the ``dt`` s before step ``t``: F x, F P F' + Q.

    ``driven`` : by how much the variances of the held offsets grow.
    """
    x, p = work.mean, work.covariance
    n, lasts, slow = len(x), work.intervals[t], work.slows[t]
    for c in range(3):
        x[POSITION, c] += lasts * x[VELOCITY, c]
        x[VELOCITY, c] *= slow
    _add_multiple(p[VELOCITY], lasts, p[POSITION])
    _multiply(p[VELOCITY], slow)
    for i in range(n):
        p[i, POSITION] += lasts * p[i, VELOCITY]
        p[i, VELOCITY] *= slow
    p[0, 0] += q * dt * dt * dt / 3.0
    p[0, 1] += q * dt * dt / 2.0
    p[1, 0] += q * dt * dt / 2.0
    p[1, 1] += q * dt
    for i in range(OFFSETS, n):
        if work.fades[t] != 1.0:
            _fade(x, p, i, work.fades[t])
        p[i, i] += driven


@inlined
def _likelihood(scaled: float, variance: float, freedom: int) -> float:
    """Likelihood of an innovation in space, but for a factor, by its square over its variance."""
    tail: float = (1.0 + scaled / freedom) ** (freedom + 3)
    return 1.0 / math.sqrt(variance * variance * variance * tail)


@inlined
def _excess(scaled: float, odds: float, freedom: int) -> float:
    """Return the factor by which an outlier adds to its noise's variance, by its scaled square.

    It is 1 / (w p) - 1, where w is the weight that Student's t gives the measurement, at most 1,
    and p the probability that it is of the joint at all.
    """
    return (1.0 + odds) * max((freedom + scaled) / (freedom + 3), 1.0) - 1.0


@inlined
def _odds(
    steps: Steps, t: int, m: int, level: int, innovation: tuple[float, float], likelihood: float,
    noise: JointNoise, work: FusionWork,
) -> tuple[float, float]:  # fmt: skip
    """Return what :func:`outlier_odds` does of a step's measurement of a joint."""
    time, camera, parent = steps.times[t], steps.cameras[t], noise.parents[m]
    wrong = work.doubts.joints[parent, t] if parent >= 0 else 0.0
    ratio = noise.elsewhere / max(likelihood, 1e-30)
    return outlier_odds(time, camera, level, innovation, ratio, wrong, noise.lasting, work.doubts)


@inlined
def _correct(steps: Steps, t: int, m: int, noise: JointNoise, work: FusionWork) -> None:
    """Correct the state by a measurement."""
    x, p, h = work.mean, work.covariance, work.row
    n, k, scale = len(x), OFFSETS + steps.cameras[t], work.scales[t]
    for j in range(n):
        h[j] = p[POSITION, j] + scale * p[k, j]
    variance = h[POSITION] + scale * h[k] + work.variances[t]
    square = 0.0
    for c in range(3):
        y = work.places[t, c] - x[POSITION, c] - scale * x[k, c]
        work.innovations[t, c] = y
        square += y * y
    scaled = square / variance
    likelihood = _likelihood(scaled, variance, noise.freedom)
    odds, _ = _odds(steps, t, m, 0, (square, variance), likelihood, noise, work)
    work.doubts.joints[m, t] = odds / (1.0 + odds)
    excess = _excess(scaled, odds, noise.freedom)
    information = 1.0 / (variance + work.variances[t] * excess)
    work.information[t] = information
    for i in range(n):
        gain = h[i] * information
        work.gains[t, i] = gain
        for c in range(3):
            x[i, c] += gain * work.innovations[t, c]
        _add_multiple(h, -gain, p[i])


@kernel
def _take_joint(steps: Steps, m: int, work: FusionWork) -> None:
    """Write what steps measure of a joint, side by side, for all who go through the steps."""
    for t in range(len(steps.times)):
        work.places[t, 0] = np.nan
        if steps.cameras[t] >= 0:
            row = steps.rows[t]
            work.variances[t] = steps.variances[row, m]
            for c in range(3):
                work.places[t, c] = steps.positions[row, m, c]


@inlined
def _is_measured(work: FusionWork, t: int) -> bool:
    """Whether a step measures the joint."""
    return not math.isnan(work.places[t, 0])


@kernel
def _rate(
    steps: Steps, m: int, noise: JointNoise, states: JointStates, row: int, work: FusionWork
) -> None:
    """Write how likely a joint's measurements are if it stays at a level.

    Only x and v are estimated; the offsets of the cameras count as white noise. That changes the
    result by .01 mm, and costs a tenth. A processor works at all levels of a step at once.
    """
    time, seen = states.times[row, m], states.seen[row, m]
    p = states.covariances[row, m]
    is_known = p[POSITION, POSITION] != 0.0
    for level in range(LEVELS):
        _load_doubts(states, row, m, level, work.doubts)
        rated = work.rated[level]
        for c in range(3):
            rated[c] = states.means[row, m, POSITION, c]
            rated[3 + c] = states.means[row, m, VELOCITY, c]
        rated[6], rated[7] = p[POSITION, POSITION], p[POSITION, VELOCITY]
        rated[8] = p[VELOCITY, VELOCITY]
    for t in range(len(steps.times)):
        for level in range(LEVELS):
            work.levels[t, level] = 1.0
        if not _is_measured(work, t):
            continue
        if not is_known:
            is_known, time, seen = True, steps.times[t], steps.times[t]
            for level in range(LEVELS):
                rated = work.rated[level]
                for c in range(3):
                    rated[c], rated[3 + c] = work.places[t, c], 0.0
                rated[6], rated[7], rated[8] = _POSITION_VARIANCE, 0.0, _VELOCITY_VARIANCE
        dt = max(steps.times[t] - time, 0.0)
        lasts, slow = _slowed(max(time - seen, 0.0), dt)
        seen = time = max(steps.times[t], time)
        for level in range(LEVELS):
            _rate_level(steps, t, m, level, (dt, lasts, slow), noise, work)


@inlined
def _rate_level(
    steps: Steps, t: int, m: int, level: int, interval: tuple[float, float, float],
    noise: JointNoise, work: FusionWork,
) -> None:  # fmt: skip
    """Write how likely a measurement is at a level, and correct x and v by it.

    ``interval`` : s since the one before, for how many of them the velocity lasts, and the share
    of it that is left.
    """
    q, offset = noise.accelerations[m] * _LEVELS[level], noise.offsets[m]
    rated, (dt, lasts, slow) = work.rated[level], interval
    xx, xv, vv = rated[6], rated[7], rated[8]
    xx += lasts * (2.0 * xv + lasts * vv) + q * dt * dt * dt / 3.0
    xv = slow * (xv + lasts * vv) + q * dt * dt / 2.0
    vv = slow * slow * vv + q * dt
    noise_variance = work.variances[t] + offset
    square = 0.0
    for c in range(3):
        rated[c] += lasts * rated[3 + c]
        rated[3 + c] *= slow
        square += (work.places[t, c] - rated[c]) ** 2
    variance = xx + noise_variance
    scaled = square / variance
    likelihood = _likelihood(scaled, variance, noise.freedom)
    odds, right = _odds(steps, t, m, level, (square, variance), likelihood, noise, work)
    work.levels[t, level] = right * likelihood * (1.0 + odds)
    variance += noise_variance * _excess(scaled, odds, noise.freedom)
    gain, gain_of_speed = xx / variance, xv / variance
    for c in range(3):
        innovation = work.places[t, c] - rated[c]
        rated[c] += gain * innovation
        rated[3 + c] += gain_of_speed * innovation
    rated[8] = vv - gain_of_speed * xv
    rated[7] = xv - gain * xv
    rated[6] = xx - gain * xx


@kernel
def _go_over(before: Floats, stay: float, after: Floats) -> None:
    """Write the probabilities of the levels later: each goes over to any other, or stays."""
    for k in range(LEVELS):
        after[k] = stay * before[k] + (1.0 - stay) / LEVELS


@kernel
def _normalize(probabilities: Floats) -> None:
    """Let probabilities sum to 1."""
    total = 0.0
    for k in range(LEVELS):
        total += probabilities[k]
    for k in range(LEVELS):
        probabilities[k] /= total


@kernel
def _choose_levels(
    steps: Steps, keep: int, m: int, states: JointStates, row: int, work: FusionWork
) -> None:
    """Write the factor of the density of each step: a hidden Markov model over the levels.

    Forwards, and back by the filtered probabilities (Rauch's form, for a symmetric chain). The
    factor is the geometric mean over the levels. The probabilities before step ``keep`` are kept.
    """
    n, level, next_level = len(steps.times), work.levels, work.row
    previous, time = states.levels[row, m], states.times[row, m]
    if states.covariances[row, m, POSITION, POSITION] == 0.0:
        time = -np.inf  # nothing is known: all levels are equally likely
    for t in range(n):
        work.stays[t] = math.exp(-_CHANGES * max(steps.times[t] - time, 0.0))
        time = max(steps.times[t], time)
        _go_over(previous, work.stays[t], next_level)
        for k in range(LEVELS):
            level[t, k] *= next_level[k]
        _normalize(level[t])
        previous = level[t]
    if min(keep, n) > 0:
        _copy(level[min(keep, n) - 1], states.levels[row, m])
    for t in range(n - 2, -1, -1):
        stay = work.stays[t + 1]
        _go_over(level[t], stay, next_level)
        others = 0.0
        for k in range(LEVELS):
            others += level[t + 1, k] / next_level[k] * (1.0 - stay) / LEVELS
        for k in range(LEVELS):
            level[t, k] *= stay * level[t + 1, k] / next_level[k] + others
        _normalize(level[t])
    for t in range(n):
        log = 0.0
        for k in range(LEVELS):
            log += level[t, k] * math.log(_LEVELS[k])
        work.factors[t] = math.exp(log)


@kernel
def _first_seen(steps: Steps, work: FusionWork) -> int:
    """Return the first step that measures the joint; the number of steps if none does."""
    for t in range(len(steps.times)):
        if _is_measured(work, t):
            return t
    return len(steps.times)


@kernel
def _forward(
    steps: Steps, keep: int, m: int, noise: JointNoise, states: JointStates, row: int,
    work: FusionWork,
) -> None:  # fmt: skip
    """Filter one joint; leave its state after ``keep`` steps in ``states``."""
    x, p = work.mean, work.covariance
    q, offset_variance = noise.accelerations[m], noise.offsets[m]
    _load(states, row, m, work)
    time, seen, started = states.times[row, m], states.seen[row, m], p[0, 0] > 0.0
    first, scale = 0 if started else _first_seen(steps, work), 1.0
    for t in range(len(steps.times)):
        if t == keep and started:
            _save(states, row, m, (time, seen), scale, work)
        work.intervals[t] = _UNKNOWN
        is_pose = steps.cameras[t] < 0
        if not is_pose and not _is_measured(work, t):
            continue
        if not started:
            if first == len(steps.times) or steps.times[t] < steps.times[first] - _EARLY:
                continue
            started, time, seen = True, steps.times[t], steps.times[first]
            _start(work.places[first], offset_variance, x, p)
        dt = max(steps.times[t] - time, 0.0)
        work.intervals[t], work.slows[t] = _slowed(max(time - seen, 0.0), dt)
        remains = math.exp(-dt / noise.time)
        scale, work.fades[t] = scale * remains, 1.0
        if scale < _LEAST_SCALE:
            work.fades[t], scale = scale, 1.0
        work.scales[t] = scale
        time = max(steps.times[t], time)
        if dt > 0.0:
            driven = offset_variance * (1.0 - remains * remains) / (scale * scale)
            _predict(t, dt, q * work.factors[t], driven, work)
        if is_pose:
            work.information[t] = p[POSITION, POSITION]
            _copy(p[POSITION], work.gains[t])
            _copy(p[VELOCITY], work.velocities[t])
            _copy(x[POSITION], work.innovations[t])
            _copy(x[VELOCITY], work.speeds[t])
        else:
            seen = time
            _correct(steps, t, m, noise, work)
    if keep >= len(steps.times) and started:
        _save(states, row, m, (time, seen), scale, work)


@inlined
def _measured(steps: Steps, t: int, work: FusionWork) -> None:
    """Carry the adjoint back through a measurement.

    l = (I - K H)' l - H' y / S,  L = (I - K H)' L (I - K H) + H' H / S
    H has 1 at the position, and the scale at the camera's offset.
    The matrix is L'. It is L but for rounding.
    """
    adjoint, square, g = work.mean, work.covariance, work.row
    n, k, scale = len(adjoint), OFFSETS + steps.cameras[t], work.scales[t]
    for c in range(3):
        s = work.information[t] * work.innovations[t, c]
        for i in range(n):
            s += work.gains[t, i] * adjoint[i, c]
        adjoint[POSITION, c] -= s
        adjoint[k, c] -= scale * s
    total = work.information[t]
    g[:] = 0.0
    for j in range(n):
        _add_multiple(square[j], work.gains[t, j], g)
    for i in range(n):
        total += g[i] * work.gains[t, i]
        square[i, POSITION] -= g[i]
        square[i, k] -= scale * g[i]
    _add_multiple(g, -1.0, square[POSITION])
    _add_multiple(g, -scale, square[k])
    square[POSITION, POSITION] += total
    square[POSITION, k] += scale * total
    square[k, POSITION] += scale * total
    square[k, k] += scale * scale * total


@inlined
def _unpredict(t: int, work: FusionWork) -> None:
    """Carry the adjoint back over the interval before step ``t``: F' l, F' L F."""
    adjoint, square = work.mean, work.covariance
    n, lasts, slow = len(adjoint), work.intervals[t], work.slows[t]
    for c in range(3):
        adjoint[VELOCITY, c] = slow * adjoint[VELOCITY, c] + lasts * adjoint[POSITION, c]
    for i in range(n):
        square[i, VELOCITY] = slow * square[i, VELOCITY] + lasts * square[i, POSITION]
    _multiply(square[VELOCITY], slow)
    _add_multiple(square[POSITION], lasts, square[VELOCITY])
    if work.fades[t] != 1.0:
        for i in range(OFFSETS, n):
            _fade(adjoint, square, i, work.fades[t])


@kernel
def _backward(steps: Steps, m: int, out: FusedPoses, work: FusionWork) -> None:
    """Smooth one joint: x - P l, P - P L P at every step that wants a pose."""
    adjoint, square = work.mean, work.covariance
    adjoint[:] = 0.0
    square[:] = 0.0
    n, first = len(adjoint), 0
    while first < len(steps.times) and steps.cameras[first] != POSE:
        first += 1
    for t in range(len(steps.times) - 1, first - 1, -1):
        if work.intervals[t] < 0.0:
            continue
        if steps.cameras[t] >= 0:
            _measured(steps, t, work)
        else:
            p, pose = work.gains[t], steps.rows[t]
            variance = work.information[t]
            for i in range(n):
                for j in range(n):
                    variance -= p[i] * square[j, i] * p[j]
            out.variances[pose, m] = max(variance, 0.0)
            for c in range(3):
                x, v = work.innovations[t, c], work.speeds[t, c]
                for i in range(n):
                    x -= p[i] * adjoint[i, c]
                    v -= work.velocities[t, i] * adjoint[i, c]
                out.positions[pose, m, c] = x
                out.velocities[pose, m, c] = v
        if work.intervals[t] > 0.0:
            _unpredict(t, work)


@kernel
def smooth_joints(
    steps: Steps, keep: int, noise: JointNoise, states: JointStates, row: int, out: FusedPoses,
    work: FusionWork,
) -> None:  # fmt: skip
    """Smooth all joints of a person over the steps of a window.

    Parameters
    ----------
    states, row : where the person's filter stands before the first step; brought to the state
        before step ``keep``, where the next window starts.
    out : gets the poses that steps want. Where a joint is unknown, it stays as it is.
    """
    for m in range(len(work.doubts.joints)):
        for t in range(len(steps.times)):
            work.doubts.joints[m, t] = 0.0
    for m in noise.order:
        _take_joint(steps, m, work)
        _rate(steps, m, noise, states, row, work)
        _choose_levels(steps, keep, m, states, row, work)
        _forward(steps, keep, m, noise, states, row, work)
        _backward(steps, m, out, work)
