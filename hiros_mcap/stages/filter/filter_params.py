"""Parameters of the filter."""

from __future__ import annotations

from typing import ClassVar, Literal, Self

from pydantic import Field, model_validator

from hiros_mcap.params import Params, Seconds, advanced, fixed


class FilterParams(Params):
    """How the trajectories of markers and links are smoothed."""

    method: Literal["state_space", "butterworth"] = Field(
        "state_space",
        description="state_space: Kalman filter of integrated white noise; no lag on steady motion."
        " Without look-ahead it amplifies motion below two thirds of the cut-off by up to 13 % "
        "(order 2) or 26 % (order 3). butterworth: maximally flat, any order; lags unless it looks "
        "ahead.",
    )
    cutoff: float = Field(
        4.5,
        ge=0.01,
        le=1000,
        description="Frequency, Hz, at which the whole filter (with look-ahead) is at -3 dB. For "
        "human motion with the noise of merged cameras, the error is least at 4 to 5 Hz "
        "(benchmarks/bench_filter.py). Winter 2009 gives 6 to 10 Hz for marker-based capture.",
    )
    lookahead: float = Field(
        0.3,
        ge=0,
        le=60,
        description="How far into the future each estimate looks, s. 0 = strictly causal. At order "
        "2 or 3, more than 1 / cutoff changes nothing; a higher order rings for longer.",
    )
    order: int = advanced(
        2,
        ge=1,
        le=10,
        description="Order of the filter. state_space: 2 = constant velocity, 3 = constant "
        "acceleration (sharper, with a better acceleration). butterworth: any.",
    )
    bridge: Seconds = fixed(
        0.2,
        "Longest gap, s, of a marker or link that is filled, with half of its last confidence. "
        "A gap stays empty if the look-ahead shows that it is longer.",
    )
    max_gap: Seconds = advanced(
        1.0,
        gt=0,
        description="Time, s, without data after which the filter of a person, marker or link "
        "restarts.",
    )
    keep_lengths: bool = fixed(
        True,
        "Give each link its mean length in the input. Smoothing each joint separately shortens "
        "limbs that swing.",
    )
    length_time: ClassVar[float] = 2.0
    """Time constant, s, of the mean length of a link. A longer time is slightly better if no
    earlier stage corrects the lengths, but follows a new calibration more slowly."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.method == "state_space" and self.order not in (2, 3):
            raise ValueError("order of a state-space filter must be 2 or 3")
        return self
