"""Two logs at once: how far apart the same stage's people are."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from hiros_mcap.errors import ConfigError
from hiros_mcap.evaluate.match import MATCH_DISTANCE, skeleton_distances
from hiros_mcap.evaluate.mot import best_pairs
from hiros_mcap.io.channels import OUTPUT_PREFIX
from hiros_mcap.io.log import open_log
from hiros_mcap.skeletons import UNTRACKED, Floats, Stamps, nearest_stamps
from hiros_viewer.poses import Poses
from hiros_viewer.scene import Scene

SIMULTANEOUS_NS = 17_000_000
"""Frames of two logs at most half a period of 30 Hz apart are compared."""


def draw_distances(first: Path, second: Path, scenes: list[Scene], stage: str) -> None:
    """Draw the mean and the largest joint distance over time into the first scene.

    ``stage`` is the one to compare; "" = the last one that both logs have.

    Raises ConfigError if the logs cannot be compared, or the skeletons share no marker.
    """
    common = [s for s in scenes[0].stages if s in scenes[1].stages and s == (stage or s)]
    if not common:
        needed = f"the stage {stage!r}" if stage else "a stage"
        raise ConfigError(
            f"{first} and {second} do not both hold {needed}; view overlays two results, or a "
            "result and a truth"
        )
    names = [scene.model.marker_names for scene in scenes]
    shared = [name for name in names[0] if name in names[1]]
    if not shared:
        raise ConfigError(f"{first} and {second} share no marker")
    slots = [[markers.index(name) for name in shared] for markers in names]
    a, b = (_poses(path, common[-1]) for path in (first, second))
    mine, theirs = simultaneous(a.stamps, b.stamps)
    people = _people(a, mine, slots[0]), _people(b, theirs, slots[1])
    apart = [joint_distances(*pair) for pair in zip(*people, strict=True)]
    present = np.array([len(distances) > 0 for distances in apart], bool)
    times = a.times[mine][present]
    for name, of in (("mean", np.mean), ("largest", np.max)):
        values = np.array([of(distances) for distances in apart if len(distances)])
        scenes[0].distances(name, times, 1000 * values)


def _poses(path: Path, stage: str) -> Poses:
    with open_log(path, topics=[f"{OUTPUT_PREFIX}/{stage}"], output_prefix="/none") as log:
        read = log.read(fixed=False).blocks()
        blocks = [Poses.of_block(block, np.arange(len(block))) for block in read]
    return Poses.joined(blocks)


def _people(poses: Poses, frames: Stamps, markers: list[int]) -> Iterator[Floats]:
    """Yield (P, K, 3) some markers, m, of everybody with an id in each of the frames."""
    for begin, end in poses.rows[frames].tolist():
        people = poses.positions[begin:end, markers]
        yield people[poses.ids[begin:end] != UNTRACKED]


def simultaneous(first: Stamps, second: Stamps) -> tuple[Stamps, Stamps]:
    """Return the numbers of instants of two channels, in order, that are the same time."""
    if not (len(first) and len(second)):
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    near = nearest_stamps(second, first)
    simultaneous = np.flatnonzero(np.abs(second[near] - first) <= SIMULTANEOUS_NS)
    _, once = np.unique(near[simultaneous], return_index=True)
    return simultaneous[once], near[simultaneous][once]


def joint_distances(mine: Floats, theirs: Floats) -> Floats:
    """Distances, m, of all joints of people (P, K, 3) and (Q, K, 3), matched by place."""
    apart = np.linalg.norm(mine[:, None] - theirs[None], axis=-1)
    mean = skeleton_distances(mine, theirs)
    distances = [apart[pair] for pair in best_pairs(np.where(mean > MATCH_DISTANCE, np.inf, mean))]
    flat = np.concatenate(distances) if distances else np.zeros(0)
    return np.asarray(flat[~np.isnan(flat)])
