"""Kernels of Lee's merger: left and right re-arranged, joints clustered (Lee et al. 2022, 2.2).

A *view* is what one camera reports of one person. The views of an instant are loaded camera by
camera into arrays (N, M, 19), which have room for more; ``members`` are the indices of one person's
views, ``picked`` those of them that are averaged.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from hiros_mcap.kernels.averaging import mean_people
from hiros_mcap.kernels.compile import kernel
from hiros_mcap.kernels.distance import norm3
from hiros_mcap.skeletons import Flags, Floats, Ints, Stamps

_EQUAL = 1e-9  # m: distances that differ by less are equal


@kernel
def _linked(points: Floats, n: int, limit: float, stack: Stamps, labels: Stamps) -> int:
    """Do the work of :func:`_label` if every point is a core; few distances are needed then."""
    for k in range(n):
        labels[k] = -1
    clusters = 0
    for start in range(n):
        if labels[start] >= 0 or math.isnan(points[start, 0]):
            continue
        labels[start] = clusters
        stack[0], waiting = start, 1
        while waiting > 0:
            waiting -= 1
            a = stack[waiting]
            for b in range(start + 1, n):
                if labels[b] >= 0:
                    continue
                x = points[a, 0] - points[b, 0]
                y = points[a, 1] - points[b, 1]
                z = points[a, 2] - points[b, 2]
                if x * x + y * y + z * z <= limit:  # false for NaN
                    labels[b] = clusters
                    stack[waiting] = b
                    waiting += 1
        clusters += 1
    return clusters


@kernel
def _label(
    points: Floats, n: int, radius: float, min_points: int, near: Flags, core: Flags,
    stack: Stamps, labels: Stamps,
) -> int:  # fmt: skip
    """Do the work of :func:`dbscan` on the first ``n`` points in the room that it gives."""
    limit = radius * radius
    if min_points <= 1:
        linked: int = _linked(points, n, limit, stack, labels)
        return linked
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
    """Whether the first ``n`` points lie near the first one: a single cluster if N_c = 1."""
    farthest = 0.0
    for k in range(1, n):
        x = points[k, 0] - points[0, 0]
        y = points[k, 1] - points[0, 1]
        z = points[k, 2] - points[0, 2]
        farthest = max(farthest, x * x + y * y + z * z)
    return farthest <= radius * radius


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
def _mean_turn(states: Floats, picked: Stamps, n: int, m: int, p: int, out: Floats) -> None:
    """Mean of the orientations, signs aligned with the first one, then with the mean itself."""
    x = y = z = w = np.nan
    for k in range(n):
        v = picked[m, k]
        x, y, z, w = states[v, m, 3], states[v, m, 4], states[v, m, 5], states[v, m, 6]
        if not math.isnan(x):
            break
    if math.isnan(x):
        return
    for _ in range(2):
        qx, qy, qz, qw = x, y, z, w
        x = y = z = w = 0.0
        for k in range(n):
            v = picked[m, k]
            a, b, c, d = states[v, m, 3], states[v, m, 4], states[v, m, 5], states[v, m, 6]
            if math.isnan(a):
                continue
            if a * qx + b * qy + c * qz + d * qw >= 0.0:
                x, y, z, w = x + a, y + b, z + c, w + d
            else:
                x, y, z, w = x - a, y - b, z - c, w - d
        norm = math.sqrt(x * x + y * y + z * z + w * w)
        x, y, z, w = x / norm, y / norm, z / norm, w / norm
    out[p, m, 3], out[p, m, 4], out[p, m, 5], out[p, m, 6] = x, y, z, w


@kernel
def _average(
    states: Floats, confidences: Floats, picked: Stamps, sizes: Stamps, p: int, out: Floats,
    out_confidences: Floats,
) -> None:  # fmt: skip
    """Average all that the picked views say of each marker or link; NaN where none says any.

    ``picked`` (M, N) are the views of each slot, of which the first ``sizes`` (M,) count.
    """
    for m in range(len(sizes)):
        n = sizes[m]
        for first in (0, 7, 10, 13, 16):
            norm = float(n)
            x = y = z = 0.0
            for k in range(n):
                v = picked[m, k]
                x += states[v, m, first]
                y += states[v, m, first + 1]
                z += states[v, m, first + 2]
            if math.isnan(x):  # seldom of some views only: the sum costs less than asking each
                norm = x = y = z = 0.0
                for k in range(n):
                    v = picked[m, k]
                    if not math.isnan(states[v, m, first]):
                        norm += 1.0
                        x += states[v, m, first]
                        y += states[v, m, first + 1]
                        z += states[v, m, first + 2]
            if norm > 0.0:
                out[p, m, first] = x / norm
                out[p, m, first + 1] = y / norm
                out[p, m, first + 2] = z / norm
        total = norm = 0.0
        for k in range(n):
            c = confidences[picked[m, k], m]
            if not math.isnan(c):
                total, norm = total + c, norm + 1.0
        if norm > 0.0:
            out_confidences[p, m] = total / norm
        _mean_turn(states, picked, n, m, p, out)


@kernel
def _pick_markers(
    members: Stamps, cameras: Stamps, markers: Floats, confidences: Floats, reference: Floats,
    previous: Floats, past: int, numbers: Floats, used: Flags, points: Floats, near: Flags,
    flags: Flags, stack: Stamps, labels: Stamps, kept: Flags, picked: Stamps, sizes: Stamps,
    counts: Stamps,
) -> None:  # fmt: skip
    """Pick the views whose candidates form the largest cluster of each marker."""
    core, trusted, chosen = flags[0], flags[1], flags[2]
    radius, least = numbers[3], int(numbers[4])
    for m in range(markers.shape[1]):
        n = 0
        for k in range(len(members)):
            v = members[k]
            kept[v, m] = used[m] and not math.isnan(markers[v, m, 0])
            if kept[v, m]:
                picked[m, n] = v
                trusted[n] = not confidences[v, m] < numbers[0]
                for c in range(3):
                    points[n, c] = markers[v, m, c]
                n += 1
        sizes[m] = n
        if n == 0 or radius <= 0.0 or (least <= 1 and _close_by(points, n, radius)):
            continue
        for c in range(3):
            points[n, c] = reference[m, c] if numbers[5] > 0.0 else np.nan
            points[n + 1, c] = previous[past, m, c] if past >= 0 else np.nan
        clusters = _label(points, n + 2, radius, least, near, core, stack, labels)
        if not _elect(points, n, labels, clusters, trusted, chosen):
            continue
        sizes[m] = 0
        for k in range(n):
            v = picked[m, k]
            if chosen[k]:
                picked[m, sizes[m]] = v
                sizes[m] += 1
            else:
                kept[v, m] = False
                counts[0, cameras[v]] += 1


@kernel
def _pick_links(
    members: Stamps, links: Floats, ends: Ints, used: Flags, kept: Flags, picked: Stamps,
    sizes: Stamps,
) -> None:  # fmt: skip
    """Pick the views that placed both ends of each link well; all views if none did."""
    for m in range(links.shape[1]):
        sizes[m] = 0
        parent, child = ends[m, 0], ends[m, 1]
        if (parent >= 0 and not used[parent]) or (child >= 0 and not used[child]):
            continue
        n = 0
        for k in range(len(members)):
            v = members[k]
            right = (parent < 0 or kept[v, parent]) and (child < 0 or kept[v, child])
            if right and not (math.isnan(links[v, m, 3]) and math.isnan(links[v, m, 0])):
                picked[m, n] = v
                n += 1
        if n == 0:
            for k in range(len(members)):
                picked[m, k] = members[k]
            n = len(members)
        sizes[m] = n


@njit(
    "void(int64, int64, int64[:,::1], float64[::1], float64[:,:,::1], float64[:,::1],"
    " float64[:,:,::1], float64[:,::1], int64[::1], int64[::1], float64[:,:,::1], int32[:,::1],"
    " int32[:,::1], boolean[::1], float64[::1], int64[::1], float64[::1], float64[:,:,::1],"
    " float64[:,::1], float64[:,:,::1], float64[:,::1], int64[:,::1])",
    cache=True,
    nogil=True,
)
def merge_views(
    stamp: int,
    n: int,
    whose: Stamps,
    trust: Floats,
    markers: Floats,
    confidences: Floats,
    links: Floats,
    link_confidences: Floats,
    rows: Stamps,
    seen: Stamps,
    previous: Floats,
    pairs: Ints,
    ends: Ints,
    used: Flags,
    numbers: Floats,
    out_stamps: Stamps,
    out_trust: Floats,
    out: Floats,
    out_confidences: Floats,
    out_links: Floats,
    out_link_confidences: Floats,
    counts: Stamps,
) -> None:
    """Merge an instant: re-arrange left and right, cluster, average.

    Parameters
    ----------
    stamp : merged time, ns. n : number of views.
    whose, trust, markers, confidences, links, link_confidences : the views, as
        :func:`load_views` left them; overwritten.
    rows : (P,) row of each person in ``seen`` (S,), the time of the last merged position, ns, and
        ``previous`` (S, M, 3), that position, which joins the candidates; brought to ``stamp``.
    pairs : (K, 2) left and right slots to re-arrange. ends : (L, 2) parent and child of each link.
    used : (M,) markers that are merged; the others stay absent.
    numbers : least confidence of medium, of low, re-arrange (0 no, 1 by the right side, 2 by
        both), radius (0 = average of all), minimum of neighbours, reference joins the candidates,
        carried, ns for which the previous position joins them (as stages/cluster.py packs them).
    out_stamps, out_trust, out, out_confidences, out_links, out_link_confidences : (P, ...), filled
        where anything is known.
    counts : (2, C) candidates left out and pairs swapped by camera, added to.
    """
    n_markers = markers.shape[1]
    reference = np.empty((n_markers, 3))
    kept = np.empty((n, n_markers), np.bool_)
    swapped = np.empty(n_markers, np.bool_)
    points, near = np.empty((n + 2, 3)), np.empty((n + 2, n + 2), np.bool_)
    flags = np.empty((3, n + 2), np.bool_)
    stack, labels = np.empty(n + 2, np.int64), np.empty(n + 2, np.int64)
    member_room = np.empty(n, np.int64)
    slots = max(n_markers, links.shape[1])
    picked, sizes = np.empty((slots, n), np.int64), np.empty(slots, np.int64)
    cameras = whose[1]
    for p in range(len(rows)):
        count = 0
        for v in range(n):
            if whose[0, v] == p:
                member_room[count] = v
                count += 1
        members = member_room[:count]
        reference_positions(members, markers, confidences, numbers, reference)
        if numbers[2] > 0.0:
            changed = 0
            for k in range(count):
                v = members[k]
                swaps = _rearrange(
                    v, markers, confidences, links, link_confidences, pairs, ends, reference,
                    numbers[2] > 1.0, swapped,
                )  # fmt: skip
                counts[1, cameras[v]] += swaps
                changed += swaps
            if changed > 0:
                reference_positions(members, markers, confidences, numbers, reference)
        past = rows[p] if 0 <= stamp - seen[rows[p]] <= numbers[7] else -1
        _pick_markers(
            members, cameras, markers, confidences, reference, previous, past, numbers, used,
            points, near, flags, stack, labels, kept, picked, sizes, counts,
        )  # fmt: skip
        _average(markers, confidences, picked, sizes[:n_markers], p, out, out_confidences)
        _pick_links(members, links, ends, used, kept, picked, sizes)
        _average(
            links, link_confidences, picked, sizes[: links.shape[1]], p, out_links,
            out_link_confidences,
        )  # fmt: skip
        seen[rows[p]] = stamp
        for m in range(n_markers):
            for c in range(3):
                previous[rows[p], m, c] = out[p, m, c]
    mean_people(
        stamp, whose[0, :n], whose[2, :n], trust[:n], numbers[6] > 0.0, out_stamps, out_trust
    )
