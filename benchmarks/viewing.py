"""How long it takes until a long log is seen, and until all of it is drawn.

::

    python benchmarks/viewing.py [--minutes 60] [--people 2] [--cameras 3]

The log is simulated, processed, and drawn into a file by the code that draws into a window. What
is seen first are the first seconds: the layout is sent after them, and the rest follows.
"""

from __future__ import annotations

import argparse
import resource
import tempfile
import time
from pathlib import Path

from hiros_mcap.running.pipeline import process
from hiros_mcap.simulate import SimulateParams
from hiros_mcap.simulate.write_log import write_log
from hiros_viewer.destinations import new_recording
from hiros_viewer.replay import replay


def main() -> None:
    """Simulate, process, draw, print."""
    parser = argparse.ArgumentParser(description=__doc__)
    for name, default in (("minutes", 60), ("people", 2), ("cameras", 3)):
        parser.add_argument(f"--{name}", type=int, default=default)
    asked = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        log, out = Path(folder) / "log.mcap", Path(folder) / "out.mcap"
        write_log(
            log,
            SimulateParams(
                people=asked.people, cameras=asked.cameras, seconds=60.0 * asked.minutes, seed=1
            ),
        )
        process(log, out)
        size = out.stat().st_size / 1e6
        print(f"{asked.minutes} min, {asked.people} people, {asked.cameras} cameras, {size:.0f} MB")
        draw(out, Path(folder) / "drawn.rrd")


def draw(log: Path, target: Path) -> None:
    """Draw the log and print how long it took."""
    recording = new_recording("benchmark")
    recording.save(target)
    laid_out: list[float] = []
    send = recording.send_blueprint
    start = time.perf_counter()

    def timed(*arguments: object, **named: object) -> None:
        laid_out.append(time.perf_counter() - start)
        send(*arguments, **named)  # type: ignore[arg-type]

    recording.send_blueprint = timed  # type: ignore[method-assign]
    replay([log], recording)
    recording.disconnect()
    whole = time.perf_counter() - start
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(
        f"first picture after {laid_out[0]:.1f} s, all of it after {whole:.1f} s; "
        f"{target.stat().st_size / 1e6:.0f} MB for the viewer; "
        f"peak memory {peak:.0f} MB (with the simulator)"
    )


if __name__ == "__main__":
    main()
