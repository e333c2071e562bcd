"""Two baselines behind the association by centroids: means over time and over cameras."""

from __future__ import annotations

from hiros_mcap.frames import by_block
from hiros_mcap.systems.raw import raw
from hiros_mcap.systems.run import Run, Stages


def maf(run: Run) -> Stages:
    """Average each person's last detections (Malaguti 2019, IV)."""
    from hiros_mcap.stages.malaguti.moving_average import moving_average

    params = run.config.moving_average
    mean = run.stage(moving_average, params, fixed_frame=run.fixed_frame)
    return {**raw(run), "merged": by_block(mean)}


def average(run: Run) -> Stages:
    """Average what the cameras see at one time."""
    from hiros_mcap.stages.merge.merge import merge_blocks

    mean = run.stage(merge_blocks, run.config.merge, fixed_frame=run.fixed_frame)
    return {**raw(run), "merged": mean}
