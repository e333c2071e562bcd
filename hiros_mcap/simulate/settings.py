"""All parameters of a simulation, with units."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import (
    AfterValidator,
    Field,
    NonNegativeFloat,
    NonNegativeInt,
    PositiveFloat,
    PositiveInt,
    model_validator,
)

from hiros_mcap.params import Params, advanced


def _ordered(ends: tuple[float, float]) -> tuple[float, float]:
    if ends[0] > ends[1]:
        raise ValueError(f"the first of {ends} should not be greater than the second")
    return ends


Range = Annotated[tuple[NonNegativeFloat, NonNegativeFloat], AfterValidator(_ordered)]
PositiveRange = Annotated[tuple[PositiveFloat, PositiveFloat], AfterValidator(_ordered)]
Frames = Annotated[tuple[PositiveInt, PositiveInt], AfterValidator(_ordered)]
CameraPose = tuple[float, float, float, float, float, float, float]
Area = tuple[float, float, float, float]
"""Least x and y, greatest x and y, m."""
ROOM: Area = (-2.5, -2.0, 2.5, 2.0)
WALL = 0.5
"""m; nobody comes closer to a wall."""
Angle = Annotated[float, Field(gt=0, lt=180)]
Share = Annotated[float, Field(ge=0, le=1)]
Scale = Annotated[float, Field(ge=0, le=100)]
Rate = Annotated[float, Field(gt=0, le=1000)]
ActionName = Literal[
    "walk", "squat", "bend", "sit", "jog", "jump", "cross_arms", "point", "wave", "throw",
    "free_static", "free_dynamic", "circle", "cross", "in_out", "pass", "eight", "roam", "lunge",
    "hands_up_down", "walk_in_place", "crawl", "get_up", "roll", "kick", "spin",
]  # fmt: skip
CameraKind = Literal["depth", "rgb"]

BODY_BYTES = 2200
"""Of a person in a camera's frame."""
SIGHT_BYTES = 1700
"""Of the occlusions in a frame, times the number of people cubed (measured)."""
MOST_BYTES = 16e9
PHANTOMS_PER_MINUTE = 0.5
"""People whom a camera reports and who are not there."""


class RigParams(Params):
    """The cameras: where they stand, what they see, how their clocks run."""

    kinds: Annotated[tuple[CameraKind, ...], Field(min_length=1)] = Field(
        ("depth",),
        description="Kind of each camera, or of all: depth cameras report skeletons, RGB cameras "
        "keypoints of their image.",
    )
    poses: tuple[CameraPose, ...] = advanced(
        (),
        description="Pose of each camera in the world: x, y, z, m, and quaternion x y z w; "
        "default: on a circle.",
    )

    apart: Angle | None = advanced(
        None,
        description="Angle between one camera and the next, deg; default: evenly all around, two "
        "at right angles.",
    )
    radius: PositiveFloat = advanced(3.6, description="Distance from the middle of the room, m.")
    height: PositiveFloat = advanced(2.0, description="Height of the cameras, m.")
    aim_height: float = advanced(1.0, description="Height that they look at in the middle, m.")
    fov: tuple[Angle, Angle] = advanced(
        (75.0, 65.0), description="Field of view, deg: across, upright (Azure Kinect, narrow)."
    )
    range: Range = advanced((0.5, 5.5), description="Nearest and farthest depth seen, m.")
    rate: Rate = Field(30.0, description="Frames per second of each camera.")
    synchronised: bool = advanced(
        False, description="Whether all cameras fire together; otherwise each at its own phase."
    )
    jitter: NonNegativeFloat = advanced(0.001, description="SD of the time of a frame, s.")
    clock_offset: Annotated[float, Field(ge=0, le=86_400)] = Field(
        0.0, description="SD of the constant error of a camera's clock, s (0.035 is a bad one)."
    )
    delay: Range = advanced(
        (0.020, 0.040), description="Least and greatest time from the frame to its message, s."
    )
    pause: NonNegativeFloat = advanced(
        0.0, description="Time, s, for which all cameras pause in the middle of the log."
    )
    lost_frames: Share = advanced(0.015, description="Share of frames that never arrive.")
    position_error: NonNegativeFloat = advanced(
        0.004, description="SD of a camera's published position, per axis, m."
    )
    orientation_error: NonNegativeFloat = advanced(
        0.15, description="SD of a camera's published orientation, per axis, deg."
    )


