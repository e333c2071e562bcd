"""Parameters of :mod:`hiros_mcap.stages.cluster`."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from hiros_mcap.params import Params, Seconds, advanced


class ClusterParams(Params):
    """Parameters of Lee's merger."""

    method: Literal["dbscan", "average"] = Field(
        "dbscan",
        description="dbscan: average the largest cluster. average: average all candidates (variants"
        " A1 and A2).",
    )
    radius: float = Field(
        0.1,
        gt=0,
        description="Search radius of DBSCAN, m. 0.1 is the best of the paper's 5, 10, 15 and 20 "
        "cm.",
    )
    joints: Literal["all", "lee16"] = advanced(
        "all", description="All joints of the log, or the 16 that the paper merges (2.2.1)."
    )
    rearrange: Literal["off", "right", "both"] = advanced(
        "right",
        description="When a camera's left and right joints are swapped (2.2.1). right: if its right"
        " joint is farther from the right reference position than its left joint (paper). both: if"
        " the distances of both sides together are smaller after the swap, which is slightly safer"
        " (benchmarks/papers/lee_2022.py).",
    )
    min_neighbours: int = advanced(
        1,
        ge=1,
        description="N_c of algorithm 1, including the point. With 1 (paper), nothing is noise.",
    )
    reference_helps: bool = advanced(
        True, description="Add the reference position to the candidates (2.2.2)."
    )
    previous_helps: bool = advanced(
        True, description="Add the previous position to the candidates: 1-frame smoothing (2.2.2)."
    )
    memory: Seconds = advanced(
        0.1,
        gt=0,
        description="Longest time, s, for which a merged position serves as the previous one; three"
        " frames at 30 Hz. After that, a joint may have moved farther than the radius.",
    )
    compensate_motion: bool = advanced(
        True,
        description="Move views to the merged time with their velocities. The paper's cameras are "
        "synchronised by wire; those of a log often are not.",
    )
    cameras: int = advanced(
        0,
        ge=0,
        description="Number of messages in a merged instant; 0 = the number of known cameras.",
    )
    max_delta_time: Seconds = advanced(
        0.07,
        gt=0,
        description="Longest time, s, between the oldest and the newest message of a merged "
        "instant.",
    )
