"""Cues to the direction that a person faces, whatever its left and right are called.

Heads and toes point forwards, elbows bend backwards and knees forwards. A detector that confuses
the sides of a person cannot confuse these.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from hiros_mcap.body.segments import HEAD, LOWER_SPINE, NECK, SIDES, TOE
from hiros_mcap.body.symmetry import split_side, symmetry_of
from hiros_mcap.kernels.array_types import J1, J2
from hiros_mcap.skeletons import SkeletonModel

CUES = ("head", "elbow", "knee", "toe")
"""Vectors that point forwards: from the neck to the head, from the elbow to the line between
shoulder and wrist, from the line between hip and ankle to the knee, from the ankle to the toes."""

_TO_HEAD, _AT_ELBOW, _AT_KNEE, _TO_TOES = range(len(CUES))
_NONE = -1
_SHOULDER, _ELBOW, _WRIST = ("shoulder", "upperarm"), ("elbow", "forearm"), ("wrist", "hand")
_HIP, _KNEE, _ANKLE = ("hip", "upleg"), ("knee", "leg"), ("ankle",)


class FacingMarkers(NamedTuple):
    """Slots of the markers that show the facing; the first two as in :mod:`.symmetry`."""

    mirror: J1  # (M,)
    lateral: J2  # (K, 2)
    vectors: J2
    """(V, 4): cue, slot where the vector begins, slot where it ends, -1. Or: cue, ends of a line,
    slot of the joint that leaves the line forwards (knee) or backwards (elbow)."""
    feet: J2  # (F, 2) ankle and toes
    trunk: J2  # (T, 2) a hip and the shoulder above it: the way of the trunk
    upper: J2
    """(U, 3) the way of the trunk in a view without hips: from the middle of the first two markers
    to the third, the best row first. From the lower spine to the neck, or from neck to head."""

    @classmethod
    def of(cls, model: SkeletonModel) -> FacingMarkers:
        """Find the markers by their names; a cue whose markers are missing is left out."""
        slots = {split_side(name): slot for slot, name in enumerate(model.marker_names)}

        def find(*chain: tuple[str, ...], side: str) -> tuple[int, ...] | None:
            indices = [
                next((slots[n, side] for n in names if (n, side) in slots), None) for names in chain
            ]
            return None if None in indices else tuple(slot for slot in indices if slot is not None)

        def rows() -> Iterator[tuple[int, ...]]:
            if head := find(NECK, HEAD, side=""):
                yield (_TO_HEAD, *head, _NONE)
            for side in SIDES:
                if arm := find(_SHOULDER, _WRIST, _ELBOW, side=side):
                    yield (_AT_ELBOW, *arm)
                if leg := find(_HIP, _ANKLE, _KNEE, side=side):
                    yield (_AT_KNEE, *leg)
                if foot := find(_ANKLE, TOE, side=side):
                    yield (_TO_TOES, *foot, _NONE)

        symmetry = symmetry_of(model)
        vectors = np.array(list(rows()), np.int32).reshape(-1, 4)
        trunk = [find(_HIP, _SHOULDER, side=side) for side in SIDES]
        shoulders = [
            slots[name, side] for name in _SHOULDER for side in SIDES if (name, side) in slots
        ]
        neck = [slots[name, ""] for name in NECK if (name, "") in slots]
        heads = [slots[name, ""] for name in HEAD if (name, "") in slots]
        upper = [(pair[0], *pair) for pair in [find(LOWER_SPINE, NECK, side="")] if pair]
        upper += [(slot, slot, head) for slot in neck for head in heads]
        upper += [(*shoulders, head) for head in heads if len(shoulders) == len(SIDES)]
        return cls(
            symmetry.mirror,
            symmetry.lateral,
            vectors,
            np.ascontiguousarray(vectors[vectors[:, 0] == _TO_TOES, 1:3]),
            np.array([pair for pair in trunk if pair], np.int32).reshape(-1, 2),
            np.array(upper, np.int32).reshape(-1, 3),
        )
