"""What a detector finds in one image: the keypoints of everybody in it."""

from __future__ import annotations

from typing import NamedTuple

from hiros_mcap.skeletons import Floats


class KeypointFrame(NamedTuple):
    """The keypoints of P people in one image, of a model of J joints."""

    camera: str
    stamp: int
    """Time of the image, ns."""
    log_time: int
    """ns."""
    pixels: Floats
    """(P, J, 2) px; NaN where a joint was not found."""
    scores: Floats
    """(P, J) how sure the detector is, 0 to 1."""
