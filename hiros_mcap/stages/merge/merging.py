"""Kernels of the merger: votes and weighted means over cameras (Hi-ROS 2023, section 3.2)."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from hiros_mcap.kernels.array_types import B1, F1, F2, F3, F4, I1, I2, arrays
from hiros_mcap.kernels.averaging import (
    ORIENTATION,
    POSITION,
    VELOCITY,
    Buffers,
    Views,
    blank,
    blank_person,
    copy_pose,
    load_views,
    mean_person,
    mean_state,
)
from hiros_mcap.kernels.compile import entry, inlined, kernel
from hiros_mcap.kernels.points import norm3, step_between
from hiros_mcap.kernels.quaternions import angle_of
from hiros_mcap.skeletons import STATE, Flags, Floats, People, Stamps

OUTLIERS, FLIPS = 0, 1
"""Rows of ``counts``: votes that a camera lost, and its views that faced the wrong way."""

_HORIZON = 0.2  # s for which a past pose is carried on at constant velocity
_LIMBS = 0.05  # s; how long the limbs of somebody whom no view shows go on by themselves
_ROUNDS = 3  # of reweighting
_FAINT = 1 / 9
"""Share of the best view's weight below which a view has no vote: a third of its confidence.
Otherwise it would lead the past astray, and then win with it."""


class MergerSettings(NamedTuple):
    """Parameters of merge.py; m, rad and s."""

    max_position_delta: float
    max_orientation_delta: float
    max_facing_delta: float
    confidence_power: float
    robust_scale: float
    offset_time: float
    bridge: float
    carry: float
    pelvis_link: int  # slot; -1 = there is none
    past_votes: bool
    compensate_motion: bool


class MergerPast(NamedTuple):
    """The memory of S people, a row each."""

    seen: I1  # (S,) time of the last merged pose, ns; 0 = never
    confidences: F1
    markers: F3
    marker_confidences: F2
    links: F3
    link_confidences: F2  # (S, ...) the last merged pose; coordinates as in People
    camera_offsets: F4  # (S, C, M, 3) slow offset of each camera's markers from the merged ones, m

    @classmethod
    def empty(cls, n_markers: int, n_links: int) -> MergerPast:
        """Return arrays with no rows."""
        m, n = (0, n_markers), (0, n_links)
        return arrays(cls, 0, 0, (*m, STATE), m, (*n, STATE), n, (0, 4, n_markers, 3))


class MergerWork(NamedTuple):
    """Scratch for up to K views of a person. A kernel that makes arrays is twice as slow."""

    values: F2  # (K + 1, 4) the positions or orientations of the views, then those of the past pose
    distances: F1  # ((K + 1)^2,) between them
    present: B1  # (K,) views that count
    weights: F1
    robust: F1  # (K,)
    marker_weights: F2
    link_weights: F2  # (K, M) and (K, L)
    past_positions: F2
    past_orientations: F2  # (M, 3) and (L, 4)

    @classmethod
    def of(cls, views: int, n_markers: int, n_links: int) -> MergerWork:
        """Make room."""
        k, m, n = views, n_markers, n_links
        return arrays(cls, (k + 1, 4), (k + 1) ** 2, k, k, k, (k, m), (k, n), (m, 3), (n, 4))


class _Slots(NamedTuple):
    """The markers or the links of one person's views."""

    states: Floats  # (K, M, 19)
    confidences: Floats  # (K, M)
    skeleton_confidences: Floats  # (K,) of the views as a whole
    weights: Floats  # (K, M)
    past: Floats  # (M, 3) positions, or (M, 4) orientations, of the past pose; NaN = no vote
    merged: Floats
    merged_confidences: Floats  # (M, 19) and (M,), to be written


