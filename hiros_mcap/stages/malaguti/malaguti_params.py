"""Parameters of Malaguti 2019 and of its baselines."""

from __future__ import annotations

from typing import ClassVar

from pydantic import Field

from hiros_mcap.params import Accelerations, Metres, Params, Seconds, advanced, fixed

NOISE_RATE = 30.0
"""Hz: the noise of one second is that of so many steps of the paper's model (33 ms)."""
STARTING_SPEED = 1.0
"""m/s, SD per axis of what was just seen for the first time."""


class AssociateParams(Params):
    """Parameters of the association by centroids."""

    gate: float = Field(
        18.467,
        gt=0,
        description="epsilon (III-A): largest squared Mahalanobis distance of a match. The paper "
        "gives no number; this is 99.9 % of a chi-squared distribution with 4 degrees of freedom, "
        "as in OpenPTrack.",
    )
    position_noise: ClassVar[float] = 0.1
    """SD per axis, m, of a detection's centroid about the person's centroid."""
    acceleration: ClassVar[float] = 3.0  # SD per axis, m/s2, of a person's acceleration over 1/30 s
    max_gap: Seconds = advanced(
        1.5,
        gt=0,
        description="Time, s, without a detection after which a track ends (not in the paper).",
    )
    confirm_detections: int = advanced(
        3, ge=1, description="Number of detections that confirm a track (3: OpenPTrack; 1: paper)."
    )
    min_distance: ClassVar[float] = 0.3
    """An unmatched detection starts no track if it is this near, m, to another track. Detectors may
    report a person twice (not in the paper)."""
    reorder: Seconds = advanced(
        1.0,
        ge=0,
        description="Longest time, s, that a message waits for older messages of slower cameras.",
    )


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
    use_confidence: bool = fixed(True, "Divide sigma_r^2 by the confidence (eq 8).")
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
    range_noise: float = fixed(
        0.0,
        "Adds (range_noise x distance^2)^2 to sigma_r^2, with the distance from the camera in "
        "m; in 1/m. OpenPTrack has 0.0026.",
    )
    max_gap: Seconds = fixed(
        1.0,
        "Time, s, without a detection after which the filter of a person restarts (not in the "
        "paper).",
    )
    hold: ClassVar[float] = 0.2
    """Time, s, for which an undetected person stays in the output; at most max_gap."""


class StraightenParams(Params):
    """Parameters of the limb lengths."""

    frames: int = advanced(
        30,
        ge=1,
        description="Number of whole skeletons that give the first lengths, by their mean (III-E).",
    )
    rate: float = advanced(
        0.002,
        ge=0,
        le=1,
        description="Weight of a new measurement in a length. The paper measures the optimized "
        "joints, whose links already have this length; hiros measures the filter's joints.",
    )
    head: bool = advanced(
        True,
        description="Give the links of the head constant lengths, too. The paper leaves the head "
        "out of its tree (III-E).",
    )
    chest_midpoint: bool = advanced(
        False, description="Put the chest midway between the shoulders and hips (III-E)."
    )


class MovingAverageParams(Params):
    """Parameters of the moving average."""

    window: int = advanced(
        5,
        ge=1,
        le=10_000,
        description="Number of detections in the average (as in OpenPTrack's MAF).",
    )
    lifetime: ClassVar[float] = 0.6  # time, s, after which a detection no longer counts
