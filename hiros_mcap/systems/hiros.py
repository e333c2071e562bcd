"""Hi-ROS (Guidolin et al. 2023): tracker, merger, optimizer, filter; and our own system."""

from __future__ import annotations

from dataclasses import replace

from hiros_mcap.frames import BlockStage
from hiros_mcap.stages.merge.merge_params import MergeParams
from hiros_mcap.systems.run import Run, Stages


def hiros(run: Run) -> Stages:
    """Output channel -> the stage that fills it, in the order of the paper (Fig. 2)."""
    from hiros_mcap.stages.filter.filter import filter_blocks
    from hiros_mcap.stages.merge.merge import merge_blocks
    from hiros_mcap.stages.optimize.optimize import optimize_blocks
    from hiros_mcap.stages.track.track import track_blocks

    config = run.config
    mended, merging = _mended_views(run, guesses=True)
    merge = run.stage(merge_blocks, merging, fixed_frame=run.fixed_frame, cameras=run.cameras)
    return {
        "tracked": run.stage(track_blocks, config.track, cameras=run.cameras),  # 3.1
        "merged": lambda blocks: merge(mended(blocks)),  # 3.2
        "optimized": run.stage(optimize_blocks, config.optimize, limbs=run.limbs),  # 3.3
        "filtered": run.stage(filter_blocks, config.filter),  # 3.4
    }


def fuse(run: Run) -> Stages:
    """All cameras fused by one smoother per joint: output channel -> the stage that fills it."""
    from hiros_mcap.stages.filter.filter import filter_blocks
    from hiros_mcap.stages.fuse.align_links import align_blocks
    from hiros_mcap.stages.fuse.constrain import constrain_blocks
    from hiros_mcap.stages.fuse.fuse import fuse_blocks, noise_of
    from hiros_mcap.stages.track.track import track_blocks

    config = run.config
    mended, merging = _mended_views(run, guesses=False)
    noise = noise_of(run.model, config.fuse, run.noise)
    noise = replace(noise, to_given=run.to_given, pose_errors=run.pose_errors, clocks=run.clocks)
    fusion = run.stage(
        fuse_blocks, config.fuse, merging=merging, fixed_frame=run.fixed_frame,
        cameras=run.cameras, noise=noise,
    )  # fmt: skip
    bodies = run.stage(constrain_blocks, config.constrain, limbs=run.limbs)
    derivatives = run.stage(filter_blocks, config.filter, keep_positions=True)
    return {
        "tracked": run.stage(track_blocks, config.track, cameras=run.cameras),
        # smoothed positions
        "merged": lambda blocks: fusion(mended(blocks)),
        # lengths and prior; links along the bones
        "optimized": lambda blocks: align_blocks(bodies(blocks), run.model),
        # velocities and accelerations
        "filtered": derivatives,
    }


def _mended_views(run: Run, *, guesses: bool) -> tuple[BlockStage, MergeParams]:
    """Return what comes between tracker and merger, and the merger's parameters.

    Detections that contradict the person's own body count less; then left and right are decided;
    then joints that a camera does not see count less. With ``guesses``, so do those that its
    detector guesses by its own word. Where left and right are decided, the merger does not vote
    on them (section 3.2).
    """
    from hiros_mcap.stages.detections.hidden import mend_hidden_blocks
    from hiros_mcap.stages.detections.plausible import drop_implausible_blocks
    from hiros_mcap.stages.detections.sides import decide_sides, knows_sides

    merging = run.config.merge
    if run.config.sides.over_time and knows_sides(run.model):
        merging = merging.model_copy(update={"max_facing_delta": 0.0})
    bodies = run.stage(drop_implausible_blocks, run.config.plausible, cameras=run.cameras)
    decide = run.stage(decide_sides, run.config.sides)
    hidden = run.stage(
        mend_hidden_blocks, run.config.plausible, cameras=run.cameras, guesses=guesses
    )
    return lambda blocks: hidden(decide(bodies(blocks))), merging


def merging_order(params: MergeParams) -> tuple[str, ...]:
    """Return what the merger does with the views of a person, in order (section 3.2)."""
    votes = params.max_position_delta > 0 or params.max_orientation_delta > 0
    steps = {"flips": params.max_facing_delta > 0, "outliers": votes, "mean": True}
    return tuple(name for name, is_on in steps.items() if is_on)
