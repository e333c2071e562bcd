"""Clutter: one camera reports 300 skeletons in each of 60 messages of 2 s, at places of all kinds.

    python benchmarks/clutter.py [SKELETONS [CAMERAS]]

``standing`` are people 1 m apart, ``crowd`` as many within 3 m, ``storm`` anywhere on 60 m by 60 m,
elsewhere in every message. Prints wall and CPU time of the run, CPU of its steps, and the people
found. The first run of a process also loads the compiled kernels.

Only the time counts here, so there is no detector: the skeletons are made up.
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from hiros_mcap.io.channels import add_skeleton_channel
from hiros_mcap.io.codec import Encoder
from hiros_mcap.io.container import McapWriter
from hiros_mcap.running.pipeline import process
from hiros_mcap.simulate import SimulateParams, simulate
from hiros_mcap.skeletons import ORIENTATION, POSITION, Floats, Frame

START, STEP, MESSAGES = 1_700_000_000 * 10**9, 10**9 // 30, 60
KINDS = ("standing", "crowd", "storm")


def places(kind: str, n: int, rng: np.random.Generator) -> Floats:
    """Where (n, 3) skeletons stand in one message, m."""
    if kind == "standing":
        side = int(np.ceil(np.sqrt(n)))
        spots = np.stack(np.divmod(np.arange(n), side), axis=-1) + rng.normal(0, 0.02, (n, 2))
    elif kind == "crowd":
        spots = rng.normal(0, 1, (n, 2))
    else:
        spots = rng.uniform(0, 60, (n, 2))
    return np.pad(spots, ((0, 0), (0, 1)))


def write(path: Path, kind: str, n: int, cameras: int) -> None:
    """Write the log."""
    simulation = simulate(SimulateParams(people=1, cameras=1, seconds=1.0))
    body = next(frame for frame in simulation.truth if frame.n_people)
    rng, model = np.random.default_rng(0), simulation.model
    with McapWriter(path) as writer:
        channels = [add_skeleton_channel(writer, f"/camera_{k}/skeletons") for k in range(cameras)]
        encoder = Encoder(model)
        for step in range(MESSAGES):
            for camera, channel in enumerate(channels):
                stamp = START + step * STEP + camera * STEP // cameras
                frame = Frame.empty(
                    n, model, stamp=stamp, source=f"camera_{camera}", frame_id="world"
                )
                shift = places(kind, n, rng)[:, None]
                frame.markers[..., POSITION] = body.positions[0] + shift
                frame.markers[..., POSITION] += rng.normal(0, 0.01, frame.positions.shape)
                frame.links[..., ORIENTATION] = body.orientations[0]
                frame.marker_confidences[:] = frame.link_confidences[:] = 0.66
                frame.stamps[:] = stamp
                writer.write(channel, stamp, encoder.encode(frame))
        writer.commit()


def main() -> None:
    n = int(sys.argv[1]) if len(sys.argv) > 1 else 300
    cameras = int(sys.argv[2]) if len(sys.argv) > 2 else 1
    with tempfile.TemporaryDirectory() as folder:
        for kind in ("standing", *KINDS):  # the first one loads the kernels
            log = Path(folder) / f"{kind}.mcap"
            write(log, kind, n, cameras)
            wall, cpu = time.perf_counter(), time.process_time()
            summary = process(log, Path(folder) / "out.mcap", force=True)
            wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
            steps = ", ".join(f"{stage.name} {stage.cpu_s:.2f}" for stage in summary.stages)
            print(
                f"{kind:9} {n} skeletons, {cameras} cameras, {summary.log_s:.1f} s: "
                f"wall {wall:.2f} s, CPU {cpu:.2f} s ({steps}), {len(summary.people)} people"
            )


if __name__ == "__main__":
    main()
