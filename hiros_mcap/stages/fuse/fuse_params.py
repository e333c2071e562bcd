"""Parameters of fuse: the smoother of all cameras, and constant limb lengths."""

from __future__ import annotations

from typing import ClassVar

from pydantic import Field

from hiros_mcap.params import Accelerations, Metres, Params, Seconds, advanced, fixed


class FuseParams(Params):
    """Parameters of the fuser."""

    lookahead: Seconds = Field(
        3.0,
        ge=0,
        description="How far into the future each estimate looks at least, s. A camera's offset "
        "wanders over some seconds, so less is worse. 0.1 costs about 1 % of accuracy.",
    )
    window: Seconds = fixed(
        10.0,
        "Seconds that are smoothed at once. Results do not depend on it as long as the "
        "look-ahead is long; 0 = every instant as soon as it has its look-ahead.",
    )
    acceleration: Accelerations = advanced(
        3.0,
        description="Spectral density of the acceleration of a joint at rest, m2/s3. Joints that "
        "move faster have 10 or 100 times as much, as their measurements show. 3 to 10 differ by "
        "less than 1 % on simulated logs.",
    )
    offset: Metres = advanced(
        0.01,
        description="Standard deviation of the slow offset of a camera, per joint, m. 0 = cameras "
        "have none; then the error is larger and its estimate far too small.",
    )
    offset_time: ClassVar[float] = 1.7  # time constant, s, with which such an offset wanders
    freedom: int = fixed(
        4,
        "Degrees of freedom of the noise (Student's t). With fewer, outliers count less. 4 to "
        "20 differ by 0 to 4 %.",
    )
    outliers_last: Seconds = fixed(
        0.5,
        "Mean time for which a camera stays wrong about a joint, s. 90 % of such episodes of a "
        "Kinect v2 end within 0.4 to 0.5 s; results of 0.5 to 2 are alike. 0 = each outlier comes "
        "by itself, and no limb follows the joint that holds it.",
    )
    majority: bool = fixed(
        True, "Of three cameras or more, who sees a joint elsewhere than most has no weight there."
    )
    pose_angle: float = advanced(
        0.3,
        ge=0,
        le=180,
        description="Standard deviation of a camera's orientation, degrees, assumed until cameras "
        "show how far they disagree. It and pose_shift enter the standard deviation of the result "
        "only.",
    )
    pose_shift: Metres = advanced(
        0.006, description="Standard deviation of a camera's position along each axis, m."
    )


class ConstrainParams(Params):
    """Parameters of the constraints."""

    window: Seconds = fixed(
        10.0,
        "Seconds that are corrected at once. 0 = each pose by those before it, as in "
        "fuse-realtime.",
    )
    enough: Seconds = advanced(
        60.0,
        ge=0,
        description="Seconds after which the lengths of a person stay as they are. Detectors see "
        "other lengths in other poses, so a few seconds in one pose do not give them. Results wait "
        "for it. In fuse-realtime, which does not wait, 5.",
    )
    rigid: bool = fixed(True, "Keep the distances within head, thorax and pelvis, too.")
    prior: bool = fixed(True, "Use the motion of the person in the window as a prior of each pose.")
