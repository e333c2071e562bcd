"""How long after its last needed message a result leaves ``hiros process - -o -``.

    python benchmarks/live.py [SECONDS [PEOPLE [CAMERAS]]]

Simulates a log, feeds it to the program through a pipe at the speed at which it was recorded, and
takes the time at which each result comes out of the other pipe. The log time of a result is that of
the last message that it needed; when that message was sent is known. Prints quantiles of the delay
for every channel, and the share of one core that the program takes.

Only the delay counts here, so the simulated detector is the ideal one.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import threading
import time
from collections import defaultdict
from pathlib import Path

import numpy as np
from mcap.records import Channel, Message
from mcap.stream_reader import StreamReader

from hiros_mcap.io.container import McapReader
from hiros_mcap.io.container.file import Pipe
from hiros_mcap.io.container.writer import LiveWriter
from hiros_mcap.simulate import SimulateParams
from hiros_mcap.simulate.simulation import write_log

_WARM_UP = 3.0  # s: the program listens, and catches up


def main() -> None:
    given = [float(text) for text in sys.argv[1:]] + [30.0, 4, 5][len(sys.argv) - 1 :]
    seconds, people, cameras = given[0], int(given[1]), int(given[2])
    log = Path(tempfile.gettempdir()) / f"hiros-live-{people}x{cameras}-{seconds:g}s.mcap"
    if not log.exists():
        write_log(log, SimulateParams(people=people, cameras=cameras, seconds=seconds, seed=1))
    command = [sys.executable, "-m", "hiros_cli", "process", "-", "-o", "-", "-q"]
    run = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    sent: dict[int, float] = {}
    cpu: list[tuple[float, float]] = []
    feeder = threading.Thread(target=feed, args=(log, run, sent, cpu))
    feeder.start()
    taken = take(run.stdout)
    feeder.join()
    begin = min(sent) + int(_WARM_UP * 1e9)
    print(
        f"{people} people, {cameras} cameras, {seconds:g} s; delay in ms: median, 95 %, 99 %, most"
    )
    for topic, times in sorted(taken.items()):
        delays = [1e3 * (at - sent[t]) for t, at in times if t >= begin and t in sent]
        quantiles = np.quantile(delays, [0.5, 0.95, 0.99, 1])
        print(f"{topic:18} {len(delays):6} messages ", *(f"{q:7.1f}" for q in quantiles))

    (begin_s, before), (end_s, after) = cpu
    print(f"{100 * (after - before) / (end_s - begin_s):.0f} % of one core")


def feed(log: Path, run, sent: dict[int, float], cpu: list[tuple[float, float]]) -> None:
    """Write the messages when their log times come; note when, and the CPU time of the run."""
    pipe = run.stdin
    with McapReader(log) as reader, LiveWriter(Pipe(pipe.fileno(), "pipe")) as writer:
        ids = {i: writer.adopt(c, reader.schema(c)) for i, c in reader.channels.items()}
        begin, first = 0.0, 0
        for message in reader.messages():
            if not begin:
                begin, first = time.monotonic(), message.log_time
            time.sleep(max(0.0, begin + (message.log_time - first) / 1e9 - time.monotonic()))
            writer.write_message(ids[message.channel_id], message)
            writer.flush()
            sent[message.log_time] = time.monotonic()
            if not cpu and message.log_time - first > _WARM_UP * 1e9:
                cpu.append((time.monotonic(), cpu_of(run.pid)))
        cpu.append((time.monotonic(), cpu_of(run.pid)))
        writer.commit()
    pipe.close()


def cpu_of(process: int) -> float:
    """CPU time of a process so far, s."""
    fields = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
    return sum(map(int, fields[11:13])) / os.sysconf("SC_CLK_TCK")


def take(pipe) -> dict[str, list[tuple[int, float]]]:
    """Read results; return log time and time of arrival of each, by topic."""
    topics: dict[int, str] = {}
    found = defaultdict(list)
    for record in StreamReader(os.fdopen(pipe.fileno(), "rb")).records:
        if isinstance(record, Channel):
            topics[record.id] = record.topic
        elif isinstance(record, Message) and topics[record.channel_id].startswith("/hiros/"):
            found[topics[record.channel_id]].append((record.log_time, time.monotonic()))
    return found


if __name__ == "__main__":
    main()
