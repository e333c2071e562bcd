"""Evidence of the way a person faces: the likelihood of each direction by a view, as a logarithm.

A view shows the line through shoulders and hips, its label (which end is left) and cues such as the
toes. The directions are BINS across the person's trunk, in axes that are carried along with the
body (body_axes.py). Weights and scales were fitted to recordings of two
cameras at 30 Hz.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from hiros_mcap.body.forward_cues import FacingMarkers
from hiros_mcap.kernels.array_types import F1, F2, F3, I1, I2, arrays
from hiros_mcap.kernels.averaging import copy_row
from hiros_mcap.kernels.compile import entry, inlined, kernel
from hiros_mcap.kernels.points import step_between
from hiros_mcap.skeletons import Floats, Ints, People
from hiros_mcap.stages.detections.body_axes import (
    component,
    follow_line,
    follow_trunk,
    left_to_right,
    ramp,
)

CELL = 33_333_333  # ns
BINS = 36
CUES = 4  # rows of body.forward_cues.CUES
VIEWS = 16  # of a person that are remembered
HALF = BINS // 2
TOES = 3

_VIEW = 0.1  # weight of a view's label and cues: neighbours in time err together
_LINE_SHARPNESS, _LINE_OUTLIERS = 3.0, 0.05
LABEL_SHARPNESS = 2.0
_CUE_WEIGHTS = (2.0, 1.7, 1.7, 3.0)
_CUE_SCALES = (0.05, 0.05, 0.05, 0.06)  # m
_CUE_SIGNS = (1.0, -1.0, 1.0, 1.0)  # of what is measured: elbows bend backwards
_TURN = math.radians(8.0)  # SD of the change of the facing from one cell to the next
LONGEST_GAP = 30  # cells
TELEPORT = 1e-10  # probability of any other facing
_WIDTH_QUANTILE, _WIDTH_STEP = 0.8, 0.02
_OPPOSITE = -0.5  # cosine of labelled facings that contradict each other
_LABELS = 0.2, 0.5  # honesty with which labels say nothing; they say all that labels can
_FAST_TURNS = 0.45, 0.5  # lines show no fast turn; they show it (0.5 = nothing is known yet)
_SLOW_TURNS = 0.45, 0.7  # the same of slow turns: a fifth of them counts while nothing is known
_ROUND = math.radians(270.0)  # a turn that a detector never shows if it assumes a facing
_ROUND_MEMORY = 5.0  # s in which it is made
_LARGEST_STEP = math.radians(60.0)  # from one view to the next; beyond, labels are exchanged
_PRIOR_SAMPLES, _SAMPLE = 7.5, 0.125

PRIOR_AGREEMENT = (0.8, 0.8, 0.8, 0.5)
"""Share of contradicting labels in which a cue points the same way in both views, by cue."""


class MeasuredViews(NamedTuple):
    """Measures of N views of anybody, across the person's trunk."""

    cells: I1  # (N,) number of the cell of time
    stamps: I1  # (N,) ns
    cameras: I1  # (N,) index of the camera
    rows: I1  # (N,) row of the person in what is remembered
    facing: F2  # (N, 2) unit vector: the facing by the labels left and right; NaN = not known
    widths: F1  # (N,) length of the line that it was measured on, m
    cues: F2  # (N, CUES * 2) vectors that point forwards, m; 0 = not known
    axes: F3  # (N, 3, 3) the person's: two across the trunk, one along it; NaN = not known
    starts: I1  # (N,) how often the axes were chosen anew; facings before and after are unrelated
    weights: F1  # (N,) 1 for a camera of 30 Hz or slower, less for a faster one

    @classmethod
    def allocate(cls, n: int) -> MeasuredViews:
        """Make room."""
        pair, cues, axes = (n, 2), (n, 2 * CUES), (n, 3, 3)
        return arrays(cls, n, n, n, n, pair, n, cues, axes, n, n)


class FacingPast(NamedTuple):
    """Memory of S people, a row each."""

    cells: I1  # (S,) number of the current cell; 0 = never seen
    beliefs: F2  # (S, BINS) probabilities before the current cell's views
    evidence: F2  # (S, BINS) logarithm of the likelihood of the current cell's views so far
    widths: F1  # (S,) 80 % quantile of MeasuredViews.widths, m
    view_stamps: I2
    view_cameras: I2  # (S, VIEWS) the last views, a ring; stamp 0 = none
    view_measures: F3  # (S, VIEWS, 2 + CUES * 2) their facing and cues
    view_ranges: F3
    """(S, VIEWS, 3) their facing, rad, however the axes were turned, and the least and the
    largest one that the camera showed lately without a step; NaN = not known."""
    next_view: I1  # (S,) place of the next one in the ring
    axes: F3  # (S, 3, 3) as MeasuredViews.axes, of the last view
    trunks: F2  # (S, 3) mean of the last unit vectors along the trunk
    trunk_stamps: I1  # (S,) time of the last view that showed it, ns
    lines: F2  # (S, 3) see body_axes.follow_line; NaN = not known
    starts: I1
    belief_starts: I1  # (S,) as MeasuredViews.starts: of the last view; of the current cell

    @classmethod
    def empty(cls) -> FacingPast:
        """Return arrays with no rows."""
        views, bins, three = (0, VIEWS), (0, BINS), (0, 3)
        return arrays(
            cls, 0, bins, bins, 0, views, views, (*views, 2 + CUES * 2), (*views, 3), 0,
            (0, 3, 3), three, 0, three, 0, 0,
        )  # fmt: skip


