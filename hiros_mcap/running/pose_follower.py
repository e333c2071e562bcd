"""Corrects the cameras' poses and clocks of a causal run, slowly, by what was seen before.

Every now and then both are compared with the people of the last minute, as before a run of a file
(:mod:`hiros_mcap.calibrate.refinement`). Where the people prove better poses, the detections move
to where these put them, a little with each tenth of a second: nobody jumps. Clocks that they prove
to be wrong are corrected a little with each message.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np

from hiros_mcap.body.rotations import Rigid
from hiros_mcap.body.symmetry import symmetry_of
from hiros_mcap.body.transforms import pose_arrays
from hiros_mcap.calibrate.camera_views import (
    CameraView,
    PeopleFollowed,
    Sighting,
    half_width_of,
    sightings_of,
)
from hiros_mcap.calibrate.refinement import FROM_GIVEN, refine_poses
from hiros_mcap.calibrate.survey import (
    SPACING_NS,
    FixedCamera,
    camera_faults,
    fixed_cameras,
    in_own_frame,
    shared_frames,
)
from hiros_mcap.calibrate.verdict import MOVED, TIMED, CalibratedCamera, weakness_of
from hiros_mcap.frames import Block, join
from hiros_mcap.io.log import Log, Reading
from hiros_mcap.kernels.array_types import joined
from hiros_mcap.kernels.people_rows import PoseArrays, move_messages
from hiros_mcap.running.clock_alignment import significant_offsets
from hiros_mcap.running.clock_follower import ClockFollower
from hiros_mcap.running.pose_alignment import PoseAlignment, summary_of
from hiros_mcap.running.shared_frames import said, shared_wrongly
from hiros_mcap.stages.known_cameras import KnownCameras
from hiros_mcap.threads import beside

_MOMENTS_S = (3, 4, 6, 8, 10, 15, 20, 30, 40)
"""When poses and clocks are compared, s after the first message."""
_PROVEN_S = 2.0
"""Common view that proves a pose. It is looked at again soon; before a run of a file, never."""
_CERTAIN_S = 5.0
"""Before that, poses are known to .2 degrees: as well as a careful calibration knows them."""
_EFFORT = FROM_GIVEN._replace(points=2000, cameras=5)
"""A comparison of many people costs as much as that of one or two. With three times the points,
live results of four to eight people are the same to .1 mm. Of many cameras, its cost grows with
their number, not with the number of pairs."""
_EVERY_S = 60  # afterwards at all multiples of this
_TAKES = 3
"""Ticks from the beginning of a comparison to its result: it goes on beside the run, which would
otherwise stand still for a quarter of a second."""
_WINDOW_S = 60.0
_TICK_NS = 100_000_000
_STEP_DEG, _STEP_M = 0.1, 0.005
"""Largest change of a pose in a tick. All cameras move together, and people stay where they are on
the average of the cameras: they are not seen to move."""


class PoseFollower:
    """Corrects detections in the order of the log.

    Results depend on the order and the times of the messages, not on how these come in blocks.

    Parameters
    ----------
    reading : whose messages are corrected. alignment : what is found goes here.
    known : gets the errors of the poses. clocks : correct the stamps.
    movable : whether the poses may change; the clocks may.
    """

    def __init__(
        self, reading: Reading, alignment: PoseAlignment, known: KnownCameras,
        clocks: ClockFollower, *, movable: bool,
    ) -> None:  # fmt: skip
        self._reading, self._alignment, self._known = reading, alignment, known
        self._clocks, self._movable = clocks, movable
        self._mirror = symmetry_of(reading.log.model).mirror
        self._seen: dict[str, PeopleFollowed] = {}
        """The people that each camera sees, where the log's poses put them, at times before its
        clock was corrected."""
        self._latest: dict[str, int] = {}  # stamp of each camera's last sighting, ns
        self._start = self._tick = 0  # log time of the first message, ns, and ticks since then
        self._given: dict[str, Rigid] = {}
        self._goals: dict[str, Rigid] = {}  # camera -> the better pose that is proven
        self._poses: dict[str, Rigid] = {}
        """Camera -> the pose that is used, between the given one and the goal."""
        self._moves: dict[str, PoseArrays] = {}  # camera -> how its detections move
        self._comparison: Callable[[], None] | None = None
        """Waits for the result of the comparison that has begun, and takes it."""

    def correct(self, blocks: Iterable[Block]) -> Iterator[Block]:
        """Yield blocks with right stamps and the detections where better poses put them."""
        for block in self._clocks.compared(blocks):
            self._start = self._start or int(block.log_times[0])
            for part in self._parts(block):
                self._advance(int(part.log_times[0]))
                yield self._take(self._clocks.correct(part))
        self._conclude()

    def _parts(self, block: Block) -> Iterator[Block]:
        """Cut a block where the results of comparisons come in."""
        if len(block) == 1:
            yield block
            return
        ticks = (block.log_times - self._start) // _TICK_NS
        counts = [_comparisons_until(tick - _TAKES) for tick in ticks.tolist()]
        cuts = [0, *(np.flatnonzero(np.diff(counts)) + 1).tolist(), len(block)]
        for begin, end in pairwise(cuts):
            yield block.select(slice(begin, end))

    def _take(self, block: Block) -> Block:
        """Learn from the messages of a block one by one, and move their detections."""
        new = self._new_sightings(block)
        moves: dict[int, PoseArrays] = {}
        for i, (_, source, log_time) in enumerate(block.messages()):
            self._advance(log_time)
            if source in self._moves:
                moves[i] = self._moves[source]
            if i in new:
                at = new[i].seconds - self._clocks.added(source)
                followed = self._seen.setdefault(source, PeopleFollowed(self._mirror))
                followed.add(new[i]._replace(seconds=at))
        if not moves:
            return block
        block = join([block])
        move_messages(joined([*moves.values()]), block.rows[[*moves]], block.people)
        return block

    def _new_sightings(self, block: Block) -> dict[int, Sighting]:
        """Return whom those frames of a block show that come long enough after their last ones."""
        chosen, sizes = [], block.sizes
        for i, (stamp, source, _) in enumerate(block.messages()):
            if not 0 <= stamp - self._latest.get(source, 0) < SPACING_NS:
                if sizes[i]:  # a detector may send an empty message between any two
                    self._latest[source] = stamp
                chosen.append(i)
        if not chosen:
            return {}
        return dict(zip(chosen, sightings_of(block, chosen, self._start), strict=True))

    def _advance(self, log_time: int) -> None:
        """Compare the poses when it is time, and move towards those that are proven."""
        tick = (log_time - self._start) // _TICK_NS
        if tick <= self._tick:
            return
        before, self._tick = self._tick, tick
        if _comparisons_until(tick) > _comparisons_until(before):
            self._conclude()
            self._compare()
        if _comparisons_until(tick - _TAKES) > _comparisons_until(before - _TAKES):
            self._conclude()  # also of one that has just begun: nothing came for so long
        if any(self._poses[name] is not goal for name, goal in self._goals.items()):
            self._step(tick - before)

    def _conclude(self) -> None:
        """Take the result of the comparison that has begun, if one has."""
        if self._comparison is not None:
            self._comparison()
            self._comparison = None

    def _compare(self) -> None:
        """Begin to compare the poses with the people of the last minute."""
        since = self._tick * _TICK_NS / 1e9 - _WINDOW_S
        for followed in self._seen.values():
            followed.forget(since)
        log = self._reading.log
        seeing = [c for c in fixed_cameras(log, camera_faults(log)) if c.name in self._seen]
        cameras = sorted(camera for camera in seeing if camera.movable)
        if shared_frames(log):
            self._compare_in_shared_frames(log, seeing)
        if len(cameras) < 2:
            return
        anchors = [k for k, c in enumerate(cameras) if c.frame == log.fixed_frame]
        views = [in_own_frame(camera, self._view(camera)) for camera in cameras]
        # Also where the poses are to stay: wrong ones, held, would look like wrong clocks.
        estimate = beside(
            lambda: refine_poses(
                views,
                [camera.pose for camera in cameras],
                self._mirror,
                anchors[0] if anchors else None,
                moves=False,
                proven_s=_PROVEN_S,
                effort=_EFFORT,
            )
        )

        def take() -> None:
            rig, _ = estimate()
            self._correct_clocks(rig)
            if self._movable:
                self._take_poses(cameras, rig)

        self._comparison = take

    def _compare_in_shared_frames(self, log: Log, cameras: Sequence[FixedCamera]) -> None:
        """Find out whether cameras in one frame see the same people at one place in it."""
        views = [in_own_frame(camera, self._view(camera)) for camera in cameras]
        poses, stay = [camera.pose for camera in cameras], [False] * len(cameras)
        rig, _ = refine_poses(views, poses, self._mirror, None, stay, moves=False, effort=_EFFORT)
        wrong = shared_wrongly(log, rig, or_alone=True)
        self._alignment.contradictions = tuple(map(said, wrong.items()))

    def _view(self, camera: FixedCamera) -> CameraView:
        """Return what a camera sees, where the log's poses put it."""
        followed, proved = self._seen[camera.name], self._clocks.proved(camera.name)
        tracks = followed.tracklets(proved)
        half_width = half_width_of(followed.times)
        return CameraView(camera.name, camera.frame, tracks, proved, half_width)

    def _correct_clocks(self, rig: Sequence[CalibratedCamera]) -> None:
        """Correct the clocks by what the people prove besides what they had proved."""
        clocks = self._clocks
        left = [
            replace(camera, clock_s=camera.clock_s - clocks.proved(camera.name)) for camera in rig
        ]
        sure = [
            camera for camera in left if camera.evidence and not weakness_of(camera.evidence, TIMED)
        ]
        # Their poses may still be doubtful.
        told = [replace(summary_of(camera, used=False), verdict="usable") for camera in sure]
        for name, ahead in significant_offsets(told, clocks.lags, clocks.given).items():
            clocks.prove(name, clocks.proved(name) - ahead)

    def _take_poses(self, cameras: Sequence[FixedCamera], rig: Sequence[CalibratedCamera]) -> None:
        """Go to the poses that are proven; in the first seconds, only if one is clearly wrong."""
        certain = self._tick * _TICK_NS >= _CERTAIN_S * 1e9 or any(map(_is_clearly_wrong, rig))
        for camera, calibrated in zip(cameras, rig, strict=True):
            if certain and calibrated.pose is not None and not math.isnan(calibrated.moved_mm):
                self._given[camera.name] = camera.pose
                self._goals[camera.name] = calibrated.pose
                self._poses.setdefault(camera.name, camera.pose)
        self._alignment.cameras = [
            summary_of(self._kept(camera, calibrated), used=camera.name in self._goals)
            for camera, calibrated in zip(cameras, rig, strict=True)
        ]
        self._known.errors = self._alignment.errors

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


def _is_clearly_wrong(camera: CalibratedCamera) -> bool:
    """Whether the people prove a pose that is far from the given one."""
    return camera.moved_deg > MOVED * camera.error_deg or camera.moved_mm > MOVED * camera.error_mm


def _comparisons_until(tick: int) -> int:
    """Return how often the poses are compared up to a tick."""
    seconds = tick * _TICK_NS / 1e9
    return bisect_right(_MOMENTS_S, seconds) + int(seconds // _EVERY_S)
