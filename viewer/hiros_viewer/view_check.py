"""How each camera's detections compare with the result: what it sees, mirrors, and gets wrong."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from hiros_mcap.kernels.distance import nearest
from hiros_mcap.skeletons import Flags, Floats, Ints

MIRRORED, FAR_OFF = "mirrored", "far off"
FAULTS = (MIRRORED, FAR_OFF)
SAME_PERSON_M = 1.0
_MIRRORED_M, _MIRRORED_SHARE = 0.1, 0.6
"""A detection is mirrored if it is this far from the result, and much nearer with sides swapped."""
_FAR_OFF_M = 0.2
_LAPSE_NS = 250_000_000
"""A fault goes on if it is seen again within this time."""
_SHORTEST_NS = 100_000_000
"""A shorter fault is noise."""


class FaultySpan(NamedTuple):
    """When a camera's view was wrong, ns."""

    kind: str
    start: int
    end: int


@dataclass(slots=True)
class ViewCheck:
    """Compares one camera's detections with the result, message by message."""

    mirror: Ints
    """(M,) Marker on the other side."""
    seen: int = 0
    """People of the result whom the camera reports, over all messages."""
    people: int = 0
    """People of the result, over all messages."""
    seconds: dict[str, float] = field(default_factory=dict)
    """By kind: how long the view was wrong."""
    distances: list[float] = field(default_factory=list)
    """Of each message: mean distance to the result, mm."""
    _open: dict[str, tuple[int, int]] = field(default_factory=dict)
    """By kind: first and last stamp of a fault that goes on."""

    def compare(self, positions: Floats, result: Floats) -> dict[str, Flags]:
        """Compare detections (P, M, 3) with the people of the result (Q, M, 3), m.

        Returns
        -------
        Kind of fault -> (P,) which detections have it.
        """
        plain, swapped = np.empty(len(positions)), np.empty(len(positions))
        nearest(positions, result, plain)
        nearest(np.ascontiguousarray(positions[:, self.mirror]), result, swapped)
        found = np.empty(len(result))
        nearest(result, positions, found)
        self.seen += int((found < SAME_PERSON_M).sum())
        self.people += len(result)
        same = plain < SAME_PERSON_M
        if same.any():
            self.distances.append(1000 * float(plain[same].mean()))
        mirrored = same & (plain > _MIRRORED_M) & (swapped < _MIRRORED_SHARE * plain)
        return {MIRRORED: mirrored, FAR_OFF: same & ~mirrored & (plain > _FAR_OFF_M)}

    def spans(self, stamp: int, faults: dict[str, Flags]) -> Iterator[FaultySpan]:
        """Note the faults at an instant, ns; yield those that are over by now."""
        for kind, rows in faults.items():
            start, last = self._open.get(kind, (stamp, stamp))
            if kind in self._open and stamp - last > _LAPSE_NS:
                yield from self._close(kind)
                start = stamp
            if rows.any():
                self._open[kind] = (start, stamp)

    def finish(self) -> Iterator[FaultySpan]:
        """Yield the faults that go on until the end."""
        for kind in list(self._open):
            yield from self._close(kind)

    def _close(self, kind: str) -> Iterator[FaultySpan]:
        start, last = self._open.pop(kind)
        if last - start >= _SHORTEST_NS:
            self.seconds[kind] = self.seconds.get(kind, 0.0) + (last - start) / 1e9
            yield FaultySpan(kind, start, last)

    def row(self) -> tuple[str, ...]:
        """Return coverage, median distance, and how long the view was wrong, as text."""
        coverage = f"{self.seen / self.people:.0%}" if self.people else "-"
        distance = f"{np.median(self.distances):.0f} mm" if self.distances else "-"
        return (coverage, distance, *(f"{self.seconds.get(kind, 0.0):.1f} s" for kind in FAULTS))