@kernel
def _merge_person(
    stamp: int, views: Views, past: MergerPast, row: int, settings: MergerSettings, out: People,
    p: int, counts: Stamps, work: MergerWork,
) -> None:  # fmt: skip
    """Merge the views of one person (section 3.2)."""
    has_past = _predict(stamp, past, row, settings, work)  # the past pose votes like a camera
    _drop_flipped(views, has_past, settings, counts, work)
    offsets = past.camera_offsets[row]
    blank_person(out, p)
    _subtract_offsets(views, offsets)
    _merge_slots(  # outliers by Euclidean distance, then eq 12
        _Slots(
            views.markers, views.marker_confidences, views.confidences, work.marker_weights,
            work.past_positions, out.markers[p], out.marker_confidences[p],
        ),
        False, settings.max_position_delta, settings, views.cameras, counts, work,
    )  # fmt: skip
    _merge_slots(  # outliers by eq 10, then eq 12
        _Slots(
            views.links, views.link_confidences, views.confidences, work.link_weights,
            work.past_orientations, out.links[p], out.link_confidences[p],
        ),
        True, settings.max_orientation_delta, settings, views.cameras, counts, work,
    )  # fmt: skip
    mean_person(stamp, views, settings.compensate_motion, out, p)
    _learn_offsets(
        views, work.marker_weights, out.markers[p], _rate(stamp, past, row, settings), offsets
    )
    past.seen[row] = stamp
    copy_pose(past, row, out, p)


@kernel
def _is_fresh(stamp: int, past: MergerPast, row: int) -> bool:
    """Whether the past pose is young enough to be carried on."""
    return past.seen[row] > 0 and (stamp - past.seen[row]) * 1e-9 <= _HORIZON


@kernel
def _predict(
    stamp: int, past: MergerPast, row: int, settings: MergerSettings, work: MergerWork
) -> bool:
    """Carry the past pose to ``stamp`` at constant velocity; whether it may vote.

    The previous pose votes in the published code, not in the paper.
    """
    votes: bool = settings.past_votes and _is_fresh(stamp, past, row)
    dt = max((stamp - past.seen[row]) * 1e-9, 0.0)
    for m in range(past.markers.shape[1]):
        for c in range(3):
            v = past.markers[row, m, VELOCITY + c]
            moved = past.markers[row, m, c] + dt * (0.0 if math.isnan(v) else v)
            work.past_positions[m, c] = moved if votes else np.nan
    for k in range(past.links.shape[1]):
        for c in range(4):
            work.past_orientations[k, c] = past.links[row, k, ORIENTATION + c] if votes else np.nan
    return votes


@kernel
def _fade(confidences: Floats, p: int, share: float) -> None:
    """Lower the confidences (P, N) of a person; unknown ones stay unknown."""
    for m in range(confidences.shape[1]):
        confidences[p, m] *= share


@kernel
def _bridge(
    stamp: int, past: MergerPast, row: int, settings: MergerSettings, out: People, p: int
) -> None:
    """Write the past pose, carried on at the body's velocity up to the horizon.

    What limbs move beside it fades: else who is carried comes apart. Beyond ``bridge`` s without
    a view, confidences fall, to nothing at ``carry`` s.
    """
    copy_pose(out, p, past, row)
    unseen = (stamp - past.seen[row]) * 1e-9
    if unseen > settings.bridge:
        share = max(1.0 - unseen / settings.carry, 0.0)
        out.confidences[p] *= share
        _fade(out.marker_confidences, p, share)
        _fade(out.link_confidences, p, share)
    dt = min(unseen, _HORIZON)
    own = _LIMBS * (1.0 - math.exp(-dt / _LIMBS))
    for c in range(3):
        column, body = VELOCITY + c, 0.0
        for m in range(out.markers.shape[1]):
            v = out.markers[p, m, column]
            body += 0.0 if math.isnan(v) else v / out.markers.shape[1]
        for m in range(out.markers.shape[1]):
            v = out.markers[p, m, column]
            v = body if math.isnan(v) else v
            out.markers[p, m, c] += dt * body + own * (v - body)


# Votes: on the way a person faces, on the position of a marker, on the orientation of a link.


@inlined
def _dot(a: Floats, i: int, b: Floats, j: int) -> float:
    """Scalar product of rows of two arrays."""
    dot: float = a[i, 0] * b[j, 0] + a[i, 1] * b[j, 1] + a[i, 2] * b[j, 2]
    if a.shape[1] == 4:
        dot += a[i, 3] * b[j, 3]
    return dot


@inlined
def _distance(values: Floats, a: int, b: int, orientations: bool) -> float:
    """Distance of two rows: positions, m, or ``orientations``, rad; NaN = unknown."""
    if orientations:
        dot = _dot(values, a, values, b)
        return np.nan if math.isnan(dot) else angle_of(dot)  # eq 10
    return norm3(*step_between(values, b, a))


