"""Parameters of Lee 2022."""

from __future__ import annotations

from typing import ClassVar, Literal

from pydantic import Field

from hiros_mcap.params import Params, Seconds, advanced, fixed


class ClusterParams(Params):
    """Parameters of Lee's merger."""

    method: Literal["dbscan", "average"] = fixed(
        "dbscan",
        "dbscan: average the largest cluster. average: average all candidates (variants A1 and "
        "A2).",
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
    reference_helps: bool = fixed(True, "Add the reference position to the candidates (2.2.2).")
    previous_helps: bool = fixed(
        True, "Add the previous position to the candidates: 1-frame smoothing (2.2.2)."
    )
    memory: ClassVar[float] = 0.1
    """Longest time, s, for which a merged position serves as the previous one; three frames at 30
    Hz. After that, a joint may have moved farther than the radius."""
    compensate_motion: bool = advanced(
        True,
        description="Move views to the merged time with their velocities. The paper's cameras are "
        "synchronised by wire; those of a log often are not.",
    )
    cameras: int = fixed(
        0, "Number of messages in a merged instant; 0 = the number of known cameras."
    )
    max_delta_time: Seconds = advanced(
        0.07,
        gt=0,
        description="Longest time, s, between the oldest and the newest message of a merged "
        "instant.",
    )


class PredictParams(Params):
    """Parameters of Lee's Kalman filter."""

    noise_ratio: float = Field(
        0.01,
        ge=1e-9,
        le=1e9,
        description="Q / R (paper: 0.01 / 1.0): variance that each element of the state gains in "
        "1/30 s, relative to the variance of a measured position. A smaller ratio is smoother.",
    )
    model: Literal["constant_position", "constant_velocity", "constant_acceleration"] = advanced(
        "constant_velocity",
        description="State space model A. The paper does not give it. A constant position would lag"
        " by a third of a second.",
    )
    output: Literal["predicted", "corrected"] = advanced(
        "predicted",
        description="predicted: the position predicted from the earlier frames, as in the paper. "
        "corrected: the position corrected by the frame itself, which has less error and is as "
        "smooth.",
    )
    max_gap: ClassVar[float] = 0.5
    """Time, s, without data after which the filter of a person or joint restarts."""
