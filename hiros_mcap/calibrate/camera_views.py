"""What each camera of a log sees of the people, as tracklets in its own frame and time."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from hiros_mcap.body.symmetry import symmetry_of
from hiros_mcap.calibrate.tracklets import Sighting, find_tracklets
from hiros_mcap.errors import LogError
from hiros_mcap.frames import Block
from hiros_mcap.io.log import Log
from hiros_mcap.kernels.local_line import Tracklet
from hiros_mcap.skeletons import POSITION, Frame, Ints

HALF_WIDTH_S = 0.1
"""Half of the time over which a joint's path is taken for a line; more for slow cameras."""
LONGEST_S = 120.0
"""A longer log is represented by the parts in which people move about most."""
PARTS = 6
APART_S = 2.0
"""Stamps that differ by more from the camera's log times than another camera's are corrected."""
CONFIDENCE_POWER = 3
"""A joint's weight is its confidence to this power: a guess at 1/3 counts an eighth."""


Camera = tuple[str, str]
"""Name and frame."""
Correction = Callable[[Iterable[Block]], Iterator[Block]]
"""Corrects stamps."""


@dataclass(frozen=True, slots=True)
class CameraView:
    """One camera and whom it sees."""

    name: str
    frame: str
    """Coordinate frame of its detections."""
    tracks: list[Tracklet]
    """Tracklets, by time. Seconds count from the middle of the log."""
    shift: float
    """s that were added to the camera's stamps because they are far from the log's times."""
    half_width: float
    """s, of the lines through a joint's positions."""


def camera_views(log: Log, corrected: Correction | None = None) -> list[CameraView]:
    """Read the cameras' detections, each in its own frame, as tracklets.

    ``corrected`` puts right what the times of the messages show of the clocks.

    Raises LogError if the cameras do not have a frame each.
    """
    seen = _sightings(log, corrected)
    _check_frames(log, list(seen))
    shifts = _clock_shifts({key: times for key, (_, times) in seen.items()})
    mirror = symmetry_of(log.model).mirror
    views = []
    for (name, frame), (sightings, _) in sorted(seen.items()):
        views.append(view_of(name, frame, sightings, mirror, shifts[name, frame]))
    return views


def view_of(
    name: str, frame: str, sightings: Sequence[Sighting], mirror: Ints, shift: float = 0.0
) -> CameraView:
    """Follow the people whom one camera sees; its times are ``shift`` s later than stated."""
    sightings = [s._replace(seconds=s.seconds + shift) for s in sightings]
    sightings.sort(key=lambda s: s.seconds)
    times = np.array([s.seconds for s in sightings])
    period = float(np.median(np.diff(times))) if len(times) > 1 else 0.0
    half_width = max(HALF_WIDTH_S, 2.0 * period)
    return CameraView(name, frame, find_tracklets(sightings, mirror), shift, half_width)


def _sightings(
    log: Log, corrected: Correction | None
) -> dict[Camera, tuple[list[Sighting], list[float]]]:
    """Return what each camera sees, and how far its stamps are from the log times, s."""
    middle = sum(log.span) // 2
    seen: dict[Camera, tuple[list[Sighting], list[float]]] = defaultdict(lambda: ([], []))
    parts = _best_parts(log)
    for block in parts if corrected is None else corrected(parts):
        lags = ((block.log_times - block.stamps) / 1e9).tolist()
        for i, sighting in enumerate(sightings_of(block, range(len(block)), middle)):
            sightings, late = seen[block.sources[i], block.frame_ids[i].lstrip("/")]
            sightings.append(sighting)
            late.append(lags[i])
    return seen


def sightings_of(block: Block, frames: Sequence[int], middle: int) -> list[Sighting]:
    """Return whom some frames of a block show. Seconds count from ``middle``, ns."""
    bounds = [(begin, end) for begin, end in block.rows[list(frames)].tolist()]
    ends = np.cumsum([0, *(end - begin for begin, end in bounds)]).tolist()
    rows = np.concatenate([np.zeros(0, np.int64), *(np.arange(*each) for each in bounds)])
    positions, known = (
        block.people.markers[rows, :, POSITION],
        block.people.marker_confidences[rows],
    )
    confidences = np.where(np.isnan(known), 1.0, known)
    absent = np.isnan(positions).any(axis=2) | (confidences <= 0.0)
    weights = np.where(absent, 0.0, confidences**CONFIDENCE_POWER)
    positions[absent] = np.nan
    seconds = ((block.stamps[list(frames)] - middle) / 1e9).tolist()
    return [
        Sighting(time, positions[begin:end], weights[begin:end])
        for time, begin, end in zip(seconds, ends, ends[1:], strict=False)
    ]


def _best_parts(log: Log) -> Iterator[Block]:
    """Yield the detections of a log, of a long one the best piece of each of its parts."""
    start, end = log.span
    seconds = (end - start) / 1e9
    if seconds <= LONGEST_S:
        yield from log.camera_blocks()
        return
    length = LONGEST_S / PARTS
    n_pieces = int(seconds // length)
    best: list[tuple[float, list[Frame]]] = [(-1.0, [])] * PARTS
    piece: list[Frame] = []
    current = 0
    for frame in log.frames():
        k = min(int((frame.log_time - start) / 1e9 // length), n_pieces - 1)
        if k != current:
            _keep_best(best, current * PARTS // n_pieces, piece)
            piece, current = [], k
        piece.append(frame)
    _keep_best(best, current * PARTS // n_pieces, piece)
    for _, frames in best:
        yield from map(Block.of, frames)


def _keep_best(best: list[tuple[float, list[Frame]]], part: int, frames: list[Frame]) -> None:
    """Keep a piece of a part if people spread further in it, summed over the cameras."""
    places: dict[str, list[np.ndarray[tuple[int], np.dtype[np.float64]]]] = defaultdict(list)
    for frame in frames:
        for pose in frame.positions:
            known = pose[~np.isnan(pose).any(axis=1)]
            if len(known):
                places[frame.source].append(known.mean(axis=0))
    score = sum(float(np.std(each, axis=0).sum()) * len(each) for each in places.values())
    if score > best[part][0]:
        best[part] = (score, frames)


def _check_frames(log: Log, cameras: list[Camera]) -> None:
    """Raise LogError if two cameras share a frame, or a camera moves."""
    owners: dict[str, str] = {}
    for name, frame in cameras:
        if frame in owners:
            raise LogError(
                f"{owners[frame]} and {name} publish in the same frame {frame!r}, so their poses "
                "are already applied; record the detections in each camera's own frame",
                path=log.path,
            )
        owners[frame] = name
        moving = frame in log.transforms.frames and not _at_rest(log, frame)
        if moving:
            raise LogError(
                f"{name} moves (its pose is on /tf); only cameras that stand still can be "
                "calibrated, choose them with --topic",
                path=log.path,
            )


def _at_rest(log: Log, frame: str) -> bool:
    return log.transforms.at_rest(frame, log.transforms.root(frame)) is not None


def _clock_shifts(late: dict[Camera, list[float]]) -> dict[Camera, float]:
    """Return s to add to the stamps of cameras whose clock is seconds away from the others'.

    The difference of log time and stamp shows it to the precision of the transport. A difference
    that is not constant shows nothing: such a log was not recorded live.
    """
    middles = {key: float(np.median(each)) for key, each in late.items()}
    nearest = min(middles.values(), key=abs, default=0.0)
    shifts = {}
    for key, each in late.items():
        constant = np.median(np.abs(np.array(each) - middles[key])) < 0.1
        off = middles[key] - nearest
        shifts[key] = off if constant and abs(off) > APART_S else 0.0
    return shifts