class FacingTables(NamedTuple):
    """Tables that the kernels share."""

    directions: F2  # (BINS, 2) unit vectors
    turns: F2  # (LONGEST_GAP + 1, HALF + 1) probability of a turn by so many bins in so many cells
    agreement: F2
    """(CUES, 2) learned: how often a cue points the same way in views whose labels contradict each
    other, and how often it was asked. It tells physical cues from those that follow the label."""
    rounds: F1  # (1,) learned: how often labels went round with a person; such labels are honest

    @classmethod
    def make(cls) -> FacingTables:
        """Return the tables, with nothing learned yet."""
        angles = np.arange(BINS) * (2 * np.pi / BINS)
        steps = np.arange(HALF + 1) * (2 * np.pi / BINS)
        turns = np.exp(-0.5 * (steps / (_TURN * np.arange(1, LONGEST_GAP + 2)[:, None])) ** 2)
        # Every turn but that by 0 and by half a circle has two directions.
        turns /= 2 * turns.sum(axis=1, keepdims=True) - turns[:, :1] - turns[:, -1:]
        return cls(
            np.stack([np.cos(angles), np.sin(angles)], axis=1),
            turns + TELEPORT,
            np.array([[p * _PRIOR_SAMPLES, _PRIOR_SAMPLES] for p in PRIOR_AGREEMENT]),
            np.zeros(1),
        )

    def reliability(self, cue: int) -> float:
        """Share of contradicting labels in which a cue points the same way in both views."""
        same, asked = self.agreement[cue].tolist()
        return float(same / asked)


# What a view shows.


@kernel
def _measure_cues(positions: Floats, axes: Floats, vectors: Ints, out: Floats) -> None:
    """Mean of each cue over the sides that show it."""
    out[:] = 0.0
    if math.isnan(axes[0, 0]):
        return
    for k in range(CUES):
        n = 0
        sx = sy = 0.0
        for v in range(len(vectors)):
            if vectors[v, 0] != k:
                continue
            x, y, z = _cue(positions, vectors[v, 1], vectors[v, 2], vectors[v, 3])
            if not math.isnan(x):
                n += 1
                sx, sy = sx + component(x, y, z, axes, 0), sy + component(x, y, z, axes, 1)
        scale = _CUE_SIGNS[k] / n if n > 0 else 0.0
        out[2 * k], out[2 * k + 1] = scale * sx, scale * sy


@kernel
def _cue(positions: Floats, a: int, b: int, joint: int) -> tuple[float, float, float]:
    """Vector from a to b, or from the line between them to a joint, m; NaN if not known."""
    x, y, z = step_between(positions, a, b)
    if joint < 0:
        return x, y, z
    jx, jy, jz = step_between(positions, a, joint)
    length2 = x * x + y * y + z * z
    if not length2 > 1e-6:
        return np.nan, np.nan, np.nan
    share = (x * jx + y * jy + z * jz) / length2
    return jx - share * x, jy - share * y, jz - share * z


# What is learned from one view after the other.


@kernel
def _learn(measured: MeasuredViews, i: int, past: FacingPast, tables: FacingTables) -> None:
    """Learn from view ``i``, and write its weight."""
    row, stamp, camera = measured.rows[i], measured.stamps[i], measured.cameras[i]
    last = _last_view(camera, past, row)
    cells = (stamp - past.view_stamps[row, last]) / CELL if last >= 0 else np.inf
    # A camera of 30 Hz whose stamps jitter counts as one of 30 Hz.
    weight: float = min(1.0, 1.25 * max(cells, 0.0))
    measured.weights[i] = weight
    if not math.isnan(measured.facing[i, 0]):
        for v in range(VIEWS):
            if (
                past.view_cameras[row, v] != camera
                and past.view_stamps[row, v] > 0
                and abs(stamp - past.view_stamps[row, v]) < CELL
            ):
                _compare(measured, i, past.view_measures[row, v], weight, tables.agreement)
    place = past.next_view[row]
    if _goes_round(measured, i, last, past, past.view_ranges[row, place]):
        tables.rounds[0] += _SAMPLE * weight
    past.view_stamps[row, place], past.view_cameras[row, place] = stamp, camera
    for c in range(2):
        past.view_measures[row, place, c] = measured.facing[i, c]
    for c in range(2 * CUES):
        past.view_measures[row, place, 2 + c] = measured.cues[i, c]
    past.next_view[row] = (place + 1) % VIEWS


