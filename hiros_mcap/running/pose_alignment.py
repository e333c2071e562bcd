"""Puts cameras where the people say that they stand, before the stages see the detections.

A run of a file compares the log's poses with better ones that the people give
(:mod:`hiros_mcap.calibrate.refinement`), and takes those where they prove themselves. Where the log
has no poses, or poses that the people contradict, they are found from nothing
(:mod:`hiros_mcap.calibrate.people`).
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from hiros_mcap.body.rotations import Rigid, angle
from hiros_mcap.body.symmetry import symmetry_of
from hiros_mcap.body.transforms import same_place
from hiros_mcap.calibrate.camera_views import sightings_of, view_of
from hiros_mcap.calibrate.refinement import RefinedPose, refine_poses
from hiros_mcap.calibrate.tracklets import Sighting
from hiros_mcap.calibrate.verdict import UNLINKED, remedy
from hiros_mcap.errors import LogError
from hiros_mcap.io.log import Log
from hiros_mcap.running.clock_alignment import ClockAlignment
from hiros_mcap.running.process_options import Calibration
from hiros_mcap.summary import PoseSummary

LONGEST_S, SHORTEST_S = 20.0, 12.0
"""So many seconds of a log are read, in stretches: half of it, within these limits."""
STRETCHES = 5
ENOUGH = 0.75
"""If the stretches show people in a smaller share of their time, more of the log is read."""
MOST_S = 120.0
SPACING_NS = 45_000_000
"""More frames tell little: the slow part of a detector's errors is the larger one."""
ODD_S = 10.0
CHECKED_S = 10.0
"""So much of a log is read for a quick check."""
WRONG_DEG, WRONG_MM = 1.0, 30.0
"""What a quick check reports: such a pose shows in the results if nobody corrects it."""

_MOVES = "its pose changes during the log, and only cameras at rest can be compared"
_SHARED = "its detections are in a frame that is not its own"
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
    moved: Mapping[str, Rigid] = field(default_factory=dict)
    """Camera -> what takes its people back to the log's pose, where the run uses a better one."""

    @property
    def replaced(self) -> bool:
        """Whether the run uses poses other than the log's."""
        return any(camera.used for camera in self.cameras)

    def warnings(self) -> Iterator[str]:
        """Yield what makes the poses doubtful, and the remedy."""
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


class _Fixed(NamedTuple):
    """A camera that stands still in a frame of its own."""

    name: str
    frame: str
    pose: Rigid


def find_missing_poses(log: Log, mode: Calibration) -> PoseAlignment | None:
    """Find the poses of a log that has none; return None if it has.

    Raises LogError if the people do not tell them.
    """
    if mode == "off":
        return None
    try:
        _ = log.fixed_frame
    except LogError as error:
        if any(_moves(log, frame) for camera in log.cameras for frame in camera.frames):
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
    faults = _faults(log)
    cameras = sorted(_cameras(log, faults))
    found: list[RefinedPose] = []
    if len(cameras) > 1:
        found = _refined(log, _best_sightings(log, clocks), cameras)
    else:
        faults |= {camera.name: _ALONE for camera in cameras}
    alignment = PoseAlignment(
        [_summary(camera, one) for camera, one in zip(cameras, found, strict=False)]
        + [PoseSummary(name, "impossible", reason) for name, reason in sorted(faults.items())],
        misfits=frozenset(c.name for c, one in zip(cameras, found, strict=False) if not one.fits),
    )
    if not faults and _contradicted(cameras, found):
        try:
            return _from_nothing(log, None)
        except LogError:
            pass  # the log's poses stay, and the warning says that they do not fit
    poses = {c.frame: one.pose for c, one in zip(cameras, found, strict=False) if one.pose}
    if mode == "require":
        _require(log, alignment)
    if poses:
        log.use_poses(poses, log.fixed_frame)
        alignment.moved = {
            c.name: c.pose @ one.pose.inverse()
            for c, one in zip(cameras, found, strict=False)
            if one.pose
        }
    return alignment


def pose_faults(log: Log) -> list[str]:
    """Return which poses of a log do not fit the people in it, in one line; [] if all do.

    Only some seconds of the log are read. A log whose cameras cannot be compared has no faults.
    """
    faults = _faults(log)
    cameras = sorted(_cameras(log, faults))
    if len(cameras) < 2:
        return []
    parts = stretches(*log.span, CHECKED_S, STRETCHES)
    seen = _sightings(log, ClockAlignment(), parts)
    found = _refined(log, seen, cameras)
    named = []
    for camera, one in zip(cameras, found, strict=True):
        moved = _summary(camera, one)
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


def _faults(log: Log) -> dict[str, str]:
    """Name -> reason of each camera whose pose cannot be compared with the others'."""
    faults: dict[str, str] = {}
    owners = Counter(frame for camera in log.cameras for frame in camera.frames)
    for camera in log.cameras:
        frames = camera.frames
        shared = len(frames) != 1 or len(camera.sources) != 1 or owners[frames[0]] > 1
        if shared or _moves(log, frames[0]):
            faults |= dict.fromkeys(camera.sources.values(), _SHARED if shared else _MOVES)
    return faults


