"""Base class of the readers of detectors' messages.

A reader takes one message and gives the skeletons in it, or declines::

    class MyBodies(DetectorReader):
        types = ("my_msgs/Bodies",)

        def read(self, message):
            bodies = message.fields.bodies
            if not bodies:
                return None
            ...
            return [seen_people(MODEL, message, frame_id, positions, stamp=stamp)]

:mod:`hiros_mcap.io.detectors` is where hiros finds it.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar, NamedTuple

import numpy as np

from hiros_mcap.skeletons import POSITION, SECOND, Floats, Frame, SkeletonModel


@dataclass(frozen=True)
class DetectorMessage:
    """A message of ROS 1 or ROS 2, not decoded yet."""

    topic: str
    type: str
    """``pkg/Type``."""
    log_time: int
    """ns."""
    cdr: bytes | memoryview
    """Its bytes as ROS 2 writes them, also of a message of ROS 1."""
    decode: Callable[[bytes | memoryview], Any]

    @cached_property
    def fields(self) -> Any:
        """The message with its fields as attributes; arrays of numbers are numpy arrays.

        Raises LogError for damaged bytes.
        """
        return self.decode(self.cdr)


class SeenPeople(NamedTuple):
    """The people that a camera saw at one instant."""

    topic: str
    """Of the channel that it becomes."""
    model: SkeletonModel
    """Of the frame."""
    frame: Frame
    """In the coordinates of the camera; m, ns."""


class DetectorReader(ABC):
    """Reads one kind of message. There is one instance per log, so it may keep what it saw.

    Attributes
    ----------
    types : the message types that it is asked about, ``pkg/Type``.
    hint : why messages were declined that look like the reader's own; "" if none does.
    """

    types: ClassVar[Sequence[str]]
    hint: str = ""

    @abstractmethod
    def read(self, message: DetectorMessage) -> Iterable[SeenPeople] | None:
        """Return what a message shows; None if it is of another use and shows no skeletons.

        No element means that more messages are needed. An element of nobody means that the
        camera saw nobody. Raises LogError for a message that cannot be read.
        """

    def rest(self) -> Iterable[SeenPeople]:
        """Return what is still held back at the end of the log."""
        return ()

    def remarks(self) -> Iterable[str]:
        """Return what a user should know of the messages that were read."""
        return ()


def seen_people(
    model: SkeletonModel,
    message: DetectorMessage,
    frame_id: str,
    positions: Floats,
    *,
    stamp: int = 0,
    ids: Sequence[int] | None = None,
    confidences: Sequence[float] | None = None,
) -> SeenPeople:
    """Return people whose joints are points.

    Parameters
    ----------
    model : names the joints. message : gives topic and log time.
    frame_id : coordinate frame of the positions.
    positions : (P, M, 3) m; NaN where a joint was not seen.
    stamp : time of the image, ns; 0 = not given, then the log time counts.
    ids : of the detector's own tracking. confidences : of each person, 0 to 1.
    """
    n = len(positions)
    frame = Frame.empty(
        n, model, stamp=stamp, log_time=message.log_time, source=frame_id, frame_id=frame_id
    )
    frame.markers[:, :, POSITION] = positions
    if ids is not None:
        frame.ids[:] = ids
    if confidences is not None:
        frame.confidences[:] = confidences
    add_links(frame, model)
    return SeenPeople(message.topic, model, frame)


def add_links(frame: Frame, model: SkeletonModel) -> None:
    """Give a link the confidence 1 where both of its markers are; otherwise it is absent."""
    there = ~np.isnan(frame.markers[:, :, 0])
    both = there[:, model.links].all(axis=-1) & (model.links >= 0).all(axis=-1)
    frame.link_confidences[both] = 1.0


def nanoseconds(stamp: Any) -> int:
    """Return the time, ns, of a ``builtin_interfaces/Time``."""
    return int(stamp.sec) * SECOND + int(stamp.nanosec)
