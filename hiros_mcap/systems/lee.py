"""Lee et al. (2022): joints re-arranged, clustered over the cameras, and filtered.

The paper follows one person with cameras that a wire synchronises. Here the tracker of Hi-ROS comes
first, and every person is merged as the paper merges its one. The variants A1 to A5 of section 3.1
are the same stages with other parameters (``systems/presets``).
"""

from __future__ import annotations

from hiros_mcap.frames import by_block
from hiros_mcap.systems.run import Run, Stages


def lee(run: Run) -> Stages:
    """Output channel -> the stage that fills it, in the order of the paper (Fig. 4)."""
    from hiros_mcap.stages.lee.cluster import cluster_blocks
    from hiros_mcap.stages.lee.predict import predict
    from hiros_mcap.stages.track.track import track_blocks

    config = run.config
    merge = run.stage(cluster_blocks, config.cluster, fixed_frame=run.fixed_frame)
    return {
        "tracked": run.stage(track_blocks, config.track, cameras=run.cameras),
        "merged": merge,  # 2.2.1, 2.2.2
        "filtered": by_block(run.stage(predict, config.predict)),  # 2.2.3
    }
