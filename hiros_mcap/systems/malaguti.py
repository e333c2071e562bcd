"""Malaguti et al. (2019) and the systems that it is compared with."""

from __future__ import annotations

from functools import partial

from hiros_mcap.frames import by_block
from hiros_mcap.systems.run import Run, Stages


def malaguti(run: Run) -> Stages:
    """Association by centroids, one Kalman filter per person, limb lengths (Fig. 1)."""
    from hiros_mcap.stages.straighten import straighten

    lengths = partial(
        straighten,
        model=run.model,
        params=run.config.straighten,
        events=run.events,
        limbs=run.limbs,
    )
    return {**openptrack(run), "optimized": by_block(lengths)}


def openptrack(run: Run) -> Stages:
    """Association by centroids and a filter per joint; as OpenPTrack by its parameters."""
    from hiros_mcap.stages.kalman import kalman

    fuse = partial(
        kalman,
        model=run.model,
        params=run.config.kalman,
        events=run.events,
        fixed_frame=run.fixed_frame,
        cameras=run.cameras,
    )
    return {**raw(run), "merged": by_block(fuse)}


def raw(run: Run) -> Stages:
    """Pass detections as they are, with the ids of the association."""
    from hiros_mcap.stages.associate import associate

    who = partial(associate, model=run.model, params=run.config.associate, events=run.events)
    return {"tracked": by_block(who)}


def maf(run: Run) -> Stages:
    """Association, then a moving average."""
    from hiros_mcap.stages.moving_average import moving_average

    smooth = partial(
        moving_average,
        model=run.model,
        params=run.config.moving_average,
        events=run.events,
        fixed_frame=run.fixed_frame,
    )
    return {**raw(run), "merged": by_block(smooth)}


def average(run: Run) -> Stages:
    """Association, then the plain mean of what the cameras see at one time."""
    from hiros_mcap.stages.merge import merge_blocks

    mean = partial(
        merge_blocks,
        model=run.model,
        params=run.config.merge,
        events=run.events,
        fixed_frame=run.fixed_frame,
    )
    return {**raw(run), "merged": mean}
