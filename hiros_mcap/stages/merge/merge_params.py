"""Parameters of the merger."""

from __future__ import annotations

import math

from pydantic import Field

from hiros_mcap.params import Params, Seconds, advanced, fixed


class MergeParams(Params):
    """Parameters of the merger."""

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
    in_step: bool = fixed(
        True,
        "A message also starts a new buffer where the message of its camera before, or one that "
        "was lost, would have been nearer to the others (not in the paper).",
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
        "With sides.over_time = false: views agree if the orientations of the pelvis differ by "
        "less than this, rad (section 3.2); <= 0 turns the search for flips off.",
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