@entry
def largest_group(distances: F2, weights: F1, has_past: bool, limit: float) -> int:
    """Return the view whose neighbours, nearer than ``limit``, are the right ones; -1 = no view.

    The largest group wins (section 3.2), without the votes of ``_FAINT`` views; of equal ones the
    nearest to the past, then the most confident, then the tightest. The order of the cameras never
    matters.

    Parameters
    ----------
    distances : (N, N), NaN on the diagonal for an absent view. With ``has_past`` the last row is
        the past pose, which votes like a camera but leads no group.
    weights : confidence of each view.
    """
    n = distances.shape[0]
    views = n - 1 if has_past else n
    best, least = -1, 0.0
    for k in range(views):
        if not math.isnan(distances[k, k]):
            least = max(least, _FAINT * weights[k])
    best_votes, best_past, best_weight, best_sum = 0, 0.0, 0.0, 0.0
    for k in range(views):
        if math.isnan(distances[k, k]) or weights[k] < least:
            continue
        votes, weight, total = 0, 0.0, 0.0
        for j in range(n):
            if distances[k, j] < limit:
                votes += int(j >= views or weights[j] >= least)
                total += distances[k, j]
                if j < views:
                    weight += weights[j]
        past = 0.0
        if has_past and not math.isnan(distances[k, n - 1]):
            past = distances[k, n - 1]
        better = votes > best_votes
        if votes == best_votes and best >= 0:
            if past != best_past:
                better = past < best_past
            elif abs(weight - best_weight) > 1e-12:
                better = weight > best_weight
            else:
                better = total < best_sum - 1e-6  # a view may be 1e-8 rad from itself
        if best < 0 or better:
            best, best_votes, best_past, best_weight, best_sum = k, votes, past, weight, total
    return best


# Flips.


@kernel
def _drop_flipped(
    views: Views, has_past: bool, settings: MergerSettings, counts: Stamps, work: MergerWork
) -> None:
    """Drop the views whose pelvis faces another way than that of the largest group (section 3.2).

    Views without an orientation of the pelvis stay.
    """
    n, limit, pelvis = len(views.stamps), settings.max_facing_delta, settings.pelvis_link
    size = n + 1 if has_past else n
    if limit <= 0.0 or pelvis < 0:
        return
    for c in range(4):
        for k in range(n):
            work.values[k, c] = views.links[k, pelvis, ORIENTATION + c]
        work.values[n, c] = work.past_orientations[pelvis, c]
    distances, confidences = work.distances[: size * size].reshape((size, size)), work.weights[:n]
    for a in range(size):
        for b in range(size):
            distances[a, b] = _distance(work.values, a, b, True)  # eq 10
    _sum_confidences(views, confidences)
    best = largest_group(distances, confidences, has_past, limit)
    for k in range(n if best >= 0 else 0):
        if distances[best, k] >= limit:
            counts[FLIPS, views.cameras[k]] += 1
            for m in range(views.markers.shape[1]):
                views.markers[k, m, POSITION] = np.nan
            blank(views.links[k], views.link_confidences[k])


@inlined
def _confidence(given: float, skeleton: float) -> float:
    """Confidence of a marker or link: as given, else its skeleton's, else 1 (eq 12)."""
    if math.isnan(given):
        return 1.0 if math.isnan(skeleton) else skeleton
    return given


@kernel
def _sum_confidences(views: Views, out: Floats) -> None:
    """Sum the confidences of each view's markers."""
    confidences = views.marker_confidences
    for k in range(len(confidences)):
        out[k] = 0.0
        for m in range(confidences.shape[1]):
            out[k] += _confidence(confidences[k, m], views.confidences[k])


# Outliers and the mean.