@kernel
def _last_view(camera: int, past: FacingPast, row: int) -> int:
    """Return the place of a camera's last view of a person, or -1."""
    last, stamp = -1, 0
    for v in range(VIEWS):
        if past.view_cameras[row, v] == camera and past.view_stamps[row, v] > stamp:
            last, stamp = v, past.view_stamps[row, v]
    return last


@kernel
def _goes_round(measured: MeasuredViews, i: int, last: int, past: FacingPast, out: Floats) -> bool:
    """Whether the labels of a camera went round with a person; write the range of the facing.

    A detector that assumes that people face it shows at most half a turn, then exchanges labels.
    """
    row = measured.rows[i]
    facing = math.atan2(measured.facing[i, 1], measured.facing[i, 0]) + past.lines[row, 2]
    if not line_reliability(measured.widths[i], past.widths[row]) > 0.0:
        facing = np.nan
    low = high = facing
    if last >= 0:
        before = past.view_ranges[row, last]
        step = facing - before[0]
        step -= 2.0 * math.pi * math.floor(step / (2.0 * math.pi) + 0.5)
        if abs(step) < _LARGEST_STEP:  # False for NaN
            facing = before[0] + step
            seconds = 1e-9 * max(measured.stamps[i] - past.view_stamps[row, last], 0)
            share = min(seconds / _ROUND_MEMORY, 1.0)
            low = min(facing, before[1] + share * (facing - before[1]))
            high = max(facing, before[2] + share * (facing - before[2]))
    out[0], out[1], out[2] = facing, low, high
    return high - low > _ROUND


@kernel
def _learn_width(width: float, past: FacingPast, row: int) -> None:
    """Move the quantile of a person's widths."""
    if past.widths[row] == 0.0:
        past.widths[row] = width
    elif width > past.widths[row]:
        past.widths[row] += _WIDTH_STEP * _WIDTH_QUANTILE * past.widths[row]
    else:
        past.widths[row] -= _WIDTH_STEP * (1.0 - _WIDTH_QUANTILE) * past.widths[row]


@kernel
def _compare(
    measured: MeasuredViews, i: int, other: Floats, weight: float, agreement: Floats
) -> None:
    """Count which cues point the same way in two views whose labels contradict each other."""
    x, y = measured.facing[i, 0], measured.facing[i, 1]
    if not x * other[0] + y * other[1] < _OPPOSITE:
        return
    for k in range(CUES):
        mine = x * measured.cues[i, 2 * k] + y * measured.cues[i, 2 * k + 1]
        theirs = x * other[2 + 2 * k] + y * other[3 + 2 * k]
        if mine * theirs != 0.0:
            agreement[k, 0] += _SAMPLE * weight * (1.0 if mine * theirs > 0.0 else 0.0)
            agreement[k, 1] += _SAMPLE * weight


@inlined
def honesty_of(tables: FacingTables) -> float:
    """Whether labels err by chance, from 0 to 1.

    Such a detector leaves the toes alone when it errs, and its labels go round with a person.
    """
    same, asked, rounds = tables.agreement[TOES, 0], tables.agreement[TOES, 1], tables.rounds[0]
    return (same + rounds) / (asked + rounds)


@inlined
def mistrust(tables: FacingTables) -> float:
    """Probability that a label is wrong: 0.5 for a detector that assumes that people face it."""
    return 0.5 - 0.4 * ramp(honesty_of(tables), *_LABELS)


@inlined
def line_reliability(width: float, usual: float) -> float:
    """How far the line through shoulders and hips is trusted: 0 if it is short, at most 1."""
    return 0.0 if math.isnan(width) else ramp(width / usual, 0.25, 0.75)


# Views, one after the other, in the axes of each person.


