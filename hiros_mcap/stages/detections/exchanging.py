"""Kernels that exchange left and right of people, and turn their shoulders and hips."""

from __future__ import annotations

import math

from hiros_mcap.kernels.array_types import F1, F2, F3, I1
from hiros_mcap.kernels.averaging import ACCELERATION, POSITION, VELOCITY, blank, exchange
from hiros_mcap.kernels.compile import entry, kernel
from hiros_mcap.skeletons import Floats, People
from hiros_mcap.stages.detections.body_axes import component
from hiros_mcap.stages.detections.facing_evidence import FacingMarkers


@kernel
def _turn_toes(states: Floats, ankle: int, toes: int, facing: Floats, axes: Floats) -> None:
    """Mirror the toes at the plane through the ankle that is normal to the facing."""
    length = max(math.sqrt(facing[0] * facing[0] + facing[1] * facing[1]), 1e-12)
    x = (facing[0] * axes[0, 0] + facing[1] * axes[1, 0]) / length
    y = (facing[0] * axes[0, 1] + facing[1] * axes[1, 1]) / length
    z = (facing[0] * axes[0, 2] + facing[1] * axes[1, 2]) / length
    for first in (POSITION, VELOCITY):
        along = x * (states[toes, first] - states[ankle, first])
        along += y * (states[toes, first + 1] - states[ankle, first + 1])
        along += z * (states[toes, first + 2] - states[ankle, first + 2])
        states[toes, first] -= 2.0 * along * x
        states[toes, first + 1] -= 2.0 * along * y
        states[toes, first + 2] -= 2.0 * along * z


@entry
def exchange_sides(people: People, rows: I1, facing: F2, axes: F3, markers: FacingMarkers) -> None:
    """Exchange left and right of the ``rows`` of ``people``, in place.

    A detector that mirrors a person turns the links by a convention of its own, so they become
    unknown. Where ``facing`` (N, 2) is known, the detector turns the toes, too: what of them points
    along the facing is turned round. ``axes`` (N, 3, 3) are those of the views.
    """
    mirror = markers.mirror
    for i in range(len(rows)):
        states, confidences = people.markers[rows[i]], people.marker_confidences[rows[i]]
        for m in range(len(mirror)):
            if mirror[m] > m:
                exchange(states, confidences, m, mirror[m])
        blank(people.links[rows[i]], people.link_confidences[rows[i]])
        if not math.isnan(facing[i, 0]):
            for f in range(len(markers.feet)):
                _turn_toes(states, markers.feet[f, 0], markers.feet[f, 1], facing[i], axes[i])


@kernel
def _turn_pair(a: Floats, b: Floats, turn: float, axes: Floats) -> None:
    """Turn two markers about the line along the trunk through their middle."""
    cosine, sine = math.cos(turn), math.sin(turn)
    for first in (POSITION, VELOCITY, ACCELERATION):
        x, y, z = b[first] - a[first], b[first + 1] - a[first + 1], b[first + 2] - a[first + 2]
        p, q = component(x, y, z, axes, 0), component(x, y, z, axes, 1)
        dp, dq = cosine * p - sine * q - p, sine * p + cosine * q - q
        for c in range(3):
            change = 0.5 * (dp * axes[0, c] + dq * axes[1, c])
            a[first + c] -= change
            b[first + c] += change


@entry
def turn_trunks(people: People, rows: I1, turns: F1, axes: F3, markers: FacingMarkers) -> None:
    """Turn shoulders and hips of the ``rows`` of ``people`` by ``turns`` (N,), rad, in place.

    They turn about the trunk; ``axes`` (N, 3, 3) are those of the views.
    Arms and legs stay: cameras see them better than the line of the body. Links become unknown.
    """
    for i in range(len(rows)):
        states = people.markers[rows[i]]
        for k in range(len(markers.lateral)):
            a, b = states[markers.lateral[k, 0]], states[markers.lateral[k, 1]]
            if not math.isnan(a[POSITION] + b[POSITION]):
                _turn_pair(a, b, turns[i], axes[i])
        blank(people.links[rows[i]], people.link_confidences[rows[i]])