@kernel
def _merge_slots(
    slots: _Slots, orientations: bool, limit: float, settings: MergerSettings, cameras: Stamps,
    counts: Stamps, work: MergerWork,
) -> None:  # fmt: skip
    """Merge each marker, or each link by its ``orientations``: outlier vote, then eq 12.

    Views nearer than ``limit``, m or rad, agree; 0 or less turns the vote off. A link that no view
    gives an orientation is averaged without a vote. The final weights are left in ``slots``.
    """
    n, values, scale = len(cameras), work.values, settings.robust_scale
    present, weights = work.present[:n], work.weights[:n]
    # Half of the limit, for _all_agree. The angle between quaternions is half the rotation's.
    half = math.cos(0.25 * limit) if orientations else 0.25 * limit * limit
    _raise(slots, settings.confidence_power)
    for m in range(slots.states.shape[1]):
        if not _load_values(slots, m, orientations, values, present):
            continue
        has_past = limit > 0.0 and not math.isnan(slots.past[m, 0])
        centre = _first(present)
        if limit > 0.0 and not _all_agree(values, present, orientations, has_past, half):
            centre, has_past = _reject_outliers(
                slots.weights, m, orientations, has_past, limit, cameras, counts, work,
            )  # fmt: skip
        if centre < 0:
            continue
        _fill_weights(slots.weights, m, present, weights)
        if scale > 0.0 and not orientations:
            _reweight(values, weights, work.robust[:n], has_past, scale)
        mean_state(  # eq 12
            slots.states, slots.confidences, m, weights, centre, slots.merged,
            slots.merged_confidences,
        )  # fmt: skip
        for k in range(n):
            slots.weights[k, m] = weights[k]


@kernel
def _raise(slots: _Slots, power: float) -> None:
    """Fill the weights of eq 12: confidences to a power."""
    confidences, out = slots.confidences, slots.weights
    for k in range(len(confidences)):
        for m in range(confidences.shape[1]):
            c = _confidence(confidences[k, m], slots.skeleton_confidences[k])
            if power == 2.0:  # the power function takes twenty times as long
                out[k, m] = c * c
            else:
                out[k, m] = c**power


@inlined
def _load_values(slots: _Slots, m: int, orientations: bool, values: Floats, present: Flags) -> bool:
    """Load what views and past show of a slot; whether any view shows it at all."""
    n, first = len(present), ORIENTATION if orientations else POSITION
    some = False
    for k in range(n):
        present[k] = not math.isnan(slots.states[k, m, first])
        some = some or present[k]
        for c in range(slots.past.shape[1]):
            values[k, c] = slots.states[k, m, first + c]
    for c in range(slots.past.shape[1]):
        values[n, c] = slots.past[m, c]
    if orientations and not some:
        for k in range(n):
            no_position = math.isnan(slots.states[k, m, POSITION])
            present[k] = not (no_position and math.isnan(slots.confidences[k, m]))
            some = some or present[k]
    return some


@kernel
def _first(present: Flags) -> int:
    k = 0
    while not present[k]:
        k += 1
    return k


@inlined
def _all_agree(
    values: Floats, present: Flags, orientations: bool, has_past: bool, half: float
) -> bool:
    """Whether all lie within half of the limit of one of them: no vote would reject any.

    ``half`` is the squared distance, m2, or the scalar product of two quaternions at that angle:
    the roots and arc cosines of :func:`_distance` take longer.
    """
    n = len(present)
    centre = n if has_past else _first(present)
    for k in range(n):
        if not present[k]:
            continue
        if orientations:
            if abs(_dot(values, k, values, centre)) <= half:
                return False
        else:
            x, y, z = step_between(values, centre, k)
            if x * x + y * y + z * z >= half:
                return False
    return True


@kernel
def _reject_outliers(
    slot_weights: Floats, m: int, orientations: bool, has_past: bool, limit: float,
    cameras: Stamps, counts: Stamps, work: MergerWork,
) -> tuple[int, bool]:  # fmt: skip
    """Strike the views that are not in the largest group (section 3.2).

    Returns the centre of the group, and whether the past is in it.
    """
    n = len(cameras)
    size = n + 1 if has_past else n
    distances = work.distances[: size * size].reshape((size, size))
    for a in range(size):
        for b in range(a + 1):
            distances[a, b] = distances[b, a] = _distance(work.values, a, b, orientations)
    _fill_weights(slot_weights, m, work.present[:n], work.weights[:n])
    best = largest_group(distances, work.weights[:n], has_past, limit)
    for k in range(n):
        if work.present[k] and not distances[best, k] < limit:
            work.present[k] = False
            counts[OUTLIERS, cameras[k]] += 1
    return best, has_past and distances[best, n] < limit


