"""Poses and clocks of a log's cameras from the people whom they see, starting from nothing.

::

    with open_log("lab.mcap") as log:
        calibration = calibrate_people(log)

Nothing is asked of the people but to walk about where two cameras see them at the same time. Each
step is a module: ``camera_views``, ``coarse_clock``, ``pair_pose``, ``refinement``, ``evidence``
and ``verdict``, ``gauge``.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations
from typing import Any, NamedTuple

import numpy as np

from hiros_mcap.body.rotations import Rigid
from hiros_mcap.body.symmetry import symmetry_of
from hiros_mcap.body.transforms import far_apart, same_place
from hiros_mcap.calibrate.camera_views import CameraView
from hiros_mcap.calibrate.coarse_clock import lag_candidates, landmarks_of, signatures_of
from hiros_mcap.calibrate.evidence import camera_distances, full_evidence
from hiros_mcap.calibrate.gauge import (
    WORLD,
    find_floor,
    moved,
    on_floor,
    on_transforms,
    without_tilted,
)
from hiros_mcap.calibrate.joint_refinement import Refinement
from hiros_mcap.calibrate.pair_pose import (
    PAIR_INSTANTS,
    Fits,
    Pair,
    ambiguous,
    chained,
    register_pair,
    spanning_tree,
)
from hiros_mcap.calibrate.refinement import (
    FROM_PAIRS,
    FittingRig,
    cameras_of,
    fit_together,
    refine_together,
)
from hiros_mcap.calibrate.sampling import Rig, instants_of
from hiros_mcap.calibrate.survey import (
    MOST_S,
    FixedCamera,
    Survey,
    applied,
    axes_in_words,
    check_frames,
    fixed_cameras,
    names_of,
    seen_by,
    shared_frames,
    with_own_frames,
)
from hiros_mcap.calibrate.verdict import (
    GRADES,
    NO_VIEW,
    SURE,
    UNLINKED,
    CalibratedCamera,
    Verdict,
    fault,
)
from hiros_mcap.errors import LogError
from hiros_mcap.io.camera_clock import CameraTimes, ClockCorrection
from hiros_mcap.io.channels import CameraChannel
from hiros_mcap.io.log import Log
from hiros_mcap.skeletons import Floats, Ints, SkeletonModel
from hiros_mcap.wording import plain

APART_S, CONSTANT_S = 2.0, 0.1
"""Lags that differ by more, and vary by less, show a wrong clock."""
ROOM = "room"
"""Fixed frame of cameras without transforms if others have some: then the world lies elsewhere."""
_ALIKE_DEG, _ALIKE_M = 5.0, 0.3
"""Poses that differ by less show that people were at the same place before: a transform to the room
may be wrong by so much, and cameras stand further apart."""


@dataclass(frozen=True, slots=True)
class PeopleCalibration:
    """Poses and clocks of a log's cameras."""

    fixed_frame: str
    verdict: Verdict
    reason: str  # the fault and a better recording; "" without a fault
    cameras: tuple[CalibratedCamera, ...]
    joints: dict[str, float] = field(default_factory=dict)
    """Median distance of each joint to the mean of the other cameras, mm."""
    gauge: str = ""  # origin of the fixed frame: transforms, floor, or the first camera
    people_mm: float = math.nan
    """How far the poses' errors move the mean of the cameras' joints, root mean square."""
    tilted: tuple[str, ...] = ()
    """Cameras by whose given poses people do not stand on the floor, though by others they do."""

    def to_dict(self) -> dict[str, Any]:
        """Plain data for JSON; numbers that are not known are None."""
        cameras = [camera.to_dict(self.fixed_frame) for camera in self.cameras]
        return {**plain(replace(self, cameras=())), "cameras": cameras}


