"""The moving average that systems of this field are compared with (Malaguti 2019, IV)."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator

import numpy as np
from pydantic import Field

from hiros_mcap.events import Events
from hiros_mcap.params import Params
from hiros_mcap.skeletons import POSITION, UNTRACKED, Floats, Frame, SkeletonModel


class MovingAverageParams(Params):
    """Parameters of the moving average."""

    window: int = Field(5, ge=1, description="Detections that are averaged (OpenPTrack's MAF).")
    lifetime: float = Field(
        0.6, gt=0, description="s after which a detection does not count any more."
    )


def moving_average(
    frames: Iterable[Frame],
    model: SkeletonModel,
    params: MovingAverageParams | None = None,
    events: Events | None = None,
    fixed_frame: str = "",
) -> Iterator[Frame]:
    """Average each joint over the person's last detections, whichever cameras they are of.

    Parameters
    ----------
    frames : with ids, in the fixed frame. model, params : see :class:`MovingAverageParams`.
    events : unused; every stage takes one. fixed_frame : source of the output.

    Yields
    ------
    One frame per message, with the people that it shows.
    """
    params = params or MovingAverageParams()
    past: dict[int, deque[tuple[int, Floats]]] = {}
    limit = round(params.lifetime * 1e9)
    for frame in frames:
        tracked = frame.select(frame.ids != UNTRACKED)
        fixed = fixed_frame or frame.frame_id
        out = tracked.replace(markers=tracked.markers.copy(), source=fixed)
        for row, person in enumerate(tracked.ids.tolist()):
            mine = past.setdefault(person, deque(maxlen=params.window))
            mine.append((frame.stamp, tracked.positions[row].copy()))
            poses = np.stack([pose for stamp, pose in mine if abs(frame.stamp - stamp) <= limit])
            known = ~np.isnan(poses)
            total = np.where(known, poses, 0.0).sum(axis=0)
            count = known.sum(axis=0)
            mean = np.where(count > 0, total / np.maximum(count, 1), np.nan)
            out.markers[row, :, POSITION] = mean
        yield out
