"""One look at a log: the times of all messages, and whom the cameras see, thinned out.

Clocks, poses and cameras that were moved are found from it. The sightings are from stretches of the
log. More is read only where these do not suffice: if people are rare, if a camera may have been
moved, or if poses are to be found from nothing.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from itertools import product
from operator import attrgetter
from typing import NamedTuple

import numpy as np

from hiros_mcap.body.rotations import Rigid, to_matrix
from hiros_mcap.calibrate.camera_views import (
    CameraView,
    Seen,
    Sighting,
    find_tracklets,
    half_width_of,
    sightings_from,
)
from hiros_mcap.calibrate.handedness import WrongAxes, left_handed
from hiros_mcap.errors import LogError, naming
from hiros_mcap.frames import rows_between
from hiros_mcap.io.camera_clock import CameraTimes, ClockCorrection
from hiros_mcap.io.channels import CameraChannel
from hiros_mcap.io.log import Log
from hiros_mcap.skeletons import POSITION, Ints, Stamps

LONGEST_S, SHORTEST_S = 20.0, 12.0
"""So many seconds of a log are read, in stretches: half of it, within these limits."""
STRETCHES = 5
ENOUGH = 0.75
"""If the stretches show people in a smaller share of their time, more of the log is read."""
MOST_S = 120.0
_FEW = 200
"""If the stretches show fewer people, more of the log is read to tell left-handed axes."""
SPACING_NS = 60_000_000
"""About one frame in this time, every other one at 30 Hz. More tell little: the slow part of a
detector's errors is the larger one."""
ODD_S = 10.0

Span = tuple[int, int]
"""Log times, ns."""


class Survey:
    """One look at a log: times, transforms, model and sightings.

    Parameters
    ----------
    log : the log. seconds : how much of it gives sightings; None = enough to compare poses.
    fixed : whether sightings are in the fixed frame, or in the coordinates of the cameras.
    """

    def __init__(self, log: Log, seconds: float | None = None, *, fixed: bool = True) -> None:
        start, end = log.span
        if seconds is None:
            seconds = float(np.clip((end - start) / 2e9, SHORTEST_S, LONGEST_S))
        self.log, self.fixed, self.middle = log, fixed, (start + end) // 2
        self._seconds, self._spans = seconds, stretches(start, end, seconds, STRETCHES)
        tables: list[Stamps] | None = [] if log.has_plain_times else None
        self.seen = self._read(self._spans, tables)
        self.times: Mapping[str, CameraTimes] = log.times(tables or ())
        """Camera -> the times of its messages."""

    def sightings(self, corrections: Mapping[str, ClockCorrection]) -> dict[str, list[Sighting]]:
        """Camera -> whom it sees at corrected times, s from the middle of the log.

        The stretches suffice, or more is read.
        """
        seen = self._corrected(self.seen, corrections)
        if self.is_whole or _seconds_with_people(seen) >= ENOUGH * self._seconds:
            return seen
        return self.many(corrections)

    @property
    def is_whole(self) -> bool:
        """Whether the sightings are from the whole log."""
        return len(self._spans) == 1

    @property
    def left_handed(self) -> str:
        """Which cameras' axes are left-handed for sure, in words with the remedy; "" if none."""
        return axes_in_words(self.log, self.wrong_axes.axes) if self.wrong_axes.sure else ""

    @cached_property
    def wrong_axes(self) -> WrongAxes:
        """Which cameras' axes are left-handed."""
        cameras = fixed_cameras(self.log, camera_faults(self.log)) if self.fixed else ()
        poses = {camera.name: camera.pose for camera in cameras if camera.movable}
        few = sum(len(views.positions) for views in self.seen.values()) < _FEW
        own = dict(self._more if few else self.seen)
        for name in poses.keys() & own.keys():
            turn, place = to_matrix(poses[name].xyzw), poses[name].translation
            positions = (own[name].positions - place) @ turn
            own[name] = own[name]._replace(positions=positions.astype(np.float32))
        return left_handed(own, poses, self.log.model)

    def many(self, corrections: Mapping[str, ClockCorrection]) -> dict[str, list[Sighting]]:
        """Return what :meth:`sightings` does, of as much of the log as is useful."""
        return self._corrected(self._more, corrections)

    @cached_property
    def _more(self) -> dict[str, Seen]:
        if self.is_whole or self._seconds >= MOST_S:
            return self.seen
        return self._read(stretches(*self.log.span, MOST_S, STRETCHES))

    def between(
        self, span: Span, seconds: float, corrections: Mapping[str, ClockCorrection]
    ) -> dict[str, list[Sighting]]:
        """Return what :meth:`sightings` does, of so many seconds of a part of the log."""
        seen = self._read(stretches(*span, seconds, STRETCHES))
        return self._corrected(seen, corrections)

    def _read(self, spans: Sequence[Span], times: list[Stamps] | None = None) -> dict[str, Seen]:
        parts: dict[str, list[Seen]] = {}
        blocks = self.log.read(
            fixed=self.fixed, spans=spans, step=SPACING_NS, times=times, slim=True
        )
        for _, block in blocks:
            inside = np.zeros(len(block), np.bool_)
            for begin, end in spans:
                inside |= (begin <= block.log_times) & (block.log_times <= end)
            for code in dict.fromkeys(block.sources.tolist()):
                frames, name = np.flatnonzero(inside & (block.sources == code)), block.names[code]
                rows = rows_between(block.rows[frames])
                views = Seen(
                    block.stamps[frames],
                    block.log_times[frames],
                    block.sizes[frames],
                    block.people.markers[rows, :, POSITION].astype(np.float32),
                    block.people.marker_confidences[rows].astype(np.float32),
                )
                parts.setdefault(name, []).append(views)
        return {
            name: Seen(*map(np.concatenate, zip(*views, strict=True)))
            for name, views in parts.items()
        }

    def _corrected(
        self, seen: Mapping[str, Seen], corrections: Mapping[str, ClockCorrection]
    ) -> dict[str, list[Sighting]]:
        """Return sightings at corrected times.

        Left out is what a camera stamped at quite another time than most: its clock is wrong.
        """
        start, end = self.log.span
        seconds = {}
        for name, views in seen.items():
            times = CameraTimes(views.stamps, views.log_times).corrected(corrections.get(name))
            seconds[name] = (times.stamps - self.middle) / 1e9
        every = np.concatenate([np.zeros(0), *seconds.values()])
        middle, limit = float(np.median(every)) if len(every) else 0.0, (end - start) / 1e9 + ODD_S
        return {
            name: [
                sighting
                for sighting in sightings_from(
                    views.positions, views.confidences, views.counts, seconds[name]
                )
                if abs(sighting.seconds - middle) < limit
            ]
            for name, views in seen.items()
        }


