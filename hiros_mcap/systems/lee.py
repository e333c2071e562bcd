"""Lee et al. (2022): joints re-arranged, clustered over the cameras, and filtered.

The paper follows one person with cameras that are synchronised by wire. Here the tracker of Hi-ROS
comes first, so that every person is merged as the paper merges its one. The variants A1 to A5 of
section 3.1 are the same stages with other parameters (``SYSTEM_DEFAULTS`` of the configuration).
"""

from __future__ import annotations

from functools import partial

from hiros_mcap.frames import by_block
from hiros_mcap.systems.run import Run, Stages


def lee(run: Run) -> Stages:
    """Output channel -> the stage that fills it, in the order of the paper (Fig. 4)."""
    from hiros_mcap.stages.cluster import cluster_blocks
    from hiros_mcap.stages.predict import predict
    from hiros_mcap.stages.track import track_blocks

    model, config, events = run.model, run.config, run.events
    return {
        "tracked": partial(
            track_blocks, model=model, params=config.track, events=events, cameras=run.cameras
        ),
        "merged": partial(
            cluster_blocks,
            model=model,
            params=config.cluster,
            events=events,
            fixed_frame=run.fixed_frame,
        ),
        "filtered": by_block(partial(predict, model=model, params=config.predict, events=events)),
    }
