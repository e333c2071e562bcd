"""Kernels that every merger shares: views carried to one time, weighted means over views.

A *view* is what one camera reports of one person. N views lie in arrays (N, M, 19), which may have
room for more; ``members`` (K,) are the indices of one person's views, ``weights`` (K,) how much
each counts.
"""

from __future__ import annotations

import math

import numpy as np

from hiros_mcap.kernels.bytes import copy
from hiros_mcap.kernels.compile import kernel
from hiros_mcap.kernels.quaternions import exponential, multiply
from hiros_mcap.skeletons import Floats, Ints, Stamps


@kernel
def compensate(view: int, dt: float, markers: Floats, links: Floats) -> None:
    """Carry a view to the merged time by its own velocities, in place.

    Cameras are not synchronised: at 3 m/s, views 16 ms apart disagree by 5 cm without this.
    """
    for m in range(markers.shape[1]):
        if not math.isnan(markers[view, m, 7]):
            for c in range(3):
                markers[view, m, c] += dt * markers[view, m, 7 + c]
    for m in range(links.shape[1]):
        if not math.isnan(links[view, m, 7]):
            for c in range(3):
                links[view, m, c] += dt * links[view, m, 7 + c]
        if not math.isnan(links[view, m, 10]) and not math.isnan(links[view, m, 3]):
            step = exponential(
                dt * links[view, m, 10], dt * links[view, m, 11], dt * links[view, m, 12]
            )
            q = (links[view, m, 3], links[view, m, 4], links[view, m, 5], links[view, m, 6])
            q = multiply(step, q)
            for c in range(4):
                links[view, m, 3 + c] = q[c]


@kernel
def _copy_row(to: Floats, at: int, source: Floats, row: int) -> None:
    """Copy all of a row of the first axis."""
    size = 8
    for length in to.shape[1:]:
        size *= length
    copy(to, at * size, source, row * size, size)


@kernel(
    "int64(int64, int64, int64, int64, boolean, int32[::1], int32[::1], float64[::1],"
    " float64[:,:,::1], float64[:,::1], float64[:,:,::1], float64[:,::1], int64[:,::1],"
    " float64[::1], float64[:,:,::1], float64[:,::1], float64[:,:,::1], float64[:,::1])",
)
def load_views(
    at: int,
    camera: int,
    stamp: int,
    merged: int,
    carry: bool,
    people: Ints,
    ids: Ints,
    trust: Floats,
    markers: Floats,
    confidences: Floats,
    links: Floats,
    link_confidences: Floats,
    whose: Stamps,
    to_trust: Floats,
    to_markers: Floats,
    to_confidences: Floats,
    to_links: Floats,
    to_link_confidences: Floats,
) -> int:
    """Copy a camera's views to where they are merged, carried to the merged time; the next index.

    Parameters
    ----------
    at : index of the first view to write. camera : its number.
    stamp, merged : time of the message and of the merged frame, ns.
    carry : by the views' own velocities from the one time to the other.
    people : (P,) ids of the output rows. ids : (K,) of the views; others are left out.
    trust, markers, confidences, links, link_confidences : (K, ...) of the message.
    whose : (3, N) output row, camera and time of each view; ``to_...`` (N, ...); written.
    """
    for k in range(len(ids)):
        for p in range(len(people)):
            if ids[k] == people[p]:
                whose[0, at], whose[1, at], whose[2, at] = p, camera, stamp
                to_trust[at] = trust[k]
                _copy_row(to_markers, at, markers, k)
                _copy_row(to_confidences, at, confidences, k)
                _copy_row(to_links, at, links, k)
                _copy_row(to_link_confidences, at, link_confidences, k)
                if carry:
                    compensate(at, (merged - stamp) * 1e-9, to_markers, to_links)
                at += 1
    return at


@kernel
def mean_columns(
    views: Floats, members: Stamps, m: int, first: int, weights: Floats, out: Floats, p: int
) -> None:
    """Weighted mean of three columns over the views that have them; NaN where none has."""
    norm = x = y = z = 0.0
    for k in range(len(members)):
        v = members[k]
        if weights[k] > 0.0 and not math.isnan(views[v, m, first]):
            norm += weights[k]
            x += weights[k] * views[v, m, first]
            y += weights[k] * views[v, m, first + 1]
            z += weights[k] * views[v, m, first + 2]
    if norm > 0.0:
        x, y, z = x / norm, y / norm, z / norm
    else:
        x = y = z = np.nan
    out[p, m, first], out[p, m, first + 1], out[p, m, first + 2] = x, y, z


@kernel
def mean_turn(
    views: Floats, members: Stamps, m: int, weights: Floats, reference: int, out: Floats, p: int
) -> None:
    """Weighted mean of the orientations, signs aligned with member ``reference``."""
    v = members[reference]
    qx, qy, qz, qw = views[v, m, 3], views[v, m, 4], views[v, m, 5], views[v, m, 6]
    for _ in range(2):  # the second round aligns with the mean itself
        x = y = z = w = 0.0
        for k in range(len(members)):
            v = members[k]
            if weights[k] <= 0.0 or math.isnan(views[v, m, 3]):
                continue
            dot = (
                views[v, m, 3] * qx
                + views[v, m, 4] * qy
                + views[v, m, 5] * qz
                + views[v, m, 6] * qw
            )
            weight = weights[k] if dot >= 0.0 else -weights[k]
            x += weight * views[v, m, 3]
            y += weight * views[v, m, 4]
            z += weight * views[v, m, 5]
            w += weight * views[v, m, 6]
        norm = math.sqrt(x * x + y * y + z * z + w * w)
        qx, qy, qz, qw = x / norm, y / norm, z / norm, w / norm
    out[p, m, 3], out[p, m, 4], out[p, m, 5], out[p, m, 6] = qx, qy, qz, qw


@kernel
def mean_confidence(members: Stamps, confidences: Floats, m: int, weights: Floats) -> float:
    """Weighted mean of the confidences that are given; NaN if none is."""
    total = norm = 0.0
    for k in range(len(members)):
        c = confidences[members[k], m]
        if weights[k] > 0.0 and not math.isnan(c):
            total += weights[k] * c
            norm += weights[k]
    return total / norm if norm > 0.0 else np.nan


@kernel(
    "void(int64, int64[::1], int64[::1], float64[::1], boolean, int64[::1], float64[::1])",
)
def mean_people(
    stamp: int,
    person_of: Stamps,
    stamps: Stamps,
    trust: Floats,
    carried: bool,
    out_stamps: Stamps,
    out_trust: Floats,
) -> None:
    """Fill in source time and confidence of each merged person: the means over the views.

    Parameters
    ----------
    stamp : merged time, ns.
    person_of, stamps, trust : (N,) output row, source time (ns) and confidence of each view.
    carried : every pose has been carried to the merged time, which so is the source time.
    out_stamps, out_trust : (P,), rows without views untouched, nor confidences never given.
    """
    for p in range(len(out_stamps)):
        late = total = 0.0
        count = given = 0
        for k in range(len(person_of)):
            if person_of[k] != p:
                continue
            count += 1
            late += stamps[k] - stamp
            if not math.isnan(trust[k]):
                given += 1
                total += trust[k]
        if given > 0:
            out_trust[p] = total / given
        if count > 0 and not carried:
            out_stamps[p] = stamp + int(np.rint(late / count))
