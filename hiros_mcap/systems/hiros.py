"""Hi-ROS (Guidolin et al. 2023): tracker, merger, optimizer, filter."""

from __future__ import annotations

from functools import partial

from hiros_mcap.systems.run import Run, Stages


def hiros(run: Run) -> Stages:
    """Output channel -> the stage that fills it, in the order of the paper (Fig. 2)."""
    from hiros_mcap.stages.merge import merge
    from hiros_mcap.stages.optimize import optimize
    from hiros_mcap.stages.smooth import smooth
    from hiros_mcap.stages.track import track

    model, config, events = run.model, run.config, run.events
    return {
        "tracked": partial(
            track, model=model, params=config.track, events=events, cameras=run.cameras
        ),
        "merged": partial(
            merge, model=model, params=config.merge, events=events, fixed_frame=run.fixed_frame
        ),
        "optimized": partial(
            optimize, model=model, params=config.optimize, events=events, limbs=run.limbs
        ),
        "filtered": partial(smooth, model=model, params=config.filter, events=events),
    }
