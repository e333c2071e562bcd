"""Parameters of Hi-ROS: tracker, sides, merger, optimizer and filter."""

from __future__ import annotations

import math
from typing import ClassVar, Literal, Self

from pydantic import Field, model_validator

from hiros_mcap.params import Metres, Params, Seconds, advanced, fixed


class TrackParams(Params):
    """Parameters of the tracker."""

    max_distance: float = Field(
        0.6,
        gt=0,
        description="Gate, m: largest mean distance of a detection's markers from a track (section "
        "3.1.2). Views of one person differ by 0.05 to 0.35 m. The published code works with 0.8 "
        "m, which also matches a neighbour.",
    )
    max_gap: Seconds = Field(
        1.5,
        gt=0,
        description="t_m, s: a track is deleted when no camera has seen the person for longer "
        "(section 3.1.2).",
    )
    min_marker_confidence: float = Field(
        0.0, ge=0, le=1, description="Markers and links with lower confidence count as absent."
    )
    reorder: Seconds = Field(
        1.0,
        ge=0,
        description="Longest time, s, that a message waits for older messages of slower cameras. "
        "Messages that arrive later are still tracked, at their own time. Recorders stall for up "
        "to a second; 0.1 suits a live system.",
    )
    lookahead: Seconds = Field(
        1.0,
        ge=0,
        description="Time, s, that a message with a tentative track is held. The person then has "
        "the id from the first detection on. 0 = a live system without delay.",
    )
    reidentify: Seconds = Field(
        30.0,
        ge=0,
        description="Longest absence, s, after which a person may get the old id back. Limb "
        "lengths, place, time and the number of people must make it probable (90 %). The "
        "decision waits for 0.8 of track.lookahead. 0 = whoever comes back has a new id.",
    )
    max_jump: float = advanced(
        0.3,
        gt=0,
        description="A detection is left out if its markers are on average farther, m, from their "
        "track than this, although the track was just seen (plus 3 m/s for longer intervals). "
        "Detectors distort people who are about to be hidden. A camera that repeats it for half a "
        "second is believed. inf = off (paper).",
    )
    min_distance: float = fixed(
        0.25,
        "A detection is a duplicate and starts no track if it is this near, m, to a person who "
        "is already in the same message (0.1: published code).",
    )
    orientation_weight: float = fixed(
        0.05,
        "Weight of eq 9 against eq 8 in eq 6, m per rad. The paper adds metres and radians one "
        "to one; a detection that faces the wrong way then costs as much as 3 m.",
    )
    velocity_weight: ClassVar[float] = 0.05
    """w_v of eq 8, s. Only detections with velocities use it."""
    angular_velocity_weight: ClassVar[float] = 0.0
    """w_omega of eq 9, s. Only detections with velocities use it."""
    velocity_decay: ClassVar[float] = 0.25
    """gamma of eq 11; 0 = fast markers count like slow ones (0.25: published code)."""
    flip_aware: bool = fixed(
        True, "Also compare detections with left and right swapped; needs marker names."
    )
    merge_tracks: bool = advanced(
        True,
        description="Two tracks that no camera ever showed together, near each other, are one "
        "person of whom cameras disagree for a moment: the second is not confirmed for 0.8 s, or "
        "merged into the first. A track of one camera that moves as a person does elsewhere is "
        "left out: the camera is displaced, or looks into a mirror.",
    )
    min_skeleton_confidence: float = advanced(
        0.0, ge=0, le=1, description="Detections with lower confidence are not tracked."
    )
    min_markers: int = advanced(
        4, ge=1, description="A detection with fewer markers starts no track."
    )
    confirm_detections: int = fixed(
        5, "Number of detections that confirm a track, if two cameras or more report it."
    )
    confirm_seconds: Seconds = advanced(
        0.5,
        ge=0,
        description="Time, s, after which a track of a single camera is confirmed, unless other "
        "cameras contradict it.",
    )
    confirm_alone: Seconds = fixed(
        1.0,
        "The same for a body that stands still where none of the other cameras looks. If it is "
        "longer than the look-ahead, the person's first frames have no id.",
    )
    contradiction: float = fixed(
        0.5,
        "Largest number of misses per report. Other cameras that look at a track of a single "
        "camera contradict it when they miss it more often.",
    )
    horizon: ClassVar[float] = 0.2
    """Time, s, for which eq 7 predicts constant velocity. After that velocities fade."""
    fade: Seconds = fixed(
        0.3,
        "Time constant, s, with which velocities fade beyond the horizon. 0 = a track stands "
        "still there.",
    )
    gate_growth: float = fixed(
        0.75,
        "Growth of the gate, m/s, while a track is unseen for longer than the horizon, up to "
        "twice the gate. 0 = off (paper).",
    )
    position_noise: ClassVar[float] = 0.04
    """SD, m, of a marker that one camera reports (raw error 57 mm)."""
    innovation_gate: ClassVar[float] = 3.0
    """Gate in SDs: a marker or link farther than this from its prediction corrects the track
    less."""
    max_speed: ClassVar[float] = 12.0
    """Largest speed of a marker, m/s (a throwing hand reaches 10)."""