@inlined
def _follow_body(
    positions: Floats, markers: FacingMarkers, stamp: int, past: FacingPast, row: int,
    honesty: float,
) -> tuple[float, float]:  # fmt: skip
    """Bring a person's axes to a view; return the line through shoulders and hips in them, m."""
    axes = past.axes[row]
    seconds = 1e-9 * max(stamp - past.trunk_stamps[row], 0) if past.starts[row] > 0 else np.inf
    seen, anew = follow_trunk(positions, markers, seconds, past.trunks[row], axes)
    if seen:
        past.trunk_stamps[row] = max(stamp, past.trunk_stamps[row])
    if anew:
        past.starts[row] += 1
        past.lines[row] = np.nan
        past.view_measures[row], past.view_ranges[row] = np.nan, np.nan
    x, y = left_to_right(positions, markers.lateral, axes)
    width = math.sqrt(x * x + y * y)
    if not width > 1e-6:
        return np.nan, np.nan
    _learn_width(width, past, row)
    reliable = line_reliability(width, past.widths[row])
    trust = ramp(honesty, *_SLOW_TURNS), ramp(honesty, *_FAST_TURNS)
    turn = follow_line(past.lines[row], math.atan2(y, x), reliable, seconds, trust, axes)
    cosine, sine = math.cos(turn), math.sin(turn)
    return cosine * x + sine * y, cosine * y - sine * x


@inlined
def measure_view(
    people: People, view: int, markers: FacingMarkers, measured: MeasuredViews, i: int,
    past: FacingPast, tables: FacingTables,
) -> None:  # fmt: skip
    """Measure what view ``i`` shows in the person's axes, and learn from it."""
    positions, row = people.markers[view], measured.rows[i]
    x, y = _follow_body(positions, markers, measured.stamps[i], past, row, honesty_of(tables))
    width = math.sqrt(x * x + y * y)
    measured.widths[i], measured.facing[i, 0], measured.facing[i, 1] = width, -y / width, x / width
    measured.starts[i] = past.starts[row]
    copy_row(measured.axes, i, past.axes, row)
    _measure_cues(positions, measured.axes[i], markers.vectors, measured.cues[i])
    _learn(measured, i, past, tables)


@entry
def measure(
    people: People, views: I1, markers: FacingMarkers, measured: MeasuredViews, past: FacingPast,
    tables: FacingTables,
) -> None:  # fmt: skip
    """Measure what ``views``, rows of ``people``, show, and learn from one after the other.

    Parameters
    ----------
    measured : cells, stamps, cameras and rows are given; the others are written.
    """
    for i in range(len(views)):
        measure_view(people, views[i], markers, measured, i, past, tables)


# What a view tells of the facing.


@inlined
def _squash(x: float) -> float:
    """Hyperbolic tangent within 0.025, in a tenth of its time."""
    x = min(max(x, -3.0), 3.0)
    return x * (27.0 + x * x) / (27.0 + 9.0 * x * x)


@kernel
def write_view_evidence(
    measured: MeasuredViews, i: int, past: FacingPast, tables: FacingTables, out: Floats
) -> None:
    """Write the logarithm of the likelihood of view ``i`` for every facing."""
    x, y, cues = measured.facing[i, 0], measured.facing[i, 1], measured.cues[i]
    weight = measured.weights[i]
    reliable = line_reliability(measured.widths[i], past.widths[measured.rows[i]])
    wrong, sharpness = mistrust(tables), 2.0 * _LINE_SHARPNESS * reliable
    for b in range(HALF if reliable > 0.0 else 0):
        cosine = x * tables.directions[b, 0] + y * tables.directions[b, 1]
        # cos(2 a) - 1 = 2 (cos(a)^2 - 1). The line has twice the weight of the label: a square.
        line = (1.0 - _LINE_OUTLIERS) * math.exp(sharpness * (cosine * cosine - 1.0))
        line = (line + _LINE_OUTLIERS) ** 2
        p = 0.5 + 0.5 * _squash(LABEL_SHARPNESS * cosine)
        p = p * (1.0 - wrong) + (1.0 - p) * wrong
        shared = _VIEW * math.log(line)
        out[b] = weight * (shared + _VIEW * reliable * math.log(p))
        out[b + HALF] = weight * (shared + _VIEW * reliable * math.log(1.0 - p))
    if not reliable > 0.0:
        out[:] = 0.0
    for k in range(CUES):
        cx, cy = cues[2 * k] / _CUE_SCALES[k], cues[2 * k + 1] / _CUE_SCALES[k]
        # 0 of a cue that follows the label, 1 of one that is physical
        trust = (
            weight
            * _VIEW
            * _CUE_WEIGHTS[k]
            * ramp(tables.agreement[k, 0] / tables.agreement[k, 1], 0.5, 0.8)
        )
        if trust > 0.0 and (cx != 0.0 or cy != 0.0):
            for b in range(HALF):
                along = _squash(cx * tables.directions[b, 0] + cy * tables.directions[b, 1])
                out[b] += trust * along
                out[b + HALF] -= trust * along


@entry
def write_evidence(
    measured: MeasuredViews, past: FacingPast, tables: FacingTables, out: F2
) -> None:
    """Write the evidence (N, BINS) of each view."""
    for i in range(len(measured.cells)):
        write_view_evidence(measured, i, past, tables, out[i])
