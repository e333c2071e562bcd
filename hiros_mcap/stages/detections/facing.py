"""Which way a person faces: a hidden Markov model over what all views show.

The hidden state is one of BINS directions across the person's trunk (facing_evidence.py). Time is
divided into cells of 1/30 s; the evidence of a cell's views adds up. :func:`smooth` decides by past
and future (the forward and the backward pass), ``facing_live.py`` by the past alone.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from hiros_mcap.body.forward_cues import FacingMarkers
from hiros_mcap.kernels.array_types import B1, F1, F2, F3, I1, arrays
from hiros_mcap.kernels.averaging import ACCELERATION, POSITION, VELOCITY, blank, copy_row, exchange
from hiros_mcap.kernels.compile import entry, inlined, kernel
from hiros_mcap.skeletons import Floats, People, Stamps
from hiros_mcap.stages.detections.body_axes import component, ramp
from hiros_mcap.stages.detections.facing_evidence import (
    BINS,
    HALF,
    LABEL_SHARPNESS,
    LONGEST_GAP,
    TELEPORT,
    FacingPast,
    FacingTables,
    MeasuredViews,
    honesty_of,
    line_reliability,
    mistrust,
)

_HONEST = 0.5, 0.7  # labels are not known to be honest; they are
_SURE = 0.5  # length of the mean direction of a belief that overrules labels
_LARGEST_DEVIATION = math.radians(45.0)  # of a view's facing from the decided one


class Facings(NamedTuple):
    """Decisions on N views."""

    facing: F2  # (N, 2) the way the person faces; the length, up to 1, tells how sure that is
    swapped: B1  # (N,) whether the view's left and right are exchanged
    turns: F1  # (N,) angle by which shoulders and hips are turned after that, rad
    toes: F1  # (N,) reliability of the toes (FacingTables.reliability) when this was decided

    @classmethod
    def allocate(cls, n: int) -> Facings:
        """Make room."""
        return arrays(cls, (n, 2), n, n, n)


# The model.


@kernel
def turn(belief: Floats, gap: int, tables: FacingTables, out: Floats) -> None:
    """Predict a belief ``gap`` cells later; 0 = in new axes, where every facing is as probable."""
    if gap == 0:
        out[:] = 1.0 / BINS
        return
    gap = min(gap, LONGEST_GAP)
    reach = min(HALF - 1, 6 * gap)
    total = 0.0
    for b in range(BINS):
        total += belief[b]
    for b in range(BINS):
        p = belief[b] * tables.turns[gap - 1, 0] + TELEPORT * total
        for k in range(1, reach + 1):
            low, high = b - k, b + k
            if low < 0:
                low += BINS
            if high >= BINS:
                high -= BINS
            p += (belief[low] + belief[high]) * tables.turns[gap - 1, k]
        out[b] = p / total


@kernel
def multiply(belief: Floats, evidence: Floats, out: Floats) -> None:
    """Multiply probabilities by likelihoods that are given as logarithms; the sum becomes 1."""
    most, total = -np.inf, 0.0
    for b in range(BINS):
        most = max(most, evidence[b])
    for b in range(BINS):
        out[b] = belief[b] * math.exp(evidence[b] - most)
        total += out[b]
    for b in range(BINS):
        out[b] /= total


@kernel
def mean_direction(belief: Floats, tables: FacingTables, out: Floats) -> None:
    """Mean of the directions; its length, up to 1, tells how sure it is."""
    x = y = total = 0.0
    for b in range(BINS):
        x += belief[b] * tables.directions[b, 0]
        y += belief[b] * tables.directions[b, 1]
        total += belief[b]
    out[0], out[1] = x / total, y / total


@kernel
def starts_anew(start: int, past: FacingPast, row: int) -> bool:
    """Whether nothing is known of a person's facing in these axes."""
    return past.cells[row] == 0 or start != past.belief_starts[row]


# Which views are mirrored, and whose trunk is turned.


@inlined
def _turn_back(deviation: float) -> float:
    """Angle, rad, that brings a facing nearer to the decided one, from which it deviates.

    The line through shoulders and hips has no say in the facing if it is at a right angle to where
    it should be: there, one labelling is as near as the other. Deviations beyond 45 degrees
    are reflected at 45 degrees, so the result does not depend on the labelling and never jumps.
    """
    beyond: float = max(abs(deviation) - _LARGEST_DEVIATION, 0.0)
    return math.copysign(2.0 * beyond, -deviation)


@kernel
def decide(
    measured: MeasuredViews, i: int, past: FacingPast, tables: FacingTables, out: Facings
) -> None:
    """Decide whether view ``i`` is mirrored, and by how much its trunk is turned.

    The likelihoods of its label are (1 + tanh(2 cos)) / 2 and the complement (LABEL_SHARPNESS):
    the logarithm of their ratio is 4 cos. An honest detector's label is right beforehand in 90 %.
    Labels that do not follow a detector's assumption stay while the facing is not sure.
    """
    x, y = measured.facing[i, 0], measured.facing[i, 1]
    fx, fy = out.facing[i, 0], out.facing[i, 1]
    sure = max(math.sqrt(fx * fx + fy * fy), 1e-12)
    if math.isnan(x) or (sure < _SURE and mistrust(tables) < 0.5):
        return
    cosine, sine = (fx * x + fy * y) / sure, (fx * y - fy * x) / sure
    honesty = ramp(honesty_of(tables), *_HONEST)
    right = 0.5 + 0.4 * honesty
    odds = math.log(right / (1.0 - right)) if honesty > 0.0 else 0.0
    usual = past.widths[measured.rows[i]]
    reliable = line_reliability(measured.widths[i], usual) if honesty > 0.0 else 1.0
    if odds + 2.0 * LABEL_SHARPNESS * reliable * cosine < 0.0:
        out.swapped[i] = True
        cosine, sine = -cosine, -sine
    if honesty == 0.0:
        out.turns[i] = _turn_back(math.atan2(sine, cosine))