class DetectorParams(Params):
    """The errors of one camera's detector, as real depth cameras make them.

    All but ``kind``, ``joint``, losses and phantoms belong to the detector "ideal".
    """

    kind: Literal["ideal", "kinect"] = Field(
        "ideal",
        description="ideal: every joint errs by itself, and the detector knows what it guesses. "
        "kinect: whole limbs err together, and all joints are as sure (:mod:`limb_errors`).",
    )
    joint: NonNegativeFloat = advanced(
        0.013,
        description="SD of each joint by itself, per axis, m (kinect; wrist and hand r = .91).",
    )
    coloured: NonNegativeFloat = advanced(
        0.013, description="SD of the slow part of a trunk joint's error at 3.5 m, per axis, m."
    )
    correlation: Annotated[float, Field(ge=0, lt=1)] = Field(
        0.85, description="Its correlation over 1/30 s (the time constant follows, at any rate)."
    )
    white: NonNegativeFloat = advanced(
        0.007, description="SD of the part that is new in every frame, per axis, m."
    )
    bias: NonNegativeFloat = advanced(
        0.009, description="SD of the lasting error per camera, person and joint, per axis, m."
    )
    bias_seconds: PositiveFloat = advanced(20.0, description="Time over which the bias changes, s.")
    extremities: PositiveFloat = advanced(
        1.6, description="How much larger the errors of hands and feet are than the trunk's."
    )
    range_growth: NonNegativeFloat = advanced(
        1.0, description="Errors are proportional to this power of the distance from the camera."
    )
    orientation_coloured: NonNegativeFloat = advanced(
        3.0, description="SD of the slow part of a link's orientation error, per axis, deg."
    )
    orientation_white: NonNegativeFloat = advanced(
        1.5, description="SD of its white part, per axis, deg."
    )
    orientation_bias: NonNegativeFloat = advanced(1.5, description="SD of its bias, per axis, deg.")
    guess: NonNegativeFloat = advanced(
        0.05, description="SD of an occluded trunk joint's additional error, per axis, m."
    )
    guess_seconds: PositiveFloat = advanced(0.4, description="Time over which a guess changes, s.")
    flips_per_minute: NonNegativeFloat = advanced(
        1.5, description="Left-right confusions per minute, camera and person seen from behind."
    )
    flip_seconds: PositiveRange = advanced((0.1, 3.0), description="Shortest and longest flip, s.")
    reversal_share: Share = advanced(
        0.5,
        description="Share of flips that rotate the person by 180 deg; the others only swap sides.",
    )
    losses_per_minute: NonNegativeFloat = advanced(
        1.0, description="Times per minute that a camera loses a visible person."
    )
    loss_seconds: PositiveRange = advanced((0.1, 1.0), description="Shortest and longest loss, s.")
    spawn_frames: Frames = advanced(
        (2, 6), description="How many frames a person who re-appears is in a wrong pose."
    )
    spawn_error: NonNegativeFloat = advanced(
        0.15,
        description="SD of that pose's initial error, of person and joints, per axis, m.",
    )
    static_phantoms: NonNegativeInt = advanced(
        0,
        description="How many cameras report a static object as a person all the time; RGB "
        "cameras, somebody far behind the others.",
    )


class ImageParams(Params):
    """The images of RGB cameras, and how a detector of keypoints errs in them.

    Deviations are in px where a metre is 275 px long: 4 m before the default lens. They grow with
    the size of a person in the image, as those of detectors that scale people to one size.
    """

    size: tuple[PositiveInt, PositiveInt] = advanced(
        (1920, 1080), description="Width and height, px."
    )
    focal: PositiveFloat = advanced(1100.0, description="Focal length, px.")
    joints: Literal["coco-17", "halpe-26", "openpose-25"] = Field(
        "coco-17", description="Joints that the detector finds."
    )
    white: NonNegativeFloat = advanced(
        2.5, description="SD of the part that is new in every frame, per axis, px."
    )
    quick: NonNegativeFloat = advanced(
        4.0, description="SD of the part that changes within 0.3 s, per axis, px (ideal)."
    )
    slow: NonNegativeFloat = advanced(
        5.0, description="SD of the part that changes within 5 s, per axis, px (ideal)."
    )
    pixel: NonNegativeFloat = advanced(
        0.5, description="SD of white noise at any distance, per axis, px of the image."
    )
    exposure: NonNegativeFloat = advanced(
        0.01, description="Exposure, s: a joint is put anywhere on the streak that it leaves."
    )
    outliers: Share = advanced(0.015, description="Share of keypoints that are far off (ideal).")


