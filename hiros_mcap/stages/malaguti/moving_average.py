"""The moving average that systems of this field are compared with (Malaguti 2019, IV)."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np

from hiros_mcap.events import Events
from hiros_mcap.skeletons import POSITION, UNTRACKED, Frame, SkeletonModel
from hiros_mcap.stages.bank import Bank
from hiros_mcap.stages.malaguti.malaguti_params import MovingAverageParams


def moving_average(
    frames: Iterable[Frame], model: SkeletonModel, params: MovingAverageParams | None = None,
    events: Events | None = None, fixed_frame: str = "",
) -> Iterator[Frame]:  # fmt: skip
    """Average each joint over the person's last detections, whichever cameras they are of.

    Parameters
    ----------
    frames : with ids, in the fixed frame. model : of the frames.
    params : parameters. events : unused; every stage takes one.
    fixed_frame : source of the output; empty = that of the frames.

    Yields
    ------
    One frame per message, with the people that it shows.
    """
    params = params or MovingAverageParams()
    lifetime = round(params.lifetime * 1e9)
    none = np.zeros((0, params.window, model.n_markers, 3))
    # (R, W) times, ns, and (R, W, M, 3) places, m, of the last W detections of R people
    bank = Bank((np.zeros((0, params.window), np.int64), none), params.lifetime)
    for frame in frames:
        bank.expire(frame.stamp)
        out = frame.select(frame.ids != UNTRACKED).replace(source=fixed_frame or frame.frame_id)
        rows = [bank.row(person, frame.stamp) for person in out.ids.tolist()]
        for row, pose in zip(rows, out.positions, strict=True):
            for array, newest in zip(bank.past, (frame.stamp, pose), strict=True):
                array[row, :-1] = array[row, 1:]
                array[row, -1] = newest
        stamps, poses = (array[rows] for array in bank.past)
        counts = np.abs(frame.stamp - stamps) <= lifetime
        recent = ~np.isnan(poses) & counts[:, :, np.newaxis, np.newaxis]
        total = np.where(recent, poses, 0.0).sum(axis=1)
        with np.errstate(invalid="ignore"):
            out.markers[:, :, POSITION] = total / recent.sum(axis=1)
        yield out
