"""Left and right: how often they are right, with the decision over time and without it.

    python benchmarks/sides.py                  simulated logs with a truth
    python benchmarks/sides.py LOG [LOG ...]    real logs, judged by the walking direction
    python benchmarks/sides.py --quick          fewer simulated logs
    python benchmarks/sides.py --detector ideal    whose sides are exchanged more seldom

Real logs: frames in which somebody walks faster than 0.5 m/s, the share of them that the result
faces forwards and backwards (within 60 degrees), frames in which the labels of two cameras
contradict each other and exactly one fits the walking direction, those of them in which the result
faces its way, and how often the facing turns by more than 100 degrees between two frames.
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
from scenes import params_of, use_detector
from side_scores import ALONG, WALKING, FacingTrack, facing_tracks, side_scores

from hiros_mcap.body.transforms import Transform, TransformTree, transform_to_fixed
from hiros_mcap.config import load_config
from hiros_mcap.evaluate.logs import read_channel
from hiros_mcap.frames import Block, frames_of
from hiros_mcap.running.pipeline import process
from hiros_mcap.simulate import simulate
from hiros_mcap.simulate.body_model import SLOT, SYMMETRY
from hiros_mcap.simulate.motion import Person
from hiros_mcap.simulate.simulation import Simulation
from hiros_mcap.skeletons import Floats, Frame, SkeletonModel, nearest_stamps
from hiros_mcap.stages.known_cameras import KnownCameras
from hiros_mcap.systems import Run, system

VOTE = ("sides.over_time=false",)
WAYS: dict[str, tuple[str, tuple[str, ...]]] = {
    "vote": ("hiros", VOTE),
    "over time": ("hiros", ()),
    "vote, causal": ("hiros-realtime", VOTE),
    "causal": ("hiros-realtime", ()),
}
"""Name -> system and assignments."""
NEAR = 20_000_000
"""ns: views that are farther apart do not count as simultaneous."""


def result_of(
    log: Path, way: str, channel: str = "/hiros/filtered"
) -> tuple[list[Frame], SkeletonModel]:
    """Process a log, and return a channel of the result."""
    system, overrides = WAYS[way]
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "out.mcap"
        process(log, out, config=load_config(None, overrides, system=system))
        return read_channel(out, channel)[:2]


def clear_directions(log: Path) -> tuple[np.ndarray, Floats]:
    """Times, ns, and ways (N, 3) in which somebody walks where exactly one of two cameras that
    contradict each other fits."""
    frames, model = result_of(log, "over time", "/hiros/tracked")
    cameras: dict[str, list[Frame]] = {}
    for frame in frames:
        cameras.setdefault(frame.source, []).append(frame)
    tracks = [track for own in cameras.values() for track in facing_tracks(own, model)]
    stamps, ways = [np.zeros(0, np.int64)], [np.zeros((0, 3))]
    for k, a in enumerate(tracks):
        for b in tracks[k + 1 :]:
            near = nearest_stamps(b.stamps, a.stamps)
            close = np.abs(b.stamps[near] - a.stamps) <= NEAR
            contradict = (a.facing * b.facing[near]).sum(axis=1) < 0
            speed, along = a.along()
            chosen = close & contradict & (speed > WALKING)
            unit = a.velocity / np.linalg.norm(a.velocity, axis=1, keepdims=True)
            other = (unit * b.facing[near]).sum(axis=1)
            chosen &= along * other < 0
            stamps.append(a.stamps[chosen])
            ways.append(unit[chosen])
    return np.concatenate(stamps), np.concatenate(ways)


def right_of(tracks: Sequence[FacingTrack], stamps: np.ndarray, ways: Floats) -> tuple[int, int]:
    """How many of the ways the result faces, of how many it has a facing at that time."""
    right = total = 0
    for track in tracks:
        near = nearest_stamps(track.stamps, stamps)
        facing = track.facing[near]
        known = (np.abs(track.stamps[near] - stamps) <= 2 * NEAR) & ~np.isnan(facing[:, 0])
        total += int(known.sum())
        right += int(((facing * ways).sum(axis=1)[known] > 0).sum())
    return right, total


def real(logs: Iterable[Path]) -> None:
    """Print the table of real logs."""
    print(f"{'log':40} {'':13} walking forwards backwards  clear right   share jumps")
    sums: dict[str, Floats] = {}
    for log in logs:
        stamps, ways = clear_directions(log)
        for way in WAYS:
            frames, model = result_of(log, way)
            tracks, scores = facing_tracks(frames, model), side_scores(frames, model)
            forwards = sum(
                int(((t.along()[0] > WALKING) & (t.along()[1] > ALONG)).sum()) for t in tracks
            )
            right, clear = right_of(tracks, stamps, ways)
            numbers = np.array(
                [scores.walking, forwards, scores.backwards, clear, right, scores.jumps]
            )
            sums[way] = sums.get(way, np.zeros(6)) + numbers
            print(row(log.stem, way, numbers))
    for way, numbers in sums.items():
        print(row("all", way, numbers))


def row(name: str, way: str, numbers: Floats) -> str:
    """One line of the table of real logs."""
    walking, forwards, backwards, clear, right, jumps = (float(n) for n in numbers)
    n, m = max(walking, 1), max(clear, 1)
    return (
        f"{name[:40]:40} {way:13} {walking:7.0f} {forwards / n:8.3f} {backwards / n:9.3f} "
        f"{clear:6.0f} {right:5.0f} {right / m:7.3f} {jumps:5.0f}"
    )


# Simulated logs.


class Backwards:
    """Somebody who walks backwards from 6 s to 9 s: time runs backwards there."""

    def __init__(self, person: Person) -> None:
        self._person = person

    def pose(self, t: Floats) -> tuple[Floats, Floats]:
        """See Person.pose."""
        return self._person.pose(np.where(t < 6, t, np.where(t < 9, 12 - t, t - 6)))


def mirrored(frame: Frame, *, toes: bool) -> Frame:
    """Return what a detector reports that assumes that everybody faces it: swapped labels, and
    ``toes`` that point at the camera, bends a quarter as large."""
    out = frame.replace(markers=frame.markers.copy())
    for row, markers in enumerate(out.positions):
        left, right = SLOT["HIP_LEFT"], SLOT["HIP_RIGHT"]
        if not markers[right, 0] > markers[left, 0]:  # x points to the right in the picture
            continue
        out.markers[row] = out.markers[row, SYMMETRY.mirror]
        for side in ("LEFT", "RIGHT") if toes else ():
            ankle, foot = markers[SLOT[f"ANKLE_{side}"]], markers[SLOT[f"FOOT_{side}"]]
            foot[[0, 2]] = 2 * ankle[[0, 2]] - foot[[0, 2]]
    for side in ("LEFT", "RIGHT") if toes else ():
        for chain in (("HIP", "KNEE", "ANKLE"), ("SHOULDER", "ELBOW", "WRIST")):
            a, joint, b = (SLOT[f"{name}_{side}"] for name in chain)
            for markers in out.positions:
                line = markers[b] - markers[a]
                foot_point = markers[a] + line * ((markers[joint] - markers[a]) @ line) / (
                    line @ line
                )
                markers[joint] = foot_point + (markers[joint] - foot_point) / 4
    return out


SCENES: dict[str, tuple[dict[str, object], str]] = {
    "two cameras, mirrored from behind": ({"cameras": 2, "flips": 0.0}, "labels"),
    "the same with toes and bends": ({"cameras": 2, "flips": 0.0}, "toes"),
    "three seconds backwards, 2 cameras": ({"cameras": 2}, "backwards"),
    "three seconds backwards, 5 cameras": ({"cameras": 5}, "backwards"),
    "honest, 2 cameras": ({"cameras": 2}, ""),
    "honest, 3 people, 4 cameras": ({"cameras": 4, "people": 3}, ""),
    "honest, 3 x the flips": ({"cameras": 3, "flips": 3.0}, ""),
    "one camera, 3 x the flips": ({"cameras": 1, "flips": 3.0}, ""),
}


def scene(name: str, seed: int) -> tuple[Simulation, list[Frame]]:
    """Simulate; return the simulation, and its detections in the frame "world"."""
    settings, change = SCENES[name]
    simulation = simulate(params_of(seed, **{"seconds": 15.0, **settings}))
    if change == "backwards":
        simulation.__dict__["people"] = [Backwards(person) for person in simulation.people]
    tree = TransformTree()
    for camera, pose in simulation.transforms.items():
        x, y, z = pose.translation
        tree.add(Transform(0, "world", camera, (x, y, z), tuple(pose.xyzw)), static=True)
    frames = simulation.detections
    if change in ("labels", "toes"):
        frames = (mirrored(frame, toes=change == "toes") for frame in frames)
    return simulation, list(transform_to_fixed(frames, tree, "world"))


def score(simulation: Simulation, frames: Sequence[Frame], way: str, change: str) -> Floats:
    """Frames of the result, those that face as the truth does, and the sum of errors, mm."""
    system_name, overrides = WAYS[way]
    config = load_config(None, overrides, system=system_name)
    places = {name: pose.translation for name, pose in simulation.transforms.items()}
    run = Run(
        simulation.model,
        config,
        known=KnownCameras(places),
        fixed_frame="world",
        system=system_name,
    )
    blocks: Iterable[Block] = map(Block.of, frames)
    for stage in system(system_name).stages(run).values():
        blocks = stage(blocks)
    results = list(frames_of(blocks))
    total, right, error, matched = 0, 0, 0.0, 0
    for result in results:
        (truth,) = simulation.truth_at(np.array([result.stamp]))
        seconds = (result.stamp - simulation.params.start) * 1e-9
        counts = change != "backwards" or 6 <= seconds <= 9
        for row in range(result.n_people):
            gaps = np.nanmean(
                np.linalg.norm(truth.positions - result.positions[row], axis=2), axis=1
            )
            nearest_one = int(np.argmin(gaps))
            error, matched = error + 1000 * float(gaps[nearest_one]), matched + 1
            ways = [across(p) for p in (truth.positions[nearest_one], result.positions[row])]
            total += counts
            right += counts and bool(ways[0] @ ways[1] > 0)
    return np.array([total, right, error, matched])


def across(markers: Floats) -> Floats:
    """Horizontal vector from left to right."""
    pairs = SYMMETRY.lateral
    return np.nansum(markers[pairs[:, 1], :2] - markers[pairs[:, 0], :2], axis=0)


def simulated(seeds: Sequence[int]) -> None:
    """Print the table of simulated logs."""
    print(f"{'scene':36} {'':13} frames   right  error, mm")
    for name, (_, change) in SCENES.items():
        sums = {way: np.zeros(4) for way in WAYS}
        for seed in seeds:
            simulation, frames = scene(name, seed)
            for way in WAYS:
                sums[way] += score(simulation, frames, way, change)
        for way, (total, right, error, matched) in sums.items():
            share, mean = right / max(total, 1), error / max(matched, 1)
            print(f"{name:36} {way:13} {total:6.0f} {share:7.4f} {mean:10.2f}", flush=True)


def main() -> None:
    given = use_detector(sys.argv[1:])
    logs = [Path(argument) for argument in given if not argument.startswith("--")]
    if logs:
        real(logs)
    else:
        simulated([1] if "--quick" in sys.argv else [1, 2, 3])


if __name__ == "__main__":
    main()
