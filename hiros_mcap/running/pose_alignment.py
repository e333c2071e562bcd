"""Puts cameras where the people say that they stand, before the stages see the detections.

A run of a file compares the log's poses with better ones that the people give
(:mod:`hiros_mcap.calibrate.refinement`), and takes those where they prove themselves. Where the log
has no poses, or poses that the people contradict, they are found from nothing
(:mod:`hiros_mcap.calibrate.people`).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from operator import attrgetter
from typing import TYPE_CHECKING

from hiros_mcap.body.rotations import Rigid
from hiros_mcap.body.symmetry import symmetry_of
from hiros_mcap.body.transforms import TimedPoses, same_place
from hiros_mcap.calibrate.given_poses import (
    Move,
    PosedViews,
    compare_poses,
    is_better,
    with_strays,
)
from hiros_mcap.calibrate.guessed_depth import DepthErrors, guessing_cameras
from hiros_mcap.calibrate.moved_cameras import split_moved
from hiros_mcap.calibrate.survey import (
    MOST_S,
    Survey,
    camera_faults,
    fixed_cameras,
    moves,
    names_of,
    shared_frames,
    with_own_frames,
)
from hiros_mcap.calibrate.verdict import (
    CONFIRMED,
    GRADES,
    SURE,
    UNLINKED,
    CalibratedCamera,
    remedy,
)
from hiros_mcap.config import Config
from hiros_mcap.errors import LogError
from hiros_mcap.events import CAMERA_MOVED, Event, Events
from hiros_mcap.io.log import Log
from hiros_mcap.running.clock_alignment import ClockAlignment, align_clocks
from hiros_mcap.running.process_options import Calibration
from hiros_mcap.running.shared_frames import agreements, mended, said, shared_wrongly
from hiros_mcap.running.summary import PoseSummary

if TYPE_CHECKING:
    from hiros_mcap.calibrate.people import PeopleCalibration

CHECKED_S = 10.0
"""So much of a log is read for a quick check."""
WRONG_DEG, WRONG_MM = 1.0, 30.0
"""Least error of a pose that a quick check reports: it shows in the results if it stays."""

_ENOUGH = 2  # cameras

_NOWHERE = (
    "all cameras stand at the same place with the same orientation, so that nobody has measured "
    "their poses (--calibrate off uses them all the same)"
)
_AS_THEY_ARE = "--calibrate off takes them as they are"
_DOUBTFUL = (
    "hiros calibrate people LOG -o cameras.toml writes what is known of doubtful poses, and "
    "--extrinsics cameras.toml uses them"
)
_GAUGES = "the room's origin is arbitrary", "its transforms only place the rig in the room"
_ALONE = "no other camera stands still in a frame of its own"


@dataclass(slots=True)
class PoseAlignment:
    """The poses of a run's cameras."""

    cameras: list[PoseSummary] = field(default_factory=list)
    calibration: PeopleCalibration | None = None
    """The calibration by people, if the poses were found from them alone."""
    misfits: frozenset[str] = frozenset()  # cameras whose people are not where the others see them
    moves: tuple[Move, ...] = ()  # cameras that were moved in the middle of the log
    late: Event | None = None  # a camera that was moved for too short a time to tell a pose
    alike: tuple[list[str], ...] = ()
    """Cameras that the log puts at one place with one orientation, where the people do not."""
    contradictions: tuple[str, ...] = ()
    """Cameras that publish in one frame, and do not see the same people at one place in it."""
    agreements: tuple[str, ...] = ()
    """Cameras that publish in one frame, and see the same people at one place in it."""
    own_frames: frozenset[str] = frozenset()
    """Topics whose detections are in a frame that is called as the topic, whatever they name."""
    poses_of: str = "the log"  # source of the poses that the people's replaced
    to_given: Mapping[str, Rigid] = field(default_factory=dict)
    """Camera -> motion of its people back to the log's pose, where the run uses a better one."""
    better: tuple[Mapping[str, TimedPoses], str] | None = None
    """Poses of frames that the run uses in place of the log's, and the frame that they are in."""

    left_out: frozenset[str] = frozenset()
    """Cameras whose poses nobody knows, so that the run does without them."""
    guessed: Mapping[str, DepthErrors] = field(default_factory=dict)
    """Cameras that guess depths, which nothing else was found for: to be taken as rays."""

    def used_in(self, log: Log) -> Log:
        """Return the log with the frames, the poses, and of the cameras, that the run uses."""
        log = log.with_own_frames(self.own_frames)
        if self.left_out:
            seeing = [c for c in log.cameras if not set(c.sources.values()) <= self.left_out]
            log = log.only([camera.channel.topic for camera in seeing])
        return log.with_poses(*self.better) if self.better else log

    @property
    def from_nothing(self) -> bool:
        """Whether the poses were found from the people alone."""
        return self.calibration is not None

    @property
    def replaced(self) -> bool:
        """Whether the run uses poses other than the log's."""
        return any(camera.used for camera in self.cameras)

    @property
    def misplaced(self) -> frozenset[str]:
        """The misfits if others fit each other: of two cameras, nobody knows which is wrong."""
        possible = {camera.name for camera in self.cameras if camera.verdict != "impossible"}
        return self.misfits if len(possible - self.misfits) >= _ENOUGH else frozenset()

    @property
    def errors(self) -> dict[str, float]:
        """Camera -> standard error, m, of the pose that the people gave it; of two, the larger."""
        known = [c for c in self.cameras if c.used and not math.isnan(c.error_mm)]
        known.sort(key=attrgetter("error_mm"))
        return {camera.name: camera.error_mm / 1000.0 for camera in known}

    def note_events(self, events: Events) -> None:
        """Note the cameras that were moved."""
        for move in self.moves:
            events.note(move.stamp, CAMERA_MOVED, source=move.camera, detail=move.distance)
        if self.late:
            events.log.append(self.late)

    def warnings(self) -> Iterator[str]:
        """Yield what makes the poses doubtful, and the remedy."""
        since = {c.name: c.since_s for c in self.cameras if not math.isnan(c.since_s)}
        for move in self.moves:
            yield (
                f"{move.camera} was moved by {move.distance} at {since[move.camera]:.1f} s; hiros "
                "found its pose for each part of the log. Calibrate it anew before you record "
                "again: hiros calibrate people"
            )
        if self.calibration is not None:
            yield (
                f"the cameras' poses come from the people, because {self.poses_of} has none that "
                f"fit them; {_GAUGES[self.calibration.gauge == 'transforms']}. `hiros calibrate "
                "people` saves them for other logs"
            )
        for names in self.alike:
            yield (
                f"the log has one pose for {' and '.join(names)}, so that nobody has measured it"
            )
        yield from self.contradictions
        if self.calibration is not None:
            yield from _weak_poses(self.calibration, self.left_out)
        for camera in self.cameras:
            if camera.name in self.misfits:
                nobody = ", and counts nobody whom it alone shows" * (camera.name in self.misplaced)
                yield (
                    f"{camera.name}: its pose does not fit the people ({camera.reason}); hiros "
                    f"kept it{nobody}. Calibrate the camera anew, or pass its pose with "
                    "--extrinsics FILE"
                )

    def notes(self, *, found: bool) -> Iterator[str]:
        """Yield what was done, and what nothing confirms.

        Where nobody was ``found``, no view tells whether cameras see the same people.
        """
        yield from self.agreements
        for camera in (c for c in self.cameras if found and c.reason == UNLINKED):
            yield (
                f"{camera.name} {camera.reason}; if it should, its pose is wrong, and people "
                "may appear twice. hiros calibrate people may find it"
            )
        if self.replaced and not self.from_nothing:
            yield (
                "hiros moved the cameras to where they see the same people at the same place; "
                "--calibrate off keeps the log's poses"
            )


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
    way, rays = config.input.clocks, config.input.rays == "found"
    if way == "causal" or (mode == "off" and way == "off"):
        fault = "" if log.is_live else _quick_survey(log)[0].left_handed
        poses = PoseAlignment(contradictions=tuple(filter(None, [fault])))
        return align_clocks(log, config, reorder), poses
    missing = None if mode == "off" else _missing_poses(log)
    survey = Survey(log, None if missing is None else MOST_S, fixed=missing is None)
    clocks = align_clocks(log, config, reorder, survey.times)
    if survey.left_handed and mode != "off":
        raise LogError(f"{survey.left_handed}; {_AS_THEY_ARE}", path=log.path)
    if missing is not None:
        poses = _from_nothing(survey, clocks, missing, mode)
    elif mode == "off":
        poses = _compared(survey, clocks, rays=rays and not survey.left_handed)
        contradictions = *filter(None, [survey.left_handed]), *poses.contradictions
        kept = PoseAlignment(contradictions=contradictions, agreements=poses.agreements)
    else:
        poses = _refined_poses(survey, clocks, mode, moved=config.input.moved, rays=rays)
    if poses.guessed:
        return clocks, poses
    if clocks.times:
        poses = replace(poses, cameras=clocks.take_offsets(poses.cameras))
    return clocks, kept if mode == "off" else poses


