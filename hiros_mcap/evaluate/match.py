"""Frame by frame: which skeleton is which true person, and how far its joints are off."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np

from hiros_mcap.evaluate.mot import FrameSimilarity
from hiros_mcap.evaluate.pairing import best_pairs, skeleton_distances
from hiros_mcap.evaluate.silence import silent_instants
from hiros_mcap.evaluate.truth import Truth
from hiros_mcap.skeletons import UNTRACKED, Flags, Floats, Frame

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
    missed: list[Flags] = field(default_factory=list)
    """(M,) each: which markers the truth has of a true person whom no skeleton matches."""
    false: int = 0
    """Skeletons that match nobody; those of a partial truth are of somebody else."""
    switches: int = 0
    frames: int = 0
    silent: int = 0
    """Instants with people but without a frame; see :mod:`hiros_mcap.evaluate.silence`."""
    span: tuple[int, int] | None = None
    """Stamps of the first and the last frame, ns, also of those that the truth does not cover."""
    nearest: float = math.inf
    """Least distance of a skeleton from a true person, mean over joints, m."""


def match(frames: Iterable[Frame], truth: Truth, max_distance: float = MATCH_DISTANCE) -> Matches:
    """Match skeletons with an id to true people, each frame by itself, least distance first.

    Frames that the truth does not cover do not count. Where the result is silent, everybody is
    missed. A switch is counted when a true person's nearest skeleton has another id than at the
    last match. Skeletons that match nobody of a partial truth are left out of the similarities.
    """
    result = Matches()
    last_ids: dict[int, int] = {}
    everything = list(frames)
    stamps = np.array([frame.stamp for frame in everything], np.int64)
    if stamps.size:
        result.span = int(stamps.min()), int(stamps.max())
    silent = deque(silent_instants(stamps, truth).tolist())
    for frame in everything:
        while silent and silent[0] < frame.stamp:
            _miss_everybody(silent.popleft(), truth, result)
        if truth.covers(frame.stamp):
            _match_frame(frame, truth, max_distance, result, last_ids)
    for stamp in silent:
        _miss_everybody(stamp, truth, result)
    return result


def _miss_everybody(stamp: int, truth: Truth, result: Matches) -> None:
    """Count an instant without a frame."""
    visible = ~np.isnan(truth.at(stamp)[0][..., 0])
    present = np.nonzero(visible.any(axis=-1))[0]
    result.silent += bool(len(present))
    result.missed += list(visible[present])
    nobody = np.zeros((len(present), 0))
    result.similarities.append(FrameSimilarity(tuple(present.tolist()), (), nobody))


def _match_frame(
    frame: Frame, truth: Truth, max_distance: float, result: Matches, last_ids: dict[int, int]
) -> None:
    rows = np.nonzero(frame.ids != UNTRACKED)[0]
    ids: list[int] = frame.ids[rows].tolist()
    positions, orientations = truth.at(frame.stamp)
    visible = ~np.isnan(positions[..., 0])
    present = np.nonzero(visible.any(axis=-1))[0]
    distance = skeleton_distances(positions[present], frame.positions[rows])
    for row, ident in zip(rows, ids, strict=True):
        track = result.tracks.setdefault(ident, Track())
        track.stamps.append(frame.stamp)
        track.poses.append(frame.positions[row].copy())
    pairs = best_pairs(np.where(distance < max_distance, distance, np.inf))
    pairs.sort(key=lambda pair: pair[1])  # as the frame has them
    for true_row, column in pairs:
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
    result.missed += list(visible[np.delete(present, [true_row for true_row, _ in pairs])])
    result.false += len(rows) - len(pairs)
    result.frames += 1
    result.nearest = min(result.nearest, float(distance.min(initial=math.inf)))
    # A skeleton of nobody is a fault only if the truth has everybody.
    kept = [column for _, column in pairs] if truth.partial else list(range(len(ids)))
    similarity = np.clip(1 - distance[:, kept] / max_distance, 0, 1)
    names = tuple(ids[column] for column in kept)
    result.similarities.append(FrameSimilarity(tuple(present.tolist()), names, similarity))


def explain_no_match(matches: Matches, truth: Truth) -> str:
    """Return the distance of result and truth in words if nobody was matched, else ""."""
    if matches.people or not math.isfinite(matches.nearest):
        return ""
    poses = np.stack([pose for track in matches.tracks.values() for pose in track.poses])
    return (
        f"no skeleton comes nearer than {matches.nearest:.1f} m to a true person. Is the truth in "
        "metres, in the log's fixed frame, with the right --up and --shift? Typical coordinates: "
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
        f"{(end - start) / 1e9:.3f} s, the result {(last - first) / 1e9:.3f} s; check --shift, and "
        "that the times are seconds"
    )


def _median_text(positions: Floats) -> str:
    """Median of each coordinate, as text."""
    median = np.nanmedian(positions.reshape(-1, 3), axis=0)
    return f"({', '.join(f'{value:.4g}' for value in median)})"
