"""Turn numbers that cannot be true into NaN, so that no stage has to look for them.

An absent quaternion or vector is NaN throughout. A confidence that is not given is NaN.
"""

from __future__ import annotations

import numpy as np

from hiros_mcap.kernels.array_types import F1, I1
from hiros_mcap.kernels.compile import entry, kernel
from hiros_mcap.skeletons import BOX, ORIENTATION, STATE, VELOCITY, Floats, People, Stamps

LIMIT = 1e4  # largest believable number: m, m/s, rad/s, m/s2, rad/s2

# Elements of the counts.
COUNTS = 6
ABSURD, INCOMPLETE, NO_ROTATION, NOT_UNIT, ABOVE_ONE, NEGATIVE = range(COUNTS)
KINDS = (
    "absurd number", "incomplete vector", "quaternion of length 0", "quaternion normalised",
    "confidence above 1", "negative confidence",
)  # fmt: skip
"""What the counts are called in reports."""

_QUATERNION = ORIENTATION.start

_UNIT = 1e-6  # a quaternion of float32 numbers is this far from unit length: left as it is
_NOTICE = 1e-3  # farther off than this is worth a note (rounding to three digits, say)
_SHORTEST = 1e-6  # shorter than this it has no direction


# Signatures keep numba from making a version for every number that a helper is called with.
@entry
def _vector(state: F1, first: int, n: int, counts: I1) -> bool:
    """Unset ``n`` numbers that belong together unless all are believable; return if they are."""
    unknown = 0
    absurd = False
    for k in range(first, first + n):
        unknown += np.isnan(state[k])
        absurd |= abs(state[k]) > LIMIT
    if not absurd and (unknown == 0 or unknown == n):
        return unknown == 0
    counts[ABSURD if absurd else INCOMPLETE] += 1
    for k in range(first, first + n):
        state[k] = np.nan
    return False


@kernel
def _rotation(state: Floats, counts: Stamps) -> None:
    """Give the quaternion the length 1, or unset it."""
    if not _vector(state, _QUATERNION, 4, counts):
        return
    square = 0.0
    for k in range(_QUATERNION, _QUATERNION + 4):
        square += state[k] * state[k]
    norm = np.sqrt(square)
    if abs(norm - 1.0) <= _UNIT:
        return
    if norm < _SHORTEST:
        counts[NO_ROTATION] += 1
        norm = np.nan
    elif abs(norm - 1.0) > _NOTICE:
        counts[NOT_UNIT] += 1
    for k in range(_QUATERNION, _QUATERNION + 4):
        state[k] /= norm


@kernel
def _state(state: Floats, counts: Stamps) -> None:
    _vector(state, 0, 3, counts)
    for first in range(VELOCITY.start, min(len(state), STATE), 3):
        _vector(state, first, 3, counts)
    _rotation(state, counts)


@kernel
def _confidence(confidences: Floats, k: int, counts: Stamps) -> None:
    value = confidences[k]
    if np.isinf(value):
        counts[ABSURD] += 1
        confidences[k] = np.nan
    elif value > 1.0:
        counts[ABOVE_ONE] += 1
        confidences[k] = 1.0
    elif value < 0.0:
        counts[NEGATIVE] += 1
        confidences[k] = np.nan


@kernel
def clean(people: People, counts: Stamps) -> None:
    """Take out numbers that cannot be true, in place; ``counts`` (COUNTS,) are added to.

    - ABSURD: infinite or beyond 1e4 (m, m/s, ...): its whole vector becomes NaN;
    - INCOMPLETE: some numbers of a vector are NaN: all become NaN;
    - NO_ROTATION: a quaternion of length 0 becomes NaN;
    - NOT_UNIT: a quaternion's length was off by more than 1e-3. It becomes 1, also after smaller
      errors, which are not counted;
    - ABOVE_ONE: a confidence becomes 1; an infinite one is absurd;
    - NEGATIVE: a confidence becomes NaN, since detectors mean by -1 that they give none.
    """
    for person in range(len(people.ids)):
        _confidence(people.confidences, person, counts)
        _state(people.boxes[person], counts)
        _vector(people.boxes[person], STATE, BOX - STATE, counts)
        for slot in range(people.markers.shape[1]):
            _confidence(people.marker_confidences[person], slot, counts)
            _state(people.markers[person, slot], counts)
        for slot in range(people.links.shape[1]):
            _confidence(people.link_confidences[person], slot, counts)
            _state(people.links[person, slot], counts)
