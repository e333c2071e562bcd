"""Puts cameras where the people say that they stand, before the stages see the detections.

A run of a file compares the log's poses with better ones that the people give
(:mod:`hiros_mcap.calibrate.refinement`), and takes those where they prove themselves. Where the log
has no poses, or poses that the people contradict, they are found from nothing
(:mod:`hiros_mcap.calibrate.people`).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from hiros_mcap.body.rotations import Rigid
from hiros_mcap.body.symmetry import symmetry_of
from hiros_mcap.body.transforms import TimedPoses, same_place
from hiros_mcap.calibrate.camera_graph import coarse_clocks
from hiros_mcap.calibrate.camera_result import CalibratedCamera
from hiros_mcap.calibrate.coarse_clock import landmarks_of
from hiros_mcap.calibrate.refinement import refine_poses
from hiros_mcap.calibrate.sampling import Rig
from hiros_mcap.calibrate.survey import (
    MOST_S,
    SHARED_FRAME,
    FixedCamera,
    Survey,
    camera_faults,
    fixed_cameras,
    moves,
    seen_by,
)
from hiros_mcap.calibrate.tracklets import Sighting
from hiros_mcap.calibrate.verdict import SURE, UNLINKED, remedy
from hiros_mcap.config import Config
from hiros_mcap.errors import LogError
from hiros_mcap.events import Events
from hiros_mcap.io.log import Log
from hiros_mcap.running.clock_alignment import ClockAlignment, align_clocks
from hiros_mcap.running.moved_cameras import Move, PosedViews, placed, split_moved
from hiros_mcap.running.process_options import Calibration
from hiros_mcap.summary import PoseSummary

if TYPE_CHECKING:
    from hiros_mcap.calibrate.people import PeopleCalibration

MOVED = "camera moved"
CHECKED_S = 10.0
"""So much of a log is read for a quick check."""
WRONG_DEG, WRONG_MM = 1.0, 30.0
"""What a quick check reports: such a pose shows in the results if nobody corrects it."""

_DELAY_S = 0.1
"""Lags of right clocks mostly differ by less."""

_ALONE = "no other camera stands still in a frame of its own"


@dataclass(slots=True)
class PoseAlignment:
    """The poses of a run's cameras."""

    cameras: list[PoseSummary] = field(default_factory=list)
    from_nothing: bool = False
    """Whether they were found from the people alone."""
    misfits: frozenset[str] = frozenset()
    """Cameras whose people are not where the others see them."""
    moves: tuple[Move, ...] = ()
    """Cameras that were moved in the middle of the log."""
    to_given: Mapping[str, Rigid] = field(default_factory=dict)
    """Camera -> what takes its people back to the log's pose, where the run uses a better one."""
    better: tuple[Mapping[str, TimedPoses], str] | None = None
    """Poses of frames that the run uses in place of the log's, and the frame that they are in."""

    def used_in(self, log: Log) -> Log:
        """Return the log with the poses that the run uses."""
        return log.with_poses(*self.better) if self.better else log

    @property
    def replaced(self) -> bool:
        """Whether the run uses poses other than the log's."""
        return any(camera.used for camera in self.cameras)

    def tell(self, events: Events) -> None:
        """Note the cameras that were moved."""
        for move in self.moves:
            events.note(move.stamp, MOVED, source=move.camera, detail=move.distance)

    def warnings(self) -> Iterator[str]:
        """Yield what makes the poses doubtful, and the remedy."""
        times = {c.name: c.since_s for c in self.cameras if not math.isnan(c.since_s)}
        for move in self.moves:
            yield (
                f"{move.camera} was moved by {move.distance} at {times[move.camera]:.1f} s; hiros "
                "found its pose for each part of the log. Calibrate it anew before you record "
                "again: hiros calibrate people"
            )
        for camera in self.cameras:
            if camera.name in self.misfits:
                yield (
                    f"{camera.name}: its pose does not fit the people ({camera.reason}); hiros "
                    "kept it. Calibrate the camera anew, or pass its pose with --extrinsics FILE"
                )
            elif self._is_unconfirmed(camera):
                yield (
                    f"{camera.name} {camera.reason}; if it should, its pose is wrong, and people "
                    "may appear twice. hiros calibrate people may find it"
                )

    def notes(self) -> Iterator[str]:
        """Yield what was done."""
        if self.from_nothing:
            yield (
                "the cameras' poses come from the people, because the log has none that fit them; "
                "`hiros calibrate people` saves them for other logs"
            )
        elif self.replaced:
            yield (
                "hiros moved the cameras to where they see the same people at the same place; "
                "--calibrate off keeps the log's poses"
            )

    def _is_unconfirmed(self, camera: PoseSummary) -> bool:
        """Whether others see people, but not those whom the camera sees."""
        return camera.reason == UNLINKED and len(self.cameras) > 1


