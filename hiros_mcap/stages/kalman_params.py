"""Parameters of :mod:`hiros_mcap.stages.kalman`."""

from __future__ import annotations

from pydantic import Field

from hiros_mcap.params import Accelerations, Metres, Params, Seconds, advanced


class KalmanParams(Params):
    """Parameters of the filter of all joints."""

    measurement_noise: Metres = Field(
        0.03,
        ge=1e-6,
        description="sigma_r (III-B): SD per axis, m, of a detected joint. `hiros calibrate noise` "
        "measures it on a log of people who stand still.",
    )
    process_noise: Accelerations = Field(
        8.0,
        description="sigma_q: SD per axis, m/s2, of a joint's acceleration over 1/30 s. The paper "
        "tunes it by hand and gives no number. This value has the least error on simulated walks "
        "and gestures.",
    )
    step: Seconds = advanced(
        0.0,
        ge=0,
        description="Predict in whole steps of this length, s (paper: 0.033). 0 = predict exactly "
        "to the time of each message, which cameras without a common clock need.",
    )
    use_confidence: bool = advanced(True, description="Divide sigma_r^2 by the confidence (eq 8).")
    min_confidence: float = advanced(
        0.5, ge=0, le=1, description="th (III-C): joints with lower confidence are only predicted."
    )
    history: int = advanced(
        15,
        ge=0,
        le=10_000,
        description="N of eq 9: number of distances that set the outlier threshold. 0 = no "
        "outliers.",
    )
    consecutive: bool = advanced(
        False,
        description="Measure d of eq 9 and 10 between consecutive positions of the joint, as "
        "printed. By default, d is the distance of the detection from the prediction. As printed, "
        "d depends on the time between two messages, which varies with unsynchronised cameras.",
    )
    outlier_factor: float = advanced(
        1.25, ge=1, description="w of eq 9: factor of the outlier threshold."
    )
    max_outliers: int = advanced(
        2,
        ge=0,
        description="o_max (III-D): after this many outliers in a row, the next one is accepted.",
    )
    range_noise: float = advanced(
        0.0,
        ge=0,
        le=1,
        description="Adds (range_noise x distance^2)^2 to sigma_r^2, with the distance from the "
        "camera in m; in 1/m. OpenPTrack has 0.0026.",
    )
    max_gap: Seconds = advanced(
        1.0,
        gt=0,
        description="Time, s, without a detection after which the filter of a person restarts (not "
        "in the paper).",
    )
    hold: Seconds = advanced(
        0.2,
        ge=0,
        description="Time, s, for which an undetected person stays in the output; at most max_gap.",
    )
    rate: float = advanced(
        0.0, ge=0, le=1000, description="Rate of the output, Hz. 0 = one result per message."
    )
