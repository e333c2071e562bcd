"""Parameters of :mod:`hiros_mcap.stages.straighten`."""

from __future__ import annotations

from hiros_mcap.params import Params, advanced


class StraightenParams(Params):
    """Parameters of the limb lengths."""

    frames: int = advanced(
        30,
        ge=1,
        description="Number of whole skeletons that give the first lengths, by their mean (III-E).",
    )
    rate: float = advanced(
        0.002,
        ge=0,
        le=1,
        description="Weight of a new measurement in a length. The paper measures the optimized "
        "joints, whose links already have this length; hiros measures the filter's joints.",
    )
    head: bool = advanced(
        True,
        description="Give the links of the head constant lengths, too. The paper leaves the head "
        "out of its tree (III-E).",
    )
    chest_midpoint: bool = advanced(
        False, description="Put the chest midway between the shoulders and hips (III-E)."
    )
