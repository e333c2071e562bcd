"""Poses and clocks of a log's cameras from the people whom they see, starting from nothing.

::

    with open_log("lab.mcap") as log:
        found = calibrate_people(log)

Nothing is asked of the people but to walk about where two cameras see them at the same time. Each
step is a module: ``camera_views`` and ``tracklets``, ``coarse_clock``, ``pair_pose``,
``camera_graph``, ``joint_refinement``, ``evidence`` and ``verdict``, ``gauge`` and ``floor``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations
from typing import Any, NamedTuple

import numpy as np

from hiros_mcap.body.rotations import Rigid, angle, from_matrix, to_matrix
from hiros_mcap.body.symmetry import symmetry_of
from hiros_mcap.body.transforms import same_place
from hiros_mcap.calibrate.agreement import camera_distances
from hiros_mcap.calibrate.camera_change import find_change, part_of
from hiros_mcap.calibrate.camera_graph import Fits, Pair, ambiguous, chained, spanning_tree
from hiros_mcap.calibrate.camera_result import CameraResult
from hiros_mcap.calibrate.camera_views import CameraView, Correction, camera_views
from hiros_mcap.calibrate.coarse_clock import lag_candidates, landmarks_of, signatures_of
from hiros_mcap.calibrate.evidence import Found, refine_together
from hiros_mcap.calibrate.floor import find_floor
from hiros_mcap.calibrate.gauge import moved, on_floor, on_transforms
from hiros_mcap.calibrate.pair_pose import register_pair
from hiros_mcap.calibrate.sampling import Rig, instants_of
from hiros_mcap.calibrate.verdict import MOVED, NO_VIEW, UNLINKED, Verdict, judge, remedy
from hiros_mcap.errors import LogError
from hiros_mcap.io.log import Log
from hiros_mcap.kernels.rig_equations import CLOCK
from hiros_mcap.skeletons import Floats, Ints, SkeletonModel
from hiros_mcap.summary import plain

PAIR_INSTANTS = 100
"""Instants at which two cameras are compared."""
WORLD = "world"
"""Fixed frame of a log without transforms."""
NAN = float("nan")


@dataclass(frozen=True, slots=True)
class CalibratedCamera(CameraResult):
    """What the people told about one camera.

    The pose of an impossible camera is the log's, if it has one. The clock is NaN if no motion
    tells it. Errors are those against the first camera. The residual is the median distance of its
    joints to the mean of the other cameras'.
    """

    verdict: Verdict = "impossible"
    drift_ppm: float = 0.0
    """How fast the clock's offset grows, from the middle of the log; 0 in logs of less than two
    minutes."""
    error_ms: float = NAN
    """Standard error of the clock."""
    seconds: float = 0.0
    """s in which another camera sees the same people."""
    moved_deg: float = NAN
    """Difference from the log's transforms; NaN without."""
    moved_mm: float = NAN
    since_s: float = NAN
    """When it was moved to this pose, s from the log's start; NaN if it always stood there."""
    until_s: float = NAN
    """When it was moved away from this pose; such a camera is listed twice."""
    since: int = 0
    """The first of both as a log time, ns; 0 if it always stood there."""


@dataclass(frozen=True, slots=True)
class PeopleCalibration:
    """Poses and clocks of a log's cameras."""

    fixed_frame: str
    verdict: Verdict
    reason: str
    """What is wrong and what to record; "" if nothing is."""
    cameras: tuple[CalibratedCamera, ...]
    joints: dict[str, float] = field(default_factory=dict)
    """Median distance of each joint to the mean of the other cameras, mm."""
    gauge: str = ""
    """What the fixed frame was taken from: transforms, floor, or the first camera."""

    def to_dict(self) -> dict[str, Any]:
        """Plain data for JSON; numbers that are not known are None."""
        cameras = [camera.to_dict(self.fixed_frame) for camera in self.cameras]
        return {**plain(replace(self, cameras=())), "cameras": cameras}


class _Solution(NamedTuple):
    """Those cameras whose poses were found."""

    cameras: list[int]
    found: Found