class SmoothWork(NamedTuple):
    """Scratch for up to N cells of one person."""

    places: I1  # (N,) place of each view's cell among the cells
    cells: I1  # (N,) numbers of the cells
    starts: I1  # (N,) as in MeasuredViews, of the views of each cell
    beliefs: F2
    evidence: F2  # (N, BINS) before the cell's views; of them
    facing: F2  # (N, 2) as Facings.facing
    bins: F2  # (3, BINS)

    @classmethod
    def of(cls, views: int) -> SmoothWork:
        """Make room for so many views."""
        n = views
        return arrays(cls, n, n, n, (n, BINS), (n, BINS), (n, 2), (3, BINS))


@kernel
def _lay_out(
    measured: MeasuredViews, order: Stamps, evidence: Floats, past: FacingPast, work: SmoothWork
) -> int:
    """Add up one person's views by cells; return how many cells there are.

    A view that is late counts as one of the first cell that is not decided yet. Views in new axes
    have a cell of their own.
    """
    n, cell = 0, past.cells[measured.rows[order[0]]]
    for j in range(len(order)):
        i = order[j]
        if n == 0 or measured.cells[i] > cell or measured.starts[i] != work.starts[n - 1]:
            cell = max(measured.cells[i], cell + 1)
            work.cells[n], work.starts[n], work.evidence[n, :] = cell, measured.starts[i], 0.0
            n += 1
        work.places[j] = n - 1
        for b in range(BINS):
            work.evidence[n - 1, b] += evidence[i, b]
    return n


@kernel
def _cells_between(work: SmoothWork, j: int) -> int:
    """Count the cells from the one before cell ``j`` to it; 0 = they are in different axes."""
    same = work.starts[j] == work.starts[j - 1]
    return work.cells[j] - work.cells[j - 1] if same else 0


@kernel
def _go_forwards(
    past: FacingPast, row: int, n: int, tables: FacingTables, work: SmoothWork
) -> None:
    """Write the belief before each cell."""
    belief = work.bins[0]
    multiply(past.beliefs[row], past.evidence[row], belief)
    anew = starts_anew(work.starts[0], past, row)
    gap = 0 if anew else work.cells[0] - past.cells[row]
    turn(belief, gap, tables, work.beliefs[0])
    for j in range(1, n):
        multiply(work.beliefs[j - 1], work.evidence[j - 1], belief)
        turn(belief, _cells_between(work, j), tables, work.beliefs[j])


@kernel
def _go_backwards(n: int, tables: FacingTables, work: SmoothWork) -> None:
    """Write the facing in each cell, by what comes before and after it."""
    later, belief, both = work.bins[0], work.bins[1], work.bins[2]
    later[:] = 1.0
    for j in range(n - 1, -1, -1):
        multiply(later, work.evidence[j], belief)
        for b in range(BINS):
            both[b] = work.beliefs[j, b] * belief[b]
        mean_direction(both, tables, work.facing[j])
        if j > 0:
            turn(belief, _cells_between(work, j), tables, later)


@kernel
def _keep(past: FacingPast, row: int, n: int, until: int, work: SmoothWork) -> None:
    """Remember the cells before cell ``until``."""
    for j in range(n):
        if work.cells[j] >= until:
            return
        past.cells[row] = work.cells[j]
        copy_row(past.beliefs, row, work.beliefs, j)
        copy_row(past.evidence, row, work.evidence, j)
        past.belief_starts[row] = work.starts[j]


@entry
def smooth(
    measured: MeasuredViews, order: I1, ends: I1, evidence: F2, until: int, past: FacingPast,
    tables: FacingTables, work: SmoothWork, out: Facings,
) -> None:  # fmt: skip
    """Decide on the views of a window by past and future: the forward and the backward pass.

    Parameters
    ----------
    order : (N,) the views, person by person, each person's by time. ends : (P + 1,) where each
        person's views begin in it; the last number is N.
    evidence : (N, BINS) of the views, from facing_evidence.write_evidence.
    past : brought to the last cell before cell ``until``; later views come again.
    """
    for p in range(len(ends) - 1):
        theirs = order[ends[p] : ends[p + 1]]
        row = measured.rows[theirs[0]]
        n = _lay_out(measured, theirs, evidence, past, work)
        _go_forwards(past, row, n, tables, work)
        _go_backwards(n, tables, work)
        _keep(past, row, n, until, work)
        for j in range(len(theirs)):
            copy_row(out.facing, theirs[j], work.facing, work.places[j])
            decide(measured, theirs[j], past, tables, out)


# What was decided is done.


@kernel
def _turn_toes(states: Floats, ankle: int, toes: int, facing: Floats, axes: Floats) -> None:
    """Mirror the toes at the plane through the ankle that is normal to the facing."""
    length = max(math.sqrt(facing[0] * facing[0] + facing[1] * facing[1]), 1e-12)
    x = (facing[0] * axes[0, 0] + facing[1] * axes[1, 0]) / length
    y = (facing[0] * axes[0, 1] + facing[1] * axes[1, 1]) / length
    z = (facing[0] * axes[0, 2] + facing[1] * axes[1, 2]) / length
    for first in (POSITION, VELOCITY):
        if first >= states.shape[1]:
            break
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
        if first >= len(a):
            break
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