def calibrate_people(
    log: Log,
    survey: Survey | None = None,
    corrections: Mapping[str, ClockCorrection] | None = None,
) -> PeopleCalibration:
    """Find the poses and clocks of a log's cameras from the people in it.

    The log's transforms are not needed. Where there are some, they place the rig as a whole. Where
    several channels are in one frame, each gets one that is called as its topic.

    Parameters
    ----------
    survey : of the log, if it is there. corrections : what is known of the clocks, by camera.

    Raises LogError for a log of one camera, of cameras that move, or that share a frame in which
    they see the same people at the same place.
    """
    shared = shared_frames(log)
    log = with_own_frames(log, shared)
    check_frames(log)
    survey = survey or Survey(log, MOST_S, fixed=False)
    if survey.left_handed:
        raise LogError(survey.left_handed, path=log.path)
    views = _views(survey, corrections or {})  # tracklets
    if len(views) < 2:
        raise LogError("has one camera only; poses need two or more", path=log.path)
    mirror = symmetry_of(log.model).mirror
    root, given = _given_poses(log, views)
    fits = _register_pairs(views, log.model, mirror, given)  # association, lags, pair poses
    solved = _solve(views, fits, mirror)  # joint refinement, evidence
    cameras = [
        CalibratedCamera(view.name, view.frame, reason=solved.faults.get(c, ""), pose=given.get(c))
        for c, view in enumerate(views)
    ]
    fit = solved.fit
    if fit is None:
        _check_axes(survey, cameras)
        return PeopleCalibration(root, *_whole(cameras), tuple(cameras))
    anchor = next((c for c, view in enumerate(views) if view.frame == root), None)
    rig, gauge, tilted = _in_fixed_frame(log, fit, given, anchor)  # transforms, or the floor
    for c, camera in _placed(solved, fit, rig, given):  # verdict
        cameras[c] = camera
    _check_apart(log, shared, cameras)
    _check_axes(survey, cameras)
    joints = _by_joint(fit.refined, log.model)
    people_mm = 1000.0 * fit.refined.people
    return PeopleCalibration(
        root, *_whole(cameras), tuple(cameras), joints, gauge, people_mm, tilted
    )


def _check_apart(
    log: Log, shared: Mapping[str, list[CameraChannel]], cameras: Sequence[CalibratedCamera]
) -> None:
    """Raise LogError for a frame in which several cameras see people at the same place."""
    for frame, channels in shared.items():
        if see_alike(names := names_of(channels), cameras):
            raise LogError(applied(names, frame), path=log.path)


def _check_axes(survey: Survey, cameras: Sequence[CalibratedCamera]) -> None:
    """Raise LogError if a camera has no pose whose axes seem to be left-handed."""
    unplaced = {camera.name for camera in cameras if camera.verdict not in SURE}
    if unplaced & survey.wrong_axes.axes.keys():
        raise LogError(axes_in_words(survey.log, survey.wrong_axes.axes), path=survey.log.path)


def see_alike(names: Iterable[str], cameras: Iterable[CalibratedCamera]) -> bool:
    """Whether cameras saw people at the same place in one frame, since they have one pose in it."""
    poses = {one.name: one.pose for one in cameras if one.pose and one.verdict in SURE}
    known = [poses[name] for name in names if name in poses]
    apart = [known[0].apart(pose) for pose in known[1:]]
    return bool(apart) and all(m < _ALIKE_M and degrees < _ALIKE_DEG for m, degrees in apart)


def _views(survey: Survey, corrections: Mapping[str, ClockCorrection]) -> list[CameraView]:
    """Return what each camera sees, in its own frame."""
    log, seen = survey.log, survey.many(corrections)
    mirror = symmetry_of(log.model).mirror
    if survey.fixed:
        cameras = sorted(fixed_cameras(log, {}))
    else:
        cameras = sorted(
            FixedCamera(name, next(iter(camera.frames), ""), Rigid.identity())
            for camera in log.cameras
            for name in camera.sources.values()
        )
    shifts = far_shifts(survey.times, corrections)
    return [
        seen_by(camera, seen.get(camera.name, []), mirror, shifts.get(camera.name, 0.0))
        for camera in cameras
    ]


