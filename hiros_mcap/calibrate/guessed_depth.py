"""Cameras whose 3D skeletons have a depth that the detector guesses, from one image.

Two cameras that see the same joints disagree along the ray of the first, along that of the second,
and across both. Errors along a camera's ray have a variance a, those across it a variance b. With
the cosine c between the rays, the three variances of the disagreement are

    v1 = a1 + c^2 a2 + (1 - c^2) b2,    v2 = a2 + c^2 a1 + (1 - c^2) b1,    v3 = b1 + b2

so that the excess a - b of the first camera is (v1 - v3 - c^2 (v2 - v3)) / (1 - c^4). With the
poses and clocks that explain the people best, its root is at most 34 mm, and 1.03 times the root of
v3, on nine recordings of depth cameras and 90 simulated ones. MediaPipe's world landmarks have 73
to 221 mm, and 1.5 to 5.5 times.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations
from typing import NamedTuple

import numpy as np

from hiros_mcap.calibrate.camera_views import CameraView
from hiros_mcap.calibrate.given_poses import PosedViews
from hiros_mcap.calibrate.refinement import FROM_GIVEN, refine_together
from hiros_mcap.calibrate.sampling import Rig, group, instants_of, placed, sample
from hiros_mcap.skeletons import Floats, Ints

INSTANTS = 60
GATE_M = 0.6
"""Mean distance within which people are the same: guessed depths put them far apart."""
LEAST_PEOPLE = 5
"""People at instants whom two cameras have in common, to compare them."""
PARALLEL = 0.9
"""Cosine between rays above which two cameras tell no depth."""
LEAST_M = 0.06
"""Depth errors beyond those across the ray. Smaller ones do no harm."""
LEAST_RATIO = 1.25
"""Of the depth errors to the disagreement across both rays."""
_NORMAL = 0.455  # median of the square of a normal variable with variance 1


class DepthErrors(NamedTuple):
    """Errors of a camera's joints beside the other cameras'."""

    along: float  # standard deviation along the ray beyond that across it, m; NaN = not known
    across: float  # standard deviation of the disagreement across the rays, m

    @property
    def is_guess(self) -> bool:
        """Whether the depth tells nothing that rays would not tell."""
        return self.along > max(LEAST_M, LEAST_RATIO * self.across)


def guessing_cameras(posed: PosedViews, mirror: Ints) -> dict[str, DepthErrors]:
    """Return the cameras whose depth is guessed: none, or at least two, whose rays make people.

    ``mirror`` : (M,) slot of each joint's counterpart.
    """
    if len(posed.views) < 2:  # RGB cameras alone are one view
        return {}
    own = [k for k, camera in enumerate(posed.cameras) if camera.movable]
    views, given = [posed.views[k] for k in own], Rig.of([posed.cameras[k].pose for k in own])
    if not any(error.is_guess for error in depth_errors(views, given, mirror)):
        return {}
    # Wrong poses and clocks also make people disagree, but better ones are found for these.
    refined = refine_together(views, given, mirror, FROM_GIVEN)
    known = [*zip(views, depth_errors(views, refined.rig, mirror), strict=True)]
    guessing = [view for view, error in known if error.is_guess]
    if len(guessing) < 2:
        return {}
    # A camera with the joints of most others, which guess, has their detector.
    alike = [joints_of(view) for view in guessing if 2 * len(guessing) > len(views)]
    return {view.name: error for view, error in known if error.is_guess or joints_of(view) in alike}


def joints_of(view: CameraView) -> frozenset[int]:
    """Return the joints that a camera ever shows."""
    shown = [track.weights.any(axis=0) for track in view.tracks]
    return frozenset(np.flatnonzero(np.any(shown, axis=0)).tolist() if shown else ())


def depth_errors(views: Sequence[CameraView], rig: Rig, mirror: Ints) -> list[DepthErrors]:
    """Return by how much the joints of C cameras err along their rays."""
    samples = sample(views, instants_of(views, INSTANTS, rig), rig)
    places = placed(samples, rig)
    groups = group(samples, places, mirror, GATE_M)
    places[samples.lines.weights <= 0.0] = np.nan
    swapped = np.flatnonzero(groups.mirrored)
    if len(swapped):
        places[swapped] = places[swapped][:, mirror]
    n = len(views)
    excess, across = np.full((n, n), np.nan), np.full((n, n), np.nan)
    for pair in combinations(range(n), 2):
        one, two = (np.flatnonzero(samples.cameras == c) for c in pair)
        common, i, j = np.intersect1d(groups.people[one], groups.people[two], return_indices=True)
        if len(common) >= LEAST_PEOPLE:
            c, d = pair
            excess[c, d], excess[d, c], across[c, d] = _compared(
                places[one[i]], places[two[j]], rig.shifts[list(pair)]
            )
            across[d, c] = across[c, d]
    known = [~np.isnan(row) for row in across]
    return [
        DepthErrors(
            float(np.sqrt(max(np.median(excess[c, pairs]), 0.0))) if pairs.any() else np.nan,
            float(np.sqrt(np.median(across[c, pairs]))) if pairs.any() else np.nan,
        )
        for c, pairs in enumerate(known)
    ]


def _compared(first: Floats, second: Floats, centres: Floats) -> tuple[float, float, float]:
    """Return the excess of two cameras, and the variance across both rays, m2; NaN if unknown.

    Parameters
    ----------
    first, second : (K, M, 3) the same joints as the cameras see them, m. centres : (2, 3) m.
    """
    there = np.isfinite(first[..., 0] + second[..., 0])
    apart, middle = (first - second)[there], (first + second)[there] / 2.0
    rays = [middle - centre for centre in centres]
    one, two = (ray / np.linalg.norm(ray, axis=1, keepdims=True) for ray in rays)
    cosine2 = float(np.median(np.sum(one * two, axis=1) ** 2)) if there.any() else 1.0
    if not cosine2 < PARALLEL**2:
        return np.nan, np.nan, np.nan
    normal = np.cross(one, two)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    v1, v2, v3 = (
        float(np.median(np.sum(way * apart, axis=1) ** 2)) / _NORMAL for way in (one, two, normal)
    )
    share = 1.0 - cosine2**2
    return (v1 - v3 - cosine2 * (v2 - v3)) / share, (v2 - v3 - cosine2 * (v1 - v3)) / share, v3
