"""A person's own motion as a prior: joints move together, noise does not.

Within a minute, poses vary in fewer directions than they have coordinates. What exceeds the known
variance of the markers there is motion; an estimate between the mean pose and the measured one
follows (Wiener). A few seconds are too short: an error that changes within some seconds looks like
motion there. The minute lies about each pose (:func:`shrink_noise`), or before it
(:class:`RecentMotion`). Poses are in the person's own frame: upright with the heading
(:func:`local_frames`), or, of somebody who rolls and has none, the whole body's
(:func:`body_frames`).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from hiros_mcap.body.rotations import nearest_rotation
from hiros_mcap.kernels.array_types import F1, F2, F3
from hiros_mcap.kernels.compile import entry, kernel
from hiros_mcap.skeletons import Flags, Floats, Ints, Stamps
from hiros_mcap.stages.fuse.pair_lengths import RATE

FEWEST = 30  # poses that a prior needs
_EXCESS = 1.5  # eigenvalue, in units of the noise, that noise alone may have
_PIECE = 3.0  # s
_SHOWN = 0.4  # share of its variance that a Gauss-Markov offset of 1.7 s shows within such a piece
_LEAST = 1e-9  # m; noise of a marker that does not move at all
_FIRST, _RENEWED = 2.0, 1.0  # s of a person before the first such prior, and least between two
_NEW = 1 / 15
"""Share of the poses that are new when it is renewed: of a minute, 4 s. With 1 / 30, and twice a
second, results of 23 logs are the same within .06 mm."""
_LARGEST_STEP = 0.5  # by it, in standard deviations: a new motion is believed
_POSES = 900  # of a minute
_LEFT = 1.0  # s unseen after which it is learned anew
_LEVEL = 0.2  # least horizontal share of the line from left to right that tells a heading
_TILTED = 0.02  # share of poses that may lack one: a pose of a detector may be wrong
_SUREST = 0.01**2  # m2; the least variance that counts, so that no marker alone turns a pose
_ABSENT = 1.0  # m2; variance of a marker that is missing
_FREE = 0.003  # m; what each marker may do by itself


def shrink_noise(
    positions: Floats, variances: Floats, minute: tuple[Floats, Floats], rate: float
) -> Floats:
    """Return local poses (T, M, 3), m, moved towards what the person does in the ``minute``.

    Parameters
    ----------
    variances : (T, M) m2 along each axis.
    minute : local poses (S, M, 3) and variances (S, M), at most RATE, which lie about the others.
    rate : of the poses, Hz.
    """
    known, noises = minute
    whole = ~np.isnan(known[:, :, 0]).any(axis=0)
    if len(known) < FEWEST or not whole.any():
        return positions
    known = known[:, whole]
    noises = visible_noise(known, noises[:, whole], min(rate, RATE))
    noise = visible_noise(positions[:, whole], variances[:, whole], rate)
    out = positions.copy()
    out[:, whole] = estimated(motion_of(known, noises), positions[:, whole], noise)
    return out


class RecentMotion:
    """The last minute of a person, and the prior that it gives."""

    def __init__(self) -> None:
        self._poses, self._variances = np.empty((0, 0, 3)), np.empty((0, 0))
        """Rings of _POSES poses and their variances."""
        self._kept = self._next = self._pushed = self._seen = 0
        """Poses so far; when the prior is due, the last pose was kept, and the person was seen
        last, ns."""
        self._motion: MotionPrior | None = None

    def shrink(self, local: Floats, variances: Floats, stamps: Stamps) -> Floats:
        """Return local poses (T, M, 3), m, each moved towards what the person has done before it.

        They are remembered. After a second unseen the motion is learned anew.

        Parameters
        ----------
        variances : (T, M) m2 along each axis. stamps : (T,) ns.
        """
        if not len(self._poses):
            self._poses = np.empty((_POSES, *local.shape[1:]))
            self._variances = np.empty((_POSES, *variances.shape[1:]))
        out, first, kept = local.copy(), 0, list[int]()
        for t, stamp in enumerate(stamps.tolist()):
            if stamp - self._seen > _LEFT * 1e9:
                self._take(out, variances, slice(first, t), kept)
                self._motion, self._kept, first = None, 0, t
            self._seen = stamp
            if not (self._kept or kept):
                self._next = stamp + round(_FIRST * 1e9)
            elif stamp - self._pushed < 0.9e9 / RATE:
                continue  # a minute does not need all that come fast
            self._pushed = stamp
            kept.append(t)
            if stamp >= self._next and self._kept + len(kept) >= FEWEST:
                self._take(out, variances, slice(first, t + 1), kept)
                self._renew(stamp)
                first = t + 1
        self._take(out, variances, slice(first, None), kept)
        return out

    def _take(self, poses: Floats, variances: Floats, some: slice, kept: list[int]) -> None:
        """Move some poses towards the motion, in place; remember the rows ``kept``, and empty it.

        They are not as measured: from what has less noise, a better prior is learned.
        """
        if self._motion is not None and len(poses[some]):
            poses[some] = estimated(self._motion, poses[some], variances[some], _LARGEST_STEP)
        places = (self._kept + np.arange(len(kept))) % _POSES
        self._poses[places], self._variances[places] = poses[kept], variances[kept]
        self._kept += len(kept)
        kept.clear()

    def _renew(self, stamp: int) -> None:
        """Find the motion in the poses of the minute before."""
        poses, variances = self._poses[: self._kept], self._variances[: self._kept]
        self._next = stamp + round(max(_RENEWED, _NEW * len(poses) / RATE) * 1e9)
        self._motion = motion_of(poses, variances)


def visible_noise(positions: Floats, variances: Floats, rate: float) -> Floats:
    """(T, M) Variances without what the poses (T, M, 3) contradict, m2: noise shows in them.

    Errors of detectors depend on the pose: those of a person who stands hardly change. A prior that
    expects noise there would take small movements for it. The poses are looked at in pieces of 3 s.
    """
    out, size = variances.copy(), max(round(_PIECE * rate), 2)
    for start in range(0, len(positions), size):
        part = slice(max(min(start, len(positions) - size), 0), start + size)
        present: Flags = np.asarray(~np.isnan(positions[part]))
        n = np.maximum(present[:, :, 0].sum(axis=0), 1)
        poses = np.where(present, positions[part], 0.0)
        deviations = np.where(present, poses - poses.sum(axis=0) / n[:, None], 0.0)
        noise = (deviations * deviations).sum(axis=(0, 2)) / (3 * n * _SHOWN)
        out[part] = variances[part] * np.minimum(noise / variances[part].mean(axis=0), 1.0)
    return out


def local_frames(positions: Floats, lateral: Ints) -> tuple[Floats, Floats]:
    """(T, 3, 3) and (T, 1, 3): yaw and centre of each pose; the world's where unknown."""
    frames = np.tile(np.eye(3), (len(positions), 1, 1))
    trunk = positions[:, lateral.ravel()] if len(lateral) else positions
    present = ~np.isnan(trunk[:, :, :1])
    origins = np.where(present, trunk, 0.0).sum(axis=1, keepdims=True)
    origins /= np.maximum(present.sum(axis=1, keepdims=True), 1)
    if len(lateral):
        lines = positions[:, lateral[:, 1]] - positions[:, lateral[:, 0]]
        across = np.where(np.isnan(lines), 0.0, lines).sum(axis=1)
        norm = np.hypot(across[:, 0], across[:, 1])
        good = norm > 1e-6
        cos = np.where(good, across[:, 0] / np.maximum(norm, 1e-6), 1.0)
        sin = np.where(good, across[:, 1] / np.maximum(norm, 1e-6), 0.0)
        frames[:, 0, 0], frames[:, 1, 0] = cos, sin
        frames[:, 0, 1], frames[:, 1, 1] = -sin, cos
    return frames, origins


