"""Finds cameras that were moved in the middle of a log, and where they stood before and after.

A camera is a suspect if its people do not fit those of the others, do so in a part of the log only,
or fit much better with two poses than with one (:func:`suspects`). Then stretches of the log have
to give different poses (:mod:`hiros_mcap.calibrate.camera_change`), and each part has to fit by
itself.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from hiros_mcap.body.rotations import Rigid
from hiros_mcap.body.symmetry import symmetry_of
from hiros_mcap.calibrate.camera_change import (
    CameraChange,
    find_change,
    located,
    part_of,
    partner_of,
    steps_apart,
)
from hiros_mcap.calibrate.camera_views import CameraView, Sighting
from hiros_mcap.calibrate.gauge import PRIOR_DEG, PRIOR_M, moved, on_transforms
from hiros_mcap.calibrate.given_poses import Corrections, Move, PosedViews, views_of
from hiros_mcap.calibrate.refinement import (
    FROM_GIVEN,
    refine_poses,
    refine_together,
)
from hiros_mcap.calibrate.sampling import Rig
from hiros_mcap.calibrate.survey import FixedCamera, Survey
from hiros_mcap.calibrate.verdict import SURE
from hiros_mcap.events import Event, camera_displaced
from hiros_mcap.skeletons import Floats, Ints

GAIN = 0.12
"""A camera whose misfit falls by this share with a second pose may have been moved: that of healthy
ones falls by 9 % at most."""
LATE_M = 0.05
"""If people are also so far off in one part, and that is too short for a pose, the camera is named:
those of healthy ones are off by .045 m at most."""
LEAST_M = 0.03
"""A second pose brings people nearer by this, in both parts: views of real detectors differ by
1 to 2 cm."""
FAR_M = 0.1
"""People who are no farther apart than before have steps below .07 m; of a camera that was moved so
far that they do not fit any more, .17 to .21 m."""
NARROW_S = 0.5
"""If nobody was seen in the read parts of the log for longer around the change, more is read."""
PART_S = 10.0
MOST_PARTS = 6
"""Each part that is read narrows the gap to a third or less."""


def split_moved(survey: Survey, corrections: Corrections, posed: PosedViews) -> PosedViews:
    """Return the cameras, those that were moved as two, each part with its own pose.

    Where no camera was moved, or the log does not tell, ``posed`` itself is returned.
    """
    mirror, fixed_frame = symmetry_of(survey.log.model).mirror, survey.log.fixed_frame
    left, tried = suspects(posed, fixed_frame, mirror), set[str]()
    if not left:
        return posed
    shifts = {view.name: view.shift for view in posed.views}
    splitter = _Splitter(survey, corrections, mirror, shifts)
    views = splitter.views_of(posed.cameras, survey.many(corrections))
    result = replace(posed, views=views)
    while left:
        tried.add(left[0])
        split = splitter.split(result, left[0])
        # What a moved camera does to the others is over when its parts are known.
        left = left if split is result else suspects(split, fixed_frame, mirror)
        result, left = split, [name for name in left if name not in tried]
    return result if result.moves else replace(posed, late=splitter.moved_late(result))


def suspects(posed: PosedViews, fixed_frame: str, mirror: Ints) -> list[str]:
    """Return the cameras that may have been moved: those that do not fit, then the others.

    Of two cameras that do not fit each other, it is taken to be the second.
    """
    rig = Rig.of([posed.pose(k) for k in range(len(posed.views))])
    steps = steps_apart(posed.views, rig, mirror)
    rows = zip(posed.cameras, posed.rig, posed.gains, steps, strict=True)
    free = [row for camera, *row in rows if camera.frame != fixed_frame]
    if len(posed.cameras) == 2:
        free = free[-1:]
    odd = [calibrated.name for calibrated, *_ in free if not calibrated.fits]
    doubtful = {
        calibrated.name: gain.share
        for calibrated, gain, steps_of_camera in free
        if calibrated.fits and (gain.share > GAIN or _is_far(steps_of_camera))
    }
    return odd + sorted(doubtful, key=lambda name: -doubtful[name])


def _is_far(steps: Floats) -> bool:
    """Whether people are farther from those of all other cameras in one part of the log."""
    finite = steps[~np.isnan(steps)]
    return bool(len(finite) and finite.min() > FAR_M)


@dataclass(frozen=True, slots=True)
class _Splitter:
    """Splits the views of cameras that were moved in a log."""

    _survey: Survey
    _corrections: Corrections
    _mirror: Ints
    _shifts: Mapping[str, float]  # camera -> s by which its times are later than stated

    def views_of(
        self, cameras: Sequence[FixedCamera], sightings: Mapping[str, list[Sighting]]
    ) -> list[CameraView]:
        """Return what cameras see."""
        shifts = [self._shifts[camera.name] for camera in cameras]
        return views_of(cameras, sightings, shifts, self._mirror)

    def split(self, posed: PosedViews, name: str) -> PosedViews:
        """Return the views with those of a camera in two parts, if it was moved."""
        c = [camera.name for camera in posed.cameras].index(name)
        partners = [k for k in range(len(posed.rig)) if k != c]
        sound = [k for k in partners if posed.rig[k].fits]
        partner = partner_of(posed.views, c, sound or partners)
        if partner is None:
            return posed
        change = find_change([posed.views[partner], posed.views[c]], self._mirror)
        if change is None or change.metres < LEAST_M:
            return posed
        change = self._narrowed(change, posed, (partner, c))
        parts = self._refined(posed, c, partner, change)
        if parts is None:
            return posed
        first = self._first_message(name, change.seconds)
        move = Move(name, *first, *parts.pose(c).apart(parts.pose(c + 1)))
        return replace(parts, moves=(*posed.moves, move))

    def moved_late(self, posed: PosedViews) -> Event | None:
        """Find the camera whose people are elsewhere from some time on."""
        poses = [posed.pose(k) for k in range(len(posed.views))]
        _, gains = refine_poses(posed.views, poses, self._mirror)
        c = max(range(len(gains)), key=lambda k: (round(gains[k].metres, 2), k))
        if gains[c].share <= GAIN or gains[c].metres <= LATE_M:
            return None
        name = posed.cameras[c].name
        first, _ = self._first_message(name, gains[c].seconds)
        other = [posed.cameras[1 - c].name] if len(gains) == 2 else []
        return camera_displaced(first, name, gains[c].metres, other)

    def _narrowed(
        self, change: CameraChange, posed: PosedViews, pair: tuple[int, int]
    ) -> CameraChange:
        """Look into the log where it was not read yet, until the time of the change is known."""
        for _ in range(MOST_PARTS):
            if change.end - change.begin < NARROW_S:
                break
            name = posed.cameras[pair[0]].name
            ends = [self._first_message(name, s)[1] for s in (change.begin, change.end)]
            sightings = self._survey.between((ends[0], ends[1]), PART_S, self._corrections)
            views = self.views_of([posed.cameras[k] for k in pair], sightings)
            nearer = located(views, change.early, change.late, self._mirror)
            begin, end = max(change.begin, nearer.begin), min(change.end, nearer.end)
            change = change._replace(begin=begin, end=end)
        return change

    def _refined(
        self, posed: PosedViews, c: int, partner: int, change: CameraChange
    ) -> PosedViews | None:
        """Refine all cameras, one of them in two parts; None if its parts do not fit, too."""
        camera, view, at = posed.cameras[c], posed.views[c], change.seconds
        cameras, calibrated, views = list(posed.cameras), list(posed.rig), list(posed.views)
        cameras.insert(c, camera)
        calibrated.insert(c, calibrated[c])
        views[c : c + 1] = part_of(view, -np.inf, at), part_of(view, at, np.inf)
        ends = [posed.pose(partner) @ rig.pose(1) for rig in (change.early, change.late)]
        kept = int(np.argmin([_deviation(pose, camera.pose) for pose in ends]))
        changed = c + 1 - kept
        starts = [row.pose for row in cameras]
        starts[changed] = ends[1 - kept]
        sound = [k for k, row in enumerate(calibrated) if row.fits or k in (c, c + 1)]
        fitting = [views[k] for k in sound], [starts[k] for k in sound]
        starts[changed] = self._placed(*fitting, sound.index(changed))
        frames = [row.frame for row in cameras]
        fixed = self._survey.log.fixed_frame
        anchor = frames.index(fixed) if fixed in frames else None
        movable = [camera.movable for camera in cameras]
        calibrated, gains = refine_poses(views, starts, self._mirror, anchor, movable)
        if not all(row.fits and row.verdict in SURE for row in calibrated[c : c + 2]):
            return None
        row = calibrated[changed]
        metres, degrees = (row.pose or starts[changed]).apart(camera.pose)
        calibrated[changed] = replace(
            row,
            verdict="usable" if row.verdict == "usable" else "improved",
            moved_mm=1000.0 * metres,
            moved_deg=degrees,
        )
        return PosedViews(cameras, views, calibrated, gains, posed.moves)

    def _placed(self, views: Sequence[CameraView], starts: Sequence[Rigid], changed: int) -> Rigid:
        """Return the refined pose of the camera that ``changed``; the others' place the rig."""
        refined = refine_together(views, Rig.of(starts), self._mirror, FROM_GIVEN)
        fixed = {k: pose for k, pose in enumerate(starts) if k != changed}
        return moved(refined.rig, on_transforms(refined.rig, fixed)).pose(changed)

    def _first_message(self, name: str, seconds: float) -> tuple[int, int]:
        """Corrected stamp and log time, ns, of a camera's first message from some time on.

        Seconds count from the middle of the log.
        """
        times = self._survey.times[name].corrected(self._corrections.get(name))
        since = self._survey.middle + round(1e9 * (seconds - self._shifts[name]))
        k = int(np.argmax(times.stamps >= since))
        return int(times.stamps[k]), int(times.log_times[k])


def _deviation(pose: Rigid, reference: Rigid) -> float:
    """Distance of two poses, in units of the precision of a log's poses."""
    metres, degrees = pose.apart(reference)
    return float(np.hypot(degrees / PRIOR_DEG, metres / PRIOR_M))
