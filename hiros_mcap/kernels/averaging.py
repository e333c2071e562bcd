"""Kernels that every merger shares: views carried to one time, weighted means over views.

A *view* is what one camera shows of one person. The mergers take one person at a time, whose K
views lie in arrays (K, ...).
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from hiros_mcap.kernels.array_types import F1, F2, F3, I1, I2, arrays
from hiros_mcap.kernels.bytes import copy
from hiros_mcap.kernels.compile import inlined, kernel
from hiros_mcap.kernels.quaternions import exponential, multiply
from hiros_mcap.skeletons import STATE, Floats, People

# First columns of what a KinematicState holds (hiros_mcap.skeletons).
POSITION, ORIENTATION, VELOCITY, ANGULAR_VELOCITY, ACCELERATION = 0, 3, 7, 10, 13
_VECTORS = (POSITION, VELOCITY, ANGULAR_VELOCITY, ACCELERATION, 16)

BEGIN, END, TIME, CAMERA = 0, 1, 2, 3  # columns of ``Buffers.messages``


class Buffers(NamedTuple):
    """Q buffers of messages to merge, K messages in all, for P people in all."""

    stamps: I1  # (Q,) mean time of each buffer's messages, ns
    people_ends: I1
    message_ends: I1
    """(Q + 1,) first person and first message of each buffer; the last number is P, or K."""
    messages: I2
    """(K, 4) BEGIN and END of each message's people, its TIME in ns and the index of its CAMERA."""
    past_rows: I1  # (P,) row of each person in what the merger remembers
    doubts: F2  # (N, M) m2, by which variances of the markers of the messages' people are larger


class Views(NamedTuple):
    """K views of one person; coordinates as in People."""

    cameras: I1  # (K,) index of the camera
    stamps: I1  # (K,) time of the message, ns
    confidences: F1  # (K,)
    markers: F3
    marker_confidences: F2  # (K, M, 19) and (K, M)
    links: F3
    link_confidences: F2  # (K, L, 19) and (K, L)

    @classmethod
    def allocate(cls, views: int, n_markers: int, n_links: int) -> Views:
        """Arrays whose contents are still to come."""
        k, m, n = views, n_markers, n_links
        return arrays(cls, k, k, k, (k, m, STATE), (k, m), (k, n, STATE), (k, n))


@kernel
def copy_row(to: Floats, at: int, source: Floats, row: int) -> None:
    """Copy all of a row of the first axis."""
    size = 8
    for length in to.shape[1:]:
        size *= length
    copy(to, at * size, source, row * size, size)


@inlined
def copy_pose(to: Any, at: int, source: Any, row: int) -> None:
    """Copy a row of markers, links and confidences between People, Views and what is like them."""
    to.confidences[at] = source.confidences[row]
    copy_row(to.markers, at, source.markers, row)
    copy_row(to.marker_confidences, at, source.marker_confidences, row)
    copy_row(to.links, at, source.links, row)
    copy_row(to.link_confidences, at, source.link_confidences, row)


@kernel
def blank(states: Floats, confidences: Floats) -> None:
    """Make the markers or links of one person absent."""
    for m in range(states.shape[0]):
        confidences[m] = np.nan
        for c in range(states.shape[1]):
            states[m, c] = np.nan


@kernel
def blank_person(people: People, p: int) -> None:
    """Make all markers and links of row ``p`` absent."""
    blank(people.markers[p], people.marker_confidences[p])
    blank(people.links[p], people.link_confidences[p])


@kernel
def exchange(states: Floats, confidences: Floats, a: int, b: int) -> None:
    """Exchange two slots of one person."""
    for c in range(states.shape[1]):
        states[a, c], states[b, c] = states[b, c], states[a, c]
    confidences[a], confidences[b] = confidences[b], confidences[a]


@kernel
def _carry(states: Floats, dt: float) -> None:
    """Carry the markers or links of one view on by their own velocities for ``dt`` seconds.

    Cameras are not synchronised: at 3 m/s, views 16 ms apart disagree by 5 cm without this.
    """
    for m in range(states.shape[0]):
        if not math.isnan(states[m, VELOCITY]):
            for c in range(3):
                states[m, c] += dt * states[m, VELOCITY + c]
        if not math.isnan(states[m, ANGULAR_VELOCITY]) and not math.isnan(states[m, ORIENTATION]):
            w = ANGULAR_VELOCITY
            step = exponential(dt * states[m, w], dt * states[m, w + 1], dt * states[m, w + 2])
            q = (states[m, 3], states[m, 4], states[m, 5], states[m, 6])
            q = multiply(step, q)
            for c in range(4):
                states[m, ORIENTATION + c] = q[c]