def calibrate_people(log: Log, corrected: Correction | None = None) -> PeopleCalibration:
    """Find the poses and clocks of a log's cameras from the people in it.

    The log's transforms are not needed. Where there are some, they place the rig as a whole.
    ``corrected`` puts right what the times of the messages show of the clocks.

    Raises LogError for a log of one camera, of cameras that share a frame, or that move.
    """
    views = camera_views(log, corrected)  # tracklets
    if len(views) < 2:
        raise LogError("has one camera only; poses need two or more", path=log.path)
    mirror = symmetry_of(log.model).mirror
    root, given = _given_poses(log, views)
    fits = _register_pairs(views, log.model, mirror, given)  # association, lags, pair poses
    solution, faults = _solve(views, fits, mirror)  # joint refinement, evidence
    moves = {}
    if faults:
        moves = _moves(views, fits, faults, log.model)  # cameras that were moved
    if moves:
        parts = _parts(views, moves)
        root, placed_parts = _given_poses(log, parts)
        refits = _register_pairs(parts, log.model, mirror, placed_parts)
        again, others = _solve(parts, refits, mirror)
        if again is not None and len(others) < len(faults):
            views, given, solution, faults = parts, placed_parts, again, others
    cameras = [
        CalibratedCamera(view.name, view.frame, reason=faults.get(c, ""), pose=given.get(c))
        for c, view in enumerate(views)
    ]
    if solution is None:
        return PeopleCalibration(root, *_whole(cameras), tuple(cameras))
    rig, gauge = _in_fixed_frame(log, solution, given)  # transforms, or the floor
    for k, c in enumerate(solution.cameras):
        cameras[c] = _camera(views[c], k, rig, solution.found, given.get(c))  # verdict
    cameras = _with_clocks(cameras, views, solution)
    cameras = _with_times(cameras, moves, log.span)
    joints = _by_joint(solution.found, log.model)
    return PeopleCalibration(root, *_whole(cameras), tuple(cameras), joints, gauge)


def _given_poses(log: Log, views: Sequence[CameraView]) -> tuple[str, dict[int, Rigid]]:
    """Return the fixed frame and the poses in it that the log's transforms give.

    Two cameras cannot have the same pose: nobody has calibrated them.
    """
    frames = {c: view.frame for c, view in enumerate(views) if view.frame in log.transforms.frames}
    if not frames:
        return WORLD, {}
    roots = [log.transforms.root(frame) for frame in frames.values()]
    root = max(sorted(set(roots)), key=roots.count)
    poses = {c: log.transforms.at_rest(frame, root) for c, frame in frames.items()}
    known = {c: pose for c, pose in poses.items() if pose is not None}
    named = {str(c): pose for c, pose in known.items()}
    alike = {int(name) for group in same_place(named) for name in group}
    return root, {c: pose for c, pose in known.items() if c not in alike}


def _register_pairs(
    views: Sequence[CameraView], model: SkeletonModel, mirror: Ints, given: dict[int, Rigid]
) -> Fits:
    """Register each pair of cameras by itself."""
    landmarks = landmarks_of(model)
    signatures = [signatures_of(view, landmarks) for view in views]
    fits = {}
    for a, b in combinations(range(len(views)), 2):
        if views[a].name == views[b].name:  # before and after it was moved
            continue
        candidates = lag_candidates(signatures[a], signatures[b])
        instants = instants_of(views[a : a + 1], PAIR_INSTANTS)
        start = _between(given[a], given[b]) if a in given and b in given else None
        fits[a, b] = register_pair([views[a], views[b]], candidates, instants, mirror, start)
    return fits


def _between(one: Rigid, other: Rigid) -> Rig:
    pose, rig = one.inverse() @ other, Rig.alone(2)
    rig.rotations[1], rig.shifts[1] = to_matrix(pose.xyzw), pose.translation
    return rig


