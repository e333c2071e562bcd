"""How long it takes until a long log is seen, and until all of it is drawn.

::

    python benchmarks/viewing.py [--minutes 1 10 60] [--people 2] [--cameras 3]

A minute is simulated and processed, and its messages are repeated. The log is drawn into a file by
the code that draws into a window. What is seen first are the first seconds: the layout is sent
after them, and the rest follows.

Only the time counts here, so the simulated detector is the ideal one.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from hiros_mcap.frames import Block
from hiros_mcap.io.channels import add_skeleton_channel
from hiros_mcap.io.codec import Encoder
from hiros_mcap.io.container import McapWriter
from hiros_mcap.io.log import open_log
from hiros_mcap.running.pipeline import process
from hiros_mcap.simulate import SimulateParams
from hiros_mcap.simulate.simulation import write_log
from hiros_viewer.destinations import new_recording
from hiros_viewer.replay import replay

MINUTE_NS = 60_000_000_000
_TOGETHER = 64
"""Messages of a channel that are written at once."""


def main() -> None:
    """Make logs, and draw each in a process of its own."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--minutes", type=int, nargs="+", default=[1, 10, 60])
    for name, default in (("people", 2), ("cameras", 3)):
        parser.add_argument(f"--{name}", type=int, default=default)
    parser.add_argument("--folder", type=Path, help="Keep the logs there, and use them again.")
    parser.add_argument("--draw", type=Path, help=argparse.SUPPRESS)
    asked = parser.parse_args()
    if asked.draw:
        draw(asked.draw)
        return
    print(f"{asked.people} people, {asked.cameras} cameras")
    print("min | MB of log | first picture, s | all of it, s | CPU, s | memory, MB | MB of .rrd")
    with tempfile.TemporaryDirectory() as temporary:
        folder = asked.folder or Path(temporary)
        minute = folder / "minute.mcap"
        if not minute.exists():
            simulate(minute, asked.people, asked.cameras)
        for minutes in asked.minutes:
            log = folder / f"{minutes}min.mcap"
            if not log.exists():
                repeat(minute, log, minutes)
            print(f"{minutes:3} | {log.stat().st_size / 1e6:9.0f}", end=" | ", flush=True)
            subprocess.run([sys.executable, __file__, "--draw", str(log)], check=True)
            if not asked.folder:
                log.unlink()


def simulate(target: Path, people: int, cameras: int) -> None:
    """Simulate a minute and process it."""
    raw = target.with_suffix(".raw.mcap")
    write_log(raw, SimulateParams(people=people, cameras=cameras, seconds=60.0, seed=1))
    process(raw, target)
    raw.unlink()


def repeat(minute: Path, target: Path, minutes: int) -> None:
    """Write a minute again and again; detections move to the fixed frame."""
    with open_log(minute, topics=["*"], output_prefix="/none") as log, McapWriter(target) as writer:
        encoder = Encoder(log.model, precision="micrometre")
        parts = [part for both in log.read() for part in by_topic(*both)]
        parts = [part for part in parts if not part[0].startswith("/truth")]
        topics = dict.fromkeys(topic for topic, _ in parts)
        channels = {topic: add_skeleton_channel(writer, topic) for topic in topics}
        for k in range(minutes):
            for topic, block in parts:
                moved = block.restamped(block.stamps + k * MINUTE_NS)
                times = (block.log_times + k * MINUTE_NS).tolist()
                for time, message in zip(times, encoder.encode_block(moved), strict=True):
                    writer.write(channels[topic], time, message)
        writer.commit()


def by_topic(topics: tuple[str, ...], block: Block) -> list[tuple[str, Block]]:
    """Return the frames of a block as blocks of one topic each."""
    own = np.array(topics)
    found = []
    for topic in dict.fromkeys(topics):
        places = np.flatnonzero(own == topic).tolist()
        for first in range(0, len(places), _TOGETHER):
            some = places[first : first + _TOGETHER]
            found.append((topic, block.select(some, block.log_times[some].tolist())))
    return found


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
    size = target.stat().st_size / 1e6
    seconds = f"{laid_out[0]:16.1f} | {whole:12.1f} | {time.process_time():6.1f}"
    print(f"{seconds} | {peak:10.0f} | {size:.0f}")
    target.unlink()


if __name__ == "__main__":
    main()
