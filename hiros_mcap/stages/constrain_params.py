"""Parameters of :mod:`hiros_mcap.stages.constrain`."""

from __future__ import annotations

from pydantic import Field

from hiros_mcap.params import Params, Seconds, advanced


class ConstrainParams(Params):
    """Parameters of the constraints."""

    window: Seconds = Field(
        10.0,
        ge=0,
        description="Seconds that are corrected at once. 0 = each pose by those before it, as in "
        "fuse-realtime.",
    )
    enough: Seconds = advanced(
        60.0,
        ge=0,
        description="Seconds after which the lengths of a person stay as they are. Detectors see "
        "other lengths in other poses, so a few seconds in one pose do not give them. Results wait "
        "for it. In fuse-realtime, which does not wait, 5.",
    )
    rigid: bool = advanced(
        True, description="Keep the distances within head, thorax and pelvis, too."
    )
    prior: bool = advanced(
        True, description="Use the motion of the person in the window as a prior of each pose."
    )
