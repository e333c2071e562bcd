"""Rigs that are wrong: cameras that were moved, moved late, of a wrong pose, or before a mirror.

    python benchmarks/rigs.py [--system fuse-realtime] [--detector ideal]

Two parts of a run look for such cameras: poses for each part of a log (``input.moved``), and copies
of people (``track.merge_tracks``). Each is switched off in turn. Printed are the mean and the 99th
percentile of the joint error, mm, the ids of people, switches, false and missing people. Of two
cameras, nobody knows which is wrong: the error then is mostly that of where the rig stands.
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import argparse
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from scenes import Scene, knocked, misplaced, published, use_detector

from hiros_mcap.body.rotations import rotate
from hiros_mcap.body.symmetry import symmetry_of
from hiros_mcap.config import Table, load_config
from hiros_mcap.evaluate.logs import find_truth
from hiros_mcap.evaluate.match import match
from hiros_mcap.evaluate.scores import score_matches
from hiros_mcap.running.process_options import ProcessOptions
from hiros_mcap.running.recording import Recording
from hiros_mcap.skeletons import POSITION

WALL = 3.2  # m along x, where the mirror is
OFF: Mapping[str, Table] = {
    "nothing": {},
    "moved cameras": {"input": {"moved": False}},
    "copies, double tracks": {"track": {"merge_tracks": False}},
}


def mirrored(scene: Scene) -> Scene:
    """Return a scene whose second camera also shows everybody in a mirror."""
    name = sorted(scene.poses)[1]
    pose, sides, frames = scene.poses[name], symmetry_of(scene.model).mirror, []
    for frame in scene.frames:
        n = frame.n_people
        if frame.source == name and n:
            people = frame.select([*range(n), *range(n)]).people.copy()
            there = rotate(pose.xyzw, people.markers[n:, :, POSITION]) + pose.translation
            there[..., 0] = 2 * WALL - there[..., 0]
            people.markers[n:] = np.nan
            back = rotate(pose.inverse().xyzw, there - pose.translation)
            people.markers[n:, :, POSITION] = back[:, sides]
            people.links[n:] = np.nan
            frame = frame.replace(people=people)
        frames.append(frame)
    return replace(scene, frames=frames)


MOVED = partial(knocked, degrees=8, metres=0.25)
RIGS: Mapping[str, tuple[Callable[[Scene], Scene], tuple[tuple[int, int], ...]]] = {
    "moved by 8 degrees and 25 cm": (MOVED, ((3, 2), (3, 1), (4, 3), (5, 2), (2, 2))),
    "moved by 2 degrees and 6 cm": (partial(knocked, degrees=2, metres=0.06), ((4, 2),)),
    "moved 2 s before the end": (partial(MOVED, share=0.87), ((4, 2), (3, 2))),
    "wrong by 20 degrees and 60 cm": (
        partial(misplaced, degrees=20, metres=0.6),
        ((4, 2), (2, 2), (2, 1), (2, 3)),
    ),
    "before a mirror": (mirrored, ((3, 2), (2, 1))),
}
"""What is wrong -> how, and cameras and people of the scenes."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--system", default="fuse")
    given, rest = parser.parse_known_args()
    use_detector(rest)
    print("| rig | cameras, people | off | mean | 99 % | ids | switches | false | missing |")
    print(f"|{'---|' * 9}")
    with tempfile.TemporaryDirectory() as folder:
        for what, (change, sizes) in RIGS.items():
            for k, (cameras, people) in enumerate(sizes):
                path = Path(folder) / f"{what}{k}.mcap"
                scene = published(40 + k, people=people, cameras=cameras, seconds=14.0)
                change(scene).write(path, transforms=True)
                for off, table in OFF.items():
                    numbers = measured(path, given.system, off, table)
                    print(f"| {what} | {cameras}, {people} | {off} | {numbers} |", flush=True)


def measured(path: Path, system: str, off: str, table: Table) -> str:
    """Run a log with something off, and score it."""
    config = load_config(system=system, named={off: table} if table else {})
    recording = Recording.read(path, config, ProcessOptions())
    (frames,) = recording.run(config, ProcessOptions(), last=True).values()
    truth = find_truth(path)
    assert truth is not None
    truth = truth.moved(start=recording.prepared.log.span[0]).seen_by(recording.model)
    matches = match(frames, truth)
    scores = score_matches(matches, truth, recording.model)
    numbers = len(matches.tracks), scores.switches, scores.false, scores.missing
    return " | ".join([f"{scores.mean:.2f}", f"{scores.percentile_99:.0f}", *map(str, numbers)])


if __name__ == "__main__":
    main()
