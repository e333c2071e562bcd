"""Corrects the cameras' poses of a causal run, slowly, by what was seen before.

Every now and then the poses are compared with the people of the last minute, as before a run of a
file (:mod:`hiros_mcap.calibrate.refinement`). Where the people prove better poses, the detections
move to where these put them, a little with each tenth of a second: nobody jumps.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import replace

from hiros_mcap.body.rotations import Rigid
from hiros_mcap.body.symmetry import symmetry_of
from hiros_mcap.body.transforms import pose_arrays
from hiros_mcap.calibrate.camera_result import CalibratedCamera
from hiros_mcap.calibrate.camera_views import sightings_of
from hiros_mcap.calibrate.refinement import refine_poses
from hiros_mcap.calibrate.survey import (
    SPACING_NS,
    FixedCamera,
    camera_faults,
    fixed_cameras,
    seen_by,
)
from hiros_mcap.calibrate.tracklets import Sighting
from hiros_mcap.frames import Block, join
from hiros_mcap.io.log import Reading
from hiros_mcap.kernels.transforming import PoseArrays, move
from hiros_mcap.running.pose_alignment import PoseAlignment, summary_of

_MOMENTS_S = (10, 15, 20, 30, 40)
"""When the poses are compared, s after the first message."""
_EVERY_S = 60
"""Afterwards at all multiples of this."""
_WINDOW_S = 60.0
_TICK_NS = 100_000_000
_STEP_DEG, _STEP_M = 0.02, 0.001
"""Largest change of a pose in a tick."""


class PoseFollower:
    """Corrects detections in the order of the log.

    Results depend on the order and the times of the messages, not on how these come in blocks.

    Parameters
    ----------
    reading : whose messages are corrected. alignment : what is found goes here.
    """

    def __init__(self, reading: Reading, alignment: PoseAlignment) -> None:
        self._reading, self._alignment = reading, alignment
        self._mirror = symmetry_of(reading.log.model).mirror
        self._seen: dict[str, list[Sighting]] = {}
        """Whom each camera sees, where the log's poses put them."""
        self._latest: dict[str, int] = {}
        """Stamp of each camera's last sighting, ns."""
        self._start = self._tick = 0
        """Log time of the first message, ns, and ticks since then."""
        self._given: dict[str, Rigid] = {}
        self._goals: dict[str, Rigid] = {}
        """Camera -> the better pose that is proven."""
        self._poses: dict[str, Rigid] = {}
        """Camera -> the pose that is used, between the given one and the goal."""
        self._moves: dict[str, PoseArrays] = {}
        """Camera -> how its detections move."""

    def correct(self, blocks: Iterable[Block]) -> Iterator[Block]:
        """Yield blocks in the fixed frame with the detections where better poses put them."""
        for block in blocks:
            yield self._take(block)

    def _take(self, block: Block) -> Block:
        """Learn from the messages of a block one by one, and correct them."""
        new = self._new_sightings(block)
        moves: dict[int, PoseArrays] = {}
        for i, (_, source, log_time) in enumerate(block.messages()):
            self._advance(log_time)
            if source in self._moves:
                moves[i] = self._moves[source]
            if i in new:
                self._seen.setdefault(source, []).append(new[i])
        if not moves:
            return block
        block = join([block])
        for i, arrays in moves.items():
            move(arrays, 0, block.people.at(slice(*block.rows[i].tolist())))
        return block

    def _new_sightings(self, block: Block) -> dict[int, Sighting]:
        """Return whom those frames of a block show that come long enough after their last ones."""
        self._start = self._start or int(block.log_times[0])
        chosen = []
        for i, (stamp, source, _) in enumerate(block.messages()):
            if not 0 <= stamp - self._latest.get(source, 0) < SPACING_NS:
                self._latest[source] = stamp
                chosen.append(i)
        return dict(zip(chosen, sightings_of(block, chosen, self._start), strict=True))

    def _advance(self, log_time: int) -> None:
        """Compare the poses when it is time, and move towards those that are proven."""
        tick = (log_time - self._start) // _TICK_NS
        if tick <= self._tick:
            return
        before, self._tick = self._tick, tick
        if _refinements_until(tick) > _refinements_until(before):
            self._compare()
        if any(self._poses[name] is not goal for name, goal in self._goals.items()):
            self._step(tick - before)

    def _compare(self) -> None:
        """Compare the poses with the people of the last minute."""
        since = self._tick * _TICK_NS / 1e9 - _WINDOW_S
        self._seen = {
            name: [s for s in some if s.seconds > since] for name, some in self._seen.items()
        }
        log = self._reading.log
        fixed = fixed_cameras(log, camera_faults(log))
        cameras = sorted(c for c in fixed if c.movable and c.name in self._seen)
        if len(cameras) < 2:
            return
        anchors = [k for k, one in enumerate(cameras) if one.frame == log.fixed_frame]
        rig = refine_poses(
            [seen_by(camera, self._seen[camera.name], self._mirror) for camera in cameras],
            [camera.pose for camera in cameras],
            self._mirror,
            anchors[0] if anchors else None,
        ).cameras
        for camera, one in zip(cameras, rig, strict=True):
            if one.pose is not None and not math.isnan(one.moved_mm):
                self._given[camera.name] = camera.pose
                self._goals[camera.name] = one.pose
                self._poses.setdefault(camera.name, camera.pose)
        self._alignment.cameras = [
            summary_of(self._kept(camera, one), used=camera.name in self._goals)
            for camera, one in zip(cameras, rig, strict=True)
        ]

    def _kept(self, camera: FixedCamera, calibrated: CalibratedCamera) -> CalibratedCamera:
        """Return what was found with the pose that is used: one that was proven stays."""
        goal = self._goals.get(camera.name)
        if goal is None:
            return calibrated
        metres, degrees = goal.apart(camera.pose)
        return replace(calibrated, verdict="improved", moved_mm=1000.0 * metres, moved_deg=degrees)

    def _step(self, ticks: int) -> None:
        """Move all cameras by the same share of their ways, so far as the steps allow."""
        share = 1.0
        for name, goal in self._goals.items():
            metres, degrees = self._poses[name].apart(goal)
            for way, step in ((metres, _STEP_M), (degrees, _STEP_DEG)):
                share = min(share, ticks * step / way) if way > 0.0 else share
        for name, goal in self._goals.items():
            pose = goal if share >= 1.0 else self._poses[name].towards(goal, share)
            self._poses[name] = pose
            self._moves[name] = pose_arrays([pose @ self._given[name].inverse()])


def _refinements_until(tick: int) -> int:
    """Return how often the poses are compared up to a tick."""
    seconds = tick * _TICK_NS / 1e9
    return sum(seconds >= moment for moment in _MOMENTS_S) + int(seconds // _EVERY_S)