def align_cameras(
    log: Log, config: Config, mode: Calibration, reorder: float
) -> tuple[ClockAlignment, PoseAlignment]:
    """Find out how the cameras of a log stand, and how their clocks go.

    Parameters
    ----------
    mode : "off" keeps the log's poses. reorder : of :func:`align_clocks`.

    Raises LogError if the log has no poses and the people do not tell them, if ``mode`` is
    "require" and they do not confirm a camera's pose, or if the log has no frame of the name that
    the user gave for the results.
    """
    way = config.input.clocks
    if way == "causal" or (mode == "off" and way == "off"):
        return align_clocks(log, config, reorder), PoseAlignment()
    missing = None if mode == "off" else _missing_poses(log)
    survey = Survey(log, None if missing is None else MOST_S, fixed=missing is None)
    clocks = align_clocks(log, config, reorder, survey.times)
    if missing is not None:
        poses = _from_nothing(survey, clocks, missing)
    else:
        poses = _refined_poses(survey, clocks, mode)
    if clocks.times:
        clocks.take_offsets(poses.cameras)
    return clocks, PoseAlignment() if mode == "off" else poses


def _missing_poses(log: Log) -> LogError | None:
    """Return which poses the log lacks, None if it has all."""
    if log.transforms.frames:
        log.check_fixed_frame()
    try:
        _ = log.fixed_frame
    except LogError as error:
        if any(moves(log, frame) for camera in log.cameras for frame in camera.frames):
            raise
        return error
    return None


def _refined_poses(survey: Survey, clocks: ClockAlignment, mode: Calibration) -> PoseAlignment:
    """Compare the log's poses with those that the people give; use the better ones."""
    log = survey.log
    faults = camera_faults(log)
    free = [camera.name for camera in fixed_cameras(log, faults) if camera.movable]
    if not free and mode != "require" and {*faults.values()} == {SHARED_FRAME}:
        return PoseAlignment()  # everybody is where they are in the room: no pose is used
    if len(free) == 1:
        faults |= {free[0]: _ALONE}
    cameras = sorted(
        camera._replace(movable=camera.movable and mode != "off")
        for camera in fixed_cameras(log, faults)
    )
    posed = PosedViews([], [], [], [])
    if len(cameras) > 1:
        posed = _refined(log, survey.sightings(clocks.corrections), cameras, clocks.lags)
    if mode == "off":
        return _aligned(posed, log.span[0], {})
    posed = split_moved(survey, clocks, posed)
    alignment = _aligned(posed, log.span[0], faults)
    if not faults and _contradicted(posed.cameras, posed.found):
        try:
            return _from_nothing(survey, clocks, None)
        except LogError:
            pass  # the log's poses stay, and the warning says that they do not fit
    if mode == "require":
        _require(log, alignment)
    poses = _poses_used(posed)
    if poses:
        alignment.better = poses, log.fixed_frame
        alignment.to_given = _to_given(posed)
    return alignment