def _cameras(log: Log, faults: Mapping[str, str]) -> Iterator[_Fixed]:
    """Yield the cameras that stand still in frames of their own."""
    fixed = log.fixed_frame
    for camera in log.cameras:
        for name in camera.sources.values():
            if name not in faults:
                pose = log.transforms.at_rest(camera.frames[0], fixed)
                yield _Fixed(name, camera.frames[0], pose or Rigid.identity())


def _moves(log: Log, frame: str) -> bool:
    """Whether the log knows how a frame moves."""
    if frame not in log.transforms.frames:
        return False
    return log.transforms.at_rest(frame, log.transforms.root(frame)) is None


def _refined(
    log: Log, seen: Mapping[str, list[Sighting]], cameras: Sequence[_Fixed]
) -> list[RefinedPose]:
    """Compare the cameras' poses with those that their people give."""
    mirror = symmetry_of(log.model).mirror
    anchors = [k for k, camera in enumerate(cameras) if camera.frame == log.fixed_frame]
    views = [view_of(c.name, c.frame, seen.get(c.name, []), mirror) for c in cameras]
    poses = [camera.pose for camera in cameras]
    return refine_poses(views, poses, mirror, anchors[0] if anchors else None)


def _best_sightings(log: Log, clocks: ClockAlignment) -> Mapping[str, list[Sighting]]:
    """Return whom the cameras see, at corrected times, in enough of the log."""
    start, end = log.span
    seconds = float(np.clip((end - start) / 2e9, SHORTEST_S, LONGEST_S))
    parts = stretches(start, end, seconds, STRETCHES)
    seen = _sightings(log, clocks, parts)
    if len(parts) > 1 and _seconds_with_people(seen) < ENOUGH * seconds:
        seen = _sightings(log, clocks, stretches(start, end, MOST_S, STRETCHES))
    return seen


def stretches(start: int, end: int, seconds: float, n: int) -> list[tuple[int, int]]:
    """Return n spans of a log, ns, that are ``seconds`` long together; all of a short log."""
    length = end - start
    if length <= 1e9 * seconds:
        return [(start, end)]
    part, piece = length / n, 1e9 * seconds / n
    begins = [round(start + k * part + (part - piece) / 2.0) for k in range(n)]
    return [(begin, begin + round(piece)) for begin in begins]


def _sightings(
    log: Log, clocks: ClockAlignment, spans: Sequence[tuple[int, int]]
) -> dict[str, list[Sighting]]:
    """Camera -> whom it sees in some spans of log times, ns.

    Left out is what a camera stamped at quite another time than most: its clock is no clock.
    """
    start, end = log.span
    seen: dict[str, list[Sighting]] = {}
    latest: dict[str, int] = {}
    for block in clocks.correct(log.camera_blocks(spans)):
        chosen = []
        for stamp, source, log_time, (_, i) in block.messages():
            inside = any(begin <= log_time <= until for begin, until in spans)
            if inside and not 0 <= stamp - latest.get(source, 0) < SPACING_NS:
                latest[source] = stamp
                chosen.append(i)
        for i, sighting in zip(chosen, sightings_of(block, chosen, start), strict=True):
            seen.setdefault(block.sources[i], []).append(sighting)
    times = [s.seconds for some in seen.values() for s in some]
    middle, most = float(np.median(times)) if times else 0.0, (end - start) / 1e9 + ODD_S
    return {
        name: [s for s in some if abs(s.seconds - middle) < most] for name, some in seen.items()
    }


def _seconds_with_people(seen: Mapping[str, Sequence[Sighting]]) -> int:
    """Return in how many seconds at least two cameras see somebody."""
    times = Counter(
        second
        for some in seen.values()
        for second in {int(s.seconds // 1.0) for s in some if len(s.positions)}
    )
    return sum(n > 1 for n in times.values())


def _contradicted(cameras: Sequence[_Fixed], found: Sequence[RefinedPose]) -> bool:
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
    poses = {camera.frame: camera.pose for camera in found.cameras if camera.pose is not None}
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
        )
        for camera in found.cameras
    ]
    clocks = {c.name: c.clock_s for c in found.cameras if not math.isnan(c.clock_s)}
    return PoseAlignment(cameras, from_nothing=True, clocks=clocks)


def _not_found(error: LogError | None, reason: str) -> str:
    first = "the poses do not fit the people" if error is None else error.fault
    return f"{first}. The people do not tell them: {reason}"


def _summary(camera: _Fixed, found: RefinedPose) -> PoseSummary:
    """Return what a user should know of one camera."""
    degrees = metres = math.nan
    if found.pose is not None:
        degrees = math.degrees(float(angle(found.pose.xyzw, camera.pose.xyzw)))
        metres = float(np.linalg.norm(found.pose.translation - camera.pose.translation))
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
