"""What a log holds, for somebody who sees it for the first time."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any

from hiros_mcap.errors import LogError
from hiros_mcap.io.camera_clock import clocks_in_words, judge_clocks
from hiros_mcap.io.log import Log, open_log
from hiros_mcap.summary import plain

_GAP_S = 1.0


@dataclass(frozen=True, slots=True)
class ChannelRow:
    """A channel of the file."""

    topic: str
    type: str
    encoding: str
    messages: int


@dataclass(frozen=True, slots=True)
class CameraRow:
    """A camera whose skeletons can be read."""

    name: str
    topic: str
    frame: str
    """Frame of its detections, "" if no message says."""
    fault: str
    """Why that frame cannot be expressed in the fixed frame, "" if it can."""
    frames: int
    """Messages with something new in them."""
    rate_hz: float
    """Frames per second of the camera's own time, gaps of more than 1 s left out."""
    longest_gap_s: float
    """Longest time between two frames, s."""
    least_people: int
    most_people: int
    mean_people: float


@dataclass(frozen=True, slots=True)
class Overview:
    """The whole log."""

    path: str
    seconds: float
    """Time between the first and the last message, s."""
    megabytes: float
    channels: tuple[ChannelRow, ...]
    cameras: tuple[CameraRow, ...]
    markers: tuple[str, ...]
    links: tuple[str, ...]
    fixed_frame: str
    """Frame that results would be in, "" if there is none."""
    fault: str
    """Why there is no fixed frame, "" if there is."""
    remarks: tuple[str, ...]
    """Notes about the log."""
    skipped: Mapping[str, Mapping[str, int]]
    """Messages that give nothing, by topic and reason."""
    clocks: tuple[str, ...]
    """What the times of the messages say about the cameras' clocks."""

    def to_dict(self) -> dict[str, Any]:
        """Plain data for JSON; numbers that are not finite are None."""
        return plain(self)


@dataclass(slots=True)
class _CameraCounts:
    """Times and numbers of people of a camera's frames."""

    topic: str
    frame: str
    stamps: list[int] = field(default_factory=list)
    people: list[int] = field(default_factory=list)

    def row(self, name: str, fault: str) -> CameraRow:
        """Return the camera's line of the overview."""
        ordered = sorted(self.stamps)
        steps = [(b - a) / 1e9 for a, b in pairwise(ordered) if b > a]
        steady = [step for step in steps if step <= _GAP_S]
        return CameraRow(
            name=name,
            topic=self.topic,
            frame=self.frame,
            fault=fault,
            frames=len(self.stamps),
            rate_hz=len(steady) / sum(steady) if steady else math.nan,
            longest_gap_s=max(steps, default=math.nan),
            least_people=min(self.people, default=0),
            most_people=max(self.people, default=0),
            mean_people=sum(self.people) / len(self.people) if self.people else math.nan,
        )


def look(
    path: str | os.PathLike[str],
    *,
    topics: Sequence[str] | None = None,
    extrinsics: str | os.PathLike[str] | None = None,
) -> Overview:
    """Read a log from end to end and report what is in it.

    Parameters are those of :func:`hiros_mcap.io.log.open_log`, and so are the errors: a log that
    cannot be read, or that holds no skeletons, has no overview. Frames that do not resolve are
    no error here but part of the answer.
    """
    with open_log(path, topics=topics, extrinsics=extrinsics) as log:
        fixed, fault = _fixed_frame(log)
        counts = _counts(log)
        start, end = log.span
        return Overview(
            path=str(path),
            seconds=(end - start) / 1e9,
            megabytes=Path(log.path).stat().st_size / 1e6,
            channels=tuple(
                ChannelRow(info.topic, info.schema, info.encoding, info.count)
                for info in log.channels
            ),
            cameras=tuple(
                count.row(name, _unresolved(log, count.frame, fixed))
                for name, count in counts.items()
            ),
            markers=log.model.marker_names,
            links=log.model.link_names,
            fixed_frame=fixed,
            fault=fault,
            remarks=log.remarks,
            skipped={t: dict(account.skipped) for t, account in log.accounts.items()},
            clocks=clocks_in_words(judge_clocks(log.times()), start),
        )


def _fixed_frame(log: Log) -> tuple[str, str]:
    try:
        return log.fixed_frame, ""
    except LogError as error:
        return "", error.fault


def _unresolved(log: Log, frame: str, fixed: str) -> str:
    """Return why ``frame`` does not resolve to ``fixed``, "" if it does."""
    try:
        log.transforms.lookup(frame, fixed or log.transforms.root(frame), 0)
    except LogError as error:
        return error.fault
    return "" if fixed or not frame else "no fixed frame"


def _counts(log: Log) -> dict[str, _CameraCounts]:
    topics = {name: camera for camera in log.cameras for name in camera.sources.values()}
    counts = {
        name: _CameraCounts(camera.channel.topic, next(iter(camera.frames), ""))
        for name, camera in topics.items()
    }
    for frame in log.frames():
        count = counts.setdefault(frame.source, _CameraCounts("", frame.frame_id))
        count.stamps.append(frame.stamp)
        count.people.append(frame.n_people)
    return counts