def _missing_poses(log: Log) -> LogError | None:
    """Return which poses the log lacks, or why those that it has cannot be; None if it has all."""
    if log.transforms.frames:
        log.check_fixed_frame()
    try:
        _ = log.fixed_frame
    except LogError as error:
        if any(moves(log, frame) for camera in log.cameras for frame in camera.frames):
            raise
        return error
    return LogError(log.far_apart, path=log.path) if log.far_apart else None


def _compared(survey: Survey, clocks: ClockAlignment, *, rays: bool) -> PoseAlignment:
    """Compare the log's poses as they are with the people, for the clocks alone.

    ``rays`` : as of :func:`_refined_poses`.
    """
    cameras = sorted(fixed_cameras(survey.log, camera_faults(survey.log)))
    fixed = [camera._replace(movable=False) for camera in cameras]
    posed = compare_poses(survey, clocks.corrections, fixed, clocks.lags)
    as_they_are = replace(posed, cameras=cameras)
    if rays and (guessed := guessing_cameras(as_they_are, symmetry_of(survey.log.model).mirror)):
        return PoseAlignment(guessed=guessed)
    alignment = _aligned(posed, survey.log.span[0], {})
    contradictions = tuple(map(said, shared_wrongly(survey.log, posed.rig).items()))
    return replace(
        alignment, contradictions=contradictions, agreements=agreements(survey.log, posed.rig)
    )


