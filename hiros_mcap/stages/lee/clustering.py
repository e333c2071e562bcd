"""Kernels of Lee's merger: left and right re-arranged, joints clustered (Lee et al. 2022, 2.2)."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from hiros_mcap.kernels.array_types import B1, B2, F1, F2, F3, I1, I2, J2, arrays
from hiros_mcap.kernels.averaging import (
    ORIENTATION,
    POSITION,
    Buffers,
    Views,
    blank_person,
    exchange,
    load_views,
    mean_person,
    mean_state,
)
from hiros_mcap.kernels.compile import entry, kernel
from hiros_mcap.kernels.points import norm3, point_distance, step_between
from hiros_mcap.skeletons import Flags, Floats, Ints, People, Stamps

OUTLIERS, SWAPS = 0, 1
"""Rows of ``counts``: a camera's candidates outside the largest cluster, its pairs re-arranged."""

_EQUAL = 1e-9  # m: distances that differ by less are equal


class ClusterSettings(NamedTuple):
    """Parameters of cluster.py, m and ns; and what the names of markers and links say."""

    medium_confidence: float
    low_confidence: float
    radius: float  # 0 = the average of all candidates
    min_neighbours: int
    memory: int  # ns; -1 = the previous position never joins the candidates
    rearrange: bool
    both_sides: bool
    reference_helps: bool
    compensate_motion: bool
    pairs: J2  # (K, 2) left and right slots that may be re-arranged
    links: J2  # (L, 2) parent and child of each link
    used: B1  # (M,) markers that are merged; the others stay absent


class ClusterPast(NamedTuple):
    """The memory of S people, a row each."""

    seen: I1  # (S,) time of the last merged position, ns; 0 = never
    positions: F3  # (S, M, 3) that position, m


class ClusterWork(NamedTuple):
    """Scratch for up to K views of a person. A kernel that makes arrays is twice as slow."""

    reference: F2  # (M, 3) reference positions
    swapped: B1  # (M,) whether the marker was exchanged in the view at hand
    kept: B2  # (K, M) candidates that are averaged
    weights: F1  # (K,) 1 = the view is averaged, 0 = it is not
    points: F2  # (K + 2, 3) the candidates, the reference and the previous position of a joint
    near: B1  # ((K + 2)^2,) neighbours
    core: B1
    chosen: B1
    stack: I1
    labels: I1  # (K + 2,)

    @classmethod
    def of(cls, views: int, n_markers: int) -> ClusterWork:
        """Make room."""
        k, m, n = views, n_markers, views + 2
        return arrays(cls, (m, 3), m, (k, m), k, (n, 3), n * n, n, n, n, n)


@kernel
def _merge_person(
    stamp: int, views: Views, past: ClusterPast, row: int, settings: ClusterSettings,
    out: People, p: int, counts: Stamps, work: ClusterWork,
) -> None:  # fmt: skip
    """Merge the views of one person (sections 2.2.1 and 2.2.2)."""
    reference_positions(  # 2.2.1: the mean of the candidates of medium, else of low confidence
        views.markers, views.marker_confidences, settings.medium_confidence,
        settings.low_confidence, work.reference,
    )  # fmt: skip
    if settings.rearrange and _rearrange_all(views, settings, counts, work):  # 2.2.1
        reference_positions(
            views.markers, views.marker_confidences, settings.medium_confidence,
            settings.low_confidence, work.reference,
        )  # fmt: skip
    has_previous = past.seen[row] > 0 and 0 <= stamp - past.seen[row] <= settings.memory
    blank_person(out, p)
    for m in range(len(settings.used)):
        _load_candidates(views, m, settings.used[m], work)
        if settings.radius > 0.0:
            n = len(views.stamps)
            for c in range(3):  # 2.2.2: the reference and the previous position join
                helps = settings.reference_helps
                work.points[n, c] = work.reference[m, c] if helps else np.nan
                work.points[n + 1, c] = past.positions[row, m, c] if has_previous else np.nan
            _keep_largest_cluster(views, m, settings, counts, work)  # algorithms 1 and 2
        _average_marker(views, m, out, p, work)  # the centroid, without the helpers
    for m in range(len(settings.links)):
        _average_link(views, m, settings, out, p, work)
    mean_person(stamp, views, settings.compensate_motion, out, p)
    past.seen[row] = stamp
    for m in range(len(settings.used)):
        for c in range(3):
            past.positions[row, m, c] = out.markers[p, m, POSITION + c]


# Re-arrangement (section 2.2.1).


