"""End-to-end speed: a simulated log of 4 people, 5 cameras at 30 Hz, zstd in and out.

    python benchmarks/throughput.py [SECONDS [PEOPLE [CAMERAS]]]

Prints times real time, CPU per merged frame of each step, the size of the output and how much of it
is copied input, and peak memory. The log stays in the temporary folder for the next time. The first
run of a process also loads the compiled kernels.
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import resource
import sys
import tempfile
import time
from pathlib import Path

from hiros_mcap.running.pipeline import process
from hiros_mcap.simulate import SimulateParams
from hiros_mcap.simulate.write_log import write_log


def main() -> None:
    seconds, people, cameras = (float(sys.argv[1]) if len(sys.argv) > 1 else 60.0, 4, 5)
    if len(sys.argv) > 2:
        people = int(sys.argv[2])
    if len(sys.argv) > 3:
        cameras = int(sys.argv[3])
    folder = Path(tempfile.gettempdir())
    log = folder / f"hiros-throughput-{people}x{cameras}-{seconds:g}s.mcap"
    if not log.exists():
        params = SimulateParams(people=people, cameras=cameras, seconds=seconds, seed=1)
        write_log(log, params)
        print("wrote", log, "- run again: memory now includes the simulator")
    print(f"{people} people, {cameras} cameras, {seconds:g} s, {log.stat().st_size / 1e6:.1f} MB")
    for _ in range(3):
        with tempfile.TemporaryDirectory() as out:
            wall, cpu = time.perf_counter(), time.process_time()
            summary = process(log, Path(out) / "out.mcap")
            wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
            size = (Path(out) / "out.mcap").stat().st_size / 1e6
        frames = summary.written["/hiros/merged"]
        print(
            f"\nwall {wall:.2f} s, CPU {cpu:.2f} s (all threads), "
            f"{summary.log_s / wall:.1f} times real time, "
            f"output {size:.0f} MB, {log.stat().st_size / 1e6:.0f} MB of it copied, "
            f"peak memory {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024:.0f} MB"
        )
        for stage in summary.stages:
            per_frame = stage.cpu_s / frames * 1000
            print(
                f"  {stage.name:10} {stage.cpu_s:6.3f} s CPU  {per_frame:6.3f} ms per merged frame"
            )
        fusing = sum(s.cpu_s for s in summary.stages if s.name not in ("read", "write"))
        print(f"  tracker to filter {fusing / frames * 1000:.3f} ms per merged frame")


if __name__ == "__main__":
    main()
