"""Does hiros hold at sizes that nobody has? Many cameras, many people, high rates, long logs.

    python benchmarks/scale.py [--system NAME] [--only CASE] [--folder FOLDER]

Each case is two simulated logs: the second has twice the cameras, people or rate, or ten times the
length. A line for each log: its size, wall time, CPU of the user, peak memory and exit code of
`hiros process`, and the last line on stderr. "x" is by how much the CPU of the second grew beside
its bytes: 1 is linear. FOLDER keeps the logs for another time; they and the results take 9 GB.

People beyond ten are in rooms of ten that lie side by side. Every camera sees into all rooms.

Only the time counts here, so the simulated detector is the ideal one.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from multiprocessing import get_context
from pathlib import Path
from typing import NamedTuple

import numpy as np

from hiros_mcap.body.rotations import Rigid, conjugate, rotate
from hiros_mcap.io.channels import add_skeleton_channel, add_static_poses
from hiros_mcap.io.codec import Encoder
from hiros_mcap.io.container import McapWriter
from hiros_mcap.simulate import RigParams, SimulateParams, Simulation, simulate
from hiros_mcap.simulate.simulation import WORLD
from hiros_mcap.skeletons import Frame, People

ROOM = 10
"""People whom a simulation can have."""
DISTANCE = 6.0
"""m, from the middle of a room to that of the next."""


class Scene(NamedTuple):
    """The size of a log."""

    seconds: float
    rate: float
    cameras: int = 3
    people: int = 2


CASES = {
    "cameras": (Scene(20, 30, cameras=30), Scene(20, 30, cameras=60)),
    "people": (Scene(10, 10, people=150), Scene(10, 10, people=300)),
    "rate": (Scene(10, 1000), Scene(10, 2000)),
    "seconds": (Scene(3600, 5), Scene(36_000, 5)),
}
"""By the field of the scene that grows."""


class Run(NamedTuple):
    """Cost of `hiros process`, and how it ended."""

    wall: float
    cpu: float
    """s of the user."""
    memory: float
    """MB"""
    code: int
    last: str
    """The last line on stderr."""


def simulations(scene: Scene) -> list[Simulation]:
    """Return the rooms of a scene; their sizes are not checked as those of a user are."""
    rig: dict[str, object] = {"rate": scene.rate}
    faults: dict[str, object] = {"phantoms": 0.0}
    if scene.people > ROOM:
        # The cameras of all rooms stand alike, and fire at the same times.
        rig |= {"synchronised": True, "jitter": 0.0, "delay": (0.03, 0.03)}
        faults |= {"dropouts": 0.0, "calibration_error": 0.0}
    found: list[Simulation] = []
    for seed in range(-(-scene.people // ROOM)):
        sizes = {"people": min(ROOM, scene.people - seed * ROOM), "cameras": scene.cameras}
        sizes |= {"seconds": scene.seconds, "rig": RigParams().model_copy(update=rig)}
        found.append(simulate(SimulateParams(seed=seed).model_copy(update=sizes | faults)))
        poses = [(*camera.pose.translation, *camera.pose.xyzw) for camera in found[0].cameras]
        rig["poses"] = tuple(poses)
    return found


def shifted(frame: Frame, room: int, pose: Rigid) -> Frame:
    """Return a camera's message, with the people where their room lies."""
    place = DISTANCE * np.array([room % 6, room // 6, 0.0])
    moved = frame.replace(people=frame.people.copy())
    moved.positions[:] += rotate(conjugate(pose.xyzw), place)
    return moved


def messages(rooms: list[Simulation]) -> Iterator[Frame]:
    """Yield the messages of a scene, with the people of all rooms."""
    poses = {camera.name: camera.pose for camera in rooms[0].cameras}
    for views in zip(*(room.detections for room in rooms), strict=True):
        people = [shifted(view, k, poses[view.source]).people for k, view in enumerate(views)]
        columns = zip(*people, strict=True)
        yield views[0].replace(people=People(*(np.concatenate(column) for column in columns)))


def write(path: Path, scene: Scene) -> None:
    """Write a log without the truth."""
    rooms = simulations(scene)
    encoder = Encoder(rooms[0].model)
    with McapWriter(path) as writer:
        add_static_poses(writer, rooms[0].transforms, WORLD, rooms[0].params.start)
        names = [camera.name for camera in rooms[0].cameras]
        channels = {name: add_skeleton_channel(writer, f"/{name}/skeletons") for name in names}
        for frame in messages(rooms):
            writer.write(channels[frame.source], frame.log_time, encoder.encode(frame))
        writer.commit()


def process(log: Path, target: Path, system: str) -> Run:
    """Run `hiros process` in a process of its own."""
    command = [sys.executable, "-m", "hiros_cli", "process", log, "-o", target, "-f", "-q"]
    began = time.perf_counter()
    with tempfile.TemporaryFile("w+") as errors:
        run = subprocess.Popen([*command, "--system", system], stderr=errors)
        _, status, used = os.wait4(run.pid, 0)
        run.returncode = os.waitstatus_to_exitcode(status)
        errors.seek(0)
        last = ["", *errors.read().splitlines()][-1]
    wall = time.perf_counter() - began
    return Run(wall, used.ru_utime, used.ru_maxrss / 1024, run.returncode, last)


def main() -> None:
    """Print a line for each log."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--system", default="fuse")
    parser.add_argument("--only", choices=CASES, help="one case")
    parser.add_argument("--folder", type=Path, help="where logs are kept")
    given = parser.parse_args()
    print(
        f"{'case':8} {'size':>5} {'log MB':>6} {'wall s':>6} {'CPU s':>6} {'MB':>5} exit    x  said"
    )
    with tempfile.TemporaryDirectory() as temporary:
        folder = given.folder or Path(temporary)
        for case in [given.only] if given.only else CASES:
            before: tuple[int, Run] | None = None
            for scene in CASES[case]:
                log = folder / f"{case}-{'-'.join(map(str, scene))}.mcap"
                if not log.exists():  # elsewhere: a child's peak begins with that of its parent
                    maker = get_context("spawn").Process(target=write, args=(log, scene))
                    maker.start()
                    maker.join()
                size, run = log.stat().st_size, process(log, folder / "out.mcap", given.system)
                grown = ""
                if before:
                    grown = f"{run.cpu / before[1].cpu / (size / before[0]):.2f}"
                before = size, run
                print(
                    f"{case:8} {getattr(scene, case):5d} {size / 1e6:6.0f} {run.wall:6.1f} "
                    f"{run.cpu:6.1f} {run.memory:5.0f} {run.code:4d} {grown:>4}  {run.last}",
                    flush=True,
                )


if __name__ == "__main__":
    main()