def _aligned(posed: PosedViews, start: int, faults: Mapping[str, str]) -> PoseAlignment:
    """Return what a user should know of the cameras.

    ``start`` is that of the log, ns. ``faults`` say why the poses of some cannot be compared.
    """
    pairs = list(zip(posed.cameras, posed.found, strict=True))
    summaries = [summary_of(one, used=_is_better(one)) for one in posed.found]
    names = [camera.name for camera in posed.cameras]
    for move in posed.moves:
        k, seconds = names.index(move.camera), (move.log_time - start) / 1e9
        summaries[k] = replace(summaries[k], until_s=seconds)
        summaries[k + 1] = replace(summaries[k + 1], since_s=seconds)
    for k, one in enumerate(summaries):
        if one.verdict == "impossible" and one.name in faults:
            summaries[k] = replace(one, reason=faults[one.name])
    summaries += [
        PoseSummary(name, "impossible", reason)
        for name, reason in sorted(faults.items())
        if name not in names
    ]
    misfits = frozenset(camera.name for camera, one in pairs if camera.movable and not one.fits)
    return PoseAlignment(summaries, misfits=misfits, moves=posed.moves)


def _poses_used(posed: PosedViews) -> dict[str, dict[int, Rigid]]:
    """Frame -> poses other than the log's, by the log times from which on they hold."""
    since = {move.camera: move.log_time for move in posed.moves}
    poses: dict[str, dict[int, Rigid]] = {}
    for k, (camera, one) in enumerate(zip(posed.cameras, posed.found, strict=True)):
        if camera.name in since:
            time = since[camera.name] if camera.frame in poses else 0
            poses.setdefault(camera.frame, {})[time] = placed(posed, k)
        elif _is_better(one):
            poses[camera.frame] = {0: placed(posed, k)}
    return poses


def _is_better(camera: CalibratedCamera) -> bool:
    """Whether the people gave the camera a pose in place of the log's."""
    return not math.isnan(camera.moved_mm)


def _to_given(posed: PosedViews) -> dict[str, Rigid]:
    """Camera -> what takes its people back to the log's pose, without those with two poses."""
    twice = {move.camera for move in posed.moves}
    return {
        camera.name: camera.pose @ placed(posed, k).inverse()
        for k, (camera, one) in enumerate(zip(posed.cameras, posed.found, strict=True))
        if _is_better(one) and camera.name not in twice
    }


def pose_faults(log: Log) -> list[str]:
    """Return which poses of a log do not fit the people in it, in one line; [] if all do.

    Only some seconds of the log are read. A log whose cameras cannot be compared has no faults.
    """
    faults = camera_faults(log)
    cameras = sorted(camera for camera in fixed_cameras(log, faults) if camera.movable)
    if len(cameras) < 2:
        return []
    posed = _refined(log, Survey(log, CHECKED_S).sightings({}), cameras, {})
    named = []
    for one in posed.found:
        if not one.fits:
            named.append(f"{one.name}: {one.reason}")
        elif one.moved_deg > WRONG_DEG or one.moved_mm > WRONG_MM:
            named.append(f"{one.name}: {one.moved_deg:.1f} degrees, {one.moved_mm / 10.0:.0f} cm")
    if not named:
        return []
    return [
        f"these poses do not fit the people ({'; '.join(named)}); hiros process uses better ones "
        "where the people tell them, and hiros calibrate people saves them"
    ]


def _require(log: Log, alignment: PoseAlignment) -> None:
    """Raise LogError for a camera whose pose the people do not confirm."""
    for camera in alignment.cameras:
        if camera.verdict not in SURE:
            what = remedy(camera.name, len(alignment.cameras))
            raise LogError(
                f"--calibrate require: {camera.name}: {camera.verdict}: {camera.reason}; {what}",
                path=log.path,
            )


