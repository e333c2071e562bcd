"""Detections that contradict a person's own body count less, before they are merged or fused.

A detector that sees a part of somebody guesses the rest: limbs get longer or shorter, feet float,
the pelvis jumps. Every person's limb lengths, and how much they usually vary, are learned on the
way. Then

1. a view whose limbs contradict them while somebody else stands in front of the person is left
   out, if no other camera shows the person, and the detector is sure of every joint; the person
   is carried on (merge.carry).
2. a marker whose limbs contradict them has a larger variance.

Lengths do not depend on how fast somebody moves, nor on sides that a detector has exchanged.
Nothing is changed while too little is known of a person.

Each person's links have a running mean length L and a variance, the same on both sides. The
deviation of a link is z = (l - L) / s. Until a person has shown enough, s is that of people in
general (scaled inverse chi square, Gelman et al. 2013, section 2.6):

    s^2 = (n v + PRIOR (RELATIVE L)^2) / (n + PRIOR),   v = mean (l - L)^2.

The deviation of a view is the root mean square of z over its links. A marker contradicts by the
second largest z^2 of its links, or by that of its only link; the view counts like some more. So, of
the two ends of a link, the one that contradicts more of its links is at fault. Its standard
deviation grows as the contradiction y does, from MAX_DEVIATION on: its variance is larger by

    HONEST^2 (y^2 / MAX_DEVIATION^2 - 1).

A view is left out if its deviation is larger than

    sqrt(1 + SURE sqrt(2 / N)) + PER_METRE d,

where N is the number of its links, and d < BESIDE the distance, m, of somebody in front from the
line of sight. The mean square of N independent z has the mean 1 and the variance 2 / N.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from hiros_mcap.body.symmetry import symmetry_of
from hiros_mcap.events import Events
from hiros_mcap.frames import Block, CameraMessages, CameraNumbers, Doubts, places_of
from hiros_mcap.kernels.array_types import F1, F2, I1, I2, J2, arrays
from hiros_mcap.kernels.compile import entry, inlined, kernel
from hiros_mcap.kernels.distance import centre
from hiros_mcap.kernels.points import norm3, point_distance
from hiros_mcap.skeletons import UNTRACKED, Floats, People, SkeletonModel, Stamps
from hiros_mcap.stages.bank import Bank
from hiros_mcap.stages.detections.detection_params import PlausibleParams
from hiros_mcap.stages.detections.visibility import GUESSED_BELOW, HONEST

DISTORTED, CONTRADICTORY = "distorted", "implausible marker"
"""Kinds of events: views that are left out, and markers that count less."""
_PRIOR = 300.0  # views that the assumed deviation counts as much as: 5 s of two cameras
_RELATIVE = 0.1  # assumed standard deviation of a length, as a share of it
_FEWEST = 100.0  # views that give a length
_MEMORY = 1800.0  # views that a length remembers: 30 s of two cameras
_OUTLIER = 4.0  # standard deviations at which what is learned is clipped
_LARGEST = 36.0  # z^2; a larger one says no more of the view as a whole
_FEWEST_LINKS = 6  # links of known length; fewer say too little of a view
_SHARED = 2.0  # links that the view counts like where one of its markers is compared
# Of real recordings by two cameras, the deviation is 0.8 at the median, and below 1.75 in 95 % of
# the views. Distorted views of people who cross have 1.6 to 3.
_SURE, _PER_METRE = 4.0, 0.8
_BESIDE = 0.5  # m
_ALONE = 200_000_000  # ns without a good view of another camera: then a camera is alone
_IN_FRONT = 0.35  # m: somebody this much nearer to the camera is in front

OUT, MARKERS = 0, 1  # rows of the counts: views left out, and markers that are trusted less
_FORGET = 30.0  # s; longest absence after which somebody gets the old id back (track.reidentify)


def drop_implausible_blocks(
    blocks: Iterable[Block], model: SkeletonModel, params: PlausibleParams | None = None,
    events: Events | None = None, cameras: Mapping[str, Floats] | None = None,
) -> Iterator[Block]:  # fmt: skip
    """Find detections that contradict the limb lengths of their person; they count less.

    Parameters
    ----------
    blocks : tracked frames in the fixed frame, in the order of time.
    model, params : the skeleton; see :class:`PlausibleParams`.
    events : counts "distorted" (views that are left out) and "implausible marker" (markers with a
        larger variance), by camera.
    cameras : source -> (3,) position in the fixed frame, m. Without it no view is left out.

    Yields
    ------
    The same frames at once, with their doubts.
    """
    params, events = params or PlausibleParams(), Events() if events is None else events
    if not params.limbs:
        yield from blocks
        return
    links, numbers = links_of(model), CameraNumbers()
    bank = Bank(LimbPast.empty(len(links.ends)), _FORGET)
    for block in blocks:
        people, (views, owners) = block.people, block.everybody()
        rows = np.full(len(people.ids), -1, np.int64)
        rows[views] = bank.rows_of(people.ids[views], block.stamps[owners])
        messages, places = numbers.messages(block), places_of(numbers, cameras or {})
        if new := max(len(places) - bank.past.good_views.shape[1], 0):
            good_views = np.pad(bank.past.good_views, ((0, 0), (0, new)))
            bank.past = bank.past._replace(good_views=good_views)
        doubts = Doubts.none(*people.markers.shape[:2])
        work = PlausibleWork.of(doubts, len(places))
        find_implausible(
            messages, people, rows, places, links, bank.past, params.max_deviation, params.enough,
            params.patience, work,
        )  # fmt: skip
        for kind, by_camera in zip((DISTORTED, CONTRADICTORY), work.counts.tolist(), strict=True):
            for source, n in zip(numbers, by_camera, strict=True):
                events.count(kind, source, n)
        yield replace(block, doubts=doubts)


def links_of(model: SkeletonModel) -> LimbLinks:
    """Return the links of a skeleton that have two ends, and where their lengths are kept."""
    ends = model.links[(model.links >= 0).all(axis=1)]
    mirror = symmetry_of(model).mirror
    places = {tuple(pair): k for k, pair in enumerate(ends.tolist())}
    mirrored = [places.get(tuple(pair), k) for k, pair in enumerate(mirror[ends].tolist())]
    slots: Stamps = np.minimum(np.arange(len(ends)), mirrored).astype(np.int64)
    return LimbLinks(np.ascontiguousarray(ends), slots)


class LimbLinks(NamedTuple):
    """Links whose lengths are compared."""

    ends: J2  # (K, 2) marker slots
    slots: I1  # (K,) where the length is kept; both sides share one


class LimbPast(NamedTuple):
    """Limbs of R people, as their views have shown them."""

    lengths: F2  # (R, K) mean, m
    variances: F2  # (R, K) m2
    counts: F2  # (R, K) views that they are of
    first: I1  # (R,) when the person was seen first, ns; 0 = never
    refused: I1  # (R,) since when all views of the person have been left out, ns; 0 = they are not
    good_views: I2  # (R, C) when each camera last had a good view of the person, ns; 0 = never

    @classmethod
    def empty(cls, n_links: int) -> LimbPast:
        """Return arrays with no rows."""
        return arrays(cls, *3 * [(0, n_links)], 0, 0, (0, 4))


class PlausibleWork(NamedTuple):
    """Findings about P people, and scratch for a view."""

    doubts: Doubts
    counts: I2  # (2, C) views left out and markers that are trusted less, by camera

    largest: F1
    second: F1  # (M,) z^2 of the links of each marker; -1 = there is none
    centres: F2  # (P, 3) mean marker position, m
    limit: F1  # (1,) deviation that is still likely of an honest view

    @classmethod
    def of(cls, doubts: Doubts, n_cameras: int) -> PlausibleWork:
        """Make room."""
        p, m = doubts.variances.shape
        return arrays(cls, doubts, (2, n_cameras), m, m, (p, 3), 1)


@inlined
def _length(view: Floats, k: int, links: LimbLinks) -> float:
    """Length of link k in a view (M, 19), m; NaN if an end is absent."""
    return point_distance(view[links.ends[k, 0]], view[links.ends[k, 1]])


@inlined
def _spread(row: int, slot: int, past: LimbPast) -> float:
    """Return the standard deviation s of a length, m."""
    n, assumed = past.counts[row, slot], _RELATIVE * past.lengths[row, slot]
    variance = (n * past.variances[row, slot] + _PRIOR * assumed * assumed) / (n + _PRIOR)
    return math.sqrt(variance) + 1e-6


@kernel
def _learn(view: Floats, row: int, links: LimbLinks, past: LimbPast) -> None:
    """Add the lengths of a view (M, 19) to the means."""
    for k in range(len(links.ends)):
        slot, length = links.slots[k], _length(view, k, links)
        if math.isnan(length):
            continue
        n = min(past.counts[row, slot] + 1.0, _MEMORY)
        error = length - past.lengths[row, slot]
        if n > _FEWEST:
            limit = _OUTLIER * _spread(row, slot, past)
            error = min(max(error, -limit), limit)
        past.counts[row, slot] = n
        past.lengths[row, slot] += error / n
        square = error * error * (n - 1.0) / n
        past.variances[row, slot] += (square - past.variances[row, slot]) / n


@kernel
def _compare(
    view: Floats, row: int, links: LimbLinks, past: LimbPast, work: PlausibleWork
) -> float:
    """Deviation of a view (M, 19), NaN if too little is known; the rest goes to ``work``."""
    for m in range(len(view)):
        work.largest[m] = work.second[m] = -1.0
    total, n = 0.0, 0
    for k in range(len(links.ends)):
        slot, length = links.slots[k], _length(view, k, links)
        if math.isnan(length) or past.counts[row, slot] < _FEWEST:
            continue
        z = (length - past.lengths[row, slot]) / _spread(row, slot, past)
        total += min(z * z, _LARGEST)
        n += 1
        for end in range(2):
            m = links.ends[k, end]
            work.second[m] = max(work.second[m], min(work.largest[m], z * z))
            work.largest[m] = max(work.largest[m], z * z)
    work.limit[0] = math.sqrt(1.0 + _SURE * math.sqrt(2.0 / max(n, 1)))
    return math.sqrt(total / n) if n >= _FEWEST_LINKS else np.nan


@kernel
def _doubt(deviation: float, max_deviation: float, variances: Floats, work: PlausibleWork) -> int:
    """Write the variances (M,) that contradictory markers of a view have more; return how many."""
    n = 0
    for m in range(len(variances)):
        square = work.second[m] if work.second[m] >= 0.0 else work.largest[m]
        if square < 0.0:
            continue
        mean = (square + _SHARED * deviation * deviation) / (1.0 + _SHARED)
        more = mean / max_deviation**2 - 1.0
        if more > 0.0:
            variances[m] = HONEST * HONEST * more
            n += 1
    return n


@kernel
def _least_distance(p: int, begin: int, end: int, camera: Floats, centres: Floats) -> float:
    """Least distance, m, of anybody in front from the camera's line of sight to person p."""
    x, y, z = camera[0], camera[1], camera[2]
    px, py, pz = centres[p, 0] - x, centres[p, 1] - y, centres[p, 2] - z
    away, least = norm3(px, py, pz), np.inf
    for q in range(begin, end):
        qx, qy, qz = centres[q, 0] - x, centres[q, 1] - y, centres[q, 2] - z
        along = (px * qx + py * qy + pz * qz) / away
        if 0.0 < along < away - _IN_FRONT:
            square = qx * qx + qy * qy + qz * qz - along * along
            least = min(least, math.sqrt(max(square, 0.0)))
    return least


