"""Malaguti et al. (2019): association by centroids, a Kalman filter per person, limb lengths."""

from __future__ import annotations

from hiros_mcap.frames import by_block
from hiros_mcap.systems.openptrack import openptrack
from hiros_mcap.systems.run import Run, Stages


def malaguti(run: Run) -> Stages:
    """Output channel -> the stage that fills it, in the order of the paper (Fig. 1)."""
    from hiros_mcap.stages.malaguti.straighten import straighten

    lengths = run.stage(straighten, run.config.straighten, limbs=run.limbs)
    return {**openptrack(run), "optimized": by_block(lengths)}  # III-E
