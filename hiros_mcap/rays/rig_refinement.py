"""Poses and lags of RGB cameras, refined from the people whom they film before a run.

The given poses are about right. The people correct what they tell better
(:func:`hiros_mcap.rays.bundle.weighed`). The errors of a detector belong to a joint and last for
seconds.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from hiros_mcap.body.intrinsics import Intrinsics
from hiros_mcap.body.rotations import Rigid
from hiros_mcap.kernels.array_types import chosen
from hiros_mcap.kernels.ray_equations import LAG, UNKNOWNS, RayCameras, RayPoints
from hiros_mcap.rays.bundle import (
    RAYLEIGH,
    Bundle,
    adjust,
    cameras_at,
    placed,
    poses_of,
    standard_errors,
    weighed,
    with_common_velocities,
)
from hiros_mcap.rays.image_tracks import ImageView, instants_of, sample_images, views_of
from hiros_mcap.rays.keypoints import KeypointFrame
from hiros_mcap.rays.lags import APART_S, coarse_lags
from hiros_mcap.rays.matching import joints_of, match
from hiros_mcap.skeletons import SECOND, Flags, Floats, Stamps

GATES = (0.08, 0.05, 0.04)
"""Mean distance of rays, x / z, within which people are the same, round by round."""
ROUNDS, STILL_S = 8, 5e-4
"""Most rounds; one that changes the lags by less is the last."""
FIRST, AGAIN = 4, 2
"""How often the noise of keypoints is measured while poses are adjusted: first, and later."""
LEAST_SHARE = 0.15
"""Of the way to the right lag, a step goes at least so far."""
INSTANTS, JOINTS = 100, 4000
"""Instants that are looked at; more joints than these are thinned."""
LEAST_RAYS = 200
"""A camera with fewer rays of joints that others see is left as it is."""
SAME = 0.97
"""Share of the votes for a lag at which people would move as much alike at another one."""
REACH_S = 0.1
"""Lags that differ by less are within reach of the steps."""
ALIKE = 0.96
"""Fits with other lags that explain so large a share of the rays are as good as the best."""
NEAR_PX = 10.0
"""Distance at which a keypoint counts half in that."""
MOST_S, STRETCHES = 60.0, 4
"""Of a longer log, so many stretches are looked at, as long in all."""
BLOCKS, LONGEST_BLOCK_S = 10, 2.0
TIMED_S = 0.01
"""A lag with a larger standard error is not known: nobody moves enough."""


class RayRig(NamedTuple):
    """What a run should take for the poses and clocks of its RGB cameras."""

    poses: dict[str, Rigid]
    """Camera -> where it stands in the room."""
    lags: dict[str, float]
    """Camera -> s by which its stamps are late."""
    noise: dict[str, float]
    """Camera -> standard deviation of its keypoints along an axis, px; NaN if it sees nobody."""
    before: dict[str, float]
    """Camera -> median reprojection error with the given poses and the lags, px."""
    after: dict[str, float]
    """The same with the new poses."""
    reason: str
    """Why the given poses stay; "" if people tell better ones."""
    untimed: tuple[str, ...]
    """Cameras whose lag the people do not tell; their stamps stay as they are."""
    regular: bool
    """Whether people move so regularly that other lags would fit as well: a step later, say."""


class RigFit(NamedTuple):
    """Cameras that were fitted to people."""

    bundle: Bundle
    lags: Floats
    """(C,) s."""
    instants: Floats
    rows: Stamps
    """(P, 3) instant, person and joint of each point."""
    fitting: float
    """How many numbers per keypoint fit that the places of the joints did not need."""

    @property
    def blocks(self) -> Stamps:
        """(P,) number of the stretch of time of each point."""
        seconds = self.instants[self.rows[:, 0]]
        length = min(LONGEST_BLOCK_S, float(np.ptp(seconds)) / BLOCKS + 1e-3)
        return np.asarray(((seconds - seconds.min()) // length).astype(np.int64))


def refine_rig(
    frames: Mapping[str, Sequence[KeypointFrame]],
    lenses: Mapping[str, Intrinsics],
    poses: Mapping[str, Rigid],
    *,
    clocks: bool = True,
) -> RayRig:
    """Find out whether the people know better poses than the given ones, and how the clocks go.

    Parameters
    ----------
    frames : of all cameras, each by time. poses : where they stand in the room, about.
    clocks : whether lags are looked for.

    The rig as a whole stays where the given poses put it, and has their size.
    """
    views, names = views_of(_stretches(frames), lenses), list(frames)
    given, free = cameras_at([poses[name] for name in names]), free_unknowns(views, clocks)
    fit, regular = _best_fit(views, given, free)
    if fit is None:
        unknown, lags = dict.fromkeys(names, math.nan), dict.fromkeys(names, 0.0)
        reason = "no two cameras see the same person"
        return RayRig(dict(poses), lags, unknown, unknown, unknown, reason, (), False)
    errors = errors_of(fit)
    untimed = free[:, LAG] & ~(errors[:, LAG] < TIMED_S)
    if untimed.any():
        free[untimed, LAG] = False
        fit = fit_rig(views, given, np.where(untimed, 0.0, fit.lags), free) or fit
        errors = errors_of(fit)
    new = weighed(fit.bundle, given, errors)
    return _verdict(fit, new, names, poses, given, untimed)._replace(regular=regular)


def _best_fit(
    views: Sequence[ImageView], given: RayCameras, free: Flags
) -> tuple[RigFit | None, bool]:
    """Fit the rig from the likeliest lags; return the best one, and whether others are as good."""
    zero = np.zeros(len(views))
    likely, rivalry = coarse_lags(views, given) if free[:, LAG].any() else ([zero], 0.0)
    likely = [lags - lags[~free[:, LAG]][0] for lags in likely]
    starts = [lags for lags in likely if np.ptp(lags) > REACH_S]
    fits = [fit_rig(views, given, start, free) for start in (zero, *starts)]
    found = [fit for fit in fits if fit is not None]
    if not found:
        return None, False
    best = max(found, key=lambda fit: fit.fitting)
    # Lags at which people move alike, too, and which explain nearly as much.
    alike = found[len(starts) == len(likely) :]
    alike = [fit for fit in alike if fit.fitting > ALIKE * best.fitting]
    regular = rivalry > SAME or any(np.ptp(fit.lags - best.lags) > APART_S for fit in alike)
    if regular and alike:
        best = min(alike, key=lambda fit: float(np.ptp(fit.lags)))
    return best, regular


def _stretches(
    frames: Mapping[str, Sequence[KeypointFrame]],
) -> dict[str, Sequence[KeypointFrame]]:
    """Return all frames of a short log, and some stretches of a long one."""
    stamps = [f.stamp for every in frames.values() for f in (*every[:1], *every[-1:])]
    first, last = min(stamps, default=0), max(stamps, default=0)
    if last - first <= MOST_S * SECOND:
        return dict(frames)
    period, length = (last - first) / STRETCHES, MOST_S * SECOND / STRETCHES
    return {
        name: [frame for frame in every if (frame.stamp - first) % period < length]
        for name, every in frames.items()
    }


def free_unknowns(views: Sequence[ImageView], clocks: bool) -> Flags:
    """(C, 7) all poses; the lags of all cameras but the one that sees most, which has the time."""
    free = np.ones((len(views), UNKNOWNS), np.bool_)
    free[:, LAG] = clocks
    free[np.argmax([sum(len(t.seconds) for t in view.tracks) for view in views]), LAG] = False
    return free


def fit_rig(
    views: Sequence[ImageView], cameras: RayCameras, lags: Floats, free: Flags
) -> RigFit | None:
    """Join the people of all cameras, and fit poses and lags to them, in turns.

    Parameters
    ----------
    cameras : about right. lags : (C,) s, right to 0.15 s. free : (C, 7) what may change.

    Returns None if no two cameras see the same people.
    """
    n, given, fit, before = len(views), cameras, None, np.zeros((2, len(views)))
    focals = np.array([view.focal for view in views])
    for k in range(ROUNDS):
        instants = instants_of(views, INSTANTS, lags)
        samples = sample_images(views, instants, lags)
        people = match(samples, cameras, GATES[min(k, len(GATES) - 1)])
        points, rows = joints_of(samples, people, n)
        thinning = 1 + len(rows) // JOINTS
        some = rows.sum(axis=1) % thinning == 0
        points, rows = with_common_velocities(chosen(points, some), cameras), rows[some]
        movable = free & _seeing(points)[:, None]
        if np.count_nonzero(_seeing(points)) < 2:
            return fit
        start, rounds = cameras._replace(lags=np.zeros(n)), AGAIN if fit else FIRST
        bundle = adjust(points, start, focals, movable, rounds)
        bundle = placed(bundle, given, np.asarray(~movable[:, :LAG].any(axis=1)))
        cameras, step = bundle.cameras, bundle.cameras.lags
        # Velocities are noisy, so steps are too short: by a share that two steps tell (secant).
        moved = np.abs(before[1]) > STILL_S
        share = np.where(moved, (before[0] - step) / np.where(moved, before[1], 1.0), 1.0)
        change = step / np.clip(share, LEAST_SHARE, 1.0)
        lags, before = lags + change, np.stack([step, change])
        keypoints = int(np.count_nonzero(samples.lines.weights > 0.0))
        fitting = thinning * _spare_fit(bundle) / float(keypoints)
        fit = RigFit(bundle, lags, instants, rows, fitting)
        if k >= len(GATES) - 1 and np.abs(change).max() < STILL_S:
            break
    return fit


def _spare_fit(bundle: Bundle) -> float:
    """Return how many numbers of keypoints fit, about, beyond the three of each joint's place.

    Any two rays meet nearly: two cameras that were joined to wrong people still fit each other.
    """
    cameras = np.count_nonzero(np.isfinite(bundle.distances), axis=1)
    near = np.nansum(1.0 / (1.0 + (bundle.distances / NEAR_PX) ** 2), axis=1)
    return float((near * (2.0 - 3.0 / np.maximum(cameras, 1))).sum())


def _seeing(points: RayPoints) -> Flags:
    """(C,) which cameras see enough joints that others see, too."""
    return np.asarray(np.count_nonzero(points.weights > 0.0, axis=0) >= LEAST_RAYS)


def errors_of(fit: RigFit) -> Floats:
    """(C, 7) standard errors; those of cameras that see too little are infinite."""
    errors = standard_errors(fit.bundle, fit.blocks, fit.rows[:, 2])
    errors[~_seeing(fit.bundle.points)] = np.inf
    return errors


def _verdict(
    fit: RigFit, new: RayCameras, names: list[str], poses: Mapping[str, Rigid],
    given: RayCameras, untimed: Flags,
) -> RayRig:  # fmt: skip
    """Say how well the given and the ``new`` poses fit, and which lags to use."""
    bundle, still = fit.bundle, np.zeros_like(fit.bundle.free)
    given = given._replace(lags=bundle.cameras.lags)
    before, after = (
        medians(adjust(bundle.points, each, bundle.focals, still, AGAIN).distances)
        for each in (given, new)
    )

    def table(values: Iterable[Any]) -> dict[str, Any]:
        return dict(zip(names, values, strict=True))

    free = np.asarray(bundle.free[:, :LAG].any(axis=1))
    lags = np.where(untimed, 0.0, fit.lags)
    lags -= np.sort(lags)[(len(lags) - 1) // 2]
    return RayRig(
        table(
            found if is_free else poses[name]
            for name, found, is_free in zip(names, poses_of(new), free, strict=True)
        ),
        table(lags.tolist()),
        table((after / RAYLEIGH).tolist()),
        table(before.tolist()),
        table(after.tolist()),
        "",
        tuple(name for name, out in table(untimed).items() if out),
        regular=False,
    )


def medians(distances: Floats) -> Floats:
    """(C,) median distance of each camera's rays, px; NaN where it sees nothing."""
    columns = (column[np.isfinite(column)] for column in distances.T)
    return np.array([np.median(column) if len(column) else np.nan for column in columns])