def has_heading(positions: Floats, lateral: Ints) -> bool:
    """Whether the line from left to right is never upright in poses (T, M, 3) of a person.

    That of somebody who rolls, or does a cartwheel, is: its horizontal part leaps.
    """
    if not len(lateral):
        return True
    lines = positions[:, lateral[:, 1]] - positions[:, lateral[:, 0]]
    across = np.where(np.isnan(lines), 0.0, lines).sum(axis=1)
    level = np.hypot(across[:, 0], across[:, 1]) >= _LEVEL * np.linalg.norm(across, axis=1)
    return bool(level.mean() >= 1 - _TILTED)


def body_frames(positions: Floats, variances: Floats) -> tuple[Floats, Floats]:
    """Return the frames (T, 3, 3) and origins (T, 1, 3), m, in which poses differ least.

    Each pose is turned and moved as a rigid body onto the mean of all, as the procrustes analysis
    does (Gower 1975); ``variances`` (T, M), m2, are those of its markers along each axis.
    """
    absent: Flags = np.asarray(np.isnan(positions).any(axis=2))
    weights = np.where(absent, 0.0, 1 / np.maximum(variances, _SUREST))
    poses = np.where(absent[:, :, None], 0.0, positions)
    centres = _mean(poses, weights, 1)
    frames = np.tile(np.eye(3), (len(poses), 1, 1))
    mean = poses[weights.sum(axis=1).argmax()]
    for _ in range(2):
        middles = _mean(np.broadcast_to(mean, poses.shape), weights, 1)
        products = np.swapaxes(weights[:, :, None] * (poses - centres), 1, 2) @ (mean - middles)
        frames = np.swapaxes(nearest_rotation(products), 1, 2)
        mean = _mean((poses - centres) @ frames + middles, weights, 0)[0]
    middles = _mean(np.broadcast_to(mean, poses.shape), weights, 1)
    return frames, centres - middles @ np.swapaxes(frames, 1, 2)


def _mean(points: Floats, weights: Floats, axis: int) -> Floats:
    """Weighted mean of points (T, M, 3) along an axis, which stays; 0 where nothing has weight."""
    total = np.maximum(weights.sum(axis=axis, keepdims=True), 1e-12)
    return np.asarray(
        (weights[:, :, None] * points).sum(axis=axis, keepdims=True) / total[..., None]
    )


