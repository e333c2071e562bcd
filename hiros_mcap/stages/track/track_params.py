"""Parameters of the tracker."""

from __future__ import annotations

from typing import ClassVar

from pydantic import Field

from hiros_mcap.params import Params, Seconds, advanced, fixed


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
        description="Time, s, that a message with a tentative track is held, or up to eight times "
        "as long while somebody is absent and it is not clear who came. The person then has the id "
        "from the first detection on. 0 = a live system without delay.",
    )
    reidentify: Seconds = Field(
        30.0,
        ge=0,
        description="Longest absence, s, after which a person may get the old id back. Limb "
        "lengths, place, time and the number of people must make it probable (90 %). The "
        "decision waits for 0.8 of track.lookahead, and up to eight times as long while it is not "
        "clear who came. 0 = whoever comes back has a new id.",
    )
    max_jump: float = advanced(
        0.3,
        gt=0,
        description="A detection is left out if its markers are on average farther, m, from their "
        "track than this, although the track was just seen (plus 3 m/s for longer intervals). "
        "Detectors distort people who are about to be hidden. A camera that repeats it for half a "
        "second is believed, and so are two that show the same at once. inf = off (paper).",
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
    max_speed: ClassVar[float] = 12.0  # largest speed of a marker, m/s (a throwing hand reaches 10)
