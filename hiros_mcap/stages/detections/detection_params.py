"""Parameters of what is mended in single detections."""

from __future__ import annotations

from typing import ClassVar

from pydantic import Field

from hiros_mcap.params import Params, fixed


class PlausibleParams(Params):
    """Parameters of plausible bodies."""

    limbs: bool = Field(
        True,
        description="Compare the limb lengths of each detection with those that the person has "
        "shown so far. Contradictory markers count less; a contradictory detection behind somebody "
        "else is left out where no other camera shows the person. false: off (paper).",
    )
    behind_others: bool = fixed(
        True,
        "Joints that a camera cannot see because somebody stands in front count less, and stay "
        "where they were seen last on the moving body. So do joints that the detector guesses by "
        "its own word, but not in fuse, which averages guesses. false: off (paper).",
    )
    max_deviation: ClassVar[float] = 3.0
    """Deviation of the links of a marker from the person's lengths, in standard deviations of
    these, up to which it counts as it is. Beyond, its variance grows with the square. With 3, that
    is so for below 1 % of the markers of simulated logs."""
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
        "walking direction, and exchange left and right of views that contradict it. false: labels "
        "stay; hiros leaves out the views of an instant whose pelvis faces another way than most "
        "(Hi-ROS 2023, section 3.2), fuse does not.",
    )
    lookahead: float = Field(
        1.0,
        ge=0,
        le=600,
        description="Time, s, that the decision looks ahead at least; at most twice as long. "
        "On real recordings 1, 2 and 10 s give the same sides. 0 = a live system without delay.",
    )
