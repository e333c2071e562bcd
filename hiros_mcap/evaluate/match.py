"""Frame by frame: which skeleton is which true person, who is missing, whom the truth lacks."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from hiros_mcap.evaluate.mot import FrameSimilarity, best_pairs
from hiros_mcap.evaluate.truth import Truth
from hiros_mcap.kernels.distance import mean_distances
from hiros_mcap.skeletons import UNTRACKED, Flags, Floats, Frame, Ints, SkeletonModel, Stamps

MATCH_DISTANCE = 1.0
"""m: a skeleton farther than this from a true person, mean over joints, is of somebody else."""


_NOBODY = Frame.empty(0, SkeletonModel.of([], []))
_ROWS = "stamps", "people", "ids", "poses", "true_poses", "orientations", "true_orientations"
_CHUNK = 256  # instants at which the truth is interpolated at once


@dataclass(frozen=True, slots=True)
class Track:
    """One id over T frames."""

    stamps: Stamps  # (T,) ns
    poses: Floats  # (T, M, 3) m


def tracks_of(frames: Iterable[Frame]) -> dict[int, Track]:
    """Id -> its track, in the order in which they appear."""
    some = [frame for frame in frames if frame.n_people]
    if not some:
        return {}
    ids = np.concatenate([frame.ids for frame in some])
    stamps = np.repeat([frame.stamp for frame in some], [frame.n_people for frame in some])
    poses = np.concatenate([frame.positions for frame in some])
    names = [ident for ident in dict.fromkeys(ids.tolist()) if ident != UNTRACKED]
    return {ident: Track(stamps[ids == ident], poses[ids == ident]) for ident in names}


@dataclass(slots=True)
class Matches:
    """R matched skeletons of a channel, and what was not matched."""

    stamps: Stamps  # (R,) ns
    people: Stamps  # (R,) row of the true person in the truth
    ids: Ints  # (R,) id of the skeleton
    poses: Floats  # (R, M, 3) m
    true_poses: Floats
    orientations: Floats  # (R, L, 4) x y z w
    true_orientations: Floats
    tracks: Mapping[int, Track] = field(default_factory=dict)  # every id, matched or not
    frames: int = 0
    span: tuple[int, int] | None = None
    """Stamps of the first and the last frame, ns, also of those that the truth does not cover."""
    similarities: list[FrameSimilarity] = field(default_factory=list)
    missed: list[Flags] = field(default_factory=list)
    """(M,) each: which markers the truth has of a true person whom no skeleton matches."""
    false: int = 0  # skeletons that match nobody; those of a partial truth are of somebody else
    silent: int = 0  # instants with people but without a frame; see :func:`silent_instants`
    nearest: float = math.inf
    """Least distance of a skeleton from a true person, mean over joints, m."""

    @property
    def switches(self) -> int:
        """How often a true person's nearest skeleton has another id than at the last match."""
        each = (self.ids[self.people == person] for person in np.unique(self.people))
        return sum(int(np.count_nonzero(np.diff(ids))) for ids in each)


SHORTEST_NS = 50_000_000
"""A step between frames that is not longer is never silence."""
_IRREGULAR_NS = 100_000_000
"""Cameras that take turns make steps of many lengths, up to this one; longer steps are gaps."""
_SLACK = 1.5  # silence is longer than this many usual steps, so that one lost frame counts
_ENDS_NS = 100_000_000
"""Cameras and truth do not start and stop together: shorter silence at the ends does not count."""


def silent_instants(stamps: Stamps, truth: Truth) -> Stamps:
    """(S,) Times, ns, of the truth's span at which a result is silent; increasing.

    A result has its own rhythm: motion capture at 100 Hz beside a result of 30 Hz is not silence.
    So silence between frames, before the first, and after the last is filled at that rhythm.

    ``stamps`` are the times of all frames of the result, ns, in any order, also of frames without
    people. The rhythm is the mean step outside silence; a result of less than two different times
    has the rhythm of the truth.
    """
    stamps = np.unique(stamps)
    steps = np.diff(stamps if stamps.size > 1 else truth.stamps)
    if not steps.size:
        return np.zeros(0, np.int64)
    longest = max(_SLACK * _usual(steps), SHORTEST_NS)
    step = float(np.mean(steps[steps <= longest]))
    first, last = truth.stamps[[0, -1]]
    inside = stamps[(stamps >= first) & (stamps <= last)]
    # The span of the truth is closed: with a frame one step before and one after it, its first and
    # last instants are filled as those between two frames.
    ends = np.concatenate([[first - step], inside, [last + step]])
    gaps = [
        np.arange(ends[k] + step, ends[k + 1] - step / 2, step)
        for k, length in enumerate(np.diff(ends))
        if length > (longest if 0 < k < len(ends) - 2 else max(longest, _ENDS_NS + step))
    ]
    instants = np.concatenate([np.zeros(0), *gaps]).astype(np.int64)
    return np.asarray(instants[truth.covers(instants)])


def _usual(steps: Stamps) -> float:
    """Longest step that belongs to the rhythm, ns: 90 % are not longer, or the median of them."""
    most = float(np.percentile(steps, 90))
    return most if most <= _IRREGULAR_NS else float(np.median(steps))


