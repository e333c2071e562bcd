"""The poses that a log gives, compared with those that its people give.

:func:`compare_poses` refines the poses (:mod:`hiros_mcap.calibrate.refinement`), and finds clocks
that are far off. :func:`.moved_cameras.split_moved` then looks for cameras that were moved in the
middle of the log, :func:`with_strays` at those that share no view with the others.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from hiros_mcap.body.rotations import Rigid
from hiros_mcap.body.symmetry import symmetry_of
from hiros_mcap.calibrate.camera_change import SecondPose
from hiros_mcap.calibrate.camera_views import CameraView, Sighting
from hiros_mcap.calibrate.coarse_clock import landmarks_of
from hiros_mcap.calibrate.pair_pose import coarse_clocks, seen_elsewhere
from hiros_mcap.calibrate.refinement import linked, refine_poses
from hiros_mcap.calibrate.sampling import Rig
from hiros_mcap.calibrate.survey import FixedCamera, Survey, seen_by
from hiros_mcap.calibrate.verdict import UNLINKED, CalibratedCamera
from hiros_mcap.events import Event
from hiros_mcap.io.camera_clock import ClockCorrection
from hiros_mcap.skeletons import Ints

_APART_MM = 60.0
"""Where a clock is wrong by most of a second, people who walk slowly may still fit: they are off by
8 to 11 cm, others by 4 to 5."""
_DELAY_S = 0.1  # lags of right clocks mostly differ by less

Corrections = Mapping[str, ClockCorrection]
"""What is known of the cameras' clocks, by name."""


class Move(NamedTuple):
    """A camera was moved."""

    camera: str
    stamp: int  # of its first message afterwards, ns
    log_time: int  # of the same message
    metres: float
    degrees: float

    @property
    def distance(self) -> str:
        """How far, in words."""
        return f"{100 * self.metres:.0f} cm and {self.degrees:.1f} degrees"


@dataclass(frozen=True, slots=True)
class PosedViews:
    """Views of the cameras, and the poses that follow from the people in them.

    A camera that was moved has two rows: before the move, and after it.
    """

    cameras: list[FixedCamera]  # with the poses that the log gives
    views: list[CameraView]
    rig: list[CalibratedCamera]
    gains: list[SecondPose]  # by how much a second pose would explain each camera better
    moves: tuple[Move, ...] = ()
    late: Event | None = None  # a camera that was moved for too short a time to tell a pose

    @property
    def linked(self) -> list[CalibratedCamera]:
        """Those that see the people where others do."""
        return [camera for camera in self.rig if camera.fits and camera.reason != UNLINKED]

    def pose(self, k: int) -> Rigid:
        """Return the pose of a row's camera that is used."""
        return self.rig[k].pose or self.cameras[k].pose

    def poses_used(self) -> dict[str, dict[int, Rigid]]:
        """Frame -> poses other than the log's, by the log times from which on they hold."""
        since = {move.camera: move.log_time for move in self.moves}
        poses: dict[str, dict[int, Rigid]] = {}
        for k, (camera, calibrated) in enumerate(zip(self.cameras, self.rig, strict=True)):
            if camera.frame in poses:
                poses[camera.frame][since[camera.name]] = self.pose(k)
            elif camera.name in since or is_better(calibrated):
                poses[camera.frame] = {0: self.pose(k)}
        return poses

    def to_given(self) -> dict[str, Rigid]:
        """Camera -> what takes its people back to the log's pose; none that was moved."""
        twice = {move.camera for move in self.moves}
        return {
            camera.name: camera.pose @ self.pose(k).inverse()
            for k, (camera, calibrated) in enumerate(zip(self.cameras, self.rig, strict=True))
            if is_better(calibrated) and camera.name not in twice
        }


def is_better(camera: CalibratedCamera) -> bool:
    """Whether the people gave the camera a pose in place of the log's."""
    return not math.isnan(camera.moved_mm)


def views_of(
    cameras: Iterable[FixedCamera], sightings: Mapping[str, list[Sighting]],
    shifts: Iterable[float], mirror: Ints,
) -> list[CameraView]:  # fmt: skip
    """Return the people that cameras see; ``shifts``, s, are added to the cameras' times."""
    return [
        seen_by(camera, sightings.get(camera.name, []), mirror, shift)
        for camera, shift in zip(cameras, shifts, strict=True)
    ]


