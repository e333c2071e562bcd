"""Who is who from image to image of each camera, and where all are at common instants."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from hiros_mcap.body.intrinsics import Intrinsics
from hiros_mcap.kernels.array_types import chosen, joined
from hiros_mcap.kernels.distance import follow_people
from hiros_mcap.kernels.local_line import Lines, Tracklet, fit_lines
from hiros_mcap.rays.keypoints import KeypointFrame
from hiros_mcap.skeletons import Flags, Floats, Stamps

GATE = 0.1
"""Mean distance of a person's rays, x / z, from image to image up to which it is the same one."""
CROSSING = 0.04
"""People in one image who are nearer to each other may be confused: nobody follows them there."""
GAP_S, SHORTEST_S = 0.15, 0.3
"""A tracklet ends with a gap, of slow cameras with two lost images; a shorter one is left out."""
HALF_WIDTH_S = 0.1
"""Half of the time over which a joint's path is taken for a line; more for slow cameras."""
LEAST_JOINTS = 4


class ImageView(NamedTuple):
    """One RGB camera and whom it sees."""

    camera: str
    tracks: list[Tracklet]
    """Their positions are x / z, y / z and 1; seconds are on the camera's clock."""
    half_width: float
    """s, of the lines through a joint's positions."""
    focal: float
    """px."""


class Samples(NamedTuple):
    """N people whom cameras see at common instants, each in the frame of the camera."""

    instants: Stamps
    """(N,) index of the instant."""
    cameras: Stamps
    """(N,) index of the camera."""
    tracks: Stamps
    """(N,) index of the tracklet, among those of the camera, or of all cameras' images."""
    lines: Lines
    """Their joints; in images, positions are x / z, y / z and 1."""

    def part(self, rows: Flags | Stamps) -> Samples:
        """Return some of them."""
        instants, cameras, tracks, lines = self
        return Samples(instants[rows], cameras[rows], tracks[rows], chosen(lines, rows))


def image_view(frames: Sequence[KeypointFrame], lens: Intrinsics, middle: int) -> ImageView:
    """Follow the people in one camera's images, in order; seconds count from ``middle``, ns."""
    counts = np.array([len(frame.pixels) for frame in frames], np.int64)
    seconds = np.array([frame.stamp - middle for frame in frames]) / 1e9
    joints = max((frame.pixels.shape[1] for frame in frames), default=0)
    pixels = np.concatenate([np.zeros((0, joints, 2)), *(frame.pixels for frame in frames)])
    scores = np.concatenate([np.zeros((0, joints)), *(frame.scores for frame in frames)])
    rays = np.concatenate([lens.normalized(pixels), np.ones((*pixels.shape[:2], 1))], axis=2)
    weights = np.where(np.isfinite(rays[..., 0]) & (scores > 0.0), scores, 0.0)
    rays[weights <= 0.0] = np.nan
    period = float(np.median(np.diff(seconds))) if len(seconds) > 1 else 0.0
    ends = np.concatenate([[0], np.cumsum(counts)])
    tracks = _tracklets(seconds, ends, rays, weights, max(GAP_S, 2.5 * period))
    return ImageView(
        frames[0].camera if frames else "", tracks, max(HALF_WIDTH_S, 2.0 * period), lens.focal
    )


def _tracklets(
    seconds: Floats, ends: Stamps, rays: Floats, weights: Floats, gap: float
) -> list[Tracklet]:
    """Join the people of consecutive images who are nearest to each other, mutually."""
    growing, done = list[list[int]](), list[list[int]]()
    times = np.repeat(seconds, np.diff(ends))
    for k, now in enumerate(seconds.tolist()):
        rows = range(int(ends[k]), int(ends[k + 1]))
        poses = rays[rows.start : rows.stop]
        ended = [now - times[track[-1]] > gap for track in growing]
        last = rays[[track[-1] for track in growing]]  # also of those that end: nobody else is them
        owners = _owners(poses, last)
        crossing = _crossing(poses)
        following: list[list[int]] = []
        for p, row in enumerate(rows):
            owner = owners[p]
            if owner >= 0 and not ended[owner] and not crossing[p]:
                growing[owner].append(row)
            elif not crossing[p]:
                following.append([row])
        crossed = {owners[p] for p in range(len(rows)) if crossing[p]}
        stays = [not end and q not in crossed for q, end in enumerate(ended)]
        done += [track for track, stay in zip(growing, stays, strict=True) if not stay]
        growing = [track for track, stay in zip(growing, stays, strict=True) if stay] + following
    long = [t for t in done + growing if times[t[-1]] - times[t[0]] >= SHORTEST_S]
    long.sort(key=lambda track: (times[track[0]], track[0]))
    return [Tracklet(times[t], np.nan_to_num(rays[t]), weights[t]) for t in long]