def _refined(
    log: Log,
    seen: Mapping[str, list[Sighting]],
    cameras: Sequence[FixedCamera],
    lags: Mapping[str, float],
) -> PosedViews:
    """Compare the cameras' poses with those that their people give, and find the clocks.

    ``lags`` are those of :attr:`ClockAlignment.lags`. Clocks that are far off are searched for if
    people do not fit, or if the lags suggest it.
    """
    mirror = symmetry_of(log.model).mirror
    poses = [camera.pose for camera in cameras]
    anchor = next((k for k, one in enumerate(cameras) if one.frame == log.fixed_frame), None)

    def refined(shifts: Sequence[float]) -> PosedViews:
        views = [
            seen_by(camera, seen.get(camera.name, []), mirror, shift)
            for camera, shift in zip(cameras, shifts, strict=True)
        ]
        found = refine_poses(views, poses, mirror, anchor, [c.movable for c in cameras])
        return PosedViews(list(cameras), views, *found)

    posed = refined([0.0] * len(cameras))
    hints = [lags.get(camera.name, 0.0) for camera in cameras]
    if _fitting(posed) == len(cameras) and np.ptp(hints) < _DELAY_S:
        return posed
    shifts = coarse_clocks(posed.views, Rig.of(poses), hints, landmarks_of(log.model), mirror)
    again = refined(shifts.tolist()) if shifts.any() else posed
    return again if _fitting(again) >= _fitting(posed) else posed


def _fitting(posed: PosedViews) -> int:
    """Return how many cameras see the people where others see them."""
    return sum(one.fits and one.reason != UNLINKED for one in posed.found)


def _contradicted(cameras: Sequence[FixedCamera], found: Sequence[CalibratedCamera]) -> bool:
    """Whether the people do not fit the given poses, or nobody has measured these."""
    coincide = any(same_place({camera.name: camera.pose for camera in cameras}))
    return any(not one.fits or (coincide and one.verdict == "impossible") for one in found)


def _from_nothing(survey: Survey, clocks: ClockAlignment, error: LogError | None) -> PoseAlignment:
    """Use poses that need no transforms; raise LogError if the people do not tell them."""
    from hiros_mcap.calibrate.people import calibrate_people

    log = survey.log
    try:
        found = calibrate_people(log, survey, clocks.corrections)
    except LogError as reason:
        raise LogError(_not_found(error, reason.fault), path=log.path) from None
    if found.verdict not in SURE:
        raise LogError(_not_found(error, found.reason), path=log.path)
    poses: dict[str, dict[int, Rigid]] = {}
    for camera in found.cameras:
        if camera.pose is not None:
            poses.setdefault(camera.frame, {})[camera.since] = camera.pose
    cameras = [summary_of(camera, used=True) for camera in found.cameras]
    moves, better = tuple(_moves_of(found)), (poses, found.fixed_frame)
    return PoseAlignment(cameras, from_nothing=True, moves=moves, better=better)


def _moves_of(found: PeopleCalibration) -> Iterator[Move]:
    """Yield how cameras were moved."""
    for before, after in pairwise(found.cameras):
        if before.name == after.name and before.pose is not None and after.pose is not None:
            yield Move(after.name, after.since, after.since, *before.pose.apart(after.pose))


def _not_found(error: LogError | None, reason: str) -> str:
    first = "the poses do not fit the people" if error is None else error.fault
    return f"{first}. The people do not tell them: {reason}"


def summary_of(camera: CalibratedCamera, *, used: bool) -> PoseSummary:
    """Return what a user should know of one camera."""
    return PoseSummary(
        name=camera.name,
        verdict=camera.verdict,
        reason=camera.reason,
        used=used,
        moved_mm=camera.moved_mm,
        moved_deg=camera.moved_deg,
        clock_ms=1000.0 * camera.clock_s,
        error_mm=camera.error_mm,
        error_deg=camera.error_deg,
        error_ms=camera.error_ms,
        since_s=camera.since_s,
        until_s=camera.until_s,
    )
