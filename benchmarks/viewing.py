"""How long it takes until a long log is seen, and until all of it is drawn.

::

    python benchmarks/viewing.py [--minutes 60] [--people 2] [--cameras 3]

A minute is simulated and processed, and its messages are repeated. The log is drawn into a file by
the code that draws into a window. What is seen first are the first seconds: the layout is sent
after them, and the rest follows.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from hiros_mcap.frames import Block
from hiros_mcap.io.channels import add_skeleton_channel
from hiros_mcap.io.codec import Encoder
from hiros_mcap.io.container import McapWriter
from hiros_mcap.io.log import open_log
from hiros_mcap.running.pipeline import process
from hiros_mcap.simulate import SimulateParams
from hiros_mcap.simulate.write_log import write_log
from hiros_viewer.destinations import new_recording
from hiros_viewer.replay import replay

MINUTE_NS = 60_000_000_000


def main() -> None:
    """Make a log, and draw it in a process of its own."""
    parser = argparse.ArgumentParser(description=__doc__)
    for name, default in (("minutes", 60), ("people", 2), ("cameras", 3)):
        parser.add_argument(f"--{name}", type=int, default=default)
    parser.add_argument("--draw", type=Path, help=argparse.SUPPRESS)
    asked = parser.parse_args()
    if asked.draw:
        draw(asked.draw)
        return
    with tempfile.TemporaryDirectory() as folder:
        log, out, long = (Path(folder) / name for name in ("log.mcap", "out.mcap", "long.mcap"))
        write_log(
            log, SimulateParams(people=asked.people, cameras=asked.cameras, seconds=60.0, seed=1)
        )
        process(log, out)
        repeat(out, long, asked.minutes)
        size = long.stat().st_size / 1e6
        print(
            f"{asked.minutes} min, {asked.people} people, {asked.cameras} cameras, {size:.0f} MB",
            flush=True,
        )
        command = [sys.executable, __file__, "--draw", str(long)]
        subprocess.run(command, check=True)


def repeat(minute: Path, target: Path, minutes: int) -> None:
    """Write a minute again and again; detections move to the fixed frame."""
    with open_log(minute, topics=["*"], output_prefix="/none") as log, McapWriter(target) as writer:
        encoder = Encoder(log.model)
        frames = [f for f in log.detections_by_topic() if not f[0].startswith("/truth")]
        channels = {topic: add_skeleton_channel(writer, topic) for topic, _ in frames}
        for k in range(minutes):
            for topic, frame in frames:
                block = Block.of(frame)
                (moved,) = block.restamped(block.stamps + k * MINUTE_NS).frames()
                when = frame.log_time + k * MINUTE_NS
                writer.write(channels[topic], when, encoder.encode(moved))
        writer.commit()


def draw(log: Path) -> None:
    """Draw the log and print how long it took."""
    import resource

    target = log.with_suffix(".rrd")
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
        f"first picture after {laid_out[0]:.1f} s, all of it after {whole:.1f} s "
        f"({time.process_time():.1f} s of CPU); {target.stat().st_size / 1e6:.0f} MB for the "
        f"viewer; peak memory {peak:.0f} MB"
    )


if __name__ == "__main__":
    main()
