"""Our own system: all cameras fused by one smoother per joint."""

from __future__ import annotations

from hiros_mcap.systems.hiros import left_and_right
from hiros_mcap.systems.run import Run, Stages


def fuse(run: Run) -> Stages:
    """Output channel -> the stage that fills it."""
    from hiros_mcap.stages.filter.filter import filter_blocks
    from hiros_mcap.stages.fuse.align_links import align_blocks
    from hiros_mcap.stages.fuse.constrain import constrain_blocks
    from hiros_mcap.stages.fuse.fuse import fuse_blocks, noise_of
    from hiros_mcap.stages.track.track import track_blocks

    config = run.config
    sides, merging = left_and_right(run)
    fusion = run.stage(
        fuse_blocks, config.fuse, merging=merging, fixed_frame=run.fixed_frame,
        cameras=run.cameras, noise=noise_of(run.model, config.fuse, run.noise, run.to_given),
    )  # fmt: skip
    bodies = run.stage(constrain_blocks, config.constrain, limbs=run.limbs)
    derivatives = run.stage(filter_blocks, config.filter, keep_positions=True)
    return {
        "tracked": run.stage(track_blocks, config.track, cameras=run.cameras),
        # smoothed positions
        "merged": lambda blocks: fusion(sides(blocks)),
        # lengths and prior; links along the bones
        "optimized": lambda blocks: align_blocks(bodies(blocks), run.model),
        # velocities and accelerations
        "filtered": derivatives,
    }
