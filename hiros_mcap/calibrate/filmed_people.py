"""Poses and clocks of RGB cameras from the keypoints of people, starting from nothing.

The people tell everything but the size and the place of the rig (:mod:`hiros_mcap.rays`). The size
is from poses that the log has, from how tall the people are, or from the limbs of adults.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np

from hiros_mcap.body.rotations import Rigid
from hiros_mcap.body.symmetry import split_side
from hiros_mcap.calibrate.gauge import WORLD, find_floor, on_floor
from hiros_mcap.calibrate.people import PeopleCalibration
from hiros_mcap.calibrate.sampling import Rig
from hiros_mcap.calibrate.verdict import (
    GOOD,
    GRADES,
    NO_VIEW,
    UNLINKED,
    USABLE,
    CalibratedCamera,
    Limits,
    Verdict,
)
from hiros_mcap.errors import LogError
from hiros_mcap.io.channels import OUTPUT_PREFIX, is_selected
from hiros_mcap.io.container import McapReader
from hiros_mcap.io.detectors.conversion import of_people
from hiros_mcap.io.detectors.keypoint_messages import is_keypoints
from hiros_mcap.io.rgb_cameras import RgbCamera, placed_cameras, sampled_cameras, too_few
from hiros_mcap.kernels.ray_equations import LAG
from hiros_mcap.rays.bundle import (
    Bundle,
    cameras_at,
    centres_of,
    placed,
    poses_of,
)
from hiros_mcap.rays.image_tracks import views_of
from hiros_mcap.rays.relative_pose import FoundRig, rig_from_people
from hiros_mcap.rays.rig_refinement import errors_of, medians
from hiros_mcap.skeletons import Floats, SkeletonModel

LIMBS = {
    "hip": ("knee", 0.245),
    "knee": ("ankle", 0.246),
    "shoulder": ("elbow", 0.186),
    "elbow": ("wrist", 0.146),
}
"""Limb -> its other end, and its length as a share of the stature (Winter 2009, figure 4.1)."""
ADULT_M, ADULT_ERROR = 1.70, 0.055
"""Mean stature of adults, and its standard deviation among them as a share."""
LIMBS_ERROR = 0.025
"""Standard deviation, as a share, of a stature from limbs: bodies and detectors differ."""
FEWEST_LIMBS = 50
POOR_PX = 25.0
"""Median reprojection error beyond which a camera contradicts the others."""
REGULAR = 0.95
"""Share of a camera's rays from which on another lag is as likely as the one that was found."""


class _Size(NamedTuple):
    """How large the rig is, and who said so."""

    scale: float  # m per unit of the rig
    error: float  # its standard error as a share
    source: str


def calibrate_filmed(
    reader: McapReader, topics: Sequence[str] | None = None, height: float | None = None
) -> PeopleCalibration | None:
    """Find the poses and clocks of a log's RGB cameras from the keypoints of people.

    Returns None if the log has no keypoints, or other cameras beside them.

    Parameters
    ----------
    height : stature of the people, m, in the mean; None = not known.

    Raises LogError if fewer than two cameras have a lens, or no two see the same people.
    """
    selects = partial(is_selected, topics=topics or None, output_prefix=OUTPUT_PREFIX)
    infos = of_people(reader, selects)
    images = [info.topic for info in infos if is_keypoints(info)]
    if not images or len(images) < len(infos):
        return None
    cameras = sampled_cameras(reader, selects)
    if len(cameras) < 2:
        raise too_few(reader, images, [camera.topic for camera in cameras])
    frames = {camera.name: camera.frames for camera in cameras}
    views = views_of(frames, {camera.name: camera.lens for camera in cameras})
    rig = rig_from_people(views)
    if rig is None:
        raise LogError("no two RGB cameras see the same person; record people whom all cameras see")
    tree, channels = placed_cameras(reader, None, cameras)
    known = [channel.frames[0] for channel in channels if channel.frames[0] in tree.frames]
    root = tree.root(known[0]) if known else WORLD
    poses = {
        camera.name: pose
        for camera, channel in zip(cameras, channels, strict=True)
        if (pose := tree.at_rest(channel.frames[0], root)) is not None
    }
    return _calibration(rig, cameras, poses, root, height)