class MotionPrior(NamedTuple):
    """How a person moves: P = B B' + free variance about the mean pose; N = 3 M."""

    mean: F1  # (N,) m; NaN = never seen
    basis: F2  # (N, R) B: in which directions poses vary, times the standard deviation, m


def motion_of(positions: Floats, variances: Floats) -> MotionPrior:
    """Find the motion in poses (T, M, 3), m, with variances (T, M): the excess over the noise."""
    y = positions.reshape(len(positions), -1)
    absent = np.isnan(y)
    present = ~absent[:, ::3]
    white = np.where(absent, 0.0, y)
    with np.errstate(invalid="ignore"):  # of what was never seen
        mean = white.sum(axis=0) / (~absent).sum(axis=0)
        noise = np.where(present, variances, 0.0).sum(axis=0) / present.sum(axis=0)
    noise = np.repeat(np.fmax(np.sqrt(noise), _LEAST), 3)
    # P: directions in which the whitened poses vary by more than noise does.
    white -= mean
    white /= noise
    white[absent] = 0.0
    squares, directions = np.linalg.eigh(white.T @ white)
    excess = squares / len(y) - _EXCESS
    used = excess > 0
    basis = noise[:, None] * (directions[:, used] * np.sqrt(excess[used]))
    return MotionPrior(mean, np.ascontiguousarray(basis))


def estimated(
    motion: MotionPrior, positions: Floats, variances: Floats, most: float = math.inf
) -> Floats:
    """Return the estimates mu + P (P + V)^-1 (y - mu) of poses y.

    Parameters
    ----------
    positions : (T, M, 3) local poses, m; NaN = absent, and stays so. variances : (T, M) V, m2.
    most : standard deviations of a measurement, in space, by which a marker moves at most.
    """
    out, r = np.empty(positions.shape), motion.basis.shape[1]
    poses, noise = np.ascontiguousarray(positions), np.ascontiguousarray(variances)
    estimate_poses.raw(motion, poses, noise, most, out, PriorWork(np.empty((r, r)), np.empty(r)))
    return out


class PriorWork(NamedTuple):
    """Scratch for one pose."""

    inner: F2  # (R, R) I + B' D^-1 B, below the diagonal; then its Cholesky factor
    along: F1  # (R,) B' D^-1 (y - mu); then s


@kernel
def _weigh(motion: MotionPrior, pose: Floats, variances: Floats, work: PriorWork) -> None:
    """Write I + B' D^-1 B and B' D^-1 (y - mu) of a pose (M, 3)."""
    inner, along = work.inner, work.along
    inner[:] = 0.0
    along[:] = 0.0
    for k in range(len(along)):
        inner[k, k] = 1.0
    for i in range(len(motion.mean)):
        off = pose[i // 3, i % 3] - motion.mean[i]
        if math.isnan(motion.mean[i]):
            continue
        spread = _FREE**2 + (_ABSENT if math.isnan(off) else variances[i // 3])
        off = 0.0 if math.isnan(off) else off
        for k in range(len(along)):
            weighted = motion.basis[i, k] / spread
            along[k] += weighted * off
            for j in range(k + 1):
                inner[k, j] += weighted * motion.basis[i, j]


@kernel
def _solve_in_place(a: Floats, b: Floats) -> None:
    """Solve A x = b by Cholesky's factor of A (R, R), below its diagonal; ``b`` becomes x."""
    n = len(b)
    for k in range(n):
        for j in range(k + 1):
            total = a[k, j]
            for i in range(j):
                total -= a[k, i] * a[j, i]
            a[k, j] = math.sqrt(total) if j == k else total / a[j, j]
    for k in range(n):
        for i in range(k):
            b[k] -= a[k, i] * b[i]
        b[k] /= a[k, k]
    for k in range(n - 1, -1, -1):
        for i in range(k + 1, n):
            b[k] -= a[i, k] * b[i]
        b[k] /= a[k, k]


@entry
def estimate_poses(
    motion: MotionPrior, positions: F3, variances: F2, most: float, out: F3, work: PriorWork
) -> None:
    """Write what :func:`estimated` returns.

    With D = V + free variance and Woodbury's identity, B B' (B B' + D)^-1 (y - mu) = B s, where
    (I + B' D^-1 B) s = B' D^-1 (y - mu).
    """
    for t in range(len(positions)):
        _weigh(motion, positions[t], variances[t], work)
        _solve_in_place(work.inner, work.along)
        for m in range(positions.shape[1]):
            square = 0.0
            for c in range(3):
                off = positions[t, m, c] - motion.mean[3 * m + c]
                along = 0.0
                for k in range(len(work.along)):
                    along += motion.basis[3 * m + c, k] * work.along[k]
                free = _FREE**2 * (off - along) / (_FREE**2 + variances[t, m])
                step = along + free - off
                out[t, m, c] = 0.0 if math.isnan(motion.mean[3 * m + c]) else step
                square += step * step
            largest = most * math.sqrt(3.0 * variances[t, m])
            scale = largest / math.sqrt(square) if square > largest * largest else 1.0
            for c in range(3):
                out[t, m, c] = positions[t, m, c] + scale * out[t, m, c]
