"""Puts cameras where the people say that they stand, before the stages see the detections.

A run of a file compares the log's poses with better ones that the people give
(:mod:`hiros_mcap.calibrate.refinement`), and takes those where they prove themselves. Where the log
has no poses, or poses that the people contradict, they are found from nothing
(:mod:`hiros_mcap.calibrate.people`).
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from hiros_mcap.body.rotations import Rigid
from hiros_mcap.body.symmetry import symmetry_of
from hiros_mcap.body.transforms import same_place
from hiros_mcap.calibrate.camera_views import view_of
from hiros_mcap.calibrate.refinement import RefinedPose, refine_poses
from hiros_mcap.calibrate.tracklets import Sighting
from hiros_mcap.calibrate.verdict import UNLINKED, remedy
from hiros_mcap.errors import LogError
from hiros_mcap.events import Events
from hiros_mcap.io.log import Log
from hiros_mcap.running.clock_alignment import ClockAlignment
from hiros_mcap.running.fixed_cameras import (
    STRETCHES,
    FixedCamera,
    best_sightings,
    camera_faults,
    fixed_cameras,
    moves,
    read_sightings,
    stretches,
)
from hiros_mcap.running.moved_cameras import Move, PosedViews, distance_of, split_moved
from hiros_mcap.running.process_options import Calibration
from hiros_mcap.summary import PoseSummary

if TYPE_CHECKING:
    from hiros_mcap.calibrate.people import PeopleCalibration

MOVED = "camera moved"
CHECKED_S = 10.0
"""So much of a log is read for a quick check."""
WRONG_DEG, WRONG_MM = 1.0, 30.0
"""What a quick check reports: such a pose shows in the results if nobody corrects it."""

_LEAST_CLOCK_MS = 10.0
"""Smaller offsets are left: a person who walks is then off by 1 cm, less than the joints are."""
_SURE_CLOCK = 3.0
"""An offset counts if it is so many standard errors long."""

_ALONE = "no other camera stands still in a frame of its own"


@dataclass(slots=True)
class PoseAlignment:
    """The poses of a run's cameras."""

    cameras: list[PoseSummary] = field(default_factory=list)
    from_nothing: bool = False
    """Whether they were found from the people alone."""
    misfits: frozenset[str] = frozenset()
    """Cameras whose people are not where the others see them."""
    clocks: Mapping[str, float] = field(default_factory=dict)
    """Camera -> s to add to its stamps, found together with poses from nothing."""
    moves: tuple[Move, ...] = ()
    """Cameras that were moved in the middle of the log."""
    to_given: Mapping[str, Rigid] = field(default_factory=dict)
    """Camera -> what takes its people back to the log's pose, where the run uses a better one."""

    def clock_offsets(self, given: Collection[str]) -> dict[str, float]:
        """Return by how many seconds the clocks of cameras are ahead, where the people prove it.

        ``given`` are the cameras whose clocks the user has set: the others are compared with
        these. Without any, the median clock counts as right.
        """
        measured = {c.name: c for c in sorted(self.cameras, key=_clock_error) if _has_clock(c)}
        right = [camera.clock_ms for name, camera in measured.items() if name in given]
        middle = float(np.median(right)) if right else 0.0
        behind = {name: camera.clock_ms - middle for name, camera in measured.items()}
        return {
            name: -behind[name] / 1000.0
            for name, camera in measured.items()
            if name not in given
            and abs(behind[name]) > max(_LEAST_CLOCK_MS, _SURE_CLOCK * camera.error_ms)
        }

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
        for camera in self.cameras:
            if camera.reason == UNLINKED and len(self.cameras) > 1:
                yield (
                    f"{camera.name} {UNLINKED}; if it should, its pose is wrong, and hiros "
                    "calibrate people may find it"
                )


def _has_clock(camera: PoseSummary) -> bool:
    """Whether the people show the camera's clock, and nothing speaks against its pose."""
    return camera.verdict in ("good", "improved") and not math.isnan(camera.clock_ms)


def _clock_error(camera: PoseSummary) -> float:
    """Return a key that puts the surest clock of a moved camera last."""
    return -camera.error_ms


