"""Cameras whose axes are left-handed: one of them has the wrong sign.

Such a camera shows everybody as in a mirror. Left and right are where the detector says, and noses,
toes, elbows and knees are where they are; yet facing, left and up of a person then form a
left-handed system. A detector that exchanges left and right of people who turn their backs is
another matter: those who face it are right. So a camera's axes are left-handed if nearly all
people contradict their labels, those who face the camera, too; or if their mirror images, and not
they, are where the other cameras see people.

The poses that the log gives tell which axis it is: the one whose sign makes the cameras see people
at the same places. If they do so as it is, the detector exchanges names, and nothing is wrong with
the axes. Without poses, people stand upright before the camera: y of an optical frame points down
and z ahead (REP 103), or z up and x ahead.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import combinations, product
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from hiros_mcap.body.forward_cues import CUES, FacingMarkers
from hiros_mcap.body.rotations import Rigid, to_matrix
from hiros_mcap.body.segments import unit
from hiros_mcap.body.units import AXES
from hiros_mcap.calibrate.camera_views import Seen
from hiros_mcap.rays.common_instants import mean_known
from hiros_mcap.rays.keypoints import TRIANGULATED
from hiros_mcap.skeletons import Flags, Floats, SkeletonModel, Stamps

_SIGNS = np.array([1.0, -1.0, 1.0, 1.0])  # of :data:`CUES`: elbows point backwards
_WEIGHTS, _LENGTHS_M = np.array([2.0, 1.7, 1.7, 3.0]), np.array([0.05, 0.05, 0.05, 0.06])
"""Of the cues, and at which length they count about fully. A Kinect's labels agree with all of them
in 94, 92, 84 and 100 % of the views in which they are right."""
_CLEAR = 1.0  # least sum of the cues; below it nothing points anywhere
_REVERSED = 0.75
"""Share of the views that contradict their labels: 80 % and more with left-handed axes, up to 20 %
with healthy ones, of nine recordings of Kinects and eleven simulated ones."""
_MOSTLY = 0.5
"""The same of a camera, where all cameras together have more."""
_TOWARDS = 0.5
"""Cosine between a person's facing and the way to the camera, from which on they face it."""
_FEWEST, _FACING = 20, 0.05
"""Views that decide, and the share of them in which people face the camera."""
_FIT_M, _BETTER = 0.3, 0.5
"""People are at the same place up to here, and if they are nearer by this factor than before."""
_AT_ONCE_NS, _MOST = 50_000_000, 300
"""Times that are one, and people of a camera who are compared."""


class _Views(NamedTuple):
    """What the P people of a camera show."""

    contradict: Flags  # (P,) whether the labels contradict the cues, of those who show both
    facing: Flags  # (P,) whether these people face the camera
    up: Floats  # (3,) sum of unit vectors along the trunks, in the camera's axes
    middle: Floats  # (3,) sum of the bodies' middles, in the camera's axes, m

    @property
    def reversed_share(self) -> float:
        """Share of the views that contradict their labels."""
        return float(self.contradict.mean()) if len(self.contradict) else 0.0


class WrongAxes(NamedTuple):
    """Which cameras are left-handed."""

    axes: dict[str, str]  # camera -> axis with the wrong sign
    sure: bool
    """False if some cameras contradict the others, and no poses tell more: then the detector may
    as well exchange the names of left and right."""


def left_handed(
    seen: Mapping[str, Seen], poses: Mapping[str, Rigid], model: SkeletonModel
) -> WrongAxes:
    """Return which axis of which cameras has the wrong sign.

    Parameters
    ----------
    seen : people by camera, in the camera's own axes.
    poses : of the cameras whose poses are known, in one frame.
    """
    markers = FacingMarkers.of(model)
    if not (len(markers.lateral) and len(markers.vectors)):
        return WrongAxes({}, True)
    views = {
        name: _measured(np.asarray(some.positions, np.float64), markers)
        for name, some in seen.items()
        if name != TRIANGULATED and len(some.positions)
    }
    every = np.concatenate([np.zeros(0, np.bool_), *(view.contradict for view in views.values())])
    limit = _MOSTLY if len(every) and every.mean() > _REVERSED else _REVERSED
    suspects = [name for name, view in views.items() if view.reversed_share > limit]
    contradict = np.concatenate([np.zeros(0, np.bool_), *(views[n].contradict for n in suspects)])
    facing = np.concatenate([np.zeros(0, np.bool_), *(views[n].facing for n in suspects)])
    if len(contradict) < _FEWEST:
        return WrongAxes({}, True)
    axis, cameras = _fitting_axis(seen, poses, suspects)
    asked = contradict[facing]
    are_facing = len(asked) > _FACING * len(contradict) and asked.mean() > _REVERSED
    if axis == "none" or not (axis or are_facing):
        return WrongAxes({}, True)
    axes = {name: axis or _usual_axis(views[name]) for name in cameras}
    return WrongAxes(axes, bool(axis) or len(cameras) == len(views))