@kernel
def _fill_weights(slot_weights: Floats, m: int, present: Flags, out: Floats) -> None:
    """Weight of each view that is present; equal if all are zero."""
    total = 0.0
    for k in range(len(out)):
        out[k] = slot_weights[k, m] if present[k] else 0.0
        total += out[k]
    if total <= 0.0:
        for k in range(len(out)):
            out[k] = 1.0 if present[k] else 0.0


@kernel
def _reweight(
    values: Floats, weights: Floats, robust: Floats, has_past: bool, scale: float
) -> None:
    """Multiply the weights by Cauchy weights of ``scale`` m about the mean that they give.

    The start prefers no camera: it is the past, if that may vote, or the plain weighted mean.
    """
    n = len(weights)
    x, y, z = values[n, 0], values[n, 1], values[n, 2]
    for k in range(n):
        robust[k] = weights[k]
    for i in range(_ROUNDS):
        if i > 0 or not has_past:
            x, y, z = _mean_position(values, robust)
        for k in range(n):
            if weights[k] > 0.0:
                dx, dy, dz = values[k, 0] - x, values[k, 1] - y, values[k, 2] - z
                robust[k] = weights[k] / (1.0 + (dx * dx + dy * dy + dz * dz) / (scale * scale))
    for k in range(n):
        weights[k] = robust[k]


@kernel
def _mean_position(values: Floats, weights: Floats) -> tuple[float, float, float]:
    """Weighted mean of the rows."""
    norm = x = y = z = 0.0
    for k in range(len(weights)):
        if weights[k] > 0.0:
            norm += weights[k]
            x += weights[k] * values[k, 0]
            y += weights[k] * values[k, 1]
            z += weights[k] * values[k, 2]
    return x / norm, y / norm, z / norm


# The cameras' slow offsets.


@kernel
def _subtract_offsets(views: Views, offsets: Floats) -> None:
    """Take each camera's slow offset (C, M, 3) off its markers."""
    for k in range(len(views.cameras)):
        for m in range(offsets.shape[1]):
            for c in range(3):
                views.markers[k, m, c] -= offsets[views.cameras[k], m, c]


@kernel
def _rate(stamp: int, past: MergerPast, row: int, settings: MergerSettings) -> float:
    """Share by which an offset follows what is observed; 0 = not at all."""
    if settings.offset_time <= 0.0 or not _is_fresh(stamp, past, row):
        return 0.0
    dt = max((stamp - past.seen[row]) * 1e-9, 0.0)
    return 1.0 - math.exp(-dt / settings.offset_time)


@kernel
def _learn_offsets(
    views: Views, weights: Floats, merged: Floats, rate: float, offsets: Floats
) -> None:
    """Move each camera's offset towards the distance of its markers from the merged ones.

    In proportion to the weight (K, M) that the view had: a guess says little.
    """
    if rate <= 0.0:
        return
    for m in range(len(merged)):
        if math.isnan(merged[m, 0]):
            continue
        heaviest = 0.0
        for k in range(len(views.cameras)):
            heaviest = max(heaviest, weights[k, m])
        for k in range(len(views.cameras)):
            if weights[k, m] > 0.0:
                share = rate * weights[k, m] / heaviest
                for c in range(3):
                    difference = views.markers[k, m, c] - merged[m, c]
                    offsets[views.cameras[k], m, c] += share * difference


@entry
def merge_buffers(
    buffers: Buffers, people: People, scratch: Views, past: MergerPast, settings: MergerSettings,
    out: People, counts: I2, work: MergerWork,
) -> None:  # fmt: skip
    """Merge buffer after buffer.

    Parameters
    ----------
    buffers, people : the messages, and the people that they show.
    scratch : for the views of any person in a buffer; so is ``work``.
    past : brought to the last buffer that shows the person.
    out : (P,) the merged people. ``ids`` say whom to merge; ``stamps`` hold the merged times. Who
        is in no message of a buffer is carried on from the past.
    counts : (2, C) outliers and flips by camera; added to.
    """
    for q in range(len(buffers.stamps)):
        for p in range(buffers.people_ends[q], buffers.people_ends[q + 1]):
            views = load_views(buffers, q, people, out.ids[p], settings.compensate_motion, scratch)
            row = buffers.past_rows[p]
            if len(views.stamps) == 0:
                _bridge(buffers.stamps[q], past, row, settings, out, p)
                continue
            _merge_person(buffers.stamps[q], views, past, row, settings, out, p, counts, work)