def _owners(poses: Floats, last: Floats) -> Stamps:
    """(P,) whom each of the poses continues; -1 = nobody."""
    n, q = len(poses), len(last)
    owners, swapped = np.full(n, -1), np.zeros(n, np.bool_)
    if n and q:
        swaps, distances = np.zeros((n, q), np.bool_), np.zeros((n, q))
        follow_people(poses, poses, last, 0.0, GATE, distances, swaps, owners, swapped)
    return owners


def _crossing(poses: Floats) -> list[bool]:
    """Say of each of (P, J, 3) poses whether somebody else is where it is."""
    if len(poses) < 2:
        return [False] * len(poses)
    apart = np.linalg.norm(poses[:, None] - poses[None], axis=3)
    known = np.isfinite(apart)
    mean = np.where(known, apart, 0.0).sum(axis=2) / np.maximum(known.sum(axis=2), 1)
    near = (mean < CROSSING) & known.any(axis=2)
    np.fill_diagonal(near, False)
    return list(near.any(axis=1))


def sample_images(views: Sequence[ImageView], instants: Floats, lags: Floats) -> Samples:
    """Take everybody in all images at common times, (K,) s, increasing.

    ``lags`` (C,) are what a camera's clock is late, s.
    """
    rows = zip(views, lags, strict=True)
    samples = sample_tracks([(v.tracks, v.half_width, instants + lag) for v, lag in rows])
    before = np.cumsum([0, *(len(view.tracks) for view in views)])
    return samples._replace(tracks=samples.tracks + before[samples.cameras])


def sample_tracks(cameras: Iterable[tuple[Sequence[Tracklet], float, Floats]]) -> Samples:
    """Take whom cameras see at common times.

    Somebody counts while a tracklet lasts, and with :data:`LEAST_JOINTS`.

    Parameters
    ----------
    cameras : tracklets of each, half width of lines, s, and (K,) times on its clock, increasing.
    """
    parts, joints = list[Samples](), 0
    for c, (tracks, half_width, seconds) in enumerate(cameras):
        for k, track in enumerate(tracks):
            joints = track.weights.shape[1]
            inside = np.flatnonzero((seconds >= track.seconds[0]) & (seconds <= track.seconds[-1]))
            if len(inside):
                lines = lines_at(track, seconds[inside], half_width)
                camera, number = np.full_like(inside, c), np.full_like(inside, k)
                parts.append(Samples(inside, camera, number, lines))
    none, rows = np.zeros((0, joints, 3)), np.zeros(0, np.int64)
    parts.append(Samples(rows, rows, rows, Lines(none, none, none[..., 0])))
    at, numbers, owners = (np.concatenate(c) for c in zip(*(p[:3] for p in parts), strict=True))
    samples = Samples(at, numbers, owners, joined([part.lines for part in parts]))
    known = np.count_nonzero(samples.lines.weights > 0.0, axis=1)
    return samples.part(np.flatnonzero(known >= LEAST_JOINTS))


def lines_at(track: Tracklet, seconds: Floats, half_width: float) -> Lines:
    """Return the joints of a tracklet at times, s, of its camera's clock, increasing."""
    shape = len(seconds), track.weights.shape[1]
    lines = Lines(np.zeros((*shape, 3)), np.zeros((*shape, 3)), np.zeros(shape))
    fit_lines(track, np.ascontiguousarray(seconds), half_width, lines)
    return lines


def instants_of(views: Sequence[ImageView], most: int, lags: Floats) -> Floats:
    """(K,) times, s, at which two cameras see somebody: ``most`` at random, spread evenly.

    A regular grid would be commensurate with the cameras' frames, and bias the lags.
    """
    spans = [
        (c, *(track.seconds[[0, -1]] - lags[c]).tolist())
        for c, v in enumerate(views)
        for track in v.tracks
    ]
    if not spans:
        return np.zeros(0)
    first, last = min(s[1] for s in spans), max(s[2] for s in spans)
    cells = first + 0.02 * np.arange(1 + int((last - first) / 0.02))
    seen = np.zeros((len(views), len(cells)), np.bool_)
    for c, begin, end in spans:
        seen[c, np.searchsorted(cells, begin) : np.searchsorted(cells, end)] = True
    shared = cells[np.count_nonzero(seen, axis=0) > 1]
    edges = np.linspace(0, len(shared), min(most, len(shared)) + 1)
    rng = np.random.default_rng(0)
    drawn = edges[:-1] + rng.random(len(edges) - 1) * np.diff(edges)
    at = shared[drawn.astype(np.int64)]
    return np.asarray(at + 0.02 * rng.random(len(at)))


def views_of(
    frames: Mapping[str, Sequence[KeypointFrame]], lenses: Mapping[str, Intrinsics]
) -> list[ImageView]:
    """Follow the people before all cameras, in the order of ``frames``."""
    stamps = [frame.stamp for every in frames.values() for frame in (*every[:1], *every[-1:])]
    middle = (min(stamps) + max(stamps)) // 2 if stamps else 0
    return [
        image_view(every, lenses[name], middle)._replace(camera=name)
        for name, every in frames.items()
    ]
