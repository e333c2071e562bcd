"""Frame by frame: which skeleton is which true person, and how far its joints are off."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np

from hiros_mcap.evaluate.mot import FrameSimilarity
from hiros_mcap.evaluate.pairing import best_pairs, skeleton_distances
from hiros_mcap.evaluate.truth import Truth
from hiros_mcap.skeletons import UNTRACKED, Floats, Frame

MATCH_DISTANCE = 1.0
"""m: a skeleton farther than this from a true person, mean over joints, is of somebody else."""


@dataclass(frozen=True, slots=True)
class Track:
    """One id over time."""

    stamps: list[int] = field(default_factory=list)
    poses: list[Floats] = field(default_factory=list)
    """(M, 3) m each."""


@dataclass(slots=True)
class Matches:
    """R matched skeletons of a channel, and what was not matched."""

    stamps: list[int] = field(default_factory=list)
    """(R,) ns."""
    people: list[int] = field(default_factory=list)
    """(R,) row of the true person in the truth."""
    ids: list[int] = field(default_factory=list)
    """(R,) id of the skeleton."""
    poses: list[Floats] = field(default_factory=list)
    """(M, 3) m each."""
    true_poses: list[Floats] = field(default_factory=list)
    orientations: list[Floats] = field(default_factory=list)
    """(L, 4) x y z w each."""
    true_orientations: list[Floats] = field(default_factory=list)
    tracks: dict[int, Track] = field(default_factory=dict)
    """Every id, matched or not."""
    similarities: list[FrameSimilarity] = field(default_factory=list)
    missing: int = 0
    false: int = 0
    switches: int = 0
    frames: int = 0
    nearest: float = math.inf
    """Least distance of a skeleton from a true person, mean over joints, m."""


def match(frames: Iterable[Frame], truth: Truth, max_distance: float = MATCH_DISTANCE) -> Matches:
    """Match skeletons with an id to true people, each frame by itself, least distance first.

    Frames outside the time of the truth do not count. A switch is counted when a true person's
    nearest skeleton has another id than at the last match.
    """
    result = Matches()
    last_ids: dict[int, int] = {}
    for frame in frames:
        if truth.covers(frame.stamp):
            _match_frame(frame, truth, max_distance, result, last_ids)
    return result


def _match_frame(
    frame: Frame, truth: Truth, max_distance: float, result: Matches, last_ids: dict[int, int]
) -> None:
    rows = np.nonzero(frame.ids != UNTRACKED)[0]
    ids: list[int] = frame.ids[rows].tolist()
    positions, orientations = truth.at(frame.stamp)
    present = np.nonzero(~np.isnan(positions[..., 0]).all(axis=-1))[0]
    distance = skeleton_distances(positions[present], frame.positions[rows])
    for row, ident in zip(rows, ids, strict=True):
        track = result.tracks.setdefault(ident, Track())
        track.stamps.append(frame.stamp)
        track.poses.append(frame.positions[row].copy())
    pairs = best_pairs(np.where(distance < max_distance, distance, np.inf))
    for true_row, column in sorted(pairs, key=lambda pair: pair[1]):  # as the frame has them
        person, ident, row = int(present[true_row]), ids[column], rows[column]
        result.switches += last_ids.get(person, ident) != ident
        last_ids[person] = ident
        result.stamps.append(frame.stamp)
        result.people.append(person)
        result.ids.append(ident)
        result.poses.append(frame.positions[row].copy())
        result.true_poses.append(positions[person])
        result.orientations.append(frame.orientations[row].copy())
        result.true_orientations.append(orientations[person])
    result.missing += len(present) - len(pairs)
    result.false += len(rows) - len(pairs)
    result.frames += 1
    result.nearest = min(result.nearest, float(distance.min(initial=math.inf)))
    similarity = np.clip(1 - distance / max_distance, 0, 1)
    result.similarities.append(FrameSimilarity(tuple(present.tolist()), tuple(ids), similarity))


def explain_no_match(matches: Matches, truth: Truth) -> str:
    """Return the distance of result and truth in words if nobody was matched, else ""."""
    if matches.people or not math.isfinite(matches.nearest):
        return ""
    found = np.stack([pose for track in matches.tracks.values() for pose in track.poses])
    return (
        f"no skeleton comes nearer than {matches.nearest:.1f} m to a true person. Is the truth in "
        "metres, in the log's fixed frame, with the right --up and --shift? Typical coordinates: "
        f"truth {_median_text(truth.positions)}, result {_median_text(found)}"
    )


def _median_text(positions: Floats) -> str:
    """Median of each coordinate, as text."""
    median = np.nanmedian(positions.reshape(-1, 3), axis=0)
    return f"({', '.join(f'{value:.4g}' for value in median)})"
