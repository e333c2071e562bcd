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
from hiros_mcap.rays.intrinsics import COUNTS, PLUMB_BOB


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
    "walk",
    "squat",
    "bend",
    "sit",
    "jog",
    "jump",
    "cross_arms",
    "point",
    "wave",
    "throw",
    "free_static",
    "free_dynamic",
    "circle",
    "cross",
    "in_out",
    "pass",
    "eight",
    "roam",
    "lunge",
    "hands_up_down",
    "walk_in_place",
    "crawl",
    "get_up",
    "roll",
    "kick",
    "spin",
]


CameraKind = Literal["depth", "rgb"]

BODY_BYTES = 2200
"""Of a person in a camera's frame."""
SIGHT_BYTES = 1700
"""Of the occlusions in a frame, times the number of people cubed (measured)."""
MOST_BYTES = 16e9


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


class LimbErrorParams(Params):
    """The errors of the detector "kinect", as two Kinect v2 were measured to make them.

    They were measured on 32 minutes of views in 19 recordings by two cameras each: lengths against
    the person's own, positions between the cameras and against the fused result. A decision of the
    detector holds for ``seconds`` while somebody stands, and for less while somebody moves. A
    mistake is a slip or a guess; its size is log-normal, and the SDs below are those of the median
    size.
    """

    shift: NonNegativeFloat = advanced(
        0.008,
        description="SD of the shift of the whole body, per axis, m. Measured between two cameras: "
        "23 to 28 mm at the median, errors of the poses included.",
    )
    direction: NonNegativeFloat = advanced(
        2.3,
        description="SD of the direction of an upper arm or a thigh, per axis, deg. Elbows differ "
        "by 39 to 49 mm between two cameras.",
    )
    length: NonNegativeFloat = advanced(
        0.02, description="Relative SD of a limb's length (robust SD of all errors: .03 to .07)."
    )
    slide: NonNegativeFloat = advanced(
        0.025,
        description="Relative SD by which a knee slides along the leg: the lengths of thigh and "
        "shank correlate by -.35 to -.64.",
    )
    aside: NonNegativeFloat = advanced(
        1.0,
        description="How much larger these are in views from the side and from behind (.3 to 2).",
    )
    joint: NonNegativeFloat = advanced(
        0.013, description="SD of each joint by itself, per axis, m (wrist and hand r = .91)."
    )
    seconds: PositiveFloat = advanced(
        1.2,
        description="Mean time for which a decision holds while somebody stands, s "
        "(95 % of second differences of a hand: 24 mm).",
    )
    moving_seconds: PositiveFloat = advanced(
        0.15,
        description="The same of somebody who moves fast, s (95 % of second differences of a hand "
        "at more than .3 m/s: 129 mm).",
    )
    lasting: Share = advanced(
        0.1, description="Share of their variance that lasts (autocorrelation .2 to .5 after 1 s)."
    )
    lasting_seconds: PositiveFloat = advanced(
        20.0, description="Time for which the lasting part holds, s (recordings: 15 to 100 s)."
    )
    slips: tuple[Share, Share, Share] = advanced(
        (0.08, 0.12, 0.15),
        description="Probability that a decision which movement brings is a slip: from the front, "
        "from the side, from behind. Of the wrists of people faster than .3 m/s, 6, 10 and 12 % "
        "are off by more than .2 m.",
    )
    slip_shift: NonNegativeFloat = advanced(
        0.035,
        description="SD of the shift of the whole body in a slip, per axis, m (99 % of second "
        "differences of a trunk: 36 to 82 mm).",
    )
    narrow: NonNegativeFloat = advanced(
        0.5,
        description="SD of the share of the width of hips and shoulders that a mistake loses: 5 % "
        "of those from the side are short by 25 to 42 %, hardly any is too long.",
    )
    mistake_angle: NonNegativeFloat = advanced(
        30.0,
        description="SD of a segment's direction in a mistake, per axis, deg (peaks of .34 m).",
    )
    mistake_length: NonNegativeFloat = advanced(
        0.2, description="SD of the log of its length (99 % of lengths are off by 17 to 34 %)."
    )
    guess_odds: NonNegativeFloat = advanced(
        2.0, description="Probability of a wrong guess to the covered share of the body."
    )
    guess_shift: NonNegativeFloat = advanced(
        0.3,
        description="SD of the shift of a body to its covered share, per axis, m "
        "(shift at .25 to .45: median 50 to 59, 90 % 138 to 180 mm).",
    )
    loses_at: Range = advanced(
        (0.3, 0.8),
        description="Share of a body that others cover when it is lost: least, most. Reported are "
        "80 % of those who are covered by .1 to .25, 25 % by .45 to .7.",
    )
    finds_after: PositiveFloat = advanced(
        0.5, description="Mean time after which who is uncovered is found again, s (.3 to 1.8)."
    )
    exchanged: Annotated[float, Field(ge=0, le=1)] = advanced(
        0.45, description="Share of the views from behind with exchanged sides (measured: .45)."
    )
    exchanged_seconds: PositiveFloat = advanced(
        0.5, description="Mean time between two decisions on the sides, s (exchanges: median .7)."
    )