def _refined_poses(
    survey: Survey, clocks: ClockAlignment, mode: Calibration, *, moved: bool, rays: bool
) -> PoseAlignment:
    """Compare the log's poses with those that the people give; use the better ones.

    ``moved``, ``rays`` : whether to look for cameras that were moved, and that guess depths.
    """
    log = survey.log
    faults = camera_faults(log)
    free = [camera.name for camera in fixed_cameras(log, faults) if camera.movable]
    if len(free) == 1:
        faults |= {free[0]: _ALONE}
    posed = compare_poses(survey, clocks.corrections, fixed_cameras(log, faults), clocks.lags)
    if rays and (guessed := guessing_cameras(posed, symmetry_of(log.model).mirror)):
        return PoseAlignment(guessed=guessed)
    if separated := _separated(survey, clocks, mode, posed):
        return separated
    if not free and mode != "require" and all(camera.reason == UNLINKED for camera in posed.rig):
        return PoseAlignment()  # nothing tells a pose, and none is used: all are in one frame
    posed = split_moved(survey, clocks.corrections, posed) if moved else posed
    posed = posed if posed.moves else with_strays(survey, clocks.corrections, posed)
    alike = [] if faults else same_place({camera.name: camera.pose for camera in posed.cameras})
    if not faults and (anew := _found_anew(survey, clocks, mode, posed, alike)):
        return anew
    alignment = _aligned(posed, log.span[0], faults)
    alignment.agreements = agreements(log, posed.rig)
    if mode == "require":
        _require(log, alignment)
    if poses := posed.poses_used():
        alignment.better = poses, log.fixed_frame
        alignment.to_given = posed.to_given()
    return alignment


def _found_anew(
    survey: Survey, clocks: ClockAlignment, mode: Calibration, posed: PosedViews,
    alike: list[list[str]],
) -> PoseAlignment | None:  # fmt: skip
    """Return poses that the people alone give, where those of the log cannot be.

    ``alike`` are the cameras with one pose, in groups. Without an answer the log's poses stay, and
    a warning says that they do not fit; raises LogError if all cameras are at one place.
    """
    misfit = any(not camera.fits for camera in posed.rig)
    impossible = any(camera.verdict == "impossible" for camera in posed.rig)
    if not misfit and not (alike and impossible):
        return None
    nowhere = misfit and any(len(group) == len(posed.cameras) for group in alike)
    error = LogError(_NOWHERE, path=survey.log.path) if nowhere else None
    try:
        wrong = mode != "require" and len(posed.linked) < _ENOUGH
        anew = _from_nothing(survey, clocks, error, mode, contradicted=wrong)
        return replace(anew, alike=tuple(alike))
    except LogError:
        if nowhere:
            raise
        return None


