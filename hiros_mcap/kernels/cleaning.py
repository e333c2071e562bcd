"""Turn numbers that cannot be true into NaN, so that no stage has to look for them."""

# mypy: disable-error-code="no-any-return"
# (numba's decorator hides the types of the helpers from their callers)

from __future__ import annotations

import numpy as np
from numba import types

from hiros_mcap.kernels.compile import kernel
from hiros_mcap.skeletons import Floats, Stamps

LIMIT = 1e4
"""Largest believable number: m, m/s, rad/s, m/s2, rad/s2."""

# Elements of the counts.
ABSURD, INCOMPLETE, NO_ROTATION, NOT_UNIT, CONFIDENCE = 0, 1, 2, 3, 4
COUNTS = 5

_STATE = 19
_BOX = 22
_ORIENTATION = 3

# A quaternion of float32 numbers is this far from unit length: left as it is.
_UNIT = 1e-6
# Farther off than this is worth telling (rounding to three digits, say).
_NOTICE = 1e-3
# Shorter than this it has no direction.
_SHORTEST = 1e-6

_F1, _F2, _F3 = types.float64[::1], types.float64[:, ::1], types.float64[:, :, ::1]


# Signatures keep numba from making a version for every number that a helper is called with.
@kernel(types.void(_F1, types.int64, types.int64, types.boolean))
def _unset(vector: Floats, first: int, n: int, fix: bool) -> None:
    if fix:
        for k in range(first, first + n):
            vector[k] = np.nan


@kernel(types.boolean(_F1, types.int64, types.int64, types.int64[::1], types.boolean))
def _vector(state: Floats, first: int, n: int, counts: Stamps, fix: bool) -> bool:
    """Look at ``n`` numbers that belong together; return whether all of them are given."""
    unknown = 0
    absurd = False
    for k in range(first, first + n):
        unknown += np.isnan(state[k])
        absurd |= abs(state[k]) > LIMIT
    if absurd:
        counts[ABSURD] += 1
        _unset(state, first, n, fix)
        return False
    if 0 < unknown < n:
        counts[INCOMPLETE] += 1
        _unset(state, first, n, fix)
    return unknown == 0


@kernel
def _rotation(state: Floats, counts: Stamps, fix: bool) -> bool:
    """Look at the quaternion; return whether it needs a change that is too small to count."""
    if not _vector(state, _ORIENTATION, 4, counts, fix):
        return False
    square = 0.0
    for k in range(_ORIENTATION, _ORIENTATION + 4):
        square += state[k] * state[k]
    norm = np.sqrt(square)
    if abs(norm - 1.0) <= _UNIT:
        return False
    if norm < _SHORTEST:
        counts[NO_ROTATION] += 1
        _unset(state, _ORIENTATION, 4, fix)
        return False
    if abs(norm - 1.0) > _NOTICE:
        counts[NOT_UNIT] += 1
    if fix:
        for k in range(_ORIENTATION, _ORIENTATION + 4):
            state[k] /= norm
    return True


@kernel
def _state(state: Floats, counts: Stamps, fix: bool) -> bool:
    _vector(state, 0, 3, counts, fix)
    for first in range(7, _STATE, 3):
        _vector(state, first, 3, counts, fix)
    return _rotation(state, counts, fix)


@kernel
def _confidence(confidences: Floats, k: int, counts: Stamps, fix: bool) -> None:
    value = confidences[k]
    if np.isinf(value):
        counts[ABSURD] += 1
        value = np.nan
    elif value < 0.0 or value > 1.0:
        counts[CONFIDENCE] += 1
        value = min(max(value, 0.0), 1.0)
    if fix:
        confidences[k] = value


@kernel(
    types.boolean(types.int64[::1], types.boolean, _F1, _F3, _F2, _F3, _F2, _F2),
)
def clean(
    counts: Stamps,
    fix: bool,
    confidences: Floats,
    markers: Floats,
    marker_confidences: Floats,
    links: Floats,
    link_confidences: Floats,
    boxes: Floats,
) -> bool:
    """Count what is wrong with a frame's numbers and, if asked to, put it right in place.

    Returns whether there is anything to put right; ``counts`` is (5,), set by this call.
    """
    for k in range(COUNTS):
        counts[k] = 0
    change = False
    for person in range(len(confidences)):
        _confidence(confidences, person, counts, fix)
        change |= _state(boxes[person], counts, fix)
        _vector(boxes[person], _STATE, _BOX - _STATE, counts, fix)
        for slot in range(markers.shape[1]):
            _confidence(marker_confidences[person], slot, counts, fix)
            change |= _state(markers[person, slot], counts, fix)
        for slot in range(links.shape[1]):
            _confidence(link_confidences[person], slot, counts, fix)
            change |= _state(links[person, slot], counts, fix)
    for k in range(COUNTS):
        change |= counts[k] > 0
    return change