def stretches(start: int, end: int, seconds: float, n: int) -> list[tuple[int, int]]:
    """Return n spans of a log, ns, that are ``seconds`` long together; all of a short log."""
    length = end - start
    if length <= 1e9 * seconds:
        return [(start, end)]
    part, piece = length / n, 1e9 * seconds / n
    begins = [round(start + k * part + (part - piece) / 2.0) for k in range(n)]
    return [(begin, begin + round(piece)) for begin in begins]


_MOVES = "its pose changes during the log, and only cameras at rest can be compared"
SHARED_FRAME = "its detections are in a frame that is not its own"


class FixedCamera(NamedTuple):
    """A camera, and where it stands."""

    name: str
    frame: str
    pose: Rigid
    movable: bool = True
    """Whether it stands still in a frame of its own, so that it may have another pose. The people
    of others are taken where they are in the fixed frame."""


def camera_faults(log: Log) -> dict[str, str]:
    """Name -> reason of each camera whose pose cannot be compared with the others'.

    A camera that shows nobody is in nobody's way.
    """
    faults: dict[str, str] = {}
    owners = Counter(frame for camera in log.cameras for frame in camera.frames)
    for camera in filter(attrgetter("frames"), log.cameras):
        frames = camera.frames
        shared = len(frames) != 1 or len(camera.sources) != 1 or owners[frames[0]] > 1
        if shared or moves(log, frames[0]):
            faults |= dict.fromkeys(camera.sources.values(), SHARED_FRAME if shared else _MOVES)
    return faults


def fixed_cameras(log: Log, faults: Mapping[str, str]) -> Iterator[FixedCamera]:
    """Yield the cameras that show people; those with faults are not movable."""
    fixed = log.fixed_frame
    for camera in filter(attrgetter("frames"), log.cameras):
        for name in camera.sources.values():
            if name in faults:
                yield FixedCamera(name, fixed, Rigid.identity(), movable=False)
            else:
                pose = log.transforms.at_rest(camera.frames[0], fixed)
                yield FixedCamera(name, camera.frames[0], pose or Rigid.identity())