def find_missing_poses(log: Log, mode: Calibration) -> PoseAlignment | None:
    """Find the poses of a log that has none; return None if it has.

    Raises LogError if the people do not tell them, or the log has no frame of the name that the
    user gave for the results.
    """
    if mode == "off":
        return None
    if log.transforms.frames:
        log.check_fixed_frame()
    try:
        _ = log.fixed_frame
    except LogError as error:
        if any(moves(log, frame) for camera in log.cameras for frame in camera.frames):
            raise
        return _from_nothing(log, error)
    return None


def align_poses(log: Log, clocks: ClockAlignment, mode: Calibration) -> PoseAlignment:
    """Compare the log's poses with those that the people give; use the better ones.

    ``clocks`` are those of the run.

    Raises LogError if ``mode`` is "require" and the people do not confirm a camera's pose.
    """
    if mode == "off":
        return PoseAlignment()
    faults = camera_faults(log)
    cameras = sorted(fixed_cameras(log, faults))
    posed = PosedViews([], [], [])
    if len(cameras) > 1:
        posed = _refined(log, best_sightings(log, clocks), cameras)
        posed = split_moved(log, clocks, posed)
    else:
        faults |= {camera.name: _ALONE for camera in cameras}
    alignment = _aligned(posed, log.span[0])
    alignment.cameras += [
        PoseSummary(name, "impossible", reason) for name, reason in sorted(faults.items())
    ]
    if not faults and _contradicted(posed.cameras, posed.found):
        try:
            return _from_nothing(log, None)
        except LogError:
            pass  # the log's poses stay, and the warning says that they do not fit
    if mode == "require":
        _require(log, alignment)
    poses = _poses_used(posed)
    if poses:
        log.use_poses(poses, log.fixed_frame)
        alignment.to_given = _to_given(posed)
    return alignment


def _aligned(posed: PosedViews, start: int) -> PoseAlignment:
    """Return what a user should know of the cameras; ``start`` is that of the log, ns."""
    pairs = list(zip(posed.cameras, posed.found, strict=True))
    summaries = [summary_of(camera, one) for camera, one in pairs]
    names = [camera.name for camera in posed.cameras]
    for move in posed.moves:
        k, seconds = names.index(move.camera), (move.log_time - start) / 1e9
        summaries[k] = replace(summaries[k], until_s=seconds)
        summaries[k + 1] = replace(summaries[k + 1], since_s=seconds)
    misfits = frozenset(camera.name for camera, one in pairs if not one.fits)
    return PoseAlignment(summaries, misfits=misfits, moves=posed.moves)


def _poses_used(posed: PosedViews) -> dict[str, dict[int, Rigid]]:
    """Frame -> poses other than the log's, by the log times from which on they hold."""
    since = {move.camera: move.log_time for move in posed.moves}
    poses: dict[str, dict[int, Rigid]] = {}
    for camera, one in zip(posed.cameras, posed.found, strict=True):
        if camera.name in since:
            time = since[camera.name] if camera.frame in poses else 0
            poses.setdefault(camera.frame, {})[time] = one.pose or camera.pose
        elif one.pose is not None:
            poses[camera.frame] = {0: one.pose}
    return poses


def _to_given(posed: PosedViews) -> dict[str, Rigid]:
    """Camera -> what takes its people back to the log's pose, without those with two poses."""
    twice = {move.camera for move in posed.moves}
    return {
        camera.name: camera.pose @ one.pose.inverse()
        for camera, one in zip(posed.cameras, posed.found, strict=True)
        if one.pose is not None and camera.name not in twice
    }


def pose_faults(log: Log) -> list[str]:
    """Return which poses of a log do not fit the people in it, in one line; [] if all do.

    Only some seconds of the log are read. A log whose cameras cannot be compared has no faults.
    """
    faults = camera_faults(log)
    cameras = sorted(fixed_cameras(log, faults))
    if len(cameras) < 2:
        return []
    parts = stretches(*log.span, CHECKED_S, STRETCHES)
    seen = read_sightings(log, ClockAlignment(), parts)
    posed = _refined(log, seen, cameras)
    named = []
    for camera, one in zip(cameras, posed.found, strict=True):
        moved = summary_of(camera, one)
        if not one.fits:
            named.append(f"{camera.name}: {one.reason}")
        elif moved.moved_deg > WRONG_DEG or moved.moved_mm > WRONG_MM:
            off = f"{moved.moved_deg:.1f} degrees, {moved.moved_mm / 10.0:.0f} cm"
            named.append(f"{camera.name}: {off}")
    if not named:
        return []
    return [
        f"these poses do not fit the people ({'; '.join(named)}); hiros process uses better ones "
        "where the people tell them, and hiros calibrate people saves them"
    ]


