"""Parameters of :mod:`hiros_mcap.stages.plausible`."""

from __future__ import annotations

from pydantic import Field

from hiros_mcap.params import Params, Seconds, advanced


class PlausibleParams(Params):
    """Parameters of plausible bodies."""

    limbs: bool = Field(
        True,
        description="Compare the limb lengths of each detection with those that the person has "
        "shown so far. Contradictory markers count less; a contradictory detection behind somebody "
        "else is left out where no other camera shows the person. false: off (paper).",
    )
    max_deviation: float = advanced(
        3.0,
        gt=0,
        description="Deviation of the links of a marker from the person's lengths, in standard "
        "deviations of these, up to which it keeps its confidence. Beyond, the confidence falls "
        "with the square. With 3, below 1 % of the markers of simulated logs lose some.",
    )
    enough: Seconds = advanced(
        5.0,
        ge=0,
        description="Seconds that a person must have been seen before lengths are compared. A few "
        "seconds in one pose do not show how much they vary.",
    )
    patience: Seconds = advanced(
        1.0,
        ge=0,
        description="Longest time, s, for which all detections of a person are left out. After "
        "that they count again, so nobody is lost. As long as merge.carry.",
    )
