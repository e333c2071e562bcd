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

from collections import deque

import numpy as np

from hiros_mcap.body.rotations import nearest_rotation
from hiros_mcap.skeletons import Flags, Floats, Ints

FEWEST = 30  # poses that a prior needs
_AT_ONCE = 256  # poses that are estimated together: a matrix each
_EXCESS = 1.5  # eigenvalue, in units of the noise, that noise alone may have
_PIECE = 3.0  # s
_SHOWN = 0.4  # share of its variance that a Gauss-Markov offset of 1.7 s shows within such a piece
_LEAST = 1e-9  # m; noise of a marker that does not move at all
_RATE = 15.0  # Hz; a prior of the poses before needs no more poses
_FIRST, _RENEWED = 2.0, 0.5  # s of a person before the first such prior, and between two
_LARGEST_STEP = 0.5  # by it, in standard deviations: a new motion is believed
_POSES = 900  # of a minute
_LEFT = 1.0  # s unseen after which it is learned anew
_LEVEL = 0.2  # least horizontal share of the line from left to right that tells a heading
_TILTED = 0.02  # share of poses that may lack one: a pose of a detector may be wrong
_SUREST = 0.01**2  # m2; the least variance that counts, so that no marker alone turns a pose
_ABSENT = 1.0  # m2; variance of a marker that is missing
_FREE = 0.003  # m; what each marker may do by itself
_TURNS = 2  # times that poses are turned onto their mean


def shrink_noise(
    positions: Floats, variances: Floats, minute: tuple[Floats, Floats], rate: float
) -> Floats:
    """Return local poses (T, M, 3), m, moved towards what the person does in the ``minute``.

    Parameters
    ----------
    variances : (T, M) m2 along each axis.
    minute : local poses (S, M, 3) and variances (S, M), which lie about the others.
    rate : poses per second, Hz.
    """
    known, noises = minute
    some = ~np.isnan(known[:, :, 0]).any(axis=0)
    if len(known) < FEWEST or not some.any():
        return positions
    size = max(round(_PIECE * rate), 2)
    known, noises = known[:, some], at_most_shown(known[:, some], noises[:, some], size)
    noise = at_most_shown(positions[:, some], variances[:, some], size)
    motion, out = motion_of(known, noises), positions.copy()
    for start in range(0, len(positions), _AT_ONCE):
        part = slice(start, start + _AT_ONCE)
        out[part, some] = estimated(*motion, out[part, some], noise[part])
    return out


class RecentMotion:
    """The last minute of a person, and the prior that it gives."""

    def __init__(self) -> None:
        self._poses = deque[Floats](maxlen=_POSES)
        self._variances = deque[Floats](maxlen=_POSES)
        self._next = self._pushed = self._seen = 0
        """When the prior is due, the last pose was kept, and the person was seen last, ns."""
        self._motion: tuple[Floats, Floats, Flags] | None = None
        """Of :func:`motion_of`, and the markers that any pose had."""

    def shrink(self, local: Floats, variances: Floats, stamp: int) -> Floats:
        """Return a local pose (M, 3), m, moved towards what the person has done; remember it.

        After a second unseen the motion is learned anew.
        """
        if stamp - self._seen > _LEFT * 1e9:
            self._poses.clear()
            self._variances.clear()
            self._motion = None
            self._next = self._pushed = 0
        self._seen = stamp
        estimate = self._estimate(local, variances)
        # Not the pose as measured: from what has less noise, a better prior is learned.
        self._remember(estimate, variances, stamp)
        return estimate

    def _estimate(self, local: Floats, variances: Floats) -> Floats:
        if self._motion is None:
            return local
        mean, basis, seen = self._motion
        estimate, some, noise = local.copy(), local[seen], variances[seen]
        steps = estimated(mean, basis, some[None], noise[None])[0] - some
        sizes, most = np.linalg.norm(steps, axis=1), _LARGEST_STEP * np.sqrt(3 * noise)
        scales = np.divide(most, sizes, out=np.ones_like(sizes), where=sizes > most)
        estimate[seen] = some + scales[:, None] * steps
        return estimate

    def _remember(self, local: Floats, variances: Floats, stamp: int) -> None:
        """Keep a pose; renew the prior if it is due."""
        if not self._poses:
            self._next = stamp + round(_FIRST * 1e9)
        elif stamp - self._pushed < 0.9e9 / _RATE:
            return
        self._pushed = stamp
        self._poses.append(local)
        self._variances.append(variances)
        if stamp >= self._next and len(self._poses) >= FEWEST:
            self._next = stamp + round(_RENEWED * 1e9)
            poses = np.stack(self._poses)
            present: Flags = np.asarray(~np.isnan(poses).any(axis=2).all(axis=0))
            some, noise = poses[:, present], np.stack(self._variances)[:, present]
            self._motion = (*motion_of(some, noise), present) if present.any() else None