class PlausibleParams(Params):
    """Parameters of plausible bodies."""

    limbs: bool = Field(
        True,
        description="Compare the limb lengths of each detection with those that the person has "
        "shown so far. Contradictory markers count less; a contradictory detection behind somebody "
        "else is left out where no other camera shows the person. false: off (paper).",
    )
    max_deviation: ClassVar[float] = 3.0
    """Deviation of the links of a marker from the person's lengths, in standard deviations of
    these, up to which it keeps its confidence. Beyond, the confidence falls with the square. With
    3, below 1 % of the markers of simulated logs lose some."""
    enough: ClassVar[float] = 5.0
    """Seconds that a person must have been seen before lengths are compared. A few seconds in one
    pose do not show how much they vary."""
    patience: ClassVar[float] = 1.0
    """Longest time, s, for which all detections of a person are left out. After that they count
    again, so nobody is lost. As long as merge.carry."""


class SidesParams(Params):
    """Parameters of left and right."""

    over_time: bool = Field(
        True,
        description="Decide over time which way each person faces, by labels, body cues and "
        "walking direction, and exchange left and right of views that contradict it. false: the "
        "views of each instant vote (Hi-ROS 2023, section 3.2).",
    )
    lookahead: float = Field(
        1.0,
        ge=0,
        le=600,
        description="Time, s, that the decision looks ahead at least; at most twice as long. "
        "On real recordings 1, 2 and 10 s give the same sides. 0 = a live system without delay.",
    )


class MergeParams(Params):
    """Parameters of the merger."""

    flips: Literal["relabel", "drop"] = fixed(
        "relabel",
        "With sides.over_time = false: what happens to a view that faces the wrong way. "
        "relabel: its left and right are swapped if this brings it near the others, otherwise "
        "it is dropped. drop: it is dropped (paper).",
    )
    max_delta_time: Seconds = Field(
        0.07,
        gt=0,
        description="Longest time, s, between the oldest and the newest message of a buffer (second"
        " trigger, section 3.2). Two periods of a 30 Hz camera.",
    )
    cameras: int = fixed(
        0,
        "Number of messages that fill the buffer (third trigger); 0 = the number of known cameras.",
    )
    max_position_delta: float = advanced(
        0.2,
        description="Views of a marker agree if they differ by less than this, m (0.2 in the "
        "published code's launch file); <= 0 turns the vote off.",
    )
    max_orientation_delta: float = fixed(
        math.pi / 4,
        "Views of a link agree if they differ by less than this, rad (eq 10); <= 0 turns the "
        "vote off.",
    )
    max_facing_delta: float = fixed(
        math.pi / 2,
        "With sides.over_time = false: views agree if their facing directions differ by less "
        "than this, rad (section 3.2); <= 0 turns the search for flips off.",
    )
    facing: Literal["auto", "pelvis", "sides"] = fixed(
        "auto",
        "How the facing direction is measured. pelvis: orientation of the pelvis (paper). "
        "sides: line from the left to the right shoulders and hips. auto: whichever of the two "
        "differs more.",
    )
    past_votes: bool = fixed(
        True,
        "The previous merged pose votes like a camera and breaks ties (published code; not in "
        "the paper).",
    )
    compensate_motion: bool = fixed(True, "Move views to the merged time with their velocities.")
    confidence_power: float = fixed(
        2.0,
        "Exponent of the confidences in eq 12 (paper: 1). A marker that the detector guesses "
        "has half the confidence but about five times the error.",
    )
    robust_scale: float = fixed(
        0.05,
        "A view this far from the mean, m, counts half, and a farther view counts less (Cauchy "
        "weights on top of eq 12); <= 0 = plain eq 12.",
    )
    offset_time: Seconds = fixed(
        5.0,
        "Time constant, s, of the learned offset between each camera and the others, per "
        "marker. The offset is subtracted, so the mean does not jump when a camera drops out. 3 "
        "to 30 s reduce the error after the filter by 1 to 3 %. 0 = off (paper).",
    )
    bridge: float = fixed(
        0.12,
        "Time, s, for which a person who is in no message of the buffer continues at constant "
        "velocity. Without it, people whom only one camera sees would flicker. 0 = off (paper).",
    )
    carry: float = Field(
        1.0,
        ge=0,
        le=5,
        description="Longest time, s, for which results go on while other people hide a person "
        "from every camera that looks there. The confidences fall to 0 over this time. Results do "
        "not go on if a camera should see the person. 0 = off (paper).",
    )