def _solve(
    views: Sequence[CameraView], fits: Fits, mirror: Ints
) -> tuple[_Solution | None, dict[int, str]]:
    """Refine all cameras together; while one of them does not fit, leave out the worst.

    Returns the solution, None if there is none, and why each other camera has no pose.
    """
    faults = {c: NO_VIEW for c, view in enumerate(views) if not view.tracks}
    while True:
        left = {pair: each for pair, each in fits.items() if not faults.keys() & set(pair)}
        tree, cameras = spanning_tree(left, [c for c in range(len(views)) if c not in faults])
        if len(cameras) < 2:
            break
        start = chained(tree, fits, cameras, len(views)).select(cameras)
        rivals = [_only_ambiguous(c, tree, fits) for c in cameras]
        found = refine_together([views[c] for c in cameras], start, mirror, rivals)
        bad = {
            c: (evidence.share, reason)
            for c, evidence in zip(cameras, found.evidence, strict=True)
            for verdict, reason in [judge(evidence, moved=False)]
            if verdict == "impossible"
        }
        if not bad:
            faults |= {c: UNLINKED for c in range(len(views)) if c not in {*cameras, *faults}}
            return _Solution(cameras, found), faults
        worst = min(bad, key=lambda c: (bad[c][0], -c))
        faults[worst] = bad[worst][1]
        if len(cameras) == 2:
            faults |= dict.fromkeys(cameras, bad[worst][1])
    return None, {c: faults.get(c, UNLINKED) for c in range(len(views))}


def _moves(
    views: Sequence[CameraView], fits: Fits, faults: Mapping[int, str], model: SkeletonModel
) -> dict[str, float]:
    """Return when cameras without a pose were moved, s of their own time from the log's middle.

    Two cameras show that one of them was moved, but not which: it is then the second.
    """
    landmarks, mirror = landmarks_of(model), symmetry_of(model).mirror
    found = {}
    sound = [c for c in range(len(views)) if c not in faults] or [0]
    for c in faults:
        partners = [a for a in sound if a != c and fits.get((min(a, c), max(a, c)))]
        if not partners or not views[c].tracks:
            continue
        best = max(partners, key=lambda a: fits[min(a, c), max(a, c)][0].quality)
        change = find_change([views[best], views[c]], landmarks, mirror)
        if change is not None:
            found[views[c].name] = change.seconds
    return found


def _parts(views: Sequence[CameraView], moves: Mapping[str, float]) -> list[CameraView]:
    """Return the views, those of cameras that were moved as two."""
    parts = []
    for view in views:
        at = moves.get(view.name)
        spans = [(-np.inf, np.inf)] if at is None else [(-np.inf, at), (at, np.inf)]
        parts += [part_of(view, *span) for span in spans]
    return parts


def _with_times(
    cameras: list[CalibratedCamera], moves: Mapping[str, float], span: tuple[int, int]
) -> list[CalibratedCamera]:
    """Return the cameras with the times at which they were moved."""
    names = [camera.name for camera in cameras]
    for c, camera in enumerate(cameras):
        if names.count(camera.name) < 2:
            continue
        at = sum(span) // 2 + round(1e9 * moves[camera.name])
        seconds = (at - span[0]) / 1e9
        if names.index(camera.name) == c:
            cameras[c] = replace(camera, until_s=seconds)
        else:
            cameras[c] = replace(camera, since_s=seconds, since=at)
    return cameras


def _only_ambiguous(c: int, tree: Sequence[Pair], fits: Fits) -> bool:
    return all(ambiguous(fits[pair]) for pair in tree if c in pair)


def _in_fixed_frame(log: Log, solution: _Solution, given: dict[int, Rigid]) -> tuple[Rig, str]:
    """Return the rig where the log's transforms or the floor put it, and which of both."""
    found = solution.found
    known = {k: given[c] for k, c in enumerate(solution.cameras) if c in given}
    if known:
        return moved(found.rig, on_transforms(found.rig, known)), "transforms"
    poses, velocities = _merged(found, log.model.n_markers)
    floor = find_floor(log.model, poses, velocities)
    placement = on_floor(found.rig, floor, found.residuals.means.mean(axis=0))
    return moved(found.rig, placement), "floor" if floor is not None else "first camera"


