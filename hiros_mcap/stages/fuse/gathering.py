"""Views of people, gathered by instants for the fuser; and what their orientations come to.

The positions of a view go to the smoother as they are. Orientations, and the positions of links,
are averaged at each instant: the robust mean of the views, weighted by confidence (Hi-ROS 2023,
eq 12) and by Cauchy weights about the mean itself.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from hiros_mcap.frames import places_of
from hiros_mcap.kernels.array_types import F1, F2, F3, I1, J1, arrays, chosen, joined
from hiros_mcap.kernels.averaging import (
    ANGULAR_VELOCITY,
    BEGIN,
    CAMERA,
    END,
    ORIENTATION,
    TIME,
    Buffers,
)
from hiros_mcap.kernels.compile import entry, kernel
from hiros_mcap.kernels.points import mean_position, norm3
from hiros_mcap.kernels.quaternions import exponential, multiply
from hiros_mcap.skeletons import POSE, VELOCITY, Floats, People, SkeletonModel, Stamps
from hiros_mcap.stages.bank import Bank
from hiros_mcap.stages.fuse.fusing import REFERENCE, Sightings
from hiros_mcap.stages.merge.merge_params import MergeParams

VIEW_WIDTHS = (POSE, ANGULAR_VELOCITY + 3)
"""Columns that the markers and links of views have at least: links are turned on to the instant."""
WIDTHS = (VELOCITY.stop, POSE)
"""Columns of fused markers and links."""

_NEAREST = 0.3  # m; noise is not assumed to fall any further nearer to a camera
_HORIZON_NS = 200_000_000  # ns for which the mean before is where the next one begins
_SCALE = 0.35  # rad from the mean at which a view counts half
_ROUNDS = 5  # of reweighting


class ViewGatherer:
    """Keeps what each camera saw, and averages orientations; the kernel of an InstantMerger.

    ``params`` has the exponent of the confidences, and how long people go on whom nobody sees.
    """

    def __init__(self, model: SkeletonModel, params: MergeParams) -> None:
        slots = model.n_markers, model.n_links
        self._settings = GatherSettings(params.confidence_power, params.bridge, params.carry)
        self.bank = Bank(LastMeans.empty(*slots))
        self._views: list[Sightings] = []
        self._instants = 0
        self._work = GatherWork.of(1)

    def __call__(
        self, buffers: Buffers, people: People, views: int, out: People, counts: Stamps
    ) -> None:
        """Gather; see :data:`hiros_mcap.stages.merge.instants.MergeKernel`."""
        if views > len(self._work.rows):
            self._work = GatherWork.of(2 * views)
        n_views = int((buffers.messages[:, 1] - buffers.messages[:, 0]).sum())
        found = Sightings.allocate(n_views, people.markers.shape[1])
        n = gather(buffers, people, self.bank.past, self._settings, self._work, out, found)
        found = chosen(found, slice(n))
        self._views.append(found._replace(instants=found.instants + self._instants))
        self._instants += len(buffers.stamps)

    def take(self, names: tuple[str, ...], places: Mapping[str, Floats]) -> Sightings:
        """Return the views since the last call; their instants are numbered from 0.

        ``names`` are those of the cameras, ``places`` where they stand (3,), m.
        """
        views, self._views, self._instants = joined(self._views), [], 0
        write_distances(views, places_of(names, places))
        return views


class GatherSettings(NamedTuple):
    """Parameters of merge; s."""

    confidence_power: float
    bridge: float
    carry: float


class LastMeans(NamedTuple):
    """The last mean of S people, a row each."""

    last_seen: I1  # (S,) its time, ns; 0 = never
    markers: F3
    links: F3  # (S, M, 7) and (S, L, 7) position and orientation
    link_confidences: F2  # (S, L)

    @classmethod
    def empty(cls, n_markers: int, n_links: int) -> LastMeans:
        """Return arrays with no rows."""
        return arrays(cls, 0, (0, n_markers, POSE), (0, n_links, POSE), (0, n_links))


class GatherWork(NamedTuple):
    """Scratch for up to K views of a person."""

    rows: I1  # (K,) of the messages' people
    later: F1  # (K,) s from the view to the instant
    values: F2  # (K, 4) orientations of a slot, carried to the instant
    weights: F1
    robust: F1  # (K,)

    @classmethod
    def of(cls, views: int) -> GatherWork:
        """Make room."""
        return arrays(cls, views, views, (views, 4), views, views)


@kernel
def _find_views(buffers: Buffers, q: int, people: People, person: int, work: GatherWork) -> int:
    """Note the rows that show a person at an instant, and how old they are; return how many."""
    n = 0
    for k in range(buffers.message_ends[q], buffers.message_ends[q + 1]):
        for i in range(buffers.messages[k, BEGIN], buffers.messages[k, END]):
            if people.ids[i] == person:
                work.rows[n] = i
                work.later[n] = (buffers.stamps[q] - buffers.messages[k, TIME]) * 1e-9
                n += 1
    return n


@kernel
def _share(unseen: float, settings: GatherSettings) -> float:
    """Share of the confidences that is left ``unseen`` s after the last view."""
    if unseen <= settings.bridge:
        return 1.0
    return max(1.0 - unseen / settings.carry, 0.0)


@kernel
def _write_views(
    buffers: Buffers, q: int, people: People, ids: J1, views: Sightings, n: int
) -> int:
    """Write what the messages of an instant show of those who are fused, from view ``n`` on."""
    for k in range(buffers.message_ends[q], buffers.message_ends[q + 1]):
        for i in range(buffers.messages[k, BEGIN], buffers.messages[k, END]):
            wanted = False
            for p in range(buffers.people_ends[q], buffers.people_ends[q + 1]):
                wanted = wanted or ids[p] == people.ids[i]
            if not wanted:
                continue
            views.instants[n] = q
            views.people[n] = people.ids[i]
            views.cameras[n] = buffers.messages[k, CAMERA]
            views.stamps[n] = buffers.messages[k, TIME]
            for m in range(people.markers.shape[1]):
                confidence = people.marker_confidences[i, m]
                views.confidences[n, m] = (
                    people.confidences[i] if math.isnan(confidence) else confidence
                )
                views.hidden[n, m] = buffers.doubts[i, m]
                views.outvoted[n, m] = 0.0
                for c in range(3):
                    views.positions[n, m, c] = people.markers[i, m, c]
            n += 1
    return n


# Means over the views of a person.


@kernel
def _keep(out: People, p: int, past: LastMeans, row: int, share: float) -> None:
    """Write the last means of a person, and a share of their confidences."""
    for m in range(past.markers.shape[1]):
        for c in range(ORIENTATION, POSE):
            out.markers[p, m, c] = past.markers[row, m, c]
    for m in range(past.links.shape[1]):
        out.link_confidences[p, m] = share * past.link_confidences[row, m]
        for c in range(POSE):
            out.links[p, m, c] = past.links[row, m, c]


@kernel
def _write_means(
    people: People, n: int, fresh: bool, past: LastMeans, row: int, power: float, work: GatherWork,
    out: People, p: int,
) -> None:  # fmt: skip
    """Average the n views of a person, and remember the means."""
    for m in range(past.markers.shape[1]):
        _weigh(people.marker_confidences, people.confidences, m, n, power, work)
        _mean_orientation(people.markers, m, n, fresh, past.markers[row], work)
    for m in range(past.links.shape[1]):
        _weigh(people.link_confidences, people.confidences, m, n, power, work)
        _mean_orientation(people.links, m, n, fresh, past.links[row], work)
        _mean_position(people.links, m, n, past.links[row], work)
        past.link_confidences[row, m] = _mean_confidence(people.link_confidences, m, n, work)
    _keep(out, p, past, row, 1.0)


@kernel
def _weigh(of_slots: Floats, whole: Floats, m: int, n: int, power: float, work: GatherWork) -> None:
    """Write the weights of eq 12: the confidence of the slot, else of the skeleton, else 1."""
    total = 0.0
    for k in range(n):
        i = work.rows[k]
        confidence = whole[i] if math.isnan(of_slots[i, m]) else of_slots[i, m]
        confidence = 1.0 if math.isnan(confidence) else confidence
        # The power function takes twenty times as long.
        work.weights[k] = confidence * confidence if power == 2.0 else confidence**power
        total += work.weights[k]
    for k in range(n if total <= 0.0 else 0):
        work.weights[k] = 1.0


@kernel
def _mean_position(states: Floats, m: int, n: int, mean: Floats, work: GatherWork) -> None:
    """Write the weighted mean of the positions of a slot; NaN where no view has one."""
    norm = x = y = z = 0.0
    for k in range(n):
        i, weight = work.rows[k], work.weights[k]
        if weight > 0.0 and not math.isnan(states[i, m, 0]):
            norm += weight
            x += weight * states[i, m, 0]
            y += weight * states[i, m, 1]
            z += weight * states[i, m, 2]
    mean[m, 0], mean[m, 1], mean[m, 2] = x / norm, y / norm, z / norm


@kernel
def _mean_confidence(confidences: Floats, m: int, n: int, work: GatherWork) -> float:
    """Weighted mean of the confidences of a slot; NaN where no view has one."""
    norm = total = 0.0
    for k in range(n):
        i, weight = work.rows[k], work.weights[k]
        if weight > 0.0 and not math.isnan(confidences[i, m]):
            norm += weight
            total += weight * confidences[i, m]
    return total / norm


@kernel
def _mean_orientation(
    states: Floats, m: int, n: int, fresh: bool, means: Floats, work: GatherWork
) -> None:
    """Write the robust mean of the orientations of a slot to ``means`` (M, 7); NaN if none is seen.

    It begins at the last mean, if that is ``fresh``, or at the view that is nearest to the others.
    The weights that it ends with stay in ``work``: they hold for the slot's position as well.
    """
    if not _carry(states, m, n, work):
        for c in range(ORIENTATION, POSE):
            means[m, c] = np.nan
        return
    if not fresh or math.isnan(means[m, ORIENTATION]):
        central = _central(n, work)
        for c in range(4):
            means[m, ORIENTATION + c] = work.values[central, c]
    for _ in range(_ROUNDS):
        x = y = z = w = 0.0
        for k in range(n):
            q = work.values[k]
            work.robust[k] = product = 0.0
            if work.weights[k] <= 0.0:
                continue
            for c in range(4):
                product += q[c] * means[m, ORIENTATION + c]
            # Four times the squared sine of half the angle: the squared angle, if that is small.
            away = 4.0 * (1.0 - product * product)
            work.robust[k] = work.weights[k] / (1.0 + away / (_SCALE * _SCALE))
            share = work.robust[k] if product >= 0.0 else -work.robust[k]
            x, y, z, w = x + share * q[0], y + share * q[1], z + share * q[2], w + share * q[3]
        norm = math.sqrt(x * x + y * y + z * z + w * w)
        if norm > 0.0:
            means[m, 3], means[m, 4], means[m, 5], means[m, 6] = (
                x / norm,
                y / norm,
                z / norm,
                w / norm,
            )
    for k in range(n):
        work.weights[k] = work.robust[k]


@kernel
def _carry(states: Floats, m: int, n: int, work: GatherWork) -> bool:
    """Turn the orientations of a slot on to the instant by their angular velocities.

    Views without one lose their weight, unless none has one. Returns whether any has one.
    """
    has_orientation, total = False, 0.0
    for k in range(n):
        if not math.isnan(states[work.rows[k], m, ORIENTATION]):
            has_orientation, total = True, total + work.weights[k]
    for k in range(n if has_orientation else 0):
        state, dt = states[work.rows[k], m], work.later[k]
        if math.isnan(state[ORIENTATION]):
            work.weights[k] = 0.0
            continue
        work.weights[k] = work.weights[k] if total > 0.0 else 1.0
        q = (state[3], state[4], state[5], state[6])
        if len(state) > ANGULAR_VELOCITY and not math.isnan(state[ANGULAR_VELOCITY]):
            wx, wy, wz = state[10], state[11], state[12]
            q = multiply(exponential(dt * wx, dt * wy, dt * wz), q)
        for c in range(4):
            work.values[k, c] = q[c]
    return has_orientation


@kernel
def _central(n: int, work: GatherWork) -> int:
    """Return the view that is nearest to the others, by their weights; of equal ones the first."""
    best, nearest = 0, -1.0
    for k in range(n):
        total = 0.0
        for j in range(n):
            product = 0.0
            for c in range(4):
                product += work.values[k, c] * work.values[j, c]
            total += work.weights[j] * abs(product) if work.weights[j] > 0.0 else 0.0
        if work.weights[k] > 0.0 and total > nearest + 1e-12:
            best, nearest = k, total
    return best


# For Python.


@entry
def gather(
    buffers: Buffers, people: People, past: LastMeans, settings: GatherSettings, work: GatherWork,
    out: People, views: Sightings,
) -> int:  # fmt: skip
    """Write the views of the people to be fused, and the means of their orientations.

    Parameters
    ----------
    buffers, people : the messages, and the people that they show.
    past : brought to the last buffer that shows the person.
    out : (P,) ``ids`` say who is fused. Gets orientations, and links. Who is in no message of a
        buffer keeps the last ones; beyond ``bridge`` s confidences fall, to nothing at ``carry`` s.
    views : has room for all; how many there are is returned.
    """
    first = 0
    for q in range(len(buffers.stamps)):
        for p in range(buffers.people_ends[q], buffers.people_ends[q + 1]):
            row, stamp = buffers.past_rows[p], buffers.stamps[q]
            n = _find_views(buffers, q, people, out.ids[p], work)
            if n == 0:
                _keep(out, p, past, row, _share((stamp - past.last_seen[row]) * 1e-9, settings))
                continue
            fresh = past.last_seen[row] > 0 and stamp - past.last_seen[row] <= _HORIZON_NS
            _write_means(people, n, fresh, past, row, settings.confidence_power, work, out, p)
            past.last_seen[row] = stamp
        first = _write_views(buffers, q, people, out.ids, views, first)
    return first


@entry
def write_distances(views: Sightings, places: F2) -> None:
    """Write how far each person is from the camera's place (C, 3), m; NaN = unknown."""
    for n in range(len(views.stamps)):
        place = places[views.cameras[n]]
        x, y, z = mean_position(views.positions[n])
        away = norm3(x - place[0], y - place[1], z - place[2])
        views.distances[n] = REFERENCE if math.isnan(away) else max(away, _NEAREST)