def shared_frames(log: Log) -> dict[str, list[CameraChannel]]:
    """Frame -> the channels whose detections are in it, where these are several."""
    owners: dict[str, list[CameraChannel]] = {}
    for camera in log.cameras:
        for frame in camera.frames:
            owners.setdefault(frame, []).append(camera)
    return {frame: cameras for frame, cameras in owners.items() if len(cameras) > 1}


def with_own_frames(log: Log, frames: Iterable[str]) -> Log:
    """Return the log with a frame for each channel, where several are in one of ``frames``.

    A channel of several cameras or frames stays as it is.
    """
    shared = shared_frames(log)
    cameras = [camera for frame in frames for camera in shared.get(frame, [])]
    plain = [c for c in cameras if len(c.frames) == 1 and len(c.sources) == 1]
    return log.with_own_frames([camera.channel.topic for camera in plain])


def names_of(cameras: Iterable[CameraChannel]) -> list[str]:
    """Return the names of the cameras on some channels."""
    return [name for camera in cameras for name in camera.sources.values()]


def check_frames(log: Log) -> None:
    """Raise LogError if two cameras share a frame, or a camera moves."""
    owners: dict[str, str] = {}
    for camera in log.cameras:
        for name, frame in product(camera.sources.values(), camera.frames):
            if frame in owners:
                raise LogError(applied([owners[frame], name], frame), path=log.path)
            owners[frame] = name
            if moves(log, frame):
                raise LogError(
                    f"{name} moves (its pose is on /tf); only cameras that stand still can be "
                    "calibrated, choose them with --topic",
                    path=log.path,
                )


def applied(names: Sequence[str], frame: str) -> str:
    """Say that the poses of cameras in one frame cannot be found any more."""
    return (
        f"{in_words(names)} publish in the same frame {frame!r}, so their poses are already "
        "applied; record the detections in each camera's own frame"
    )


def in_words(names: Sequence[str]) -> str:
    """Return names as a list in words."""
    return " and ".join(filter(None, (", ".join(names[:-1]), names[-1])))


def moves(log: Log, frame: str) -> bool:
    """Whether the log knows how a frame moves."""
    if frame not in log.transforms.frames:
        return False
    with naming(log.path):
        return log.transforms.at_rest(frame, log.transforms.root(frame)) is None


def seen_by(
    camera: FixedCamera, sightings: Sequence[Sighting], mirror: Ints, shift: float = 0.0
) -> CameraView:
    """Return what a camera sees, in its own frame, of sightings in the fixed frame.

    Its times are ``shift`` s later than stated.
    """
    late = [s._replace(seconds=s.seconds + shift) for s in sightings]
    late.sort(key=attrgetter("seconds"))
    half_width, tracks = half_width_of([s.seconds for s in late]), find_tracklets(late, mirror)
    return in_own_frame(camera, CameraView(camera.name, camera.frame, tracks, shift, half_width))


def in_own_frame(camera: FixedCamera, view: CameraView) -> CameraView:
    """Return what a camera sees, in its own frame, of a view in the fixed frame."""
    turn, place = to_matrix(camera.pose.xyzw), camera.pose.translation
    tracks = [track._replace(positions=(track.positions - place) @ turn) for track in view.tracks]
    return replace(view, tracks=tracks)


def axes_in_words(log: Log, wrong: Mapping[str, str]) -> str:
    """Say which cameras (with their axis) are left-handed, and name the option that mends it."""
    topics = {name: c.channel.topic for c in log.cameras if c.frames for name in c.sources.values()}
    same = len(wrong) == len(topics) and len(set(wrong.values())) == 1
    parts, options = [], []
    for axis in sorted(set(wrong.values())):
        names = sorted(name for name in wrong if wrong[name] == axis)
        parts.append(f"the axes of {in_words(names)} are left-handed: negate {axis}")
        options += [axis] if same else [f"{topics[name]}={axis}" for name in names]
    if not parts:
        return ""
    option = ",".join(options)
    return f'{"; ".join(parts)} (--negate {option}, or input.negate = "{option}" in hiros.toml)'


def _seconds_with_people(seen: Mapping[str, Sequence[Sighting]]) -> int:
    """Return in how many seconds at least two cameras see somebody."""
    times = Counter(
        second
        for views in seen.values()
        for second in {int(s.seconds // 1.0) for s in views if len(s.positions)}
    )
    return sum(n > 1 for n in times.values())