@kernel
def load_views(
    buffers: Buffers, q: int, people: People, person: int, carry: bool, scratch: Views
) -> Views:
    """Return the views that buffer ``q`` holds of a person, copied into ``scratch``.

    ``people`` are those of all messages. With ``carry``, poses are carried to the mean time.
    """
    n = 0
    for k in range(buffers.message_ends[q], buffers.message_ends[q + 1]):
        for i in range(buffers.messages[k, BEGIN], buffers.messages[k, END]):
            if people.ids[i] != person:
                continue
            scratch.cameras[n] = buffers.messages[k, CAMERA]
            scratch.stamps[n] = buffers.messages[k, TIME]
            copy_pose(scratch, n, people, i)
            if carry:
                dt = (buffers.stamps[q] - scratch.stamps[n]) * 1e-9
                _carry(scratch.markers[n], dt)
                _carry(scratch.links[n], dt)
            n += 1
    return Views(
        scratch.cameras[:n], scratch.stamps[:n], scratch.confidences[:n], scratch.markers[:n],
        scratch.marker_confidences[:n], scratch.links[:n], scratch.link_confidences[:n],
    )  # fmt: skip


@inlined
def _mean_vector(states: Floats, m: int, first: int, weights: Floats, out: Floats) -> None:
    """Weighted mean of three columns over the views that have them; NaN where none has."""
    norm = x = y = z = 0.0
    for k in range(len(states)):
        if weights[k] > 0.0 and not math.isnan(states[k, m, first]):
            norm += weights[k]
            x += weights[k] * states[k, m, first]
            y += weights[k] * states[k, m, first + 1]
            z += weights[k] * states[k, m, first + 2]
    if norm > 0.0:
        x, y, z = x / norm, y / norm, z / norm
    else:
        x = y = z = np.nan
    out[m, first], out[m, first + 1], out[m, first + 2] = x, y, z


@kernel
def _mean_orientation(states: Floats, m: int, weights: Floats, reference: int, out: Floats) -> None:
    """Weighted mean of the orientations, signs aligned with view ``reference``."""
    qx, qy, qz, qw = (
        states[reference, m, 3], states[reference, m, 4],
        states[reference, m, 5], states[reference, m, 6],
    )  # fmt: skip
    for _ in range(2):  # the second round aligns with the mean itself
        x = y = z = w = 0.0
        for k in range(len(states)):
            if weights[k] <= 0.0 or math.isnan(states[k, m, ORIENTATION]):
                continue
            ax, ay, az, aw = states[k, m, 3], states[k, m, 4], states[k, m, 5], states[k, m, 6]
            weight = weights[k] if ax * qx + ay * qy + az * qz + aw * qw >= 0.0 else -weights[k]
            x, y, z, w = x + weight * ax, y + weight * ay, z + weight * az, w + weight * aw
        norm = math.sqrt(x * x + y * y + z * z + w * w)
        qx, qy, qz, qw = x / norm, y / norm, z / norm, w / norm
    out[m, 3], out[m, 4], out[m, 5], out[m, 6] = qx, qy, qz, qw


@inlined
def mean_state(
    states: Floats, confidences: Floats, m: int, weights: Floats, reference: int, out: Floats,
    out_confidences: Floats,
) -> None:  # fmt: skip
    """Average slot ``m`` over the views whose weight is above 0 (Hi-ROS 2023, eq 12).

    Parameters
    ----------
    states, confidences : (K, M, 19) and (K, M) markers or links of the views.
    weights : (K,). reference : view with whose orientation the others' signs are aligned; if it
        has none, the mean has none.
    out, out_confidences : (M, W) and (M,), of which slot ``m`` is written: as many columns as it
        has, at least the pose.
    """
    for first in _VECTORS:
        if first + 3 <= out.shape[1]:
            _mean_vector(states, m, first, weights, out)
    if not math.isnan(states[reference, m, ORIENTATION]):
        _mean_orientation(states, m, weights, reference, out)
    total = norm = 0.0
    for k in range(len(confidences)):
        if weights[k] > 0.0 and not math.isnan(confidences[k, m]):
            total += weights[k] * confidences[k, m]
            norm += weights[k]
    out_confidences[m] = total / norm if norm > 0.0 else np.nan


@kernel
def mean_person(stamp: int, views: Views, carried: bool, out: People, p: int) -> None:
    """Write source time and confidence of a merged person: the means over the views.

    Poses that were ``carried`` to the merged time ``stamp``, ns, have that time.
    """
    late = total = 0.0
    given = 0
    for k in range(len(views.stamps)):
        late += views.stamps[k] - stamp
        if not math.isnan(views.confidences[k]):
            given += 1
            total += views.confidences[k]
    if given > 0:
        out.confidences[p] = total / given
    if not carried:
        out.stamps[p] = stamp + int(np.rint(late / len(views.stamps)))
