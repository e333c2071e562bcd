"""The cameras of a rig, and whom they see in the best parts of a log."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from hiros_mcap.body.rotations import Rigid, to_matrix
from hiros_mcap.calibrate.camera_views import CameraView, sightings_of, view_of
from hiros_mcap.calibrate.tracklets import Sighting
from hiros_mcap.io.log import Log
from hiros_mcap.running.clock_alignment import ClockAlignment
from hiros_mcap.skeletons import Ints

LONGEST_S, SHORTEST_S = 20.0, 12.0
"""So many seconds of a log are read, in stretches: half of it, within these limits."""
STRETCHES = 5
ENOUGH = 0.75
"""If the stretches show people in a smaller share of their time, more of the log is read."""
MOST_S = 120.0
SPACING_NS = 45_000_000
"""More frames tell little: the slow part of a detector's errors is the larger one."""
ODD_S = 10.0

_MOVES = "its pose changes during the log, and only cameras at rest can be compared"
_SHARED = "its detections are in a frame that is not its own"


class FixedCamera(NamedTuple):
    """A camera, and where it stands."""

    name: str
    frame: str
    pose: Rigid
    movable: bool = True
    """Whether it stands still in a frame of its own, so that it may have another pose. The people
    of others are taken where they are in the fixed frame."""


def camera_faults(log: Log) -> dict[str, str]:
    """Name -> reason of each camera whose pose cannot be compared with the others'."""
    faults: dict[str, str] = {}
    owners = Counter(frame for camera in log.cameras for frame in camera.frames)
    for camera in log.cameras:
        frames = camera.frames
        shared = len(frames) != 1 or len(camera.sources) != 1 or owners[frames[0]] > 1
        if shared or moves(log, frames[0]):
            faults |= dict.fromkeys(camera.sources.values(), _SHARED if shared else _MOVES)
    return faults


def fixed_cameras(log: Log, faults: Mapping[str, str]) -> Iterator[FixedCamera]:
    """Yield the cameras; those with faults are not movable."""
    fixed = log.fixed_frame
    for camera in log.cameras:
        for name in camera.sources.values():
            if name in faults:
                yield FixedCamera(name, fixed, Rigid.identity(), movable=False)
            else:
                pose = log.transforms.at_rest(camera.frames[0], fixed)
                yield FixedCamera(name, camera.frames[0], pose or Rigid.identity())


def moves(log: Log, frame: str) -> bool:
    """Whether the log knows how a frame moves."""
    if frame not in log.transforms.frames:
        return False
    return log.transforms.at_rest(frame, log.transforms.root(frame)) is None


def best_sightings(log: Log, clocks: ClockAlignment) -> Mapping[str, list[Sighting]]:
    """Return whom the cameras see, at corrected times, in enough of the log."""
    start, end = log.span
    seconds = float(np.clip((end - start) / 2e9, SHORTEST_S, LONGEST_S))
    parts = stretches(start, end, seconds, STRETCHES)
    seen = read_sightings(log, clocks, parts)
    if len(parts) > 1 and _seconds_with_people(seen) < ENOUGH * seconds:
        seen = read_sightings(log, clocks, stretches(start, end, MOST_S, STRETCHES))
    return seen


def stretches(start: int, end: int, seconds: float, n: int) -> list[tuple[int, int]]:
    """Return n spans of a log, ns, that are ``seconds`` long together; all of a short log."""
    length = end - start
    if length <= 1e9 * seconds:
        return [(start, end)]
    part, piece = length / n, 1e9 * seconds / n
    begins = [round(start + k * part + (part - piece) / 2.0) for k in range(n)]
    return [(begin, begin + round(piece)) for begin in begins]


def read_sightings(
    log: Log, clocks: ClockAlignment, spans: Sequence[tuple[int, int]]
) -> dict[str, list[Sighting]]:
    """Camera -> whom it sees in some spans of log times, ns, in the fixed frame.

    Left out is what a camera stamped at quite another time than most: its clock is no clock.
    """
    start, end = log.span
    seen: dict[str, list[Sighting]] = {}
    latest: dict[str, int] = {}
    for block in clocks.correct(block for _, block in log.blocks_by_topic(spans)):
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


def seen_by(
    camera: FixedCamera, sightings: Sequence[Sighting], mirror: Ints, shift: float = 0.0
) -> CameraView:
    """Return what a camera sees, in its own frame, of sightings in the fixed frame.

    Its times are ``shift`` s later than stated.
    """
    view = view_of(camera.name, camera.frame, sightings, mirror, shift)
    turn, place = to_matrix(camera.pose.xyzw), camera.pose.translation
    tracks = [one._replace(positions=(one.positions - place) @ turn) for one in view.tracks]
    return replace(view, tracks=tracks)


def _seconds_with_people(seen: Mapping[str, Sequence[Sighting]]) -> int:
    """Return in how many seconds at least two cameras see somebody."""
    times = Counter(
        second
        for some in seen.values()
        for second in {int(s.seconds // 1.0) for s in some if len(s.positions)}
    )
    return sum(n > 1 for n in times.values())