def _calibration(
    rig: FoundRig, cameras: Sequence[RgbCamera], given: Mapping[str, Rigid], root: str,
    height: float | None,
) -> PeopleCalibration:  # fmt: skip
    """Put a rig into its place, and say how good it is."""
    names = [cameras[c].name for c in rig.cameras]
    bundle, size, gauge = rig.fit.bundle, _size(rig, cameras[0].model, height), "transforms"
    stays = np.array([name in given for name in names])
    if np.count_nonzero(stays) > 1:
        start = cameras_at([given.get(name, Rigid.identity()) for name in names])
        bundle = placed(bundle, start, np.zeros(len(names), np.bool_), stays)
        size = None
    elif size is None:
        raise LogError(
            "nothing tells the size of the rig: no limbs of arms and legs are seen; give the "
            "stature of the people with --height"
        )
    else:
        bundle, gauge = _on_floor(rig, size.scale, cameras[0].model)
        root = WORLD
    fit = rig.fit._replace(bundle=bundle)
    found = _cameras(rig._replace(fit=fit), names, given)
    others = [c.name for c in cameras if c.name not in names]
    found += [
        CalibratedCamera(name, name, reason=UNLINKED if frames else NO_VIEW, pose=given.get(name))
        for name, frames in ((c.name, c.frames) for c in cameras)
        if name in others
    ]
    found.sort(key=lambda camera: camera.name)
    worst = max(found, key=lambda camera: GRADES.index(camera.verdict))
    verdict: Verdict = "doubtful" if worst.verdict == "impossible" else worst.verdict
    reason = worst.reason and f"{worst.name}: {worst.reason}; {worst.remedy}"
    if size is not None:
        verdict = max(verdict, "usable", key=GRADES.index)
        told = f"the size of the rig is from {size.source}, so it may be wrong by {size.error:.1%}"
        reason = f"{reason}; {told}" if reason else told
    return PeopleCalibration(root, verdict, reason, tuple(found), gauge=gauge)


def _size(rig: FoundRig, model: SkeletonModel, height: float | None) -> _Size | None:
    """Return the size by the stature of the people, or of adults; None if no limbs are seen."""
    bodies = _bodies(rig, model)[0]
    slots = {split_side(name)[::-1]: m for m, name in enumerate(model.marker_names)}
    lengths, shares = 0.0, 0.0
    for (side, part), m in slots.items():
        end, share = LIMBS.get(part, ("", 0.0))
        if (other := slots.get((side, end))) is not None:
            apart = np.linalg.norm(bodies[:, m] - bodies[:, other], axis=1)
            if np.count_nonzero(np.isfinite(apart)) >= FEWEST_LIMBS:
                lengths, shares = lengths + float(np.nanmedian(apart)), shares + share
    if not lengths:
        return None
    stature = lengths / shares  # in units of the rig
    if height is not None:
        return _Size(height / stature, LIMBS_ERROR, "the stature of the people")
    return _Size(ADULT_M / stature, math.hypot(ADULT_ERROR, LIMBS_ERROR), "the limbs of adults")


def _bodies(rig: FoundRig, model: SkeletonModel) -> tuple[Floats, Floats]:
    """(G, M, 3) people at instants, and their joints' velocities; NaN = absent.

    Of velocities only the size counts, as the camera sees it from which it is largest.
    """
    fit = rig.fit
    groups = np.unique(fit.rows[:, :2], axis=0, return_inverse=True)[1].ravel()
    shape = int(groups.max()) + 1, model.n_markers, 3
    places, velocities = np.full(shape, np.nan), np.full(shape, np.nan)
    at = groups, fit.rows[:, 2]
    places[at] = fit.bundle.places
    cameras = fit.bundle.cameras
    depths = fit.bundle.places @ cameras.rotations[:, 2].T + cameras.shifts[:, 2]
    speeds = np.linalg.norm(fit.bundle.points.velocities, axis=2) * depths
    velocities[at] = 0.0
    velocities[(*at, 0)] = np.where(fit.bundle.points.weights > 0.0, speeds, 0.0).max(axis=1)
    return places, velocities


