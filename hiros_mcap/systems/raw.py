"""Detections as they are, with the ids of the association by centroids."""

from __future__ import annotations

from hiros_mcap.frames import by_block
from hiros_mcap.systems.run import Run, Stages


def raw(run: Run) -> Stages:
    """Output channel -> the stage that fills it (Malaguti 2019, III-A)."""
    from hiros_mcap.stages.malaguti.associate import associate

    return {"tracked": by_block(run.stage(associate, run.config.associate))}  # III-A
