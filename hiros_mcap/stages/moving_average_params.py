"""Parameters of :mod:`hiros_mcap.stages.moving_average`."""

from __future__ import annotations

from hiros_mcap.params import Params, Seconds, advanced


class MovingAverageParams(Params):
    """Parameters of the moving average."""

    window: int = advanced(
        5,
        ge=1,
        le=10_000,
        description="Number of detections in the average (as in OpenPTrack's MAF).",
    )
    lifetime: Seconds = advanced(
        0.6, gt=0, description="Time, s, after which a detection no longer counts."
    )