def _separated(
    survey: Survey, clocks: ClockAlignment, mode: Calibration, posed: PosedViews
) -> PoseAlignment | None:
    """Return poses of channels that share a frame, but do not see people at one place in it.

    Each gets a frame of its own. None if all channels see the same people at one place. If they do
    not see the same people at all, they keep the frame unless people prove that they do elsewhere.

    Raises LogError if the frame is wrong, and the people do not tell the poses.
    """
    log, wrong = survey.log, shared_wrongly(survey.log, posed.rig)
    strangers = {camera.name for camera in posed.rig if camera.reason == UNLINKED}
    shared = {frame: names_of(cameras) for frame, cameras in shared_frames(log).items()}
    frames = [frame for frame, names in shared.items() if frame in wrong or strangers & set(names)]
    if not frames:
        return None
    error = LogError("; ".join(map(said, wrong.items())), path=log.path) if wrong else None
    try:
        return _from_nothing(survey, clocks, error, mode, frames)
    except LogError:
        if wrong:
            raise
        return None


def _aligned(posed: PosedViews, start: int, faults: Mapping[str, str]) -> PoseAlignment:
    """Return what a user should know of the cameras.

    ``start`` is that of the log, ns. ``faults`` say why the poses of some cannot be compared.
    """
    pairs = list(zip(posed.cameras, posed.rig, strict=True))
    names = [camera.name for camera in posed.cameras]
    moved = {move.camera: (move.log_time - start) / 1e9 for move in posed.moves}
    summaries = []
    for k, (name, camera) in enumerate(zip(names, posed.rig, strict=True)):
        summary, at = summary_of(camera, used=is_better(camera)), moved.get(name, math.nan)
        is_first = k == names.index(name)
        since, until = (math.nan, at) if is_first else (at, math.nan)
        summaries.append(replace(summary, since_s=since, until_s=until))
    for k, summary in enumerate(summaries):
        if summary.verdict == "impossible" and summary.name in faults:
            summaries[k] = replace(summary, reason=faults[summary.name])
    summaries += [
        PoseSummary(name, "impossible", reason)
        for name, reason in sorted(faults.items())
        if name not in names
    ]
    misfits = frozenset(
        camera.name for camera, calibrated in pairs if camera.movable and not calibrated.fits
    )
    return PoseAlignment(summaries, misfits=misfits, moves=posed.moves, late=posed.late)


def _quick_survey(log: Log) -> tuple[Survey, bool]:
    """Return a look at some seconds of a log, and whether its poses can be those of cameras."""
    try:
        known = bool(log.fixed_frame) and not log.far_apart
    except LogError:
        known = False
    return Survey(log, CHECKED_S, fixed=known), known


def pose_faults(log: Log) -> list[str]:
    """Return which poses of a log do not fit the people in it, in one line; [] if all do.

    Only some seconds of the log are read. A log whose cameras cannot be compared has no faults.
    """
    survey, known = _quick_survey(log)
    if survey.left_handed or not known:
        return [*filter(None, [survey.left_handed])]
    faults, shared = camera_faults(log), shared_frames(log)
    cameras = sorted(camera for camera in fixed_cameras(log, faults) if camera.movable or shared)
    if len(cameras) < 2:
        return []
    posed = compare_poses(survey, {}, cameras, {})
    if wrong := shared_wrongly(log, posed.rig, or_alone=True):
        give = "hiros process and hiros calibrate people give each channel a frame of its own"
        return [f"{said(frame)}. {give}, if the people tell the poses" for frame in wrong.items()]
    named = []
    for camera in posed.rig:
        if not camera.fits:
            named.append(f"{camera.name}: {camera.reason}")
        elif camera.moved_deg > WRONG_DEG or camera.moved_mm > WRONG_MM:
            named.append(
                f"{camera.name}: {camera.moved_deg:.1f} degrees, {camera.moved_mm / 10.0:.0f} cm"
            )
    if not named:
        return []
    return [
        f"these poses do not fit the people ({'; '.join(named)}); hiros process uses better ones "
        "where the people tell them, and hiros calibrate people saves them"
    ]