def _moved(bundle: Bundle, scale: float, turn: Floats, shift: Floats) -> Bundle:
    """Return a rig in another frame: X -> scale turn X + shift."""
    rotations = np.ascontiguousarray(bundle.cameras.rotations @ turn.T)
    shifts = scale * bundle.cameras.shifts - rotations @ shift
    places = scale * bundle.places @ turn.T + shift
    cameras = bundle.cameras._replace(rotations=rotations, shifts=np.ascontiguousarray(shifts))
    return bundle._replace(cameras=cameras, places=places)


def _on_floor(rig: FoundRig, scale: float, model: SkeletonModel) -> tuple[Bundle, str]:
    """Put a rig on the floor that people stand on, or leave it in the frame of its first camera."""
    bundle = _moved(rig.fit.bundle, scale, np.eye(3), np.zeros(3))
    sized = rig._replace(fit=rig.fit._replace(bundle=bundle))
    poses, velocities = _bodies(sized, model)
    floor = find_floor(model, poses, velocities)
    turn, shift = on_floor(Rig.of(poses_of(bundle.cameras)), floor, bundle.places.mean(axis=0))
    return _moved(bundle, 1.0, turn, shift), "floor" if floor is not None else "first camera"


def _cameras(
    rig: FoundRig, names: Sequence[str], given: Mapping[str, Rigid]
) -> list[CalibratedCamera]:
    """Return the poses and clocks of the cameras, and what is known of their errors."""
    fit, bundle = rig.fit, rig.fit.bundle
    errors = errors_of(fit)
    late = fit.lags - np.sort(fit.lags)[(len(names) - 1) // 2]
    away = np.linalg.norm(bundle.places - centres_of(bundle.cameras)[:, None], axis=2)
    px = medians(bundle.distances)
    instants = fit.instants
    cameras = []
    for k, (name, pose) in enumerate(zip(names, poses_of(bundle.cameras), strict=True)):
        degrees = float(np.degrees(np.linalg.norm(errors[k, :3])))
        metres = float(np.linalg.norm(errors[k, 3:LAG]))
        seen = bundle.points.weights[:, k] > 0.0
        share = len(np.unique(fit.rows[seen, 0])) / len(instants)
        seconds = share * float(np.ptp(instants))
        verdict, reason = _verdict(degrees, metres, seconds, float(px[k]), rig.rivalry)
        apart = given[name].apart(pose) if name in given else (math.nan, math.nan)
        residual = px[k] / bundle.focals[k] * np.median(away[k][seen])
        cameras.append(
            CalibratedCamera(
                name,
                name,
                verdict,
                reason,
                pose,
                clock_s=-float(late[k]),
                error_deg=degrees,
                error_mm=1000.0 * metres,
                residual_mm=1000.0 * float(residual),
                error_ms=1000.0 * float(errors[k, LAG]),
                seconds=seconds,
                moved_deg=apart[1],
                moved_mm=1000.0 * apart[0],
            )
        )
    return cameras


def _verdict(
    degrees: float, metres: float, seconds: float, px: float, rivalry: float
) -> tuple[Verdict, str]:
    """Return the verdict on a camera, and what is wrong."""
    if px > POOR_PX:
        return "doubtful", f"its keypoints are {px:.0f} px from what the others see"
    if rivalry > REGULAR:
        return "doubtful", "people move so regularly that other clocks and poses fit as well"
    grades: dict[Verdict, Limits] = {"good": GOOD, "usable": USABLE}
    for verdict, limits in grades.items():
        if degrees < limits.error_deg and metres < limits.error_m and seconds >= limits.seconds:
            return verdict, ""
    return "doubtful", (
        f"the standard error is {degrees:.1f} degrees and {100 * metres:.0f} cm, from "
        f"{seconds:.0f} s of common view"
    )
