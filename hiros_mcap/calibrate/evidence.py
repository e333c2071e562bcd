"""What speaks for and against poses that were found from nothing."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from hiros_mcap.body.rotations import angle, from_matrix
from hiros_mcap.calibrate.agreement import compare_bodies
from hiros_mcap.calibrate.joint_refinement import GATES_M, refine
from hiros_mcap.calibrate.refinement import Refinement, evidence_of
from hiros_mcap.calibrate.repetition import closest_repetition, path_distances
from hiros_mcap.calibrate.verdict import Evidence
from hiros_mcap.skeletons import Floats, Ints


def full_evidence(refined: Refinement, mirror: Ints, rivals: Sequence[bool]) -> list[Evidence]:
    """Gather all evidence, also that strangers might pass for the same person.

    Parameters
    ----------
    rivals : whether the pose by which each camera was found is ambiguous.
    """
    halves = _halves(refined, mirror)
    bodies = compare_bodies(refined.residuals, refined.points)
    paths = path_distances(refined.residuals, refined.points)
    clocks = refined.rig.clocks
    return [
        replace(
            one,
            rival=rivals[c],
            halves_deg=float(halves[c]),
            size=float(bodies.sizes[c]),
            wander=float(bodies.wander[c]),
            limbs=float(bodies.limbs[c]) if refined.timed[c] else 1.0,
            path=float(paths[c]),
            repetition=closest_repetition(refined.views[c]),
            late=float(np.abs(np.delete(clocks, c) - clocks[c]).min()) * bool(refined.timed[c]),
        )
        for c, one in enumerate(evidence_of(refined, mirror))
    ]


def _halves(refined: Refinement, mirror: Ints) -> Floats:
    """(C,) angle, degrees, between the orientations that the halves of the log give.

    They are compared with that camera to which the others keep their orientations best.
    """
    middle = len(refined.instants) // 2
    first, second = (
        refine(refined.views, refined.rig, part, mirror, free=refined.free, gates=GATES_M[2:])[
            0
        ].rotations
        for part in (refined.instants[:middle], refined.instants[middle:])
    )
    angles = np.array(
        [
            angle(from_matrix(one.T @ first), from_matrix(other.T @ second))
            for one, other in zip(first, second, strict=True)
        ]
    )
    return np.asarray(np.degrees(angles[int(angles.sum(axis=1).argmin())]))
