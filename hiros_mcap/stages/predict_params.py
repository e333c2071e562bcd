"""Parameters of :mod:`hiros_mcap.stages.predict`."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from hiros_mcap.params import Params, Seconds, advanced


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
    max_gap: Seconds = advanced(
        0.5,
        gt=0,
        description="Time, s, without data after which the filter of a person or joint restarts.",
    )
