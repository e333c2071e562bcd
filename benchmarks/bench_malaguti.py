"""Malaguti's system: CPU time per camera message, association, filter and limb lengths.

    python benchmarks/bench_malaguti.py [SECONDS]

The paper: 13.4 ms per frame and person (Table II).
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import sys
import time
from collections.abc import Iterator

from hiros_mcap.body.transforms import Transform, TransformTree, transform_to_fixed
from hiros_mcap.simulate import SimulateParams, simulate
from hiros_mcap.skeletons import Frame
from hiros_mcap.stages.malaguti.associate import associate
from hiros_mcap.stages.malaguti.kalman import kalman
from hiros_mcap.stages.malaguti.straighten import straighten


def detections(people: int, seconds: float) -> tuple[list[Frame], object]:
    simulation = simulate(SimulateParams(people=people, seconds=seconds, seed=people))
    tree = TransformTree()
    for camera, pose in simulation.transforms.items():
        x, y, z = pose.translation
        tree.add(Transform(0, "world", camera, (x, y, z), tuple(pose.xyzw)), static=True)
    frames = (f.replace(stamp=f.stamp) for f in simulation.detections)
    return list(transform_to_fixed(frames, tree, "world")), simulation.model


def cost(stage: Iterator[Frame]) -> tuple[list[Frame], float]:
    start = time.process_time()
    result = list(stage)
    return result, time.process_time() - start


def main() -> None:
    seconds = float(sys.argv[1]) if len(sys.argv) > 1 else 10.0
    print("people  messages  associate  kalman  straighten     sum, ms per message; least of 5")
    for people in (1, 2, 4, 6):
        frames, model = detections(people, seconds)
        best = [float("inf")] * 3
        for _ in range(5):
            tracked, a = cost(associate(frames, model))  # type: ignore[arg-type]
            fused, b = cost(kalman(tracked, model))  # type: ignore[arg-type]
            _, c = cost(straighten(fused, model))  # type: ignore[arg-type]
            best = [min(old, new) for old, new in zip(best, (a, b, c), strict=True)]
        each = [1000 * t / len(frames) for t in best]
        print(
            f"{people:6} {len(frames):9} {each[0]:10.3f} {each[1]:7.3f} {each[2]:11.3f} "
            f"{sum(each):7.3f}"
        )


if __name__ == "__main__":
    main()
