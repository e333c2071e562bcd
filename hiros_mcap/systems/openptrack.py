"""OpenPTrack's filter per joint, with the numbers of ``presets/openptrack.toml``."""

from __future__ import annotations

from hiros_mcap.frames import by_block
from hiros_mcap.systems.raw import raw
from hiros_mcap.systems.run import Run, Stages


def openptrack(run: Run) -> Stages:
    """Output channel -> the stage that fills it (Malaguti 2019, III-A to III-D)."""
    from hiros_mcap.stages.malaguti.kalman import kalman

    fuse = run.stage(kalman, run.config.kalman, fixed_frame=run.fixed_frame, cameras=run.cameras)
    return {**raw(run), "merged": by_block(fuse)}  # III-B to III-D
