"""Parameters of :mod:`hiros_mcap.stages.associate`."""

from __future__ import annotations

from pydantic import Field

from hiros_mcap.params import Accelerations, Metres, Params, Seconds, advanced


class AssociateParams(Params):
    """Parameters of the association by centroids."""

    gate: float = Field(
        18.467,
        gt=0,
        description="epsilon (III-A): largest squared Mahalanobis distance of a match. The paper "
        "gives no number; this is 99.9 % of a chi-squared distribution with 4 degrees of freedom, "
        "as in OpenPTrack.",
    )
    position_noise: Metres = advanced(
        0.1,
        ge=1e-6,
        description="SD per axis, m, of a detection's centroid about the person's centroid.",
    )
    acceleration: Accelerations = advanced(
        3.0, description="SD per axis, m/s2, of a person's acceleration over 1/30 s."
    )
    max_gap: Seconds = advanced(
        1.5,
        gt=0,
        description="Time, s, without a detection after which a track ends (not in the paper).",
    )
    confirm_detections: int = advanced(
        3, ge=1, description="Number of detections that confirm a track (3: OpenPTrack; 1: paper)."
    )
    min_distance: float = advanced(
        0.3,
        ge=0,
        description="An unmatched detection starts no track if it is this near, m, to another "
        "track. Detectors may report a person twice (not in the paper).",
    )
    reorder: Seconds = advanced(
        1.0,
        ge=0,
        description="Longest time, s, that a message waits for older messages of slower cameras.",
    )