@kernel
def reference_positions(
    markers: Floats, confidences: Floats, medium: float, low: float, out: Floats
) -> None:
    """Find the reference positions: means over the views of medium, else of low confidence.

    Parameters
    ----------
    markers, confidences : (K, M, 19) and (K, M) of the views. A confidence that is not given is
        medium.
    medium, low : least confidences of these levels.
    out : (M, 3), m; NaN where no view is at least low.
    """
    for m in range(markers.shape[1]):
        best = -1
        norm = x = y = z = 0.0
        for k in range(len(markers)):
            c = confidences[k, m]
            level = 1 if c >= low else -1
            if c >= medium or math.isnan(c):
                level = 2
            if math.isnan(markers[k, m, 0]) or level < 0 or level < best:
                continue
            if level > best:
                best = level
                norm = x = y = z = 0.0
            norm += 1.0
            x, y, z = x + markers[k, m, 0], y + markers[k, m, 1], z + markers[k, m, 2]
        if best < 0:
            norm = np.nan
        out[m, 0], out[m, 1], out[m, 2] = x / norm, y / norm, z / norm


@kernel
def _rearrange_all(
    views: Views, settings: ClusterSettings, counts: Stamps, work: ClusterWork
) -> bool:
    """Re-arrange every view; whether any pair was exchanged."""
    changed = False
    for k in range(len(views.stamps)):
        swaps = _rearrange(views, k, settings, work)
        counts[SWAPS, views.cameras[k]] += swaps
        changed = changed or swaps > 0
    return changed


@kernel
def _rearrange(views: Views, k: int, settings: ClusterSettings, work: ClusterWork) -> int:
    """Exchange the pairs of a view that lie nearer to the other side's reference; how many.

    The right reference decides, as printed, or with ``both_sides`` the sums over left and right.
    """
    markers, reference, swapped = views.markers[k], work.reference, work.swapped
    count = compared = 0
    swapped[:] = False
    for i in range(len(settings.pairs)):
        left, right = settings.pairs[i, 0], settings.pairs[i, 1]
        correct = point_distance(markers[right], reference[right])  # D_correct
        wrong = point_distance(markers[left], reference[right])  # D_wrong
        if settings.both_sides:
            correct += point_distance(markers[left], reference[left])
            wrong += point_distance(markers[right], reference[left])
        if math.isnan(correct) or math.isnan(wrong) or math.isnan(reference[left, 0]):
            continue
        compared += 1
        if correct > wrong:
            exchange(markers, views.marker_confidences[k], left, right)
            swapped[left] = swapped[right] = True
            count += 1
    if count > 0:
        _blank_links(views, k, settings.links, swapped, 2 * count > compared)
    return count


@kernel
def _blank_links(views: Views, k: int, links: Ints, swapped: Flags, every: bool) -> None:
    """Make the links of a view absent that end at an exchanged marker, or all of them.

    A detector that takes one side for the other gives these links frames of its own convention.
    """
    for m in range(len(links)):
        child = links[m, 1]
        if every or (child >= 0 and swapped[child]):
            views.link_confidences[k, m] = np.nan
            for c in range(views.links.shape[2]):
                views.links[k, m, c] = np.nan


# Clustering (section 2.2.2).


@kernel
def _load_candidates(views: Views, m: int, used: bool, work: ClusterWork) -> None:
    """Load the views' positions of a marker; at first all that are known are kept."""
    for k in range(len(views.stamps)):
        work.kept[k, m] = used and not math.isnan(views.markers[k, m, POSITION])
        for c in range(3):
            work.points[k, c] = views.markers[k, m, c] if work.kept[k, m] else np.nan


@kernel
def _keep_largest_cluster(
    views: Views, m: int, settings: ClusterSettings, counts: Stamps, work: ClusterWork
) -> None:
    """Keep the candidates of the largest cluster only."""
    n = len(views.stamps)
    clusters = dbscan(work.points[: n + 2], settings.radius, settings.min_neighbours, work)
    confident = work.core  # free after the clustering
    for k in range(n):
        confident[k] = not views.marker_confidences[k, m] < settings.medium_confidence
    if not _choose_cluster(work.points, n, work.labels, clusters, confident, work.chosen):
        return
    for k in range(n):
        if work.kept[k, m] and not work.chosen[k]:
            work.kept[k, m] = False
            counts[OUTLIERS, views.cameras[k]] += 1


@entry
def dbscan(points: F2, radius: float, min_points: int, work: ClusterWork) -> int:
    """Cluster points by density (Ester et al. 1996; Lee, algorithms 1 and 2); number of clusters.

    As printed, algorithm 1 searches round ``x`` where it must search round ``z``, and leaves a
    point noise that a later cluster reaches; this is DBSCAN as it was published.

    Parameters
    ----------
    points : (N, 3), m; NaN = absent.
    radius : m, points at most this far apart are neighbours.
    min_points : neighbours, itself counted, that make a point the core of a cluster. With 1 the
        clusters are the connected components of the neighbourhood, and no point is noise.
    work : whose ``labels`` are filled with 0, 1, ... by each cluster's first core; -1 = noise or
        absent.
    """
    n, limit = len(points), radius * radius
    near, core = work.near[: n * n].reshape((n, n)), work.core
    stack, labels = work.stack, work.labels
    for a in range(n):
        labels[a] = -1
        for b in range(a + 1):
            x, y, z = step_between(points, b, a)
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


