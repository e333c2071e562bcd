"""Where the cameras stand, by a ball and a board that they see (Lee et al. 2022, 2.1).

Somebody carries a ball around. :func:`fit_sphere` finds its centre in each sensor's frames, and
:func:`common_frames` keeps the instants at which all sensors saw it. These corresponding points
give the transform from sensor to sensor (:func:`rigid_fit`). A board defines the axes of the fixed
frame (:func:`board_frame`). Nothing here reads images: the points of the ball and the centres of
the markers are the input.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from hiros_mcap.body.rotations import Rigid, from_matrix, nearest_rotation
from hiros_mcap.errors import RegistrationError
from hiros_mcap.skeletons import Flags, Floats, Stamps, nearest_stamps

_FLAT = 1e-9  # points lie on a line below this ratio of their second to their first singular value
_SAMPLE = 400  # points on which the candidates for a sphere are compared; the fit uses all points
_ROUNDS = 30  # rounds after which inliers may still change; few clouds need ten


class SphereFit(NamedTuple):
    """A sphere of known radius among points."""

    centre: Floats  # (3,) m
    inliers: Flags  # (N,) which points lie on it
    rms: float  # root mean square of the inliers' distances from the surface, m


def fit_sphere(
    points: Floats,
    radius: float,
    *,
    tolerance: float = 0.01,
    least_share: float = 0.5,
    trials: int = 1000,
    seed: int = 0,
) -> SphereFit:
    """Find the sphere of a known radius that most points lie on (Lee, 2.1.1).

    RANSAC (Fischler and Bolles 1981): three points and the radius leave two candidates. The best
    of all candidates has the least truncated squared distances (MSAC, Torr and Zisserman 2000).
    Gauss-Newton steps then minimise the squared distances of its inliers from the surface. The
    inliers are chosen anew after each step, until they stay. The side of the ball that faces the
    sensor is enough.

    Parameters
    ----------
    points : (N, 3) points of the ball and outliers, m; points with NaN are left out.
    radius : m; 0.24 in the paper.
    tolerance : m: inliers are at most this far from the surface; two to three times the noise.
    least_share : smallest share of inliers. A lost frame costs little; a wrong centre spoils the
        registration.
    trials : number of triples of points. If half of the points are outliers, one triple in eight
        has none.
    seed : of the random triples; the same seed gives the same result.

    Raises
    ------
    RegistrationError
        The shape is wrong, ``tolerance`` is not within 0 and ``radius``, fewer than four points
        are known, or fewer than ``least_share`` of them lie on a sphere.
    """
    from scipy.spatial.distance import cdist

    points = np.asarray(points, np.float64)
    if points.ndim != 2 or points.shape[1] != 3:
        raise RegistrationError(f"points of shape (N, 3) needed, got {points.shape}")
    if not 0.0 < tolerance < radius:
        raise RegistrationError(f"a tolerance of {tolerance} m is not within 0 and {radius} m")
    finite = np.isfinite(points).all(axis=1)
    if finite.sum() < 4:
        raise RegistrationError(f"at least 4 points of a sphere needed, got {finite.sum()}")
    middle = points[finite].mean(axis=0)  # far from the origin the squares would lose digits
    here = points[finite] - middle
    rng = np.random.default_rng(seed)
    centres = _spheres_through(here[rng.integers(0, len(here), (trials, 3))], radius)
    sample = here if len(here) <= _SAMPLE else rng.choice(here, _SAMPLE, replace=False)
    errors = np.abs(cdist(centres, sample) - radius)
    costs = np.sum(np.minimum(errors, tolerance) ** 2, axis=1)
    inliers = np.zeros(len(here), np.bool_)
    centre = np.full(3, np.nan)
    if len(costs):
        centre, inliers = _refine(here, centres[np.argmin(costs)], radius, tolerance)
    if inliers.sum() < max(4, least_share * len(here)):
        raise RegistrationError(
            f"no sphere of radius {radius:g} m: {inliers.mean():.0%} of {len(here)} points lie on "
            f"the best one, {least_share:.0%} needed"
        )
    residuals = np.linalg.norm(here[inliers] - centre, axis=1) - radius
    on_sphere = np.zeros(len(points), np.bool_)
    on_sphere[finite] = inliers
    return SphereFit(centre + middle, on_sphere, float(np.sqrt(np.mean(residuals**2))))


def _spheres_through(triples: Floats, radius: float) -> Floats:
    """(K, 3) centres of both spheres through each of (T, 3, 3) triples; K <= 2 T.

    They lie above and below the centre of the triple's circumcircle, where that is small enough.
    """
    a = triples[:, 0]
    b, c = triples[:, 1] - a, triples[:, 2] - a
    normal = np.cross(b, c)
    square = np.sum(normal**2, axis=1)
    wide = square > 0.0  # not a point twice, nor a line
    a, b, c, normal, square = a[wide], b[wide], c[wide], normal[wide], square[wide, None]
    b2, c2 = np.sum(b**2, axis=1, keepdims=True), np.sum(c**2, axis=1, keepdims=True)
    out = np.cross(b2 * c - c2 * b, normal) / (2.0 * square)
    height2 = radius**2 - np.sum(out**2, axis=1, keepdims=True)
    fits = height2[:, 0] >= 0.0
    up = np.sqrt(height2[fits] / square[fits]) * normal[fits]
    circle = (a + out)[fits]
    return np.concatenate([circle + up, circle - up])


def _refine(
    points: Floats, centre: Floats, radius: float, tolerance: float
) -> tuple[Floats, Flags]:
    """Fit the sphere to its inliers until they stay; return its centre (3,) and inliers (N,)."""
    before = np.zeros(len(points), np.bool_)
    for _ in range(_ROUNDS):
        rays = points - centre
        lengths = np.linalg.norm(rays, axis=1)
        inliers = np.abs(lengths - radius) <= tolerance
        directions = rays[inliers] / lengths[inliers, None]
        step = np.linalg.lstsq(directions, lengths[inliers] - radius, rcond=None)[0]
        if (inliers == before).all() and np.linalg.norm(step) < 1e-9 * radius:
            break
        centre, before = centre + step, inliers
    return centre, inliers


def common_frames(
    stamps: Sequence[Stamps], centres: Sequence[Floats], *, max_delta_time: float = 0.017
) -> tuple[Stamps, Floats]:
    """Keep the frames in which all sensors saw an object, as corresponding points (Lee, 2.1.1).

    Each frame of a sensor is paired with the nearest frame in time of the first sensor, if each is
    the other's nearest. The paper's sensors are synchronised by wire. Others see a moving ball at
    different places: hold the ball still, or choose a smaller ``max_delta_time``.

    Parameters
    ----------
    stamps : (N_s,) times, ns, of each sensor's frames, in any order.
    centres : (N_s, 3) where each sensor saw the object, m; NaN = it did not.
    max_delta_time : s between the oldest and the newest frame of an instant; half a period of a
        30 Hz camera.

    Returns
    -------
    (K,) mean time of the sensors' frames, ns, increasing, and (S, K, 3) where each sensor saw the
    object, m: column k of all sensors are corresponding points. :func:`rigid_fit` rejects K = 0.

    Raises
    ------
    RegistrationError
        There are fewer than two sensors, or stamps and centres do not fit each other.
    """
    if len(stamps) != len(centres) or len(stamps) < 2:
        raise RegistrationError(
            f"at least 2 sensors needed, got {len(stamps)} of stamps and {len(centres)} of centres"
        )
    sensors = [_seen(times, places) for times, places in zip(stamps, centres, strict=True)]
    first = sensors[0][0]
    if any(len(times) == 0 for times, _ in sensors):
        return np.zeros(0, np.int64), np.zeros((len(sensors), 0, 3))
    others = (nearest_stamps(times, first) for times, _ in sensors[1:])
    rows = np.stack([np.arange(len(first)), *others])
    paired = np.stack([times[row] for (times, _), row in zip(sensors, rows, strict=True)])
    mutual = np.all(nearest_stamps(first, paired) == rows[0], axis=0)
    kept = mutual & (np.ptp(paired, axis=0) <= max_delta_time * 1e9)
    late = (paired[:, kept] - first[kept]).mean(axis=0)
    places = [places[row[kept]] for (_, places), row in zip(sensors, rows, strict=True)]
    return first[kept] + np.rint(late).astype(np.int64), np.stack(places)


def _seen(stamps: Stamps, centres: Floats) -> tuple[Stamps, Floats]:
    """Return the frames of a sensor that saw the object, by time."""
    stamps, centres = np.asarray(stamps, np.int64), np.asarray(centres, np.float64)
    if stamps.ndim != 1 or centres.shape != (len(stamps), 3):
        raise RegistrationError(
            f"stamps (N,) and centres (N, 3) needed, got {stamps.shape} and {centres.shape}"
        )
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
