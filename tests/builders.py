"""Rooms for tests: simulated ones with known truth, and rigid motions of whole rooms."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from hiros_mcap.body.transforms import Transform, TransformTree, transform_to_fixed
from hiros_mcap.evaluate import Truth
from hiros_mcap.frames import Block, frames_of, join
from hiros_mcap.simulate import SimulateParams, simulate
from hiros_mcap.skeletons import Floats, Frame, People, SkeletonModel

FAULTLESS = {
    "noise": 0.0, "occlusion": 0.0, "flips": 0.0, "dropouts": 0.0, "clock_jitter": 0.0,
    "calibration_error": 0.0, "phantoms": 0.0,
}  # fmt: skip


@dataclass(frozen=True)
class Room:
    """The detections of a simulated room, in the frame "world", and the truth."""

    frames: list[Frame]
    model: SkeletonModel
    cameras: dict[str, Floats]
    truth: Truth


def room(**params):
    """Simulate a room with the given :class:`SimulateParams`."""
    simulation = simulate(SimulateParams.model_validate(params))
    tree = TransformTree()
    for camera, pose in simulation.transforms.items():
        x, y, z = pose.translation
        tree.add(Transform(0, "world", camera, (x, y, z), tuple(pose.xyzw)), static=True)
    frames = [
        frame.replace(stamp=int(frame.stamps[0])) if frame.n_people else frame
        for frame in simulation.detections
    ]
    return Room(
        frames=list(transform_to_fixed(frames, tree, "world")),
        model=simulation.model,
        cameras={name: pose.translation for name, pose in simulation.transforms.items()},
        truth=Truth.of(simulation.truth),
    )


def at_once(stage):
    """Make a stage of frames of a stage of blocks, which gets all of them in one block.

    ``frames.by_frame`` gives the same frame by frame, as a law says, in more time.
    """

    def run(frames, *args, **parameters):
        blocks = [*map(Block.of, frames)]
        yield from frames_of(stage([join(blocks)] if blocks else [], *args, **parameters))

    return run


def moved(frames, turn, shift):
    """Turn and shift the room: every vector turns, every position is shifted, too."""
    result = []
    for frame in frames:
        new = frame.replace(markers=frame.markers.copy(), links=frame.links.copy())
        for states in (new.markers, new.links):
            for first in (0, 7, 10, 13, 16):
                vectors = states[:, :, first : first + 3]
                vectors[:] = turn.apply(vectors.reshape(-1, 3)).reshape(vectors.shape)
            states[:, :, :3] += shift
            known = ~np.isnan(states[:, :, 3])
            if known.any():
                turned = turn * Rotation.from_quat(states[known][:, 3:7])
                states[known, 3:7] = turned.as_quat()
        result.append(new)
    return result


def same(one, other, *, but_ids=False):
    """Whether two frames hold the same bytes (NaN = NaN)."""
    names = (*(n for n in Frame.__slots__ if n != "people"), *People._fields)
    fields = [name for name in names if not (but_ids and name == "ids")]
    return all(_equal(getattr(one, name), getattr(other, name)) for name in fields)


def _equal(a, b):
    if isinstance(a, np.ndarray) and isinstance(b, np.ndarray):
        return a.shape == b.shape and bool(np.array_equal(a, b, equal_nan=a.dtype.kind == "f"))
    if isinstance(a, tuple) and isinstance(b, tuple):
        return len(a) == len(b) and all(map(_equal, a, b))
    return a == b