def _merged(found: Found, n_markers: int) -> tuple[Floats, Floats]:
    """(G, M, 3) positions and velocities of the people, each the mean of the cameras."""
    points, residuals = found.points, found.residuals
    shape = int(points.people.max()) + 1, n_markers, 3
    poses, velocities = np.full(shape, np.nan), np.full(shape, np.nan)
    at = points.people, points.joints
    poses[at] = residuals.means
    velocities[at] = residuals.mean_velocities
    return poses, velocities


def _camera(
    view: CameraView, k: int, rig: Rig, found: Found, given: Rigid | None
) -> CalibratedCamera:
    evidence, errors = found.evidence[k], found.errors[k]
    turn = from_matrix(rig.rotations[k])
    pose = Rigid(turn, rig.shifts[k])
    moved_deg = moved_m = NAN
    if given is not None:
        moved_deg = float(np.degrees(angle(pose.xyzw, given.xyzw)))
        moved_m = float(np.linalg.norm(pose.translation - given.translation))
    # The first camera has no error against itself; the others' largest tells if it was moved.
    every = errors if k else found.errors.max(axis=0)
    error_deg = float(np.degrees(np.linalg.norm(every[:3])))
    error_m = float(np.linalg.norm(every[3:6]))
    significant = moved_deg > MOVED * error_deg or moved_m > MOVED * error_m
    verdict, reason = judge(evidence, moved=significant)
    return CalibratedCamera(
        name=view.name,
        frame=view.frame,
        verdict=verdict,
        reason=reason,
        pose=pose,
        error_deg=error_deg if k else NAN,
        error_mm=1000.0 * error_m if k else NAN,
        residual_mm=1000.0 * evidence.residual,
        seconds=evidence.seconds,
        moved_deg=moved_deg,
        moved_mm=1000.0 * moved_m,
    )


def _with_clocks(
    cameras: list[CalibratedCamera], views: Sequence[CameraView], solution: _Solution
) -> list[CalibratedCamera]:
    """Return the cameras with their clocks against the median clock, which is taken for right."""
    found = solution.found
    timed = [k for k, known in enumerate(found.timed) if known]
    if len(timed) < 2:
        return cameras
    clocks = [found.rig.clocks[k] + views[solution.cameras[k]].shift for k in timed]
    right = timed[int(np.argsort(clocks)[(len(timed) - 1) // 2])]
    middle = clocks[timed.index(right)]
    for k, clock in zip(timed, clocks, strict=True):
        c = solution.cameras[k]
        drift = 1e6 * (found.rig.drifts[k] - found.rig.drifts[right])
        error = 1000.0 * float(np.hypot(found.errors[k, CLOCK], found.errors[right, CLOCK]))
        cameras[c] = replace(
            cameras[c],
            clock_s=float(clock - middle),
            drift_ppm=float(drift),
            error_ms=NAN if k == right else error,
        )
    return cameras


def _whole(cameras: Sequence[CalibratedCamera]) -> tuple[Verdict, str]:
    """Return the verdict on all cameras: that of the worst, but one camera can be left out."""
    impossible = [camera for camera in cameras if camera.verdict == "impossible"]
    doubtful = [camera for camera in cameras if camera.verdict == "doubtful"]
    bad = impossible or doubtful
    if not bad:
        improved = any(camera.verdict == "improved" for camera in cameras)
        return ("improved" if improved else "good"), ""
    reason = f"{bad[0].name}: {bad[0].reason}; {remedy(bad[0].name, len(cameras))}"
    return ("impossible" if len(impossible) == len(cameras) else "doubtful"), reason


def _by_joint(found: Found, model: SkeletonModel) -> dict[str, float]:
    distances = 1000.0 * camera_distances(found.residuals)
    table = {}
    for m, name in enumerate(model.marker_names):
        some = distances[:, found.points.joints == m]
        if (~np.isnan(some)).any():
            table[name] = float(np.nanmedian(some))
    return table