def _measured(positions: Floats, markers: FacingMarkers) -> _Views:
    """Compare the labels of people (P, M, 3) with what points forwards, whatever the labels are."""
    left, right = positions[:, markers.lateral[:, 0]], positions[:, markers.lateral[:, 1]]
    across = np.nansum(left - right, axis=1)
    ups = np.nan_to_num(unit(_trunks(positions, markers)))
    cues = np.zeros((len(positions), len(CUES), 3))
    for cue, first, last, joint in markers.vectors.tolist():
        vector = positions[:, last] - positions[:, first]
        if joint >= 0:  # how far the joint is off the line
            to_joint = positions[:, joint] - positions[:, first]
            share = _dot(to_joint, vector) / np.maximum(_dot(vector, vector), 1e-6)
            vector = to_joint - share[:, None] * vector
        cues[:, cue] += np.nan_to_num(_SIGNS[cue] * vector)
    cues -= _dot(cues, ups[:, None])[..., None] * ups[:, None]
    lengths = np.linalg.norm(cues, axis=2)
    forwards = (cues * (_WEIGHTS / np.hypot(lengths, _LENGTHS_M))[..., None]).sum(axis=1)
    labelled = np.cross(across, ups)
    clear = (np.linalg.norm(forwards, axis=1) > _CLEAR) & (np.linalg.norm(labelled, axis=1) > 0.0)
    middles = _middles(positions[clear])
    facing = _dot(unit(forwards[clear]), unit(-middles)) > _TOWARDS
    contradict = _dot(labelled, forwards)[clear] < 0.0
    return _Views(contradict, facing, ups[clear].sum(axis=0), middles.sum(axis=0))


def _trunks(positions: Floats, markers: FacingMarkers) -> Floats:
    """(P, 3) the way of the trunk, upwards; 0 where it is not seen."""
    trunks = np.zeros((len(positions), 3))
    for hip, shoulder in markers.trunk.tolist():
        trunks += np.nan_to_num(positions[:, shoulder] - positions[:, hip])
    for first, second, top in markers.upper.tolist():
        lacks = ~trunks.any(axis=1)
        middle = (positions[lacks, first] + positions[lacks, second]) / 2.0
        trunks[lacks] = np.nan_to_num(positions[lacks, top] - middle)
    return trunks


def _fitting_axis(
    seen: Mapping[str, Seen], poses: Mapping[str, Rigid], suspects: Sequence[str]
) -> tuple[str, list[str]]:
    """Return the axis whose sign makes cameras see people at one place, and of which cameras.

    These are the suspects, or all. "none" if people are at one place already; "" if nothing tells,
    as of one camera.
    """
    groups = [[*suspects], sorted(poses.keys() & seen.keys())]
    distances = {("none", 0): _apart(seen, poses, suspects, [], np.ones(3))}
    for (k, axis), (g, group) in product(enumerate(AXES), enumerate(groups)):
        signs = np.where(np.arange(3) == k, -1.0, 1.0)
        distances[axis, g] = _apart(seen, poses, suspects, group, signs)
    axis, g = min(distances, key=lambda key: distances[key])
    others = min(distance for (name, _), distance in distances.items() if name != axis)
    if not distances[axis, g] < min(_FIT_M, _BETTER * others):
        return "", groups[0]
    return axis, groups[g]


def _apart(
    seen: Mapping[str, Seen], poses: Mapping[str, Rigid], suspects: Sequence[str],
    negated: Sequence[str], signs: Floats,
) -> float:  # fmt: skip
    """Median distance, m, from a person in a camera to the nearest one of another; inf if unknown.

    One of both is a suspect. The coordinates of ``negated`` are multiplied by ``signs`` (3,).
    """
    placed = {}
    for name in poses.keys() & seen.keys():
        middles = _middles(seen[name].positions) * (signs if name in negated else 1.0)
        turn, place = to_matrix(poses[name].xyzw), poses[name].translation
        times = np.repeat(seen[name].stamps, seen[name].counts)
        placed[name] = times, middles @ turn.T + place
    distances = [
        _nearest(*placed[one], *placed[other])
        for one, other in combinations(sorted(placed), 2)
        if one in suspects or other in suspects
    ]
    every = np.concatenate([np.zeros(0), *distances])
    return float(np.median(every)) if len(every) >= _FEWEST else np.inf


def _nearest(times: Stamps, places: Floats, other_times: Stamps, others: Floats) -> Floats:
    """Distances to the nearest of other people (Q, 3) at the same time."""
    some = slice(None, None, 1 + len(times) // _MOST)
    apart = np.linalg.norm(places[some, None] - others, axis=2)
    apart[np.abs(times[some, None] - other_times) > _AT_ONCE_NS] = np.inf
    nearest = np.nan_to_num(apart, nan=np.inf).min(axis=1, initial=np.inf)
    return np.asarray(nearest[np.isfinite(nearest)])


def _usual_axis(view: _Views) -> str:
    """Return the axis that is not as cameras have it, if people stand upright before it."""
    upright = int(np.abs(view.up).argmax())
    if upright == 1:  # an optical frame: x right, y down, z ahead
        return "y" if view.up[1] > 0 else "z" if view.middle[2] < 0 else "x"
    if upright == 2:  # a body frame: x ahead, y left, z up
        return "z" if view.up[2] < 0 else "x" if view.middle[0] < 0 else "y"
    return "x"


def _middles(positions: npt.NDArray[Any]) -> Floats:
    """(P, 3) means of the joints (P, M, 3) that are there; NaN where there is none."""
    return mean_known(positions.swapaxes(1, 2))


def _dot(a: Floats, b: Floats) -> Floats:
    return np.asarray((a * b).sum(axis=-1))
