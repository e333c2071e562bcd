"""What a detector finds in one image, and what the confidence of a joint from such images says.

Skeletons carry one number per joint, its confidence. That of a triangulated joint states the
standard deviation of its position: half is 35 mm.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from hiros_mcap.skeletons import Floats

TRIANGULATED = "rgb_cameras"
"""Name of the camera that stands for all RGB cameras."""
_USUAL = 0.02  # m; the deviation at a confidence of .71
_MARGIN = 0.5
"""Of the image's size; a detector that guesses joints outside of it knows nothing beyond."""


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


def cleaned(
    pixels: Floats, scores: Floats, size: tuple[int, int] | None = None
) -> tuple[Floats, Floats]:
    """Return keypoints as hiros has them, whatever a detector writes for those it did not find.

    Not found are those with a coordinate that is no number, at exactly 0 0, with a score of 0 or
    less, or half an image beyond the border. Scores above 1 are 1. Where no keypoint has a score,
    each has 1.

    Parameters
    ----------
    pixels : (P, J, 2) px. scores : (P, J); NaN = not given. size : of the image, px.
    """
    u, v = pixels[..., 0], pixels[..., 1]
    there = np.isfinite(u) & np.isfinite(v) & ((u != 0) | (v != 0))
    if size is not None:
        width, height = size
        there &= (u > -_MARGIN * width) & (u < (1 + _MARGIN) * width)
        there &= (v > -_MARGIN * height) & (v < (1 + _MARGIN) * height)
    given = np.where(np.isnan(scores), 0.0, scores)
    if given.any():
        there &= given > 0
    else:
        given = np.ones_like(given)
    return np.where(there[..., None], pixels, np.nan), np.where(there, np.clip(given, 0, 1), 0.0)


def confidence_of(deviations: Floats) -> Floats:
    """Return the confidence, 0 to 1, of joints with a standard deviation along each axis, m."""
    return np.asarray(_USUAL / np.hypot(_USUAL, deviations))


def variance_of(confidences: Floats) -> Floats:
    """Return the variance along each axis, m2: the inverse of :func:`confidence_of`."""
    return np.asarray(_USUAL**2 * (1.0 / np.maximum(confidences, 1e-3) ** 2 - 1.0))
