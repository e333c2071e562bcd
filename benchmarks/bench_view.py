"""How long it takes to draw a log: 4 people, 5 cameras at 30 Hz, all stages.

python benchmarks/bench_view.py [SECONDS]
"""

from __future__ import annotations

import resource
import sys
import tempfile
import time
from pathlib import Path

from hiros_mcap.running.pipeline import process
from hiros_mcap.simulate import SimulateParams
from hiros_mcap.simulate.write_log import write_log
from hiros_viewer.destinations import new_recording
from hiros_viewer.replay import replay
from hiros_viewer.scene import Scene


def main() -> None:
    seconds = float(sys.argv[1]) if len(sys.argv) > 1 else 60.0
    with tempfile.TemporaryDirectory() as folder:
        log, out, target = (Path(folder) / name for name in ("log.mcap", "out.mcap", "a.rrd"))
        write_log(log, SimulateParams(people=4, seconds=seconds, seed=1))
        process(log, out)
        spent = [0.0]
        flush = Scene.flush

        def timed(scene: Scene) -> None:
            start = time.process_time()
            flush(scene)
            spent[0] += time.process_time() - start

        Scene.flush = timed  # type: ignore[method-assign]
        recording = new_recording("bench")
        recording.save(target)
        start, cpu = time.perf_counter(), time.process_time()
        replay([out], recording)
        recording.disconnect()
        wall, cpu = time.perf_counter() - start, time.process_time() - cpu
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
        print(
            f"{seconds:g} s of log: {wall:.2f} s wall, {cpu:.2f} s CPU, of which sending columns "
            f"{spent[0]:.2f} s; {target.stat().st_size / 1e6:.1f} MB; peak memory {peak:.0f} MB "
            "(with the simulator)"
        )


if __name__ == "__main__":
    main()
