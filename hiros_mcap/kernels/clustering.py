"""Kernels of Lee's merger: left and right re-arranged, joints clustered (Lee et al. 2022, 2.2).

A *view* is what one camera reports of one person. N views of an instant lie in arrays (N, M, 19);
``members`` are the indices of one person's views.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from hiros_mcap.kernels.averaging import compensate, mean_columns, mean_confidence, mean_turn
from hiros_mcap.kernels.tracking import norm3
from hiros_mcap.kernels.unaligned import kernel
from hiros_mcap.skeletons import Flags, Floats, Ints, Stamps

_EQUAL = 1e-9  # m: distances that differ by less are equal


@kernel
def _label(
    points: Floats, n: int, radius: float, min_points: int, near: Flags, core: Flags,
    stack: Stamps, labels: Stamps,
) -> int:  # fmt: skip
    """Do the work of :func:`dbscan` on the first ``n`` points in the room that it gives."""
    limit = radius * radius
    for a in range(n):
        labels[a] = -1
        for b in range(a + 1):
            x = points[a, 0] - points[b, 0]
            y = points[a, 1] - points[b, 1]
            z = points[a, 2] - points[b, 2]
            near[a, b] = near[b, a] = x * x + y * y + z * z <= limit  # false for NaN
    for a in range(n):
        count = 0
        for b in range(n):
            count += int(near[a, b])
        core[a] = count >= min_points and near[a, a]
    clusters = 0
    for start in range(n):
        if labels[start] >= 0 or not core[start]:
            continue
        labels[start] = clusters
        stack[0], waiting = start, 1
        while waiting > 0:
            waiting -= 1
            a = stack[waiting]
            if not core[a]:
                continue
            for b in range(n):
                if near[a, b] and labels[b] < 0:
                    labels[b] = clusters
                    stack[waiting] = b
                    waiting += 1
        clusters += 1
    return clusters


@njit("int64(float64[:,::1], float64, int64, int64[::1])", cache=True, nogil=True)
def dbscan(points: Floats, radius: float, min_points: int, labels: Stamps) -> int:
    """Cluster points by density (Ester et al. 1996; Lee, algorithms 1 and 2); number of clusters.

    As printed, algorithm 1 searches round ``x`` where it must search round ``z``, and leaves a
    point noise that a later cluster reaches; this is DBSCAN as it was published.

    Parameters
    ----------
    points : (N, 3), m; NaN = absent.
    radius : m, points at most this far apart are neighbours.
    min_points : neighbours, itself counted, that make a point the core of a cluster. With 1 the
        clusters are the connected components of the neighbourhood, and no point is noise.
    labels : (N,) filled with 0, 1, ... by each cluster's first core; -1 = noise or absent.
    """
    n = len(points)
    clusters: int = _label(
        points, n, radius, min_points, np.empty((n, n), np.bool_), np.empty(n, np.bool_),
        np.empty(n, np.int64), labels,
    )  # fmt: skip
    return clusters


@kernel
def _elect(
    points: Floats, n: int, labels: Stamps, clusters: int, trusted: Flags, chosen: Flags
) -> bool:
    """Choose the candidates, the first ``n`` points, of the largest cluster; whether one won.

    Points ``n`` and ``n + 1`` are the reference and the previous position, which count but are no
    candidates; a cluster of them alone does not compete. Equal clusters are told apart by their
    trusted candidates, then by the distance of their centre from the previous position; what is
    still equal wins together. So the order of the cameras does not matter.
    """
    won = False
    best_size, best_trust, best_way = 0, 0, 0.0
    for cluster in range(clusters):
        size, candidates, trust = 0, 0, 0
        x = y = z = 0.0
        for k in range(n + 2):
            if labels[k] != cluster:
                continue
            size += 1
            if k < n:
                candidates += 1
                trust += int(trusted[k])
                x, y, z = x + points[k, 0], y + points[k, 1], z + points[k, 2]
        if candidates == 0:
            continue
        way = norm3(
            x / candidates - points[n + 1, 0],
            y / candidates - points[n + 1, 1],
            z / candidates - points[n + 1, 2],
        )
        if math.isnan(way):
            way = 0.0
        order = size - best_size
        if order == 0:
            order = trust - best_trust
        if order == 0 and abs(way - best_way) > _EQUAL:
            order = 1 if way < best_way else -1
        if order < 0 and won:
            continue
        for k in range(n):
            chosen[k] = labels[k] == cluster or (order == 0 and won and chosen[k])
        won = True
        best_size, best_trust, best_way = size, trust, way
    return won


@kernel
def _close_by(points: Floats, n: int, radius: float) -> bool:
    """Whether all of the first ``n`` points lie near one of them: a single cluster if N_c = 1."""
    centre = 0
    while math.isnan(points[centre, 0]):
        centre += 1
    for k in range(centre + 1, n):
        x = points[k, 0] - points[centre, 0]
        y = points[k, 1] - points[centre, 1]
        z = points[k, 2] - points[centre, 2]
        if x * x + y * y + z * z > radius * radius:
            return False
    return True


@kernel
def reference_positions(
    members: Stamps, markers: Floats, confidences: Floats, levels: Floats, out: Floats
) -> None:
    """Find the reference positions: means over the views of medium, else of low confidence.

    ``levels`` are the least confidences of medium and of low; a confidence that is not given is
    medium. NaN where no view is at least low.
    """
    for m in range(markers.shape[1]):
        best = -1
        norm = x = y = z = 0.0
        for k in range(len(members)):
            v = members[k]
            c = confidences[v, m]
            level = 1 if c >= levels[1] else -1
            if c >= levels[0] or math.isnan(c):
                level = 2
            if math.isnan(markers[v, m, 0]) or level < 0 or level < best:
                continue
            if level > best:
                best = level
                norm = x = y = z = 0.0
            norm += 1.0
            x, y, z = x + markers[v, m, 0], y + markers[v, m, 1], z + markers[v, m, 2]
        if best < 0:
            norm = np.nan
        out[m, 0], out[m, 1], out[m, 2] = x / norm, y / norm, z / norm


@kernel
def _apart(markers: Floats, view: int, m: int, reference: Floats, r: int) -> float:
    """Distance of a marker from a reference position."""
    way: float = norm3(
        markers[view, m, 0] - reference[r, 0],
        markers[view, m, 1] - reference[r, 1],
        markers[view, m, 2] - reference[r, 2],
    )
    return way


@kernel
def _swap(markers: Floats, confidences: Floats, view: int, a: int, b: int) -> None:
    for c in range(markers.shape[2]):
        value = markers[view, a, c]
        markers[view, a, c] = markers[view, b, c]
        markers[view, b, c] = value
    value = confidences[view, a]
    confidences[view, a] = confidences[view, b]
    confidences[view, b] = value


@kernel
def _rearrange(
    view: int, markers: Floats, confidences: Floats, links: Floats, link_confidences: Floats,
    pairs: Ints, ends: Ints, reference: Floats, both: bool, swapped: Flags,
) -> int:  # fmt: skip
    """Swap the pairs of a view that lie nearer to the other side's reference; return how many.

    The right reference decides, as printed, or with ``both`` the sums over left and right.
    A detector that takes one side for the other turns the frames of the links as well, each by
    its own convention: they are unknown then, and all of the view if most pairs were swapped.
    """
    count = compared = 0
    for m in range(len(swapped)):
        swapped[m] = False
    for i in range(len(pairs)):
        left, right = pairs[i, 0], pairs[i, 1]
        correct = _apart(markers, view, right, reference, right)
        wrong = _apart(markers, view, left, reference, right)
        if both:
            correct += _apart(markers, view, left, reference, left)
            wrong += _apart(markers, view, right, reference, left)
        if math.isnan(correct) or math.isnan(wrong) or math.isnan(reference[left, 0]):
            continue
        compared += 1
        if correct > wrong:
            _swap(markers, confidences, view, left, right)
            swapped[left] = swapped[right] = True
            count += 1
    if count > 0:
        for k in range(len(ends)):
            child = ends[k, 1]
            if 2 * count > compared or (child >= 0 and swapped[child]):
                link_confidences[view, k] = np.nan
                for c in range(links.shape[2]):
                    links[view, k, c] = np.nan
    return count


@kernel
def _first_turned(states: Floats, members: Stamps, m: int, weights: Floats) -> int:
    """First weighed view with an orientation, -1 if there is none."""
    for k in range(len(members)):
        if weights[k] > 0.0 and not math.isnan(states[members[k], m, 3]):
            return k
    return -1


@kernel
def _average(
    states: Floats, confidences: Floats, members: Stamps, m: int, weights: Floats,
    p: int, out: Floats, out_confidences: Floats,
) -> None:  # fmt: skip
    """Average all that the weighed views say of a marker or link."""
    for first in (0, 7, 10, 13, 16):
        mean_columns(states, members, m, first, weights, out, p)
    turned = _first_turned(states, members, m, weights)
    if turned >= 0:
        mean_turn(states, members, m, weights, turned, out, p)
    out_confidences[p, m] = mean_confidence(members, confidences, m, weights)


@kernel
def _merge_markers(
    members: Stamps, markers: Floats, confidences: Floats, reference: Floats, previous: Floats,
    numbers: Floats, used: Flags, points: Floats, near: Flags, flags: Flags, stack: Stamps,
    labels: Stamps, weights: Floats, p: int, out: Floats, out_confidences: Floats, kept: Flags,
    outliers: Stamps,
) -> None:  # fmt: skip
    """Average each marker over the views whose candidates form its largest cluster."""
    n = len(members)
    core, trusted, chosen = flags[0], flags[1], flags[2]
    for m in range(markers.shape[1]):
        present = 0
        for k in range(n):
            v = members[k]
            kept[v, m] = used[m] and not math.isnan(markers[v, m, 0])
            present += int(kept[v, m])
            trusted[k] = not confidences[v, m] < numbers[0]
            for c in range(3):
                points[k, c] = markers[v, m, c]
        if present == 0:
            continue
        single = numbers[4] <= 1.0 and _close_by(points, n, numbers[3])
        if numbers[3] > 0.0 and not single:
            for c in range(3):
                points[n, c] = reference[m, c] if numbers[5] > 0.0 else np.nan
                points[n + 1, c] = previous[p, m, c]
            clusters = _label(points, n + 2, numbers[3], int(numbers[4]), near, core, stack, labels)
            if _elect(points, n, labels, clusters, trusted, chosen):
                for k in range(n):
                    outliers[members[k]] += int(kept[members[k], m] and not chosen[k])
                    kept[members[k], m] = chosen[k]
        for k in range(n):
            weights[k] = 1.0 if kept[members[k], m] else 0.0
        _average(markers, confidences, members, m, weights, p, out, out_confidences)


@kernel
def _merge_links(
    members: Stamps, links: Floats, confidences: Floats, ends: Ints, used: Flags, kept: Flags,
    weights: Floats, p: int, out: Floats, out_confidences: Floats,
) -> None:  # fmt: skip
    """Average each link over the views that placed both its ends well; all views if none did."""
    for m in range(links.shape[1]):
        parent, child = ends[m, 0], ends[m, 1]
        if (parent >= 0 and not used[parent]) or (child >= 0 and not used[child]):
            continue
        good = 0
        for k in range(len(members)):
            v = members[k]
            right = (parent < 0 or kept[v, parent]) and (child < 0 or kept[v, child])
            known = not (math.isnan(links[v, m, 3]) and math.isnan(links[v, m, 0]))
            weights[k] = 1.0 if right and known else 0.0
            good += int(right and known)
        if good == 0:
            for k in range(len(members)):
                weights[k] = 1.0
        _average(links, confidences, members, m, weights, p, out, out_confidences)


@njit(
    "void(float64[::1], int64[::1], float64[:,:,::1], float64[:,::1], float64[:,:,::1],"
    " float64[:,::1], float64[:,:,::1], int32[:,::1], int32[:,::1], boolean[::1], float64[::1],"
    " float64[:,:,::1], float64[:,::1], float64[:,:,::1], float64[:,::1], int64[::1], int64[::1])",
    cache=True,
    nogil=True,
)
def cluster_views(
    delays: Floats,
    person_of: Stamps,
    markers: Floats,
    confidences: Floats,
    links: Floats,
    link_confidences: Floats,
    previous: Floats,
    pairs: Ints,
    ends: Ints,
    used: Flags,
    numbers: Floats,
    out: Floats,
    out_confidences: Floats,
    out_links: Floats,
    out_link_confidences: Floats,
    swaps: Stamps,
    outliers: Stamps,
) -> None:
    """Merge an instant: carry to its time, re-arrange left and right, cluster, average.

    Parameters
    ----------
    delays : (N,) s from each view to the merged time. person_of : (N,) output row of each view.
    markers, confidences, links, link_confidences : the views; overwritten.
    previous : (P, M, 3) position that joins the candidates; NaN = none.
    pairs : (K, 2) left and right slots to re-arrange. ends : (L, 2) parent and child of each link.
    used : (M,) markers that are merged; the others stay absent.
    numbers : least confidence of medium, of low, re-arrange (0 no, 1 by the right side, 2 by
        both), radius (0 = average of all), minimum of neighbours, reference joins the candidates,
        carry (as stages/cluster.py packs them).
    out, out_confidences, out_links, out_link_confidences : (P, ...), filled.
    swaps, outliers : (N,) pairs swapped and candidates left out per view, added to.
    """
    n, n_markers = len(delays), markers.shape[1]
    reference = np.empty((n_markers, 3))
    kept = np.empty((n, n_markers), np.bool_)
    swapped = np.empty(n_markers, np.bool_)
    points, near = np.empty((n + 2, 3)), np.empty((n + 2, n + 2), np.bool_)
    flags = np.empty((3, n + 2), np.bool_)
    stack, labels = np.empty(n + 2, np.int64), np.empty(n + 2, np.int64)
    weights = np.empty(n)
    if numbers[6] > 0.0:
        for k in range(n):
            compensate(k, delays[k], markers, links)
    for p in range(len(out)):
        members = np.nonzero(person_of == p)[0]
        reference_positions(members, markers, confidences, numbers, reference)
        if numbers[2] > 0.0:
            changed = 0
            for k in range(len(members)):
                v = members[k]
                count = _rearrange(
                    v, markers, confidences, links, link_confidences, pairs, ends, reference,
                    numbers[2] > 1.0, swapped,
                )  # fmt: skip
                swaps[v] += count
                changed += count
            if changed > 0:
                reference_positions(members, markers, confidences, numbers, reference)
        weighed = weights[: len(members)]
        _merge_markers(
            members, markers, confidences, reference, previous, numbers, used, points, near, flags,
            stack, labels, weighed, p, out, out_confidences, kept, outliers,
        )  # fmt: skip
        _merge_links(
            members, links, link_confidences, ends, used, kept, weighed, p, out_links,
            out_link_confidences,
        )  # fmt: skip
