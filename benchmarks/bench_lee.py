"""CPU time of Lee's merger and Kalman filter per frame, 32 joints, 31 links, by people and cameras.

python benchmarks/bench_lee.py

The paper states 1 to 2 ms a frame for the merging of one person by four cameras (section 2.3). Each
number is the least of several runs: the machine is shared.

Only the time counts here, so the simulated detector is the ideal one.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Sequence

from hiros_mcap.body.transforms import Transform, TransformTree, transform_to_fixed
from hiros_mcap.frames import by_frame
from hiros_mcap.simulate import SimulateParams, simulate
from hiros_mcap.skeletons import Frame, SkeletonModel
from hiros_mcap.stages.lee.cluster import cluster_blocks
from hiros_mcap.stages.lee.lee_params import ClusterParams
from hiros_mcap.stages.lee.predict import predict
from hiros_mcap.stages.track.track import track_blocks

track = by_frame(track_blocks)
cluster = by_frame(cluster_blocks)

SECONDS, RUNS = 5.0, 7
AVERAGE = ClusterParams(rearrange="off", method="average")


def tracked(people: int, cameras: int) -> tuple[SkeletonModel, list[Frame]]:
    """Simulated detections with the tracker's ids, in the fixed frame."""
    simulation = simulate(SimulateParams(people=people, cameras=cameras, seconds=SECONDS, seed=4))
    tree = TransformTree()
    for camera, pose in simulation.transforms.items():
        x, y, z = pose.translation
        tree.add(Transform(0, "world", camera, (x, y, z), tuple(pose.xyzw)), static=True)
    places = {name: pose.translation for name, pose in simulation.transforms.items()}
    frames = transform_to_fixed(simulation.detections, tree, "world")
    return simulation.model, list(track(frames, simulation.model, cameras=places))


def cost(run: Callable[[], Iterable[Frame]]) -> tuple[float, Sequence[Frame]]:
    """Least CPU time, ms per frame that comes out, and the frames."""
    best = float("inf")
    for _ in range(RUNS):
        start = time.process_time()
        out = list(run())
        best = min(best, (time.process_time() - start) / len(out))
    return best * 1e3, out


def main() -> None:
    print("people x cameras   average   cluster    filter   ms CPU per frame")
    for people, cameras in ((1, 4), (1, 5), (2, 5), (4, 5), (4, 10), (10, 5)):
        model, frames = tracked(people, cameras)
        average, _ = cost(lambda m=model, f=frames: cluster(f, m, AVERAGE))
        merging, merged = cost(lambda m=model, f=frames: cluster(f, m))
        filtering, _ = cost(lambda m=model, f=merged: predict(f, m))
        print(f"{people:6} x {cameras:<9} {average:9.3f} {merging:9.3f} {filtering:9.3f}")


if __name__ == "__main__":
    main()