def at_most_shown(positions: Floats, variances: Floats, size: int) -> Floats:
    """(T, M) Variances without what the poses (T, M, 3) contradict, m2: noise shows in them.

    Errors of detectors depend on the pose: those of a person who stands hardly change. A prior that
    expects noise there would take small movements for it. ``size`` poses each are 3 s.
    """
    out = variances.copy()
    for start in range(0, len(positions), size):
        part = slice(max(min(start, len(positions) - size), 0), start + size)
        seen: Flags = np.asarray(~np.isnan(positions[part]))
        n = np.maximum(seen[:, :, 0].sum(axis=0), 1)
        poses = np.where(seen, positions[part], 0.0)
        off = np.where(seen, poses - poses.sum(axis=0) / n[:, None], 0.0)
        shown = (off * off).sum(axis=(0, 2)) / (3 * n * _SHOWN)
        out[part] = variances[part] * np.minimum(shown / variances[part].mean(axis=0), 1.0)
    return out


def local_frames(positions: Floats, lateral: Ints) -> tuple[Floats, Floats]:
    """(T, 3, 3) and (T, 1, 3): yaw and centre of each pose; the world's where unknown."""
    frames = np.tile(np.eye(3), (len(positions), 1, 1))
    trunk = positions[:, lateral.ravel()] if len(lateral) else positions
    seen = ~np.isnan(trunk[:, :, :1])
    origins = np.where(seen, trunk, 0.0).sum(axis=1, keepdims=True)
    origins /= np.maximum(seen.sum(axis=1, keepdims=True), 1)
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
    for _ in range(_TURNS):
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


def motion_of(positions: Floats, variances: Floats) -> tuple[Floats, Floats]:
    """Find the motion in poses (T, M, 3), m, with variances (T, M): the excess over the noise.

    Returns the mean pose (N,), m, where N = 3 M, and in which directions poses vary by more than
    noise does: (N, R) times the standard deviation along each, m. P = B B' + free variance.
    """
    y = positions.reshape(len(positions), -1)
    absent = np.isnan(y)
    mean = np.nanmean(y, axis=0)
    off = np.where(absent, 0.0, y - mean)
    stated = np.where(absent, np.nan, np.repeat(variances, 3, axis=1))
    noise = np.maximum(np.sqrt(np.nanmean(stated, axis=0)), _LEAST)
    # P: directions in which the whitened poses vary by more than noise does.
    white = off / noise
    squares, directions = np.linalg.eigh(white.T @ white)
    excess = squares / len(y) - _EXCESS
    used = excess > 0
    return mean, noise[:, None] * (directions[:, used] * np.sqrt(excess[used]))


def estimated(mean: Floats, basis: Floats, positions: Floats, variances: Floats) -> Floats:
    """Return the estimates mu + P (P + V)^-1 (y - mu) of poses y.

    Parameters
    ----------
    mean, basis : (N,) and (N, R) of :func:`motion_of`.
    positions : (T, M, 3) local poses, m; NaN = absent, and stays so. variances : (T, M) V, m2.
    """
    off = positions.reshape(len(positions), -1) - mean
    absent = np.isnan(off)  # nothing is known there
    off = np.where(absent, 0.0, off)
    spread = _FREE**2 + np.where(absent, _ABSENT, np.repeat(variances, 3, axis=1))
    # (B B' + D)^-1 by Woodbury's identity; then B B' (B B' + D)^-1 (y - mu) = B s.
    weighted = basis.T / spread[:, None]
    inner = weighted @ basis + np.eye(basis.shape[1])
    along = (basis @ np.linalg.solve(inner, weighted @ off[:, :, None]))[:, :, 0]
    free = _FREE**2 * (off - along) / spread
    return np.asarray(positions + (along + free - off).reshape(positions.shape))