def far_shifts(
    times: Mapping[str, CameraTimes], corrections: Mapping[str, ClockCorrection]
) -> dict[str, float]:
    """Camera -> s to add to stamps that are seconds away from the others'.

    The difference of log time and stamp shows it to the precision of the transport. A difference
    that is not constant shows nothing: such a log was not recorded live.
    """
    lags = {
        name: one.corrected(corrections.get(name)).lags
        for name, one in times.items()
        if len(one.stamps)
    }
    usual = {name: float(np.median(each)) for name, each in lags.items()}
    nearest = min(usual.values(), key=abs, default=0.0)
    return {
        name: usual[name] - nearest
        for name, each in lags.items()
        if np.median(np.abs(each - usual[name])) < CONSTANT_S
        and abs(usual[name] - nearest) > APART_S
    }


def _given_poses(log: Log, views: Sequence[CameraView]) -> tuple[str, dict[int, Rigid]]:
    """Return the fixed frame and the poses in it that the log's transforms give.

    Two cameras cannot have the same pose: nobody has calibrated them. Poses in mm tell nothing.
    """
    known = log.transforms.frames
    frames = {c: view.frame for c, view in enumerate(views) if view.frame in known}
    roots = [log.transforms.root(frame) for frame in frames.values()]
    root = max(sorted(set(roots)), key=roots.count, default="")
    poses = {c: log.transforms.at_rest(frame, root) for c, frame in frames.items()}
    given = {c: pose for c, pose in poses.items() if pose is not None}
    if all(frames[c] == root for c in given):  # a camera in itself says nothing
        return ROOM if WORLD in known else WORLD, {}
    named = {str(c): pose for c, pose in given.items()}
    alike = {int(name) for group in same_place(named) for name in group}
    wrong = alike | {int(name) for name in far_apart(named)}
    return root, {c: pose for c, pose in given.items() if c not in wrong}


def _register_pairs(
    views: Sequence[CameraView], model: SkeletonModel, mirror: Ints, given: dict[int, Rigid]
) -> Fits:
    """Register each pair of cameras by itself."""
    landmarks = landmarks_of(model)
    signatures = [signatures_of(view, landmarks) for view in views]
    fits = {}
    for a, b in combinations(range(len(views)), 2):
        candidates = lag_candidates(signatures[a], signatures[b])
        instants = instants_of(views[a : a + 1], PAIR_INSTANTS)
        start = Rig.of([given[a], given[b]]).anchored() if a in given and b in given else None
        fits[a, b] = register_pair([views[a], views[b]], candidates, instants, mirror, start)
    return fits


class Solution(NamedTuple):
    """All cameras, and what speaks against some of them."""

    fit: FittingRig | None
    """Those that fit each other, or that were refined last; None if no two are linked."""
    faults: dict[int, str]  # camera -> why its pose cannot be trusted
    last: dict[int, FittingRig]  # camera that does not fit -> the last fit in which it was


def _solve(views: Sequence[CameraView], fits: Fits, mirror: Ints) -> Solution:
    """Refine all cameras together; while one of them does not fit, leave out the worst."""

    def refined(some: list[int]) -> FittingRig | None:
        left = {pair: each for pair, each in fits.items() if set(some) >= set(pair)}
        tree, cameras = spanning_tree(left, some)
        if len(cameras) < 2:
            return None
        start = chained(tree, fits, len(views)).select(cameras)
        rig = refine_together([views[c] for c in cameras], start, mirror, FROM_PAIRS)
        if not len(rig.points.seconds):
            return None
        rivals = [_only_ambiguous(c, tree, fits) for c in cameras]
        return FittingRig(cameras, rig, full_evidence(rig, mirror, rivals))

    blind = {c: NO_VIEW for c, view in enumerate(views) if not view.tracks}
    seeing = [c for c in range(len(views)) if c not in blind]
    fit, left = fit_together(seeing, refined, fault)
    fitting = [] if fit is None else fit.cameras
    rest = {c: UNLINKED for c in range(len(views)) if c not in fitting}
    faults = rest | {c: reason for c, (reason, _) in left.items()} | blind
    last = {c: fit for c, (_, fit) in left.items()}
    return Solution(fit or next(reversed(last.values()), None), faults, last)


