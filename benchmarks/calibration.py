"""Poses and clocks found from the people in a log, against the true ones.

python benchmarks/calibration.py                accuracy, standard errors and time
python benchmarks/calibration.py hostile        scenes that must not give a wrong pose silently
python benchmarks/calibration.py LOG ...        real logs without their transforms: halves
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hiros_mcap.body.rotations import Rigid, angle
from hiros_mcap.calibrate.people import PeopleCalibration, calibrate_people
from hiros_mcap.io.channels import add_skeleton_channel
from hiros_mcap.io.codec import Encoder
from hiros_mcap.io.container import McapWriter
from hiros_mcap.io.log import open_log
from hiros_mcap.simulate import SimulateParams, simulate
from hiros_mcap.skeletons import Frame, SkeletonModel

WRONG_DEG, WRONG_M, WRONG_S = 3.0, 0.15, 0.1
"""A pose or clock that is further off and passes for good is silently wrong."""


@dataclass(frozen=True)
class Scene:
    """What cameras see, and where they stand, by the cameras' names."""

    model: SkeletonModel
    frames: list[Frame]
    poses: Mapping[str, Rigid]
    clocks: Mapping[str, float]
    """s that the stamps of each camera are too late."""

    def write(self, path: Path) -> None:
        """Write a log without transforms."""
        encoder = Encoder(self.model)
        with McapWriter(path) as writer:
            channels: dict[str, int] = {}
            for frame in sorted(self.frames, key=lambda frame: frame.log_time):
                if frame.source not in channels:
                    channels[frame.source] = add_skeleton_channel(writer, f"/{frame.source}/people")
                writer.write(channels[frame.source], frame.log_time, encoder.encode(frame))
            writer.commit()


def simulated(seed: int, *, shift: float = 2.0, **params: object) -> Scene:
    """Simulate a scene whose cameras' clocks are wrong by up to ``shift`` s; log times as well."""
    simulation = simulate(SimulateParams.model_validate({"seed": seed, **params}))
    rng = np.random.default_rng(seed)
    clocks = {camera.name: rng.uniform(-shift, shift) for camera in simulation.cameras}
    frames = [late(frame, clocks[frame.source]) for frame in simulation.detections]
    poses = {camera.name: camera.pose for camera in simulation.cameras}
    return Scene(simulation.model, frames, poses, clocks)


def late(frame: Frame, seconds: float) -> Frame:
    ns = round(1e9 * seconds)
    return frame.replace(
        stamp=frame.stamp + ns, log_time=frame.log_time + ns, stamps=frame.stamps + ns
    )


def calibrated(scene: Scene) -> tuple[PeopleCalibration, float]:
    """Calibrate a scene, and return how long it took, s."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "scene.mcap"
        scene.write(path)
        start = time.perf_counter()
        with open_log(path) as log:
            found = calibrate_people(log)
        return found, time.perf_counter() - start


@dataclass(frozen=True)
class Error:
    """Of one camera in the frame and time of another."""

    degrees: float
    metres: float
    seconds: float
    claimed: tuple[float, float, float]
    """Standard errors of the same; NaN between cameras of which none is the first."""


def errors_of(scene: Scene, found: PeopleCalibration) -> Iterator[Error]:
    """Yield the errors of all pairs of cameras with a pose."""
    known = [c for c in found.cameras if c.pose is not None and c.verdict != "impossible"]
    for i, one in enumerate(known):
        for other in known[i + 1 :]:
            got = one.pose.inverse() @ other.pose
            true = scene.poses[one.name].inverse() @ scene.poses[other.name]
            lag = other.clock_s - one.clock_s
            wanted = scene.clocks[one.name] - scene.clocks[other.name]
            first = i == 0
            claimed = (other.error_deg, other.error_mm / 1000, other.error_ms / 1000)
            yield Error(
                float(np.degrees(angle(got.xyzw, true.xyzw))),
                float(np.linalg.norm(got.translation - true.translation)),
                abs(lag - wanted),
                claimed if first else (np.nan,) * 3,
            )


def accuracy(name: str, seeds: Sequence[int], **params: object) -> None:
    """Print the errors, what was claimed, and the time of some scenes of one kind."""
    rows, seconds, verdicts = [], [], []
    for seed in seeds:
        scene = simulated(seed, **params)
        found, took = calibrated(scene)
        rows.append(list(errors_of(scene, found)))
        seconds.append(took)
        verdicts.append(found.verdict)
    every = [error for row in rows for error in row]
    if not every:
        print(f"{name:34} nothing found: {verdicts}")
        return
    table = np.array([(e.degrees, 100 * e.metres, 1000 * e.seconds) for e in every])
    claims = np.array([e.claimed for e in every]) * [1, 100, 1000]
    within = [
        np.mean(table[~np.isnan(claims[:, k]), k] <= 2 * claims[~np.isnan(claims[:, k]), k])
        for k in range(3)
    ]
    median, worst = np.nanmedian(table, axis=0), np.nanmax(table, axis=0)
    print(
        f"{name:34} median {median[0]:.2f} deg {median[1]:.1f} cm {median[2]:.1f} ms  "
        f"worst {worst[0]:.2f} {worst[1]:.1f} {worst[2]:.1f}  within 2 SE "
        f"{within[0]:.0%} {within[1]:.0%} {within[2]:.0%}  {np.median(seconds):.1f} s  "
        f"{ {v: verdicts.count(v) for v in sorted(set(verdicts))} }",
        flush=True,
    )


def main() -> None:
    seeds = range(5)
    accuracy("2 people, 5 cameras, 30 s", seeds, people=2, cameras=5, seconds=30.0)
    accuracy("1 walker, 2 cameras, 10 s", range(10), people=1, cameras=2, seconds=10.0)
    accuracy("the same with many flips", range(10), people=1, cameras=2, seconds=10.0, flips=20.0)
    accuracy("4 people, 5 cameras, 15 s", range(3), people=4, cameras=5, seconds=15.0)
    accuracy(
        "2 people crossing, 3 cameras, 15 s",
        seeds,
        people=2,
        cameras=3,
        seconds=15.0,
        action="cross",
    )
    accuracy("1 walker, 5 cameras, 30 s", seeds, people=1, cameras=5, seconds=30.0)


if __name__ == "__main__":
    main()
