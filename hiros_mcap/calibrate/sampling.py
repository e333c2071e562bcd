"""All cameras' skeletons at common instants, and who of them is the same person."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from hiros_mcap.body.rotations import Rigid, from_matrix, to_matrix
from hiros_mcap.calibrate.camera_views import CameraView
from hiros_mcap.kernels.grouping import GroupingWork, Groups, Skeletons, group_people
from hiros_mcap.rays.image_tracks import Samples, sample_tracks
from hiros_mcap.skeletons import Floats, Ints

CELL_S = 0.1
"""Shortest distance in time of the instants: each uses the frames of 0.2 s."""


class Rig(NamedTuple):
    """Poses and clocks of C cameras; a point x of a camera is at R x + p in the common frame."""

    rotations: Floats  # (C, 3, 3)
    shifts: Floats  # (C, 3) m
    clocks: Floats  # (C,) s to add to the time of each camera

    @classmethod
    def alone(cls, n_cameras: int) -> Rig:
        """Return cameras that all stand at the origin."""
        turns = np.tile(np.eye(3), (n_cameras, 1, 1))
        return cls(turns, np.zeros((n_cameras, 3)), np.zeros(n_cameras))

    @classmethod
    def of(cls, poses: Sequence[Rigid]) -> Rig:
        """Return cameras at known poses, whose clocks are right."""
        rig = cls.alone(len(poses))
        for c, pose in enumerate(poses):
            rig.rotations[c], rig.shifts[c] = to_matrix(pose.xyzw), pose.translation
        return rig

    def anchored(self) -> Rig:
        """Return the rig in the frame and the time of its first camera."""
        turn = self.rotations[0].T
        return Rig(
            turn @ self.rotations,
            (self.shifts - self.shifts[0]) @ turn.T,
            self.clocks - self.clocks[0],
        )

    def pose(self, camera: int) -> Rigid:
        """Return where a camera stands in the common frame."""
        return Rigid(from_matrix(self.rotations[camera]), self.shifts[camera])

    def select(self, cameras: Sequence[int]) -> Rig:
        """Return some of the cameras."""
        return Rig(*(array[list(cameras)] for array in self))


def sample(views: Sequence[CameraView], instants: Floats, rig: Rig) -> Samples:
    """Take every camera's skeletons at common times, (K,) s, increasing, in the order of time."""
    rows = zip(views, rig.clocks, strict=True)
    samples = sample_tracks([(v.tracks, v.half_width, instants - clock) for v, clock in rows])
    return samples.part(np.lexsort((samples.cameras, samples.instants)))


def placed(samples: Samples, rig: Rig) -> Floats:
    """(N, M, 3) the skeletons in the common frame, m."""
    turned = samples.lines.positions @ np.swapaxes(rig.rotations, 1, 2)[samples.cameras]
    return np.asarray(turned + rig.shifts[samples.cameras][:, None])


def group(samples: Samples, positions: Floats, mirror: Ints, gate: float) -> Groups:
    """Join skeletons in the common frame that are the same person at one instant.

    Parameters
    ----------
    positions : (N, M, 3) of :func:`placed`. gate : largest distance, m.
    """
    n = len(samples.cameras)
    starts = np.flatnonzero(np.diff(samples.instants, prepend=-1))
    begins = np.append(starts, n).astype(np.int64)
    most = int(np.diff(begins).max(initial=1))
    groups = Groups(np.empty(n, np.int64), np.empty(n, np.bool_), np.empty(n))
    skeletons = Skeletons(
        np.ascontiguousarray(positions), samples.lines.weights, samples.cameras, mirror
    )
    work = GroupingWork.allocate(most, len(mirror))
    group_people(skeletons, begins, gate, work, groups)
    return groups


def instants_of(views: Sequence[CameraView], most: int, rig: Rig | None = None) -> Floats:
    """(K,) times, s, at which somebody is seen, one at random in each of K <= ``most`` cells.

    A regular grid would be commensurate with the cameras' frames, and bias the clocks by some ms.
    Without ``rig``, all clocks are taken for right.
    """
    clocks = np.zeros(len(views)) if rig is None else rig.clocks
    spans = [
        track.seconds[[0, -1]] + clocks[c] for c, view in enumerate(views) for track in view.tracks
    ]
    if not spans:
        return np.zeros(0)
    first, last = float(np.min(spans)), float(np.max(spans))
    edges = np.arange(first, last + CELL_S, CELL_S)
    covered = np.zeros(len(edges), np.bool_)
    for begin, end in spans:
        covered[np.searchsorted(edges, begin) : np.searchsorted(edges, end)] = True
    cell = CELL_S * max(1, int(np.ceil(covered.sum() / most)))
    cells = np.unique(np.floor((edges[covered] - first) / cell))
    return np.asarray(first + cell * (cells + np.random.default_rng(0).random(len(cells))))