class CalibrationParams(Params):
    """How limb lengths are found."""

    calibration: Literal["auto", "two-pass", "off"] = Field(
        "auto",
        description="auto: from each person's own frames, during the run. two-pass: from the whole "
        "log, which is read once before (most accurate; lengths are strictly constant). off: only "
        "limb lengths from a file.",
    )
    calibration_frames: int = advanced(
        100,
        ge=2,
        description="Number of a person's frames in one calibration (section 3.3.1; 100 in the "
        "published code).",
    )
    lookahead: Seconds = Field(
        10.0,
        ge=0.0,
        description="Time, s, that a person's first frames are held. They then get the calibrated "
        "lengths. 10 s instead of 100 frames reduces the error of the lengths by a quarter. 0 for "
        "real time: frames pass unchanged until calibration_frames have been seen.",
    )
    calibration_windows: tuple[tuple[float, float], ...] = advanced(
        (),
        description="Calibrate only in these time ranges, each (start, end) in s from the log's "
        "start. Choose times when people stand still and are well visible. Empty: the whole log.",
    )
    max_variation: float = advanced(
        0.2,
        gt=0.0,
        description="Quality gate: largest relative variation of a link's length (standard "
        "deviation / length; 0.2 in the published code). A calibration with a larger one is "
        "rejected.",
    )
    short_link: Metres = fixed(
        0.15,
        "max_variation treats links shorter than this, m, as if they had this length. The noise "
        "of a joint does not shrink with the link: a hand of 5 cm with 2 cm of noise would "
        "reject everybody.",
    )
    max_free: float = fixed(
        0.3,
        "Share of the links that may fail the quality gate. These links keep their measured "
        "lengths; the others become constant. If more links fail, the person is not calibrated. "
        "With 0 (paper), one failing link rejects the person, even a thumb that a single camera "
        "guesses.",
    )
    debias: bool = fixed(
        True,
        "Correct the lengths for noise, which makes links look longer. false: plain (robust) "
        "mean, as in the paper.",
    )
    refine: bool = fixed(
        True, "Continue to measure after the calibration, and adjust the lengths slowly."
    )
    max_refinement: ClassVar[float] = 0.01
    """Largest relative change of a length by refinement. It is small because a person's lengths are
    constant."""

    @model_validator(mode="after")
    def _check_windows(self) -> CalibrationParams:
        for start, end in self.calibration_windows:
            if not 0.0 <= start < end:
                raise ValueError(f"calibration window ({start}, {end}): start must precede end")
        return self


class OptimizeParams(CalibrationParams):
    """Parameters of calibration, outlier detection and optimization."""

    lengths: Literal["exact", "paper"] = fixed(
        "exact",
        "exact: lengths are rigid, and markers move as little as possible. paper: the weights "
        "of eq. 18, which correct small errors only in part. exact has the smaller joint error, "
        "and a coefficient of variation of the lengths below 0.001 instead of 0.035.",
    )
    max_length_error: Metres = advanced(
        0.1,
        gt=0.0,
        description="If a link's length is off by more than this, m, one of its ends is an outlier."
        " It is also the scale L of eq. 18, which the paper does not give. 0.1 is six times the "
        "standard deviation of a link between merged joints. On clean logs, 0.1 to 0.3 give the "
        "same result; of joints displaced by 15 or 30 cm, 0.1 repairs most.",
    )
    outliers: Literal["restore", "remove"] = fixed(
        "restore",
        "What happens to an outlier. restore: it moves to where the other markers and the "
        "lengths put it, so skeletons stay complete; a robust fit finds which end of a wrong "
        "link is the outlier. remove: the distal marker of a wrong link and all links that "
        "touch it become absent (paper).",
    )
    align_links: bool = fixed(
        False,
        "Rotate link orientations with the directions of the links. Detectors measure "
        "orientations independently of positions, and better than the ends of a short link can. "
        "On logs made from real motion, this option raises the mean orientation error from 2.6 "
        "to 4.2 degrees.",
    )
    solver: Literal["lm", "ceres"] = Field(
        "lm",
        description="lm: compiled block Levenberg-Marquardt. ceres: the same energy with Ceres "
        "Solver, as in the paper; about 100 times slower, for comparison.",
    )
    tolerance: ClassVar[float] = 1e-06
    """The solver has converged when no coordinate moves farther than this, m, in a step."""


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
