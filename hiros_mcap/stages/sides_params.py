"""Parameters of :mod:`hiros_mcap.stages.sides`."""

from __future__ import annotations

from pydantic import Field

from hiros_mcap.params import Params


class SidesParams(Params):
    """Parameters of left and right."""

    over_time: bool = Field(
        True,
        description="Decide over time which way each person faces, by labels, body cues and "
        "walking direction, and exchange left and right of views that contradict it. false: the "
        "views of each instant vote (Hi-ROS 2023, section 3.2; see merge.flips).",
    )
    lookahead: float = Field(
        1.0,
        ge=0,
        le=600,
        description="Time, s, that the decision looks ahead at least; at most twice as long. "
        "On real recordings 1, 2 and 10 s give the same sides. 0 = a live system without delay.",
    )
