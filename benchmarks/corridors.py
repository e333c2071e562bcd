"""Rigs whose cameras see different people: what hiros says of their poses, and what is true.

    python benchmarks/corridors.py [SCENES [FIRST_SEED]]

Of corridors, halls, and rooms on both sides of a door, in turn. Each scene is processed as it was
published, and with one camera's pose wrong by 3, 10 or 45 degrees, or two poses exchanged. A row
for each counts the scenes in which hiros said nothing, wrote a note only, used a pose in place of
the wrong one that is right to 1.5 degrees, or warned of a camera whose pose is wrong; and those in
which it did what is not true: named another camera only, replaced right poses, or used a wrong one.
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import sys
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
from scenes import Scene, published

from hiros_mcap.body.rotations import Rigid, angle, from_matrix, from_vector, to_matrix
from hiros_mcap.io.log import open_log
from hiros_mcap.running.pipeline import ProcessOptions, process
from hiros_mcap.running.summary import Summary
from hiros_mcap.simulate.cameras import aimed

RANGE = 5.5
"""m that a camera sees."""
RIGHT_DEG = 1.5
DOOR = 0.6
"""m beyond a wall in which a camera sees people, through the door."""

Place = tuple[float, float, float, float]
"""x and y of a camera, and of what it looks at, m."""


def corridor(rng: np.random.Generator) -> tuple[list[Place], tuple[float, float, float, float]]:
    """Cameras in a row along 9 to 16 m, which all look the same way, or each its own."""
    n, length = int(rng.integers(3, 6)), float(rng.uniform(9.0, 16.0))
    row = np.linspace(0.5, length - 3.0, n)
    ways = np.where(rng.random(n) < 0.3 * rng.integers(2), -1.0, 1.0)
    places = [(float(x), 0.2, float(x + 4.0 * way), 1.2) for x, way in zip(row, ways, strict=True)]
    return places, (0.0, 0.0, length, 2.4)


def hall(rng: np.random.Generator) -> tuple[list[Place], tuple[float, float, float, float]]:
    """Cameras along the walls of 10 to 14 m by 8 to 10 m, which look inwards."""
    n, width, depth = int(rng.integers(4, 7)), rng.uniform(10.0, 14.0), rng.uniform(8.0, 10.0)
    turns = 2.0 * np.pi * (np.arange(n) + rng.uniform()) / n
    sides = np.column_stack([np.cos(turns), np.sin(turns)])
    sides /= np.abs(sides).max(axis=1)[:, None]
    at = sides * [width / 2, depth / 2]
    return [(*a, *(0.3 * a)) for a in at.tolist() for a in [np.array(a)]], (
        -width / 2, -depth / 2, width / 2, depth / 2,
    )  # fmt: skip


def door(rng: np.random.Generator) -> tuple[list[Place], tuple[float, float, float, float]]:
    """Two rooms of 5 m by 4 to 5 m, two cameras in each; the wall is at x = 0."""
    depth = float(rng.uniform(4.0, 5.0))
    corners = [(x, y) for x in (-4.8, 4.8) for y in (0.2, depth - 0.2)]
    return [(x, y, 0.1 * x, depth / 2) for x, y in corners], (-5.0, 0.0, 5.0, depth)


KINDS: Mapping[str, Callable[[np.random.Generator], tuple[list[Place], Place]]] = {
    "corridor": corridor,
    "hall": hall,
    "door": door,
}


def scene_of(kind: str, seed: int) -> Scene:
    """Simulate 30 s of two to four people who walk about."""
    rng = np.random.default_rng([seed, 59])
    places, area = KINDS[kind](rng)
    height = float(rng.uniform(1.6, 2.4))
    poses = []
    for x, y, at_x, at_y in places:
        turn = from_matrix(aimed(np.array([at_x - x, at_y - y, 1.0 - height])))
        poses.append((x, y, height, *turn.tolist()))
    people, kinect = int(rng.integers(2, 5)), bool(seed % 2)
    rig = {"poses": tuple(poses), "range": (0.5, RANGE), "rate": 15.0}
    scene = published(
        seed, people=people, cameras=len(poses), action="roam", seconds=30.0, area=area, rig=rig,
        detector={"kind": "kinect" if kinect else "ideal"},
    )  # fmt: skip
    return walled(scene) if kind == "door" else scene


def walled(scene: Scene) -> Scene:
    """Return a scene with a wall at x = 0: who is behind it is not seen."""
    frames = []
    for frame in scene.frames:
        pose = scene.poses[frame.source]
        places = np.nanmean(frame.positions, axis=1) @ to_matrix(pose.xyzw).T + pose.translation
        kept = np.flatnonzero(np.sign(pose.translation[0]) * places[:, 0] > -DOOR)
        frames.append(frame.select(kept.tolist()))
    return replace(scene, frames=frames)


def wrong_rigs(scene: Scene, seed: int) -> Iterator[tuple[str, Scene, set[str]]]:
    """Yield what is wrong with the poses, the scene, and whose poses these are."""
    yield "healthy", scene, set()
    rng = np.random.default_rng([seed, 60])
    names = sorted(scene.poses)
    for degrees in (3.0, 10.0, 45.0):
        name = str(rng.choice(names))
        axis = rng.normal(size=3)
        turn = from_vector(np.radians(degrees) * axis / np.linalg.norm(axis))
        pose = scene.poses[name] @ Rigid(turn, np.zeros(3))
        yield f"{degrees:g} degrees", replace(scene, poses={**scene.poses, name: pose}), {name}
    one, other = (str(name) for name in rng.choice(names, 2, replace=False))
    exchanged = {**scene.poses, one: scene.poses[other], other: scene.poses[one]}
    yield "exchanged", replace(scene, poses=exchanged), {one, other}


def outcome(true: Scene, given: Scene, wrong: set[str]) -> tuple[str, str]:
    """Process a scene; return in a word what hiros did, and what it said."""
    with tempfile.TemporaryDirectory() as folder:
        path, out = Path(folder) / "scene.mcap", Path(folder) / "out.mcap"
        given.write(path, transforms=True)
        summary = process(path, out, options=ProcessOptions(stages="T"))
        errors = _errors(out, true, wrong)
    about = [text for text in summary.warnings if "pose" in text or "moved" in text]
    said = " | ".join([*about, *(n for n in summary.notes if "pose" in n or "view" in n)])
    return _judged(summary, errors, wrong, about), f"{said} errors {errors}"


def _errors(out: Path, true: Scene, wrong: set[str]) -> dict[str, float]:
    """Camera -> degrees by which it is turned against most of those whose poses were right."""
    names = sorted(true.poses)
    with open_log(out) as log:
        root = log.fixed_frame
        used = {name: log.transforms.lookup(name, root, 0) for name in names}
    turns = {n: used[n] @ true.poses[n].inverse() for n in names}
    return {
        n: float(np.median([np.degrees(angle(turns[n].xyzw, turns[o].xyzw)) for o in names
                            if o != n and o not in wrong]))
        for n in names
    }  # fmt: skip


def _judged(
    summary: Summary, errors: Mapping[str, float], wrong: set[str], about: list[str]
) -> str:
    named = {name for name in errors if any(name in text for text in about)}
    off = {name for name, degrees in errors.items() if degrees > RIGHT_DEG}
    anew = any("come from the people" in text for text in about)
    if off - wrong:
        return "made wrong"
    if wrong:
        if not off:
            return "mended"
        return "named" if off & named else "another named" if named else _quiet(summary, wrong)
    return "replaced" if anew else "named" if named else _quiet(summary, wrong)


def _quiet(summary: Summary, wrong: set[str]) -> str:
    doubted = {one.name for one in summary.poses if one.verdict in ("doubtful", "impossible")}
    noted = any("shares no view" in note for note in summary.notes)
    return "noted" if noted else "doubted" if doubted & wrong else "silent"


def main(count: int, first: int) -> None:
    """Print a row for each scene, and the table."""
    table: dict[str, Counter[str]] = {}
    for seed in range(first, first + count):
        kind = list(KINDS)[seed % len(KINDS)]
        scene = scene_of(kind, seed)
        for what, given, wrong in wrong_rigs(scene, seed):
            word, said = outcome(scene, given, wrong)
            table.setdefault(what, Counter())[word] += 1
            print(f"{seed} {kind:8} {what:10} {sorted(wrong)} {word}: {said}", flush=True)
    words = sorted({word for row in table.values() for word in row})
    print(f"\n{'':12}" + "".join(f"{word:>14}" for word in words))
    for what, row in table.items():
        print(f"{what:12}" + "".join(f"{row[word]:14}" for word in words))


if __name__ == "__main__":
    arguments = [int(text) for text in sys.argv[1:]]
    main(*(arguments + [20, 59000][len(arguments) :]))