@kernel
def _choose_cluster(
    points: Floats, n: int, labels: Stamps, clusters: int, confident: Flags, chosen: Flags
) -> bool:
    """Choose the candidates, the first ``n`` points, of the largest cluster; whether there is one.

    Points ``n`` and ``n + 1`` are the reference and the previous position. They count, but a
    cluster of them alone does not compete. Of equal clusters the one with more confident candidates
    wins, then the one whose centre is nearer to the previous position; what is still equal wins
    together, for the order of the cameras must not matter.
    """
    some = False
    best_size, best_confident, best_distance = 0, 0, 0.0
    for cluster in range(clusters):
        size = candidates = good = 0
        x = y = z = 0.0
        for k in range(n + 2):
            if labels[k] != cluster:
                continue
            size += 1
            if k < n:
                candidates += 1
                good += int(confident[k])
                x, y, z = x + points[k, 0], y + points[k, 1], z + points[k, 2]
        if candidates == 0:
            continue
        distance = norm3(
            x / candidates - points[n + 1, 0],
            y / candidates - points[n + 1, 1],
            z / candidates - points[n + 1, 2],
        )
        if math.isnan(distance):
            distance = 0.0
        order = size - best_size
        if order == 0:
            order = good - best_confident
        if order == 0 and abs(distance - best_distance) > _EQUAL:
            order = 1 if distance < best_distance else -1
        if order < 0 and some:
            continue
        for k in range(n):
            chosen[k] = labels[k] == cluster or (order == 0 and some and chosen[k])
        some = True
        best_size, best_confident, best_distance = size, good, distance
    return some


@kernel
def _average_marker(views: Views, m: int, out: People, p: int, work: ClusterWork) -> None:
    """Average a marker over the views that are kept."""
    for k in range(len(views.stamps)):
        work.weights[k] = 1.0 if work.kept[k, m] else 0.0
    _average(
        views.markers, views.marker_confidences, m, work.weights, out.markers[p],
        out.marker_confidences[p],
    )  # fmt: skip


@kernel
def _average_link(
    views: Views, m: int, settings: ClusterSettings, out: People, p: int, work: ClusterWork
) -> None:
    """Average a link over the views whose both ends are kept; over all views if there is none."""
    parent, child = settings.links[m, 0], settings.links[m, 1]
    if (parent >= 0 and not settings.used[parent]) or (child >= 0 and not settings.used[child]):
        return
    some = False
    for k in range(len(views.stamps)):
        both = (parent < 0 or work.kept[k, parent]) and (child < 0 or work.kept[k, child])
        is_seen = not (
            math.isnan(views.links[k, m, ORIENTATION]) and math.isnan(views.links[k, m, POSITION])
        )
        work.weights[k] = 1.0 if both and is_seen else 0.0
        some = some or (both and is_seen)
    if not some:
        work.weights[: len(views.stamps)] = 1.0
    _average(
        views.links, views.link_confidences, m, work.weights, out.links[p], out.link_confidences[p]
    )


@kernel
def _average(
    states: Floats, confidences: Floats, m: int, weights: Floats, out: Floats,
    out_confidences: Floats,
) -> None:  # fmt: skip
    """Average slot ``m``; signs are aligned with the first view that has an orientation."""
    reference = 0
    for k in range(len(states)):
        if weights[k] > 0.0 and not math.isnan(states[k, m, ORIENTATION]):
            reference = k
            break
    mean_state(states, confidences, m, weights, reference, out, out_confidences)


@entry
def cluster_buffers(
    buffers: Buffers, people: People, scratch: Views, past: ClusterPast, settings: ClusterSettings,
    out: People, counts: I2, work: ClusterWork,
) -> None:  # fmt: skip
    """Merge buffer after buffer.

    Parameters
    ----------
    buffers, people : the messages, and the people that they show.
    scratch : for the views of any person in a buffer; so is ``work``.
    past : brought to the last buffer that shows the person.
    out : (P,) the merged people. ``ids`` say whom to merge; ``stamps`` hold the merged times.
    counts : (2, C) outliers and swaps by camera; added to.
    """
    for q in range(len(buffers.stamps)):
        for p in range(buffers.people_ends[q], buffers.people_ends[q + 1]):
            views = load_views(buffers, q, people, out.ids[p], settings.compensate_motion, scratch)
            _merge_person(
                buffers.stamps[q], views, past, buffers.past_rows[p], settings, out, p,
                counts, work,
            )  # fmt: skip
