"""Poses of cameras from the centres of a ball that each of them saw (Lee et al. 2022, 2.1.1)."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import combinations
from typing import Any, NamedTuple

import numpy as np

from hiros_mcap.body.rotations import (
    Rigid,
    conjugate,
    from_matrix,
    multiply,
    to_matrix,
    to_vector,
)
from hiros_mcap.calibrate.gauge import moved, on_transforms
from hiros_mcap.calibrate.pair_pose import links_from
from hiros_mcap.calibrate.registration import (
    common_frames,
    jackknife,
    rigid_fit,
    robust_kabsch,
)
from hiros_mcap.calibrate.sampling import Rig
from hiros_mcap.calibrate.verdict import TargetCalibration, TargetCamera
from hiros_mcap.errors import RegistrationError
from hiros_mcap.skeletons import Flags, Floats, Stamps

LEAST_CENTRES = 20
"""Two cameras need so many centres at common times."""
LEAST_SHARE, DOUBTFUL_SHARE = 0.6, 0.8
"""Of the common centres, so many must fit."""
WRONG_M, DOUBTFUL_M = 0.04, 0.02
"""Root mean square distance of the centres in two cameras: 3 to 10 mm for a ball held still."""
NARROW_M = 0.1
"""The second extent of the path (an SD) is at least this."""
NARROW_ERRORS = 5.0
"""An extent of the path must be so many times the residual."""
UNCERTAIN_DEG, UNCERTAIN_M = 1.0, 0.04
"""Largest standard errors of a pose that is believed."""
DOUBTFUL_DEG, DOUBTFUL_ERROR_M = 0.4, 0.015
BLOCKS = 10
"""Parts of the log that are left out in turn for the standard errors."""
NOISE_M = 0.003
"""The threshold for outliers is at least 3.5 times this."""
_ROUNDS = 20
ADVICE = "carry the ball through the common view of {} for 30 s, near and far, high and low"


class BallTrack(NamedTuple):
    """Where one camera saw the ball."""

    camera: str  # its name for the user
    frame: str  # coordinate frame of the centres
    stamps: Stamps  # (N,) ns
    centres: Floats  # (N, 3) m; NaN = not seen
    radii: Sequence[float] = ()  # m, as images show them
    skipped: Mapping[str, int] = {}  # depth images without a ball, by reason

    @classmethod
    def of(cls, camera: str, frame: str, points: Sequence[tuple[int, Any]]) -> BallTrack:
        """Return the track of stamps, ns, each with its centre."""
        stamps = np.array([stamp for stamp, _ in points], np.int64)
        centres = np.array([centre for _, centre in points], np.float64)
        return cls(camera, frame, stamps, centres.reshape(-1, 3))


class Placement(NamedTuple):
    """Camera b in the frame of camera a."""

    pose: Rigid
    common: int  # centres at common times
    used: int  # those that fit
    residual: float  # root mean square distance of these, m
    error_deg: float  # standard error of the orientation, degrees
    error_m: float  # standard error of the position, m
    extents: Floats  # (3,) SD of the path along its principal axes, m


def calibrate_centres(
    tracks: Sequence[BallTrack],
    *,
    fixed_frame: str = "world",
    given: Mapping[str, Rigid] | None = None,
) -> TargetCalibration:
    """Find the cameras' poses from the centres of the ball.

    Each camera is registered with that camera of the rig with which it shares most centres; the
    paper's cameras all share them with the first one.

    Parameters
    ----------
    given : frame -> pose in the fixed frame. They place the rig as a whole. Without them, the
        first camera's frame is put at the origin of the fixed frame.

    Raises
    ------
    RegistrationError
        The centres do not tell the pose of a camera. The line says what to record.
    """
    _check(tracks)
    placements = _chain(tracks)
    rig, gauge = _in_fixed_frame(tracks, placements, given or {})
    cameras = []
    for c, track in enumerate(tracks):
        seen = int(np.isfinite(track.centres).all(axis=1).sum())
        camera = TargetCamera(track.camera, track.frame, pose=rig.pose(c), seen=seen)
        if c:
            camera = _described(camera, tracks[placements[c][0]].camera, placements[c][1])
        cameras.append(camera)
    radii = [radius for track in tracks for radius in track.radii]
    radius = float(np.median(radii)) if radii else math.nan
    skipped = {track.camera: dict(track.skipped) for track in tracks}
    return TargetCalibration.of(fixed_frame, cameras, gauge, skipped, radius)


def _check(tracks: Sequence[BallTrack]) -> None:
    if len(tracks) < 2:
        names = ", ".join(track.camera for track in tracks) or "none"
        raise RegistrationError(f"at least 2 cameras needed, found {names}")
    frames = [track.frame for track in tracks]
    for frame in frames:
        if frames.count(frame) > 1 or not frame:
            names = " and ".join(t.camera for t in tracks if t.frame == frame)
            raise RegistrationError(
                f"{names} {'share' if frame else 'have'} the frame {frame!r}; "
                "give each camera a frame_id of its own"
            )
    for track in tracks:
        if not np.isfinite(track.centres).all(axis=1).any():
            raise RegistrationError(f"{track.camera} never saw the ball")


def _described(camera: TargetCamera, against: str, placement: Placement) -> TargetCamera:
    reason = _weakness_of(placement)
    return replace(
        camera,
        verdict="doubtful" if reason else "good",
        reason=reason,
        against=against,
        common=placement.common,
        used=placement.used,
        residual_mm=1000.0 * placement.residual,
        error_deg=placement.error_deg,
        error_mm=1000.0 * placement.error_m,
    )


def _chain(tracks: Sequence[BallTrack]) -> dict[int, tuple[int, Placement]]:
    """Register every camera but the first: camera -> the other camera, and its pose in the first.

    Pairs with most centres in common come first.
    """
    shared = {
        (a, b): common_frames((one.stamps, other.stamps), (one.centres, other.centres))
        for (a, one), (b, other) in combinations(enumerate(tracks), 2)
    }
    placements: dict[int, tuple[int, Placement]] = {}
    for a, b in links_from(0, sorted(shared, key=lambda pair: -len(shared[pair][0]))):
        names = tracks[a].camera, tracks[b].camera
        centres = shared[min(a, b), max(a, b)][:: 1 if a < b else -1]
        placement = place(centres[0], centres[1], names)
        placements[b] = a, _after(placements[a][1], placement) if a else placement
    return placements


def _after(first: Placement, second: Placement) -> Placement:
    """Return the second placement in the frame that the first one is in."""
    lever = math.radians(first.error_deg) * float(np.linalg.norm(second.pose.translation))
    return second._replace(
        pose=first.pose @ second.pose,
        error_deg=math.hypot(first.error_deg, second.error_deg),
        error_m=math.hypot(first.error_m, second.error_m, lever),
    )


def place(target: Floats, source: Floats, names: tuple[str, str]) -> Placement:
    """Register two cameras by corresponding centres (K, 3) each, in the order of time.

    Raises RegistrationError, which names the cameras and what to record, if there are too few
    centres, if they lie on a line, or if they do not fit each other.
    """
    pair = f"{names[0]} and {names[1]}"
    advice = ADVICE.format(pair)
    if len(source) < LEAST_CENTRES:
        raise RegistrationError(
            f"{pair} saw the ball at only {len(source)} common times, {LEAST_CENTRES} needed; "
            f"{advice}"
        )
    try:
        pose, kept = robust_fit(source, target)
    except RegistrationError:
        raise RegistrationError(f"{pair}: the ball's path is a line; {advice}") from None
    distances = _distances(pose, source, target)
    residual = float(np.sqrt(np.mean(distances[kept] ** 2)))
    # Kept points stay within a threshold that adapts to them. The others count, too.
    if kept.mean() < LEAST_SHARE or residual > WRONG_M:
        apart = 100 * float(np.median(distances))
        raise RegistrationError(
            f"{pair}: the ball's centres are {apart:.0f} cm apart and only {kept.mean():.0%} fit; "
            "check the cameras' clocks and the ball's radius, and move the ball slowly"
        )
    extents = np.minimum(_extents(source[kept]), _extents(target[kept]))
    if extents[1] < max(NARROW_M, NARROW_ERRORS * residual):
        raise RegistrationError(
            f"{pair}: the ball's path is nearly a line, only {100 * extents[1]:.0f} cm wide; "
            f"{advice}"
        )
    error_deg, error_m = _standard_errors(source[kept], target[kept], pose)
    if error_deg > UNCERTAIN_DEG or error_m > UNCERTAIN_M:
        raise RegistrationError(
            f"{pair}: the pose is uncertain by {error_deg:.1f} degrees and {100 * error_m:.0f} cm; "
            f"{advice}"
        )
    used = int(kept.sum())
    return Placement(pose, len(source), used, residual, error_deg, error_m, extents)


def _weakness_of(p: Placement) -> str:
    """Why a pose may be worse than it looks, "" if it is good."""
    if p.residual > DOUBTFUL_M:
        return (
            f"the ball's centres are {1000 * p.residual:.0f} mm apart; move the ball slowly, and "
            "check the clocks"
        )
    if p.used < DOUBTFUL_SHARE * p.common:
        return (
            f"only {p.used / p.common:.0%} of the ball's centres fit; remove what looks like the "
            "ball, and check the clocks"
        )
    if p.error_deg > DOUBTFUL_DEG or p.error_m > DOUBTFUL_ERROR_M:
        return (
            f"its standard error is {p.error_deg:.1f} degrees, {1000 * p.error_m:.0f} mm; carry "
            "the ball for longer and through more of the room"
        )
    if p.extents[2] < max(0.05, NARROW_ERRORS * p.residual):
        return (
            "the ball's path lies in a plane, so no depth error across it would show; carry it "
            "high and low, near and far"
        )
    return ""


def robust_fit(source: Floats, target: Floats) -> tuple[Rigid, Flags]:
    """Return the rigid transform from ``source`` to ``target`` despite outliers, and the inliers.

    The fit with Cauchy weights is the start. Then :func:`rigid_fit` is repeated on the pairs within
    3.5 robust standard deviations.

    Parameters
    ----------
    source, target : (N, 3) corresponding points, m, none of them NaN.

    Raises RegistrationError if there are fewer than three pairs, or the points lie on a line.
    """
    matrix, shift = robust_kabsch(source, target, np.ones(len(source)), _ROUNDS)
    pose, kept = Rigid(from_matrix(matrix), shift), np.zeros(len(source), np.bool_)
    for _ in range(_ROUNDS):
        before, kept = kept, _inliers(_distances(pose, source, target))
        if (kept == before).all():
            break
        pose = rigid_fit(source[kept], target[kept])
    return pose, kept


def _distances(pose: Rigid, source: Floats, target: Floats) -> Floats:
    return np.asarray(np.linalg.norm(pose.moved(source) - target, axis=1))


def _inliers(distances: Floats) -> Flags:
    """Those within 3.5 SD per axis; the median of a 3D distance is 1.54 SD."""
    scale = max(float(np.median(distances)) / 1.54, NOISE_M)
    return distances <= 3.5 * scale


def _extents(points: Floats) -> Floats:
    """(3,) SD along the principal axes, the largest first."""
    singular = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return np.asarray(singular / math.sqrt(len(points)))


def _standard_errors(source: Floats, target: Floats, pose: Rigid) -> tuple[float, float]:
    """Return those of the orientation, degrees, and of the position, m, by a block jackknife.

    The errors of successive frames are alike, so whole parts of the log are left out in turn.
    """
    steps = []
    for block in np.array_split(np.arange(len(source)), BLOCKS):
        part = rigid_fit(np.delete(source, block, axis=0), np.delete(target, block, axis=0))
        turn = to_vector(multiply(part.xyzw, conjugate(pose.xyzw)))
        steps.append([*turn, *(part.translation - pose.translation)])
    variances = jackknife(np.array(steps) - np.mean(steps, axis=0))
    turn_error, shift_error = np.sqrt(variances[:3].sum()), np.sqrt(variances[3:].sum())
    return float(np.degrees(turn_error)), float(shift_error)


def _in_fixed_frame(
    tracks: Sequence[BallTrack],
    placements: Mapping[int, tuple[int, Placement]],
    given: Mapping[str, Rigid],
) -> tuple[Rig, str]:
    """Return the rig where the given poses put it, or with the first camera at the origin."""
    rig = Rig.alone(len(tracks))
    for c, (_, placement) in placements.items():
        rig.rotations[c] = to_matrix(placement.pose.xyzw)
        rig.shifts[c] = placement.pose.translation
    fixed = {c: given[track.frame] for c, track in enumerate(tracks) if track.frame in given}
    if not fixed:
        return rig, "first camera"
    return moved(rig, on_transforms(rig, fixed)), "transforms"