def match(frames: Iterable[Frame], truth: Truth, max_distance: float = MATCH_DISTANCE) -> Matches:
    """Match skeletons with an id to true people, each frame by itself, least distance first.

    Frames that the truth does not cover do not count. Where the result is silent, everybody is
    missed. Skeletons that match nobody of a partial truth are left out of the similarities.
    """
    every = list(frames)
    stamps = np.array([frame.stamp for frame in every], np.int64)
    silent, is_covered = silent_instants(stamps, truth), truth.covers(stamps)
    covered = [frame for frame, counts in zip(every, is_covered, strict=True) if counts]
    times = stamps[is_covered]
    places = np.searchsorted(np.maximum.accumulate(times), silent, side="right")
    instants = np.insert(times, places, silent)
    numbers = np.insert(np.arange(len(times)), places, -1).tolist()
    none, poses, links = np.zeros(0, np.int64), truth.positions[0, :0], truth.orientations[0, :0]
    rows: list[Sequence[Any]] = [(none, none, none, poses, poses, links, links)]
    nobody = dict(zip(_ROWS, rows[0], strict=True))
    result = Matches(**nobody, tracks=tracks_of(covered), frames=len(covered))
    if stamps.size:
        result.span = int(stamps.min()), int(stamps.max())
    for start in range(0, len(instants), _CHUNK):
        chunk = slice(start, start + _CHUNK)
        true = zip(*truth.at(instants[chunk]), strict=True)
        for number, (positions, orientations) in zip(numbers[chunk], true, strict=True):
            frame = covered[number] if number >= 0 else _NOBODY
            row = _match_frame(frame, (positions, orientations), truth, max_distance, result)
            if row:
                rows.append(row)
            result.silent += number < 0 and len(result.similarities[-1].true_ids) > 0
    for name, parts in zip(_ROWS, zip(*rows, strict=True), strict=True):
        setattr(result, name, np.concatenate(parts))
    return result


def _match_frame(
    frame: Frame, true: tuple[Floats, Floats], truth: Truth, max_distance: float, result: Matches
) -> Sequence[Any]:
    """Match one frame; return what it adds to each of _ROWS, nothing if nobody matches."""
    positions, orientations = true
    rows = np.nonzero(frame.ids != UNTRACKED)[0]
    ids, poses = frame.ids[rows], frame.positions[rows]
    visible = ~np.isnan(positions[..., 0])
    present = np.nonzero(visible.any(axis=-1))[0]
    distance = skeleton_distances(positions[present], poses)
    pairs = best_pairs(np.where(distance < max_distance, distance, np.inf))
    pairs.sort(key=lambda pair: pair[1])  # as the frame has them
    true_rows, columns = np.array(pairs, np.int64).reshape(-1, 2).T
    result.missed += list(visible[np.delete(present, true_rows)])
    result.false += len(rows) - len(pairs)
    result.nearest = min(result.nearest, float(distance.min(initial=math.inf)))
    # A skeleton of nobody is a fault only if the truth has everybody.
    kept = columns if truth.partial else np.arange(len(rows))
    similarity = np.clip(1 - distance[:, kept] / max_distance, 0, 1)
    names = tuple(present.tolist()), tuple(ids[kept].tolist())
    result.similarities.append(FrameSimilarity(*names, similarity))
    if not pairs:
        return ()
    people, links = present[true_rows], frame.orientations[rows[columns]]
    stamps = np.full(len(pairs), frame.stamp)
    matched = stamps, people, ids[columns], poses[columns], positions[people]
    return *matched, links, orientations[people]


def explain_no_match(matches: Matches, truth: Truth) -> str:
    """Return the distance of result and truth in words if nobody was matched, else ""."""
    if len(matches.people) or not math.isfinite(matches.nearest):
        return ""
    poses = np.concatenate([track.poses for track in matches.tracks.values()])
    return (
        f"no skeleton comes nearer than {matches.nearest:.1f} m to a true person. Is the truth in "
        "metres, in the log's fixed frame, with the right --up and --shift? --align finds another "
        "frame, --align-time another time, too. Typical coordinates: "
        f"truth {_median_text(truth.positions)}, result {_median_text(poses)}"
    )


def explain_no_overlap(matches: Matches, truth: Truth) -> str:
    """Return in words how the times of result and truth differ."""
    fault = "the truth covers no frame of the result"
    if matches.span is None:
        return fault
    first, last = matches.span
    start, end = truth.stamps[[0, -1]].tolist()
    return (
        f"{fault}: the truth begins {(start - first) / 1e9:.3f} s after the result and lasts "
        f"{(end - start) / 1e9:.3f} s, the result {(last - first) / 1e9:.3f} s; check --shift, or "
        "use --align-time, and check that the times are seconds"
    )


def _median_text(positions: Floats) -> str:
    """Median of each coordinate, as text."""
    median = np.nanmedian(positions.reshape(-1, 3), axis=0)
    return f"({', '.join(f'{value:.4g}' for value in median)})"


def skeleton_distances(a: Floats, b: Floats) -> Floats:
    """Mean distance over the markers that both skeletons have.

    Parameters
    ----------
    a, b : (A, M, 3) and (B, M, 3) marker positions, m; NaN where a marker is absent.

    Returns
    -------
    (A, B) distances, m; infinite where two skeletons share no marker.
    """
    distances = np.empty((len(a), len(b)))
    mean_distances(np.ascontiguousarray(a), np.ascontiguousarray(b), distances)
    return distances
