"""Rows of a recording's entities, collected and sent as columns."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from hiros_mcap.skeletons import Floats

TIMELINE = "stamp"


@dataclass(slots=True)
class PointRows:
    """Points of one entity over time; a row without points hides it."""

    stamps: list[int] = field(default_factory=list)
    points: list[Floats] = field(default_factory=list)
    """(K, 3) each."""
    radii: list[Floats] = field(default_factory=list)
    """(K,) each, m."""
    classes: list[list[int]] = field(default_factory=list)
    """K each; empty if the entity has one class for good."""
    keypoints: list[list[int]] = field(default_factory=list)
    """K each; empty if points are no joints."""
    shown: bool = False
    last: int = 0

    def add(
        self,
        stamp: int,
        points: Floats,
        radii: Floats,
        classes: list[int] | None = None,
        keypoints: list[int] | None = None,
    ) -> None:
        """Append a row."""
        self.stamps.append(stamp)
        self.points.append(points)
        self.radii.append(radii)
        self.classes.append(classes or [])
        self.keypoints.append(keypoints or [])
        self.shown, self.last = len(points) > 0, stamp

    def hide(self, stamp: int) -> None:
        """Append an empty row, unless nothing is shown."""
        if self.shown:
            last = self.last
            self.add(stamp, np.zeros((0, 3)), np.zeros(0))
            self.last = last


@dataclass(slots=True)
class BodyRows:
    """One body over time; all that is drawn of it is derived from its joints when it is sent."""

    stamps: list[int] = field(default_factory=list)
    poses: list[Floats | None] = field(default_factory=list)
    """(M, 3) m each; None hides the body."""
    confidences: list[Floats] = field(default_factory=list)
    """(M,) of each pose."""
    shown: bool = False
    last: int = 0
    last_root: tuple[int, Floats] | None = None
    """Stamp and place of the root in the last row that was sent."""

    def add(self, stamp: int, pose: Floats, confidences: Floats) -> None:
        """Append a row."""
        self.stamps.append(stamp)
        self.poses.append(pose)
        self.confidences.append(confidences)
        self.shown, self.last = True, stamp

    def hide(self, stamp: int) -> None:
        """Append an empty row, unless nothing is shown."""
        if self.shown:
            self.stamps.append(stamp)
            self.poses.append(None)
            self.shown = False


@dataclass(slots=True)
class ScalarRows:
    """Curves of one entity over time."""

    names: tuple[str, ...]
    stamps: list[int] = field(default_factory=list)
    values: list[Floats] = field(default_factory=list)
    """(len(names),) each."""
    started: bool = False

    def add(self, stamp: int, values: Floats) -> None:
        """Append a row."""
        self.stamps.append(stamp)
        self.values.append(values)

    def extend(self, stamps: list[int], values: Floats) -> None:
        """Append rows (T, len(names))."""
        self.stamps += stamps
        self.values += list(values)


@dataclass(slots=True)
class TextRows:
    """Lines of a log, or states, over time."""

    stamps: list[int] = field(default_factory=list)
    texts: list[str] = field(default_factory=list)
    levels: list[str] = field(default_factory=list)

    def add(self, stamp: int, text: str, level: str = "INFO") -> None:
        """Append a row."""
        self.stamps.append(stamp)
        self.texts.append(text)
        self.levels.append(level)
