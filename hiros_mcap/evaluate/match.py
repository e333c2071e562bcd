"""Frame by frame: which skeleton is which true person, and how far its joints are off."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np

from hiros_mcap.evaluate.mot import Instant
from hiros_mcap.evaluate.truth import Truth
from hiros_mcap.kernels.assignment import assign
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
    turns: list[Floats] = field(default_factory=list)
    """(L, 4) x y z w each."""
    true_turns: list[Floats] = field(default_factory=list)
    tracks: dict[int, Track] = field(default_factory=dict)
    """Every id, matched or not."""
    instants: list[Instant] = field(default_factory=list)
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
    last: dict[int, int] = {}
    for frame in frames:
        if truth.covers(frame.stamp):
            _match_frame(frame, truth, max_distance, result, last)
    return result


def _match_frame(
    frame: Frame, truth: Truth, max_distance: float, result: Matches, last: dict[int, int]
) -> None:
    rows = np.nonzero(frame.ids != UNTRACKED)[0]
    names = [int(i) for i in frame.ids[rows]]
    positions, turns = truth.at(frame.stamp)
    present = np.nonzero(~np.isnan(positions[..., 0]).all(axis=-1))[0]
    distance = _distances(positions[present], frame.positions[rows])
    if not np.isnan(distance).all():
        result.nearest = min(result.nearest, float(np.nanmin(distance)))
    allowed = np.where(distance < max_distance, distance, np.inf)
    matched = assign(np.ascontiguousarray(allowed)).tolist()
    for column, k in enumerate(matched):
        row = rows[column]
        track = result.tracks.setdefault(names[column], Track())
        track.stamps.append(frame.stamp)
        track.poses.append(frame.positions[row].copy())
        if k < 0:
            continue
        person = int(present[k])
        result.switches += last.get(person, names[column]) != names[column]
        last[person] = names[column]
        result.stamps.append(frame.stamp)
        result.people.append(person)
        result.ids.append(names[column])
        result.poses.append(track.poses[-1])
        result.true_poses.append(positions[person])
        result.turns.append(frame.orientations[row].copy())
        result.true_turns.append(turns[person])
    hits = sum(k >= 0 for k in matched)
    result.missing += len(present) - hits
    result.false += len(rows) - hits
    result.frames += 1
    similarity = np.clip(1 - np.nan_to_num(distance, nan=max_distance) / max_distance, 0, 1)
    result.instants.append(Instant(tuple(present.tolist()), tuple(names), similarity))


def strangers(matches: Matches, truth: Truth) -> str:
    """Say how far apart result and truth are where nobody was matched; "" if somebody was."""
    if matches.people or not math.isfinite(matches.nearest):
        return ""
    found = np.stack([pose for track in matches.tracks.values() for pose in track.poses])
    return (
        f"no skeleton comes nearer than {matches.nearest:.1f} m to a true person. Is the truth in "
        "metres, in the log's fixed frame, with the right --up and --shift? Typical coordinates: "
        f"truth {_typical(truth.positions)}, result {_typical(found)}"
    )


def _typical(positions: Floats) -> str:
    """Median of each coordinate, as text."""
    middle = np.nanmedian(positions.reshape(-1, 3), axis=0)
    return f"({', '.join(f'{value:.4g}' for value in middle)})"


def _distances(true: Floats, found: Floats) -> Floats:
    """(N, P) Mean distance over the joints that both have, m; NaN without any."""
    each = np.linalg.norm(true[:, None] - found[None], axis=-1)
    known = ~np.isnan(each)
    total = np.where(known, each, 0.0).sum(axis=-1)
    return np.where(known.any(axis=-1), total / np.maximum(known.sum(axis=-1), 1), np.nan)