@kernel
def _is_rated(p: int, people: People) -> bool:
    """Whether the detector itself says that it guesses some of a view's markers."""
    for m in range(people.marker_confidences.shape[1]):
        if people.marker_confidences[p, m] < GUESSED_BELOW:
            return True
    return False


@kernel
def _is_alone(stamp: int, row: int, camera: int, past: LimbPast) -> bool:
    """Whether no other camera has a good view of a person."""
    for c in range(past.good_views.shape[1]):
        if c != camera and past.good_views[row, c] > 0 and stamp - past.good_views[row, c] < _ALONE:
            return False
    return True


@kernel
def _is_left_out(
    stamp: int, row: int, camera: int, is_distorted: bool, past: LimbPast, patience: float
) -> bool:
    """Whether a view is distorted, and the only one, and this does not last for too long."""
    if not is_distorted:
        past.good_views[row, camera] = stamp
        past.refused[row] = 0
        return False
    if not _is_alone(stamp, row, camera, past):
        return False
    if past.refused[row] == 0:
        past.refused[row] = stamp
    return (stamp - past.refused[row]) * 1e-9 < patience


@entry
def find_implausible(
    messages: CameraMessages, people: People, rows: I1, places: F2, links: LimbLinks,
    past: LimbPast, max_deviation: float, enough: float, patience: float, work: PlausibleWork,
) -> None:  # fmt: skip
    """Find distorted views and contradictory markers.

    Parameters
    ----------
    work : tells which views are to be left out, and by how much variances are larger.
    rows : (P,) row of each person in what is remembered; -1 = nobody's.
    places : (C, 3) positions of the cameras, m; NaN = unknown.
    past : brought to the last message.
    max_deviation, enough, patience : of PlausibleParams.
    """
    for i in range(len(messages.stamps)):
        stamp, camera = messages.stamps[i], messages.cameras[i]
        begin, end = messages.spans[i, 0], messages.spans[i, 1]
        for p in range(begin, end):
            work.centres[p] = np.nan
            if people.ids[p] != UNTRACKED:
                centre(people.markers[p], work.centres[p])
        for p in range(begin, end):
            row = rows[p]
            if row < 0:
                continue
            if past.first[row] == 0:
                past.first[row] = stamp
            deviation = _compare(people.markers[p], row, links, past, work)
            _learn(people.markers[p], row, links, past)
            is_measured = (stamp - past.first[row]) * 1e-9 >= enough
            if math.isnan(deviation) or not is_measured:
                continue
            beside = _least_distance(p, begin, end, places[camera], work.centres)
            limit = work.limit[0] + _PER_METRE * beside
            is_distorted = beside < _BESIDE and deviation > limit and not _is_rated(p, people)
            if _is_left_out(stamp, row, camera, is_distorted, past, patience):
                work.doubts.distorted[p] = True
                work.counts[OUT, camera] += 1
            else:
                work.counts[MARKERS, camera] += _doubt(
                    deviation, max_deviation, work.doubts.variances[p], work
                )
