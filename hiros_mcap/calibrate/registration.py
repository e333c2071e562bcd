"""Where the cameras stand, by a ball and a board that they see (Lee et al. 2022, 2.1).

Somebody carries a ball around. :func:`fit_sphere` finds its centre in each sensor's frames, and
:func:`common_frames` keeps the instants at which two sensors saw it. These corresponding points
give the transform from sensor to sensor (:func:`rigid_fit`). A board defines the axes of the fixed
frame (:func:`board_frame`). Nothing here reads images: the points of the ball and the centres of
the markers are the input.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from hiros_mcap.body.rotations import Rigid, from_matrix, nearest_rotation
from hiros_mcap.errors import RegistrationError
from hiros_mcap.skeletons import Flags, Floats, Stamps, nearest_stamps

_FLAT = 1e-9  # points lie on a line below this ratio of their second to their first singular value
_LEAST_POINTS = 4
_LEAST_SHARE = 0.5  # of inliers: a lost frame costs little, a wrong centre spoils the registration
_ROUNDS, _NEARER = 60, 0.8
"""Steps to a sphere at most, and by which factor inliers come nearer with each."""


class SphereFit(NamedTuple):
    """A sphere of known radius among points."""

    centre: Floats  # (3,) m
    inliers: Flags  # (N,) which points lie on it
    rms: float  # root mean square of the inliers' distances from the surface, m


def fit_sphere(points: Floats, radius: float, *, tolerance: float = 0.01) -> SphereFit:
    """Find the sphere of a known radius that most points lie on (Lee, 2.1.1).

    The paper's RANSAC draws points at random. Here the start is known: the sensor, at the origin,
    sees the side of the ball that faces it. Gauss-Newton steps minimise the squared distances of
    inliers from the surface. These are within half of the radius first, and then nearer and nearer.

    Parameters
    ----------
    points : (N, 3) points of the ball and outliers, m; points with NaN are left out.
    radius : m; 0.24 in the paper.
    tolerance : m: inliers are at most this far from the surface; two to three times the noise.

    Raises RegistrationError if fewer than four points are known, or less than half of them lie on a
    sphere.
    """
    finite = np.isfinite(points).all(axis=1)
    if finite.sum() < _LEAST_POINTS:
        raise RegistrationError(f"at least 4 points of a sphere needed, got {finite.sum()}")
    here, reach = points[finite], radius / 2.0
    middle = np.median(here, axis=0)
    centre = middle * (1.0 + radius / np.linalg.norm(middle))
    inliers = np.zeros(len(here), np.bool_)
    for _ in range(_ROUNDS):
        rays = here - centre
        lengths = np.linalg.norm(rays, axis=1)
        before, inliers = inliers, np.abs(lengths - radius) <= reach
        directions = rays[inliers] / lengths[inliers, None]
        step = np.linalg.lstsq(directions, lengths[inliers] - radius, rcond=None)[0]
        length = float(np.linalg.norm(step))
        if reach <= tolerance and (inliers == before).all() and length < 1e-9 * radius:
            break
        centre = centre + step * min(1.0, radius / 2.0 / max(length, 1e-12))
        reach = max(tolerance, _NEARER * reach)
    if inliers.sum() < max(_LEAST_POINTS, _LEAST_SHARE * len(here)):
        raise RegistrationError(
            f"no sphere of radius {radius:g} m: {inliers.mean():.0%} of {len(here)} points lie on "
            f"the best one, {_LEAST_SHARE:.0%} needed"
        )
    residuals = np.linalg.norm(here[inliers] - centre, axis=1) - radius
    on_sphere = np.zeros(len(points), np.bool_)
    on_sphere[finite] = inliers
    return SphereFit(centre, on_sphere, float(np.sqrt(np.mean(residuals**2))))


def common_frames(
    stamps: tuple[Stamps, Stamps], centres: tuple[Floats, Floats], max_delta_time: float = 0.017
) -> tuple[Floats, Floats]:
    """Return where two sensors saw an object at the same times, as corresponding points (2.1.1).

    Frames are paired if each is the other's nearest in time. The paper's sensors are synchronised
    by wire. Others see a moving ball at different places: hold it still.

    Parameters
    ----------
    stamps : (N,) times of each sensor's frames, ns, in any order.
    centres : (N, 3) where it saw the object, m; NaN = it did not.
    max_delta_time : largest difference of two times, s; half a period of a 30 Hz camera.

    Returns (K, 3) each, in the order of time.
    """
    (first, here), (second, there) = map(_seen, stamps, centres)
    if not len(first) or not len(second):
        return np.zeros((0, 3)), np.zeros((0, 3))
    row = nearest_stamps(second, first)
    mutual = nearest_stamps(first, second[row]) == np.arange(len(first))
    kept = mutual & (np.abs(second[row] - first) <= max_delta_time * 1e9)
    return here[kept], there[row[kept]]


def _seen(stamps: Stamps, centres: Floats) -> tuple[Stamps, Floats]:
    """Return the frames of a sensor that saw the object, by time."""
    seen = np.flatnonzero(np.isfinite(centres).all(axis=1))
    order = seen[np.argsort(stamps[seen], kind="stable")]
    return stamps[order], centres[order]


def rigid_fit(source: Floats, target: Floats) -> Rigid:
    """Return the rigid transform that brings ``source`` nearest to ``target`` (Lee, 2.1.1).

    It minimises the sum of squared distances ``|target - (R source + T)|`` (Kabsch 1976). As
    printed, the paper's ``R = U V'`` is the inverse rotation, may be a reflection, and its T lacks
    R: here ``R = V diag(1, 1, det) U'`` and ``T = mean(target) - R mean(source)``.

    Parameters
    ----------
    source, target : (N, 3) corresponding points, m; pairs with NaN (a frame in which one sensor
        misses the object) are left out.

    Raises
    ------
    RegistrationError
        The shapes differ, fewer than three pairs are known, or all lie on a line.
    """
    source, target = np.asarray(source, np.float64), np.asarray(target, np.float64)
    if source.shape != target.shape or source.ndim != 2 or source.shape[1] != 3:
        raise RegistrationError(
            f"points of shape (N, 3) needed, got {source.shape} and {target.shape}"
        )
    finite = np.isfinite(source).all(axis=1) & np.isfinite(target).all(axis=1)
    if finite.sum() < 3:
        raise RegistrationError(f"at least 3 corresponding points needed, got {finite.sum()}")
    source, target = source[finite], target[finite]
    start, goal = source.mean(axis=0), target.mean(axis=0)
    for points in (source - start, target - goal):
        singular = np.linalg.svd(points, compute_uv=False)
        if singular[1] <= _FLAT * singular[0]:
            raise RegistrationError(
                "the points lie on a line: they do not determine the rotation about it"
            )
    matrix, shift = kabsch(source, target)
    return Rigid(from_matrix(matrix), shift)


def kabsch(
    source: Floats, target: Floats, weights: Floats | None = None, *, mirrors: bool = False
) -> tuple[Floats, Floats]:
    """Return the rotation (3, 3) and shift (3,) of :func:`rigid_fit`, of points that suffice.

    Parameters
    ----------
    source, target : (N, 3) corresponding points, m, none of them NaN.
    weights : (N,) not negative; None = all equal.
    mirrors : the best improper rotation, with determinant -1, instead.
    """
    if weights is None:
        weights = np.ones(len(source))
    share = weights / weights.sum()
    start, goal = share @ source, share @ target
    covariance = (source - start).T @ (share[:, None] * (target - goal))
    rotation = nearest_rotation(covariance, mirrors=mirrors)
    return rotation, goal - rotation @ start


def board_frame(centres: Floats) -> Rigid:
    """Return the pose of a board of four markers in the sensor's frame (Lee, 2.1.2).

    The origin is the centre of marker 1. x points from it to marker 2, y towards marker 0, and z is
    their cross product. Measured x and y are not quite orthogonal: x stays, y is corrected.

    Parameters
    ----------
    centres : (3 or more, 3) centres of markers 0, 1, 2, m.

    Raises
    ------
    RegistrationError
        A centre is missing, or the three lie on a line.
    """
    centres = np.asarray(centres, np.float64)
    if centres.ndim != 2 or centres.shape[0] < 3 or not np.isfinite(centres[:3]).all():
        raise RegistrationError("the centres of markers 0, 1 and 2 are needed")
    origin = centres[1]
    x, y = centres[2] - origin, centres[0] - origin
    z = np.cross(x, y)
    if np.linalg.norm(z) <= _FLAT * np.linalg.norm(x) * np.linalg.norm(y):
        raise RegistrationError("the markers lie on a line: they do not define a plane")
    axes = [x, np.cross(z, x), z]
    matrix = np.stack([axis / np.linalg.norm(axis) for axis in axes], axis=1)
    return Rigid(from_matrix(matrix), origin)


def cauchy(errors: Floats) -> Floats:
    """Return Cauchy weights of errors: 1 / (1 + (e / s)^2), s the median absolute error."""
    usual = float(np.median(np.abs(errors))) if errors.size else 0.0
    return np.asarray(1.0 / (1.0 + (errors / (usual + 1e-9)) ** 2))


def robust_kabsch(
    source: Floats, target: Floats, weights: Floats, rounds: int = 5
) -> tuple[Floats, Floats]:
    """Return the rotation (3, 3) and shift (3,) of :func:`kabsch` with Cauchy weights.

    Parameters
    ----------
    source, target : (N, 3) corresponding points, m. weights : (N,) besides those of the errors.
    """
    robust = weights
    for _ in range(rounds):
        rotation, shift = kabsch(source, target, robust)
        errors = np.linalg.norm(target - source @ rotation.T - shift, axis=1)
        robust = weights * cauchy(errors)
    return rotation, shift


def jackknife(deviations: Floats) -> Floats:
    """(F,) variances, from the deviations (N, F) of the estimates without each of N parts."""
    n = len(deviations)
    return np.asarray((n - 1) / n * np.sum(deviations**2, axis=0))
