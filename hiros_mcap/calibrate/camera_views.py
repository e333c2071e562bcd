"""What each camera of a log sees of the people, as tracklets in its own frame and time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from hiros_mcap.calibrate.tracklets import Sighting, find_tracklets
from hiros_mcap.frames import Block
from hiros_mcap.kernels.local_line import Tracklet
from hiros_mcap.skeletons import POSITION, Floats, Ints, Stamps

HALF_WIDTH_S = 0.1
"""Half of the time over which a joint's path is taken for a line; more for slow cameras."""
CONFIDENCE_POWER = 3
"""A joint's weight is its confidence to this power: a guess at 1/3 counts an eighth."""


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


def view_of(
    name: str, frame: str, sightings: Sequence[Sighting], mirror: Ints, shift: float = 0.0
) -> CameraView:
    """Follow the people whom one camera sees; its times are ``shift`` s later than stated."""
    sightings = [s._replace(seconds=s.seconds + shift) for s in sightings]
    sightings.sort(key=lambda s: s.seconds)
    half_width = half_width_of([s.seconds for s in sightings])
    return CameraView(name, frame, find_tracklets(sightings, mirror), shift, half_width)


def half_width_of(times: Sequence[float]) -> float:
    """Return half of the time, s, over which a joint's path is taken for a line."""
    period = float(np.median(np.diff(times))) if len(times) > 1 else 0.0
    return max(HALF_WIDTH_S, 2.0 * period)


def sightings_of(block: Block, frames: Sequence[int], middle: int) -> list[Sighting]:
    """Return whom some frames of a block show. Seconds count from ``middle``, ns."""
    chosen = np.array(frames, np.int64)
    rows = rows_of(block, chosen)
    return sightings_from(
        block.people.markers[rows, :, POSITION],
        block.people.marker_confidences[rows],
        np.diff(block.rows[chosen], axis=1)[:, 0],
        (block.stamps[chosen] - middle) / 1e9,
    )


def rows_of(block: Block, frames: Stamps) -> Stamps:
    """Return the rows of the people of some frames."""
    bounds = block.rows[frames].tolist()
    return np.concatenate([np.zeros(0, np.int64), *(np.arange(*each) for each in bounds)])


def sightings_from(
    positions: npt.NDArray[Any], confidences: npt.NDArray[Any], counts: Stamps, seconds: Floats
) -> list[Sighting]:
    """Return N sightings.

    Parameters
    ----------
    positions, confidences : (P, M, 3) and (P, M) of all people. counts : (N,) people of each.
    seconds : (N,).
    """
    confidences = np.where(np.isnan(confidences), 1.0, confidences)
    absent = np.isnan(positions).any(axis=2) | (confidences <= 0.0)
    weights = np.where(absent, 0.0, confidences.astype(np.float64) ** CONFIDENCE_POWER)
    places = np.where(absent[:, :, None], np.nan, positions)
    ends = np.cumsum(counts)[:-1]
    parts = np.split(places.astype(np.float64), ends), np.split(weights, ends)
    return [Sighting(*each) for each in zip(seconds.tolist(), *parts, strict=False)]
