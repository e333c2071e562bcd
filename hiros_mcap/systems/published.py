"""Published systems: Malaguti et al. (2019) with its baselines, and Lee et al. (2022).

Malaguti and the baselines have its association by centroids (III-A). Lee follows one person with
cameras that a wire synchronises. Here the tracker of Hi-ROS comes first, and every person is merged
as the paper merges its one. The variants A1 to A5 of section 3.1 are the same stages with other
parameters (``systems/presets``).
"""

from __future__ import annotations

from hiros_mcap.frames import by_block
from hiros_mcap.systems.run import Run, Stages


def raw(run: Run) -> Stages:
    """Give detections as they are the ids of the association."""
    from hiros_mcap.stages.malaguti.associate import associate

    return {"tracked": by_block(run.stage(associate, run.config.associate))}


def average(run: Run) -> Stages:
    """Average what the cameras see at one time."""
    from hiros_mcap.stages.merge.merge import merge_blocks

    mean = run.stage(merge_blocks, run.config.merge, fixed_frame=run.fixed_frame)
    return {**raw(run), "merged": mean}


def maf(run: Run) -> Stages:
    """Average each person's last detections (IV)."""
    from hiros_mcap.stages.malaguti.moving_average import moving_average

    params = run.config.moving_average
    mean = run.stage(moving_average, params, fixed_frame=run.fixed_frame)
    return {**raw(run), "merged": by_block(mean)}


def openptrack(run: Run) -> Stages:
    """Filter each joint (III-B to III-D), with the numbers of ``presets/openptrack.toml``."""
    from hiros_mcap.stages.malaguti.kalman import kalman

    fuse = run.stage(kalman, run.config.kalman, fixed_frame=run.fixed_frame, cameras=run.cameras)
    return {**raw(run), "merged": by_block(fuse)}


def malaguti(run: Run) -> Stages:
    """Filter each person, and keep the lengths of the limbs (III-E, Fig. 1)."""
    from hiros_mcap.stages.malaguti.straighten import straighten

    lengths = run.stage(straighten, run.config.straighten, limbs=run.limbs)
    return {**openptrack(run), "optimized": by_block(lengths)}


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