class DetectorParams(Params):
    """The errors of one camera's detector, as real depth cameras make them.

    All but ``kind``, ``limbs``, losses, phantoms and ids belong to the detector "ideal".
    """

    kind: Literal["ideal", "kinect"] = Field(
        "ideal",
        description="ideal: every joint errs by itself, and the detector knows what it guesses. "
        "kinect: whole limbs err together, and all joints are as sure (detector.limbs).",
    )
    limbs: LimbErrorParams = Field(LimbErrorParams(), description="Errors of kinect.")

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
    guess_extremities: PositiveFloat = advanced(
        2.2, description="How much larger the error of guessed hands and feet is."
    )
    guess_seconds: PositiveFloat = advanced(0.4, description="Time over which a guess changes, s.")
    guess_orientation: NonNegativeFloat = advanced(
        8.0, description="SD of an occluded link's additional orientation error, per axis, deg."
    )
    confidence_seen: Share = advanced(0.66, description="Confidence of a joint that is seen.")
    confidence_guessed: Share = advanced(0.33, description="Confidence of an occluded joint.")
    confidence_outside: Share = advanced(
        0.0, description="Confidence of a joint out of the picture."
    )
    invents: bool = advanced(
        False,
        description="Whether joints behind other people are invented: as confident as those that "
        "are seen, but far off. So do detectors that report a whole body, such as the Kinect v2's.",
    )
    invented: NonNegativeFloat = advanced(
        0.2, description="SD of an invented joint's additional error, per axis, m."
    )
    invented_seconds: PositiveFloat = advanced(
        0.6, description="Time over which an invented error changes, s."
    )
    hidden: Share = advanced(
        0.7, description="A person is not detected if others hide more than this share."
    )
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
    phantoms_per_minute: NonNegativeFloat = advanced(
        0.5, description="People who are not there, per minute and camera."
    )
    phantom_frames: Frames = advanced((2, 8), description="How many frames a phantom lasts.")
    double_share: Share = advanced(
        0.5, description="Share of phantoms that are a second skeleton on a real person."
    )
    static_phantoms: NonNegativeInt = advanced(
        0,
        description="How many cameras report a static object as a person all the time; RGB "
        "cameras, somebody far behind the others.",
    )
    ids: Literal["none", "camera"] = advanced(
        "none", description="Ids in the log: -1 for all, or the camera's own numbering."
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
    lens: Literal["plumb_bob", "rational_polynomial", "equidistant"] = advanced(
        PLUMB_BOB, description="Model of the distortion, as sensor_msgs/CameraInfo calls it."
    )
    distortion: tuple[float, ...] = advanced(
        (-0.1, 0.04, 0.0005, -0.0005, 0.0), description="Its coefficients, in OpenCV's order."
    )
    range: Range = advanced((0.5, 20.0), description="Nearest and farthest people seen, m.")
    joints: Literal["coco-17", "halpe-26", "openpose-25"] = Field(
        "coco-17", description="Joints that the detector finds."
    )
    white: NonNegativeFloat = advanced(
        2.5, description="SD of the part that is new in every frame, per axis, px."
    )
    quick: NonNegativeFloat = advanced(
        4.0, description="SD of the part that changes within quick_seconds, per axis, px (ideal)."
    )
    quick_seconds: PositiveFloat = advanced(0.3, description="Its time constant, s.")
    slow: NonNegativeFloat = advanced(
        5.0, description="SD of the part that changes within slow_seconds, per axis, px (ideal)."
    )
    slow_seconds: PositiveFloat = advanced(5.0, description="Its time constant, s.")
    pixel: NonNegativeFloat = advanced(
        0.5, description="SD of white noise at any distance, per axis, px of the image."
    )
    exposure: NonNegativeFloat = advanced(
        0.01, description="Exposure, s: a joint is put anywhere on the streak that it leaves."
    )
    outliers: Share = advanced(0.015, description="Share of keypoints that are far off (ideal).")
    outlier: NonNegativeFloat = advanced(60.0, description="SD of these, per axis, px.")
    exchanged: Share = advanced(
        0.1,
        description="Share of the views from behind with exchanged sides (kinect). MediaPipe did "
        "so in 6 of 400 images of one person, all of one camera.",
    )
    missing: Share = advanced(0.05, description="Share of keypoints in view that are not found.")
    hidden_missing: Share = advanced(
        0.4, description="Share of hidden joints that are not found; the others are guessed."
    )
    score_seen: Share = advanced(0.85, description="Mean score of a joint that is seen.")
    score_guessed: Share = advanced(0.4, description="Mean score of a joint that is guessed.")
    score_spread: NonNegativeFloat = advanced(0.1, description="SD of scores.")

    @model_validator(mode="after")
    def _has_a_lens(self) -> ImageParams:
        if len(self.distortion) not in COUNTS[self.lens]:
            counts = " or ".join(map(str, COUNTS[self.lens]))
            raise ValueError(f"a {self.lens} lens has {counts} coefficients of distortion")
        return self


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
        phantoms = self.detector.phantoms_per_minute * self.phantoms * minutes
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