def _require(log: Log, alignment: PoseAlignment) -> None:
    """Raise LogError for a camera whose pose the people do not confirm."""
    for camera in alignment.cameras:
        if camera.verdict not in ("good", "improved"):
            what = remedy(camera.name, len(alignment.cameras))
            raise LogError(
                f"--calibrate require: {camera.name}: {camera.verdict}: {camera.reason}; {what}",
                path=log.path,
            )


def _refined(
    log: Log, seen: Mapping[str, list[Sighting]], cameras: Sequence[FixedCamera]
) -> PosedViews:
    """Compare the cameras' poses with those that their people give."""
    mirror = symmetry_of(log.model).mirror
    anchors = [k for k, camera in enumerate(cameras) if camera.frame == log.fixed_frame]
    views = [view_of(c.name, c.frame, seen.get(c.name, []), mirror) for c in cameras]
    poses = [camera.pose for camera in cameras]
    found = refine_poses(views, poses, mirror, anchors[0] if anchors else None)
    return PosedViews(list(cameras), views, found)


def _contradicted(cameras: Sequence[FixedCamera], found: Sequence[RefinedPose]) -> bool:
    """Whether the people do not fit the given poses, or nobody has measured these."""
    coincide = any(same_place({camera.name: camera.pose for camera in cameras}))
    return any(not one.fits or (coincide and one.verdict == "impossible") for one in found)


def _from_nothing(log: Log, error: LogError | None) -> PoseAlignment:
    """Use poses that need no transforms; raise LogError if the people do not tell them."""
    from hiros_mcap.calibrate.people import calibrate_people

    try:
        found = calibrate_people(log)
    except LogError as reason:
        raise LogError(_not_found(error, reason.fault), path=log.path) from None
    if found.verdict not in ("good", "improved"):
        raise LogError(_not_found(error, found.reason), path=log.path)
    poses: dict[str, dict[int, Rigid]] = {}
    for camera in found.cameras:
        if camera.pose is not None:
            poses.setdefault(camera.frame, {})[camera.since] = camera.pose
    log.use_poses(poses, found.fixed_frame)
    cameras = [
        PoseSummary(
            name=camera.name,
            verdict=camera.verdict,
            used=True,
            moved_mm=camera.moved_mm,
            moved_deg=camera.moved_deg,
            clock_ms=1000.0 * camera.clock_s,
            error_mm=camera.error_mm,
            error_deg=camera.error_deg,
            error_ms=camera.error_ms,
            since_s=camera.since_s,
            until_s=camera.until_s,
        )
        for camera in found.cameras
    ]
    clocks = {c.name: c.clock_s for c in found.cameras if not math.isnan(c.clock_s)}
    moves = tuple(_moves_of(found))
    return PoseAlignment(cameras, from_nothing=True, clocks=clocks, moves=moves)


def _moves_of(found: PeopleCalibration) -> Iterator[Move]:
    """Yield how cameras were moved."""
    for before, after in pairwise(found.cameras):
        if before.name == after.name and before.pose is not None and after.pose is not None:
            metres, degrees = distance_of(before.pose, after.pose)
            yield Move(after.name, after.since, after.since, metres, degrees)


def _not_found(error: LogError | None, reason: str) -> str:
    first = "the poses do not fit the people" if error is None else error.fault
    return f"{first}. The people do not tell them: {reason}"


def summary_of(camera: FixedCamera, found: RefinedPose) -> PoseSummary:
    """Return what a user should know of one camera."""
    degrees = metres = math.nan
    if found.pose is not None:
        metres, degrees = distance_of(found.pose, camera.pose)
    return PoseSummary(
        name=camera.name,
        verdict=found.verdict,
        reason=found.reason,
        used=found.pose is not None,
        moved_mm=1000.0 * metres,
        moved_deg=degrees,
        clock_ms=1000.0 * found.clock_s,
        error_mm=1000.0 * found.error_m,
        error_deg=found.error_deg,
        error_ms=1000.0 * found.error_s,
    )