def compare_poses(
    survey: Survey, corrections: Corrections, cameras: Iterable[FixedCamera],
    lags: Mapping[str, float],
) -> PosedViews:  # fmt: skip
    """Compare the cameras' poses with those that their people give, and find the clocks.

    One camera alone gives no views. Clocks that are far off are searched for if people do not fit,
    or if the lags suggest it.

    Parameters
    ----------
    lags : camera -> usual time, s, from its corrected stamps to the log times.
    """
    cameras = sorted(cameras)
    if len(cameras) < 2:
        return PosedViews([], [], [], [])
    log, sightings = survey.log, survey.sightings(corrections)
    mirror = symmetry_of(log.model).mirror
    poses = [camera.pose for camera in cameras]
    anchor = next((k for k, camera in enumerate(cameras) if camera.frame == log.fixed_frame), None)

    def refined(shifts: Sequence[float]) -> PosedViews:
        views = views_of(cameras, sightings, shifts, mirror)
        fitted = refine_poses(views, poses, mirror, anchor, [c.movable for c in cameras])
        return PosedViews(cameras, views, *fitted)

    posed = refined([0.0] * len(cameras))
    hints = [lags.get(camera.name, 0.0) for camera in cameras]
    fitting, minus_worst = _fit(posed)
    if fitting == len(cameras) and -minus_worst < _APART_MM and np.ptp(hints) < _DELAY_S:
        return posed
    # All of the log: at the right lag, short stretches overlap less than at a wrong one.
    sightings = survey.many(corrections)
    views = views_of(cameras, sightings, [0.0] * len(cameras), mirror)
    shifts = coarse_clocks(views, Rig.of(poses), hints, landmarks_of(log.model), mirror)
    again = refined(shifts.tolist()) if shifts.any() else posed
    return max(again, posed, key=_fit)  # a camera that was moved may not fit at the right lag


def _fit(posed: PosedViews) -> tuple[int, float]:
    """Return how many cameras see the people where others do, and minus the worst residual, mm.

    More is better in both. Unless all cameras fit, the residual counts as 0.
    """
    fitting = posed.linked
    all_fit = len(fitting) == len(posed.rig)
    return len(fitting), -max(camera.residual_mm for camera in fitting) if all_fit else 0.0


def with_strays(survey: Survey, corrections: Corrections, posed: PosedViews) -> PosedViews:
    """Find the cameras that share no view with the others, but would share one from elsewhere.

    Such a camera does not fit. If it sees different people wherever it stands, nothing is wrong.
    The largest group of cameras that see the same people counts as right; a smaller one is like a
    camera alone.
    """
    strays = _strays(survey, posed)
    if not any(posed.cameras[k].movable for group in strays for k in group):
        return posed
    model, sightings = survey.log.model, survey.many(corrections)
    mirror, rig = symmetry_of(model).mirror, list(posed.rig)
    shifts = [view.shift for view in posed.views]
    views = views_of(posed.cameras, sightings, shifts, mirror)
    log_poses = Rig.of([camera.pose for camera in posed.cameras])
    for group in strays:
        found = (
            seen_elsewhere(k, group, views, log_poses, landmarks_of(model), mirror) for k in group
        )
        if witness := next(filter(None, found), ""):
            reason = f"its people are those whom {witness} sees elsewhere"
            for k in group:
                rig[k] = replace(rig[k], verdict="impossible", reason=reason)
    return replace(posed, rig=rig)


def _strays(survey: Survey, posed: PosedViews) -> list[list[int]]:
    """Return the groups of cameras that share no view with the others, many with one camera."""
    alone = [[k] for k, camera in enumerate(posed.rig) if camera.reason == UNLINKED]
    poses = [posed.pose(k) for k in range(len(posed.rig))]
    fitting = [k for k, camera in enumerate(posed.rig) if camera.fits and [k] not in alone]
    groups = linked(posed.views, poses, symmetry_of(survey.log.model).mirror)
    groups = [[k for k in group if k in fitting] for group in groups]
    return [*alone, *sorted(groups, key=len, reverse=True)[1:]]