def _placed(
    solved: Solution, fit: FittingRig, rig: Rig, given: Mapping[int, Rigid]
) -> Iterator[tuple[int, CalibratedCamera]]:
    """Yield the cameras with poses; those that do not fit keep the log's, if it has some.

    The log's pose is not kept if it puts people elsewhere than the other cameras do.

    ``rig`` is that of the fit in the fixed frame.
    """
    for one in (*solved.last.values(), fit):
        common = next((c for c in one.cameras if c in fit.cameras), None)
        if common is None:
            continue
        poses = one.refined.rig
        k, goal = one.cameras.index(common), fit.cameras.index(common)
        turn = rig.rotations[goal] @ poses.rotations[k].T
        poses = moved(poses, (turn, rig.shifts[goal] - turn @ poses.shifts[k]))
        every = cameras_of(one, poses, [given.get(c) for c in one.cameras])
        for c, camera in zip(one.cameras, every, strict=True):
            if one is fit and c not in solved.faults:
                yield c, camera
            is_placed = camera.verdict != "impossible" and c not in given
            if one is solved.last.get(c) and is_placed:
                yield c, replace(camera, verdict="doubtful", reason=solved.faults[c])


def _only_ambiguous(c: int, tree: Sequence[Pair], fits: Fits) -> bool:
    return all(ambiguous(fits[min(pair), max(pair)]) for pair in tree if c in pair)


def _in_fixed_frame(
    log: Log, fit: FittingRig, given: Mapping[int, Rigid], anchor: int | None
) -> tuple[Rig, str, tuple[str, ...]]:
    """Return the rig where the log's transforms or the floor put it, and which of both.

    Also those cameras by whose transforms people would not stand on the floor.

    The camera ``anchor`` defines the fixed frame.
    """
    refined = fit.refined
    at = [anchor] if anchor in fit.cameras else given
    fixed = {k: given[c] for k, c in enumerate(fit.cameras) if c in at and c in given}
    poses, velocities = _merged(refined, log.model.n_markers)
    floor = find_floor(log.model, poses, velocities)
    if fixed:
        level = without_tilted(refined.rig, fixed, floor)
        tilted = tuple(refined.views[k].name for k in fixed if k not in level)
        return moved(refined.rig, on_transforms(refined.rig, level)), "transforms", tilted
    placement = on_floor(refined.rig, floor, refined.residuals.means.mean(axis=0))
    return moved(refined.rig, placement), "floor" if floor is not None else "first camera", ()


def _merged(refined: Refinement, n_markers: int) -> tuple[Floats, Floats]:
    """(G, M, 3) positions and velocities of the people, each the mean of the cameras."""
    points, residuals = refined.points, refined.residuals
    shape = int(points.people.max()) + 1, n_markers, 3
    poses, velocities = np.full(shape, np.nan), np.full(shape, np.nan)
    at = points.people, points.joints
    poses[at] = residuals.means
    velocities[at] = residuals.mean_velocities
    return poses, velocities


def _whole(cameras: Sequence[CalibratedCamera]) -> tuple[Verdict, str]:
    """Return the verdict on all cameras: that of the worst, but one camera can be left out."""
    worst = max(reversed(cameras), key=lambda one: (GRADES.index(one.verdict), one.uncertainty))
    verdict = worst.verdict
    if verdict == "impossible" and any(camera.verdict != verdict for camera in cameras):
        verdict = "doubtful"
    return verdict, worst.reason and f"{worst.name}: {worst.reason}; {worst.remedy}"


def _by_joint(refined: Refinement, model: SkeletonModel) -> dict[str, float]:
    distances = 1000.0 * camera_distances(refined.residuals)
    table = {}
    for m, name in enumerate(model.marker_names):
        some = distances[:, refined.points.joints == m]
        if (~np.isnan(some)).any():
            table[name] = float(np.nanmedian(some))
    return table
