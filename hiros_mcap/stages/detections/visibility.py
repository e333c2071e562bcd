"""Which joints a camera sees: what its detector says of them, and who stands in front.

Association, the correction of tracks, the steps between tracker and merger, and the merger read it
here. A detector that rates its joints guesses those of little confidence. Of any other one, a joint
is hidden by h, 0 to 1, where a limb of somebody else is in the line of sight
(:mod:`hiros_mcap.kernels.line_of_sight`).
"""

from __future__ import annotations

import math

from hiros_mcap.kernels.compile import inlined, kernel
from hiros_mcap.kernels.line_of_sight import Capsules, hidden_by
from hiros_mcap.skeletons import Floats

GUESSED_BELOW, GUESSED_SHARE = 0.5, 0.75
"""Confidence below which a detector guesses, at most, and as a share of its greatest confidences.
Azure Kinect gives 0.66 to joints that it sees and 0.33 to those that it guesses. A detector that is
never surer than 0.4 does not guess everything."""
HONEST = 0.06  # m; deviation of a joint that is seen: a Kinect v2 at 3 to 4 m, hands included
INVENTED = 0.2  # m; of one that a detector invents: on a Kinect log, .2 to .8 m off (3 axes)
_RATES = 0.03  # share of guessed joints from which on a detector is taken to rate joints
_RATED = 1000.0  # views that this share is of: half a minute


# By the detector's word. A rating (3,) has the views of a detector, the share of joints that it
# guesses, and the mean over views of the greatest confidence.


@inlined
def rates_joints(rating: Floats) -> bool:
    """Whether a detector tells which joints it guesses."""
    return rating[1] > _RATES


@inlined
def guess_limit(rating: Floats) -> float:
    """Return the confidence below which a detector guesses."""
    return min(GUESSED_BELOW, GUESSED_SHARE * rating[2])


@inlined
def learn_rating(confidences: Floats, rating: Floats) -> None:
    """Learn from the confidences (M,) of a view how its detector rates joints."""
    best = low = 0.0
    for m in range(len(confidences)):
        best = max(best, confidences[m])
    rating[0] += 1.0
    share = 1.0 / min(rating[0], _RATED)
    rating[2] += share * (best - rating[2])
    limit = guess_limit(rating)
    for m in range(len(confidences)):
        low += 1.0 if confidences[m] < limit else 0.0
    rating[1] += share * (low / len(confidences) - rating[1])


# By who stands in front.


@kernel
def hide_behind(
    body: Floats, box: Floats, camera: Floats, capsules: Capsules, points: Floats, hidden: Floats
) -> float:
    """Raise h (M,) of points (M, >= 3) to how far a body hides them; return its sum behind it.

    ``box`` is the body's outline, seen from the camera (3,).
    """
    total = 0.0
    for m in range(len(points)):
        if not math.isnan(points[m, 0]):
            h = hidden_by(points[m], camera, body, box, capsules)
            hidden[m] = max(hidden[m], h)
            total += h
    return total


@inlined
def mean_over_joints(points: Floats, hidden: Floats) -> float:
    """Return the mean of h (M,) over the points (M, >= 3) that there are; 0 if there are none."""
    total, n = 0.0, 0
    for m in range(len(points)):
        if not math.isnan(points[m, 0]):
            total += hidden[m]
            n += 1
    return total / max(n, 1)
