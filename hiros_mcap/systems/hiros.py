"""Hi-ROS (Guidolin et al. 2023): tracker, merger, optimizer, filter."""

from __future__ import annotations

from functools import partial

from hiros_mcap.stages.merge import MergeParams
from hiros_mcap.systems.run import Run, Stages


def hiros(run: Run) -> Stages:
    """Output channel -> the stage that fills it, in the order of the paper (Fig. 2)."""
    from hiros_mcap.stages.filter import filter_blocks
    from hiros_mcap.stages.merge import merge_blocks
    from hiros_mcap.stages.optimize import optimize_blocks
    from hiros_mcap.stages.track import track_blocks

    model, config, events = run.model, run.config, run.events
    return {
        "tracked": partial(
            track_blocks, model=model, params=config.track, events=events, cameras=run.cameras
        ),
        "merged": partial(
            merge_blocks,
            model=model,
            params=config.merge,
            events=events,
            fixed_frame=run.fixed_frame,
        ),
        "optimized": partial(
            optimize_blocks, model=model, params=config.optimize, events=events, limbs=run.limbs
        ),
        "filtered": partial(filter_blocks, model=model, params=config.filter, events=events),
    }


def merging_order(params: MergeParams) -> tuple[str, ...]:
    """Return what the merger does with the views of a person, in order (section 3.2)."""
    votes = params.max_position_delta > 0 or params.max_orientation_delta > 0
    steps = {"flips": params.max_facing_delta > 0, "outliers": votes, "mean": True}
    return tuple(name for name, is_on in steps.items() if is_on)
