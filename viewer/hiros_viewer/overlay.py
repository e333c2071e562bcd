"""Two logs at once: how far apart the same stage's people are."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from hiros_mcap.errors import ConfigError
from hiros_mcap.io.channels import OUTPUT_PREFIX
from hiros_mcap.io.log import open_log
from hiros_mcap.kernels.assignment import assign
from hiros_mcap.skeletons import UNTRACKED, Floats, Frame
from hiros_viewer.scene import Scene

SIMULTANEOUS_NS = 17_000_000
"""Frames of two logs at most half a period of 30 Hz apart are compared."""
SAME_PERSON = 1.0
"""m, mean over joints."""


def draw_distances(first: Path, second: Path, scenes: list[Scene], stage: str) -> None:
    """Draw the mean and the largest joint distance over time into the first scene.

    ``stage`` is the one to compare; "" = the last one that both logs have.

    Raises ConfigError if the logs cannot be compared, or the skeletons share no marker.
    """
    common = [s for s in scenes[0].stages if s in scenes[1].stages and s == (stage or s)]
    if not common:
        what = f"the stage {stage!r}" if stage else "a stage"
        raise ConfigError(
            f"{first} and {second} do not both hold {what}; view overlays two results, or a "
            "result and a truth"
        )
    names = [scene.model.marker_names for scene in scenes]
    shared = [name for name in names[0] if name in names[1]]
    if not shared:
        raise ConfigError(f"{first} and {second} share no marker")
    rows = [[own.index(name) for name in shared] for own in names]
    last = common[-1]
    for a, b in paired(_frames(first, last, rows[0]), _frames(second, last, rows[1])):
        distance = joint_distances(a, b)
        if distance.size:
            scenes[0].distance(a.stamp, "mean", 1000 * float(distance.mean()))
            scenes[0].distance(a.stamp, "largest", 1000 * float(distance.max()))
    scenes[0].flush()


def _frames(path: Path, stage: str, markers: list[int]) -> Iterator[Frame]:
    """Yield the frames of a stage with some of the markers."""
    with open_log(path, topics=[f"{OUTPUT_PREFIX}/{stage}"], output_prefix="/none") as log:
        for frame in log.frames():
            yield frame.replace(markers=frame.markers[:, markers])


def paired(first: Iterator[Frame], second: Iterator[Frame]) -> Iterator[tuple[Frame, Frame]]:
    """Yield frames of the same time; both are in the order of their time."""
    a, b = next(first, None), next(second, None)
    while a is not None and b is not None:
        later = b.stamp - a.stamp
        if abs(later) <= SIMULTANEOUS_NS:
            yield a, b
            a, b = next(first, None), next(second, None)
        elif later < 0:
            b = next(second, None)
        else:
            a = next(first, None)


def joint_distances(a: Frame, b: Frame) -> Floats:
    """Distances, m, of all joints of the people that both frames hold, matched by place."""
    mine, theirs = a.positions[a.ids != UNTRACKED], b.positions[b.ids != UNTRACKED]
    each = np.linalg.norm(mine[:, None] - theirs[None], axis=-1)
    known = ~np.isnan(each)
    mean = np.where(known, each, 0).sum(axis=-1) / np.maximum(known.sum(axis=-1), 1)
    mean[~known.any(axis=-1) | (mean > SAME_PERSON)] = np.inf
    rows = assign(np.ascontiguousarray(mean)).tolist()
    found = [each[row, column] for column, row in enumerate(rows) if row >= 0]
    flat = np.concatenate(found) if found else np.zeros(0)
    return np.asarray(flat[~np.isnan(flat)])