class SimulateParams(Params):
    """A scene and how badly it is seen. The scales: 1 = like a real depth camera, 0 = off."""

    people: Annotated[int, Field(ge=0, le=10)] = Field(1, description="Number of people.")
    cameras: Annotated[int, Field(ge=1, le=32)] = Field(5, description="Number of cameras.")
    action: ActionName = Field(
        "walk",
        description="What everybody does: Table 5 of Hi-ROS 2023, gestures of Lee et al. 2022, "
        "bodies that are not upright (crawl, get_up, roll) or fast (kick, spin).",
    )
    facing: Annotated[float, Field(ge=-360, le=360)] | None = advanced(
        None,
        description="Direction that everybody on a spot faces, deg from x to y; default: at "
        "random, with the action pass to the cameras.",
    )
    area: Area = advanced(
        ROOM,
        description="Room in which people roam, m: least x and y, greatest x and y.",
    )
    seconds: Annotated[float, Field(gt=0, le=86_400)] = Field(
        10.0, description="Length of the log, s."
    )
    seed: NonNegativeInt = Field(0, description="Same seed, same log, byte for byte.")
    noise: Scale = Field(1.0, description="Scale of noise and bias of what is seen.")
    occlusion: Scale = Field(
        1.0, description="Scale of guessed joints' errors; 0 = nothing ever hides anything."
    )
    flips: Scale = Field(1.0, description="Scale of the rate of left-right flips.")
    dropouts: Scale = Field(
        1.0, description="Scale of lost frames, lost people and wrong poses of those who re-appear."
    )
    clock_jitter: Scale = Field(1.0, description="Scale of the jitter of frame times.")
    calibration_error: Scale = Field(
        1.0, description="Scale of the errors in the published camera poses."
    )
    phantoms: Scale = Field(1.0, description="Scale of the rate of phantoms.")
    heights: PositiveRange = advanced((1.55, 1.95), description="Shortest and tallest person, m.")
    proportions: NonNegativeFloat = advanced(
        0.03, description="Relative SD of trunk, arm and leg lengths at a given height."
    )
    start: NonNegativeInt = advanced(
        1_700_000_000_000_000_000, description="Time of the first instant, ns since the epoch."
    )
    truth_rate: Rate = advanced(30.0, description="Frames per second of the truth.")
    rig: RigParams = Field(RigParams(), description="The cameras.")
    detector: DetectorParams = Field(DetectorParams(), description="Their detector.")
    image: ImageParams = Field(ImageParams(), description="The images of RGB cameras.")

    @property
    def memory(self) -> float:
        """About how many bytes a simulation takes: all that every camera sees is held at once."""
        frames = self.seconds * self.rig.rate
        minutes = self.seconds / 60
        # A phantom has a place in every frame, and for a moment there are two of each.
        phantoms = PHANTOMS_PER_MINUTE * self.phantoms * minutes
        phantoms += self.detector.static_phantoms
        held = self.cameras * (self.people + phantoms) + phantoms
        return frames * (BODY_BYTES * held + SIGHT_BYTES * self.people**3)

    @model_validator(mode="after")
    def _fits(self) -> SimulateParams:
        if self.rig.poses and len(self.rig.poses) != self.cameras:
            raise ValueError(f"there are {len(self.rig.poses)} poses of {self.cameras} cameras")
        if len(self.rig.kinds) not in (1, self.cameras):
            kinds = f"there are {len(self.rig.kinds)} kinds of {self.cameras} cameras"
            raise ValueError(f"{kinds}; name one for all, or one each")
        if self.memory > MOST_BYTES:
            raise ValueError(
                f"{self.seconds:g} s, {self.rig.rate:g} Hz, {self.cameras} cameras and "
                f"{self.people} people need about {self.memory / 1e9:.0f} GB of memory, more than "
                f"{MOST_BYTES / 1e9:.0f}; make it shorter"
            )
        return self