def _require(log: Log, alignment: PoseAlignment) -> None:
    """Raise LogError for a camera whose pose the people do not confirm."""
    for camera in alignment.cameras:
        if camera.verdict not in CONFIRMED:
            advice = remedy(camera.name)
            raise LogError(
                f"--calibrate require: {camera.name}: {camera.verdict}: {camera.reason}; {advice}",
                path=log.path,
            )


def _from_nothing(
    survey: Survey, clocks: ClockAlignment, error: LogError | None, mode: Calibration,
    frames: Iterable[str] | None = None, *, contradicted: bool = False,
) -> PoseAlignment:  # fmt: skip
    """Use poses that need no transforms; raise LogError if the people do not tell them.

    Where the log's are ``contradicted``, by the floor as well, cameras are known to see the same
    people. So it does not count that strangers might fit, too.

    Without poses in the log (``error`` says so), two cameras are enough: the others are left out.
    Channels that share one of ``frames`` get frames of their own; None = any frame.
    """
    from hiros_mcap.calibrate.people import calibrate_people

    log = with_own_frames(survey.log, shared_frames(survey.log) if frames is None else frames)
    original = survey.log
    if any(camera not in original.cameras for camera in log.cameras):
        survey = Survey(log, MOST_S, fixed=False)
    try:
        calibration = calibrate_people(log, survey, clocks.corrections)
    except LogError as reason:
        raise LogError(_fault_of_both(error, reason.fault), path=log.path) from None
    enough = CONFIRMED if mode == "require" else SURE
    left = {
        camera.name
        for camera in calibration.cameras
        if camera.verdict not in enough
        and not (contradicted and calibration.tilted and camera.agrees)
    }
    poses = {
        camera.frame: {0: camera.pose}
        for camera in calibration.cameras
        if camera.pose is not None and camera.name not in left
    }
    used = len(poses)
    poses.pop(calibration.fixed_frame, None)  # of the camera that defines the frame
    if used < 2 or (left and (error is None or mode == "require")):
        fault = f"{calibration.reason}. {_DOUBTFUL}"
        raise LogError(_fault_of_both(error, fault), path=log.path)
    return PoseAlignment(
        [summary_of(camera, used=camera.name not in left) for camera in calibration.cameras],
        calibration=calibration,
        left_out=frozenset(left),
        better=(poses, calibration.fixed_frame),
        contradictions=(
            *filter(None, [original.far_apart]),
            *mended(original, log, calibration),
            *log.transforms.doubts(name for camera in original.cameras for name in camera.frames),
        ),
        own_frames=frozenset(c.channel.topic for c in log.cameras if c.own_frame == c.topic_frame),
        poses_of=log.transforms.source or "the log",
    )


def _weak_poses(rig: PeopleCalibration, left_out: frozenset[str]) -> Iterator[str]:
    """Yield what is wrong with poses that come from the people alone."""
    for camera in (row for row in rig.cameras if row.name in left_out):
        yield (
            f"{camera.name} is left out, because the people do not tell its pose "
            f"({camera.reason}): {camera.remedy}. {_DOUBTFUL}"
        )
    used = [camera for camera in rig.cameras if camera.name not in left_out]
    weak = [camera for camera in used if camera.verdict not in CONFIRMED]
    if weak:
        worst = max(
            reversed(weak), key=lambda camera: (GRADES.index(camera.verdict), camera.uncertainty)
        )
        grade = "usable only" if worst.verdict == "usable" else worst.verdict
        yield (
            f"the cameras' poses are {grade}: expect joints to be {rig.people_mm:.0f} mm off "
            f"by them ({worst.name}: {worst.reason}); for better ones, {worst.remedy}"
        )


def _fault_of_both(error: LogError | None, reason: str) -> str:
    first = "the poses do not fit the people" if error is None else error.fault
    return f"{first}. The people do not tell them: {reason}"


def summary_of(camera: CalibratedCamera, *, used: bool) -> PoseSummary:
    """Return what a user should know of one camera.

    A pose that is usable only is not surely better than the log's.
    """
    is_weak = camera.verdict == "usable" and not used
    return PoseSummary(
        name=camera.name,
        verdict="doubtful" if is_weak else camera.verdict,
        reason=camera.reason,
        used=used,
        moved_mm=camera.moved_mm,
        moved_deg=camera.moved_deg,
        clock_ms=1000.0 * camera.clock_s,
        error_mm=camera.error_mm,
        error_deg=camera.error_deg,
        error_ms=camera.error_ms,
    )
