"""A long live run, faster than real time: memory, lost messages, ids.

    python benchmarks/soak.py [MINUTES [SPEED [PEOPLE [CAMERAS [RATE]]]]]

Simulates a minute of people who walk about, and feeds it to ``hiros process - -o -`` again and
again, with times that go on: forwards, then backwards, so that nobody jumps. A program that is
slower than SPEED holds the input up. Prints for each minute of input how long it took, s, how far
the results are behind what was sent, s, the memory of the program, MB, and how many results each id
has; at the end, how many messages were sent, how many came back, and how many were lost on the way:
sent, but not copied; and sent, but not tracked.

Only delay, memory and losses count here, so the simulated detector is the ideal one.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import threading
import time
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path

from mcap.records import Channel, Message
from mcap.stream_reader import StreamReader

from hiros_mcap.io.channels import TF_TOPICS
from hiros_mcap.io.codec import Decoder, Encoder
from hiros_mcap.io.container.file import Pipe
from hiros_mcap.io.container.writer import LiveWriter
from hiros_mcap.io.log import open_log
from hiros_mcap.simulate import RigParams, SimulateParams
from hiros_mcap.simulate.body_model import MODEL
from hiros_mcap.simulate.simulation import write_log

SECOND = 10**9
MINUTE = 60 * SECOND
"""ns"""
RESULTS = "/hiros/filtered"


def main() -> None:
    given = [float(text) for text in sys.argv[1:]] + [30.0, 10.0, 2, 4, 30.0][len(sys.argv) - 1 :]
    minutes, speed, people, cameras, rate = int(given[0]), given[1], *map(int, given[2:4]), given[4]
    log = Path(tempfile.gettempdir()) / f"hiros-soak-{people}x{cameras}-{rate:g}.mcap"
    if not log.exists():
        rig = RigParams(rate=rate)
        params = SimulateParams(people=people, cameras=cameras, seconds=60.0, seed=1, rig=rig)
        write_log(log, params)
    command = [sys.executable, "-m", "hiros_cli", "process", "-", "-o", "-"]
    run = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    feeder = Feeder(log, run.stdin, minutes, speed)
    feeder.start()
    print(f"{minutes} min of {people} people and {cameras} cameras at {speed:g} times the speed")
    print(f"{'minute':>6} {'took':>6} {'behind':>6} {'MB':>6} {'results':>8}  ids")
    counts = take(run, feeder)
    feeder.join()
    tracked = counts["/hiros/tracked"]
    copied = sum(n for topic, n in counts.items() if not topic.startswith(("/hiros/", "/tf")))
    print(
        f"{feeder.sent} messages of cameras sent, {feeder.sent - copied} not copied, "
        f"{feeder.sent - tracked} not tracked; exit code {run.wait()}"
    )


class Feeder(threading.Thread):
    """Writes the log again and again, at times the speed at which it was recorded."""

    def __init__(self, log: Path, pipe, minutes: int, speed: float) -> None:
        super().__init__()
        self._log, self._pipe, self._minutes, self._speed = log, pipe, minutes, speed
        self.sent = 0
        self.latest = 0
        """Log time of the last message, ns."""

    def run(self) -> None:
        with (
            open_log(self._log) as log,
            LiveWriter(Pipe(self._pipe.fileno(), "pipe")) as writer,
        ):
            reader = log.reader
            ids = {i: writer.adopt(c, reader.schema(c)) for i, c in reader.channels.items()}
            decoder, encoder = Decoder(log.model, exact=True), Encoder(log.model)
            rows = []
            for message in reader.messages():
                topic, data = reader.channels[message.channel_id].topic, bytes(message.data)
                if topic in TF_TOPICS:
                    writer.write(ids[message.channel_id], message.log_time, data)
                elif not topic.startswith("/truth"):
                    (frame,) = decoder.decode_message(data, message.log_time)
                    rows.append((ids[message.channel_id], frame))
            writer.flush()
            begin, first = time.monotonic(), min(frame.log_time for _, frame in rows)
            for channel, frame in repeated(rows, first, self._minutes):
                self.latest = frame.log_time
                due = begin + (frame.log_time - first) / SECOND / self._speed
                time.sleep(max(0.0, due - time.monotonic()))
                writer.write(channel, frame.log_time, encoder.encode(frame))
                writer.flush()
                self.sent += 1
            writer.commit()
        self._pipe.close()


def repeated(rows: list, first: int, minutes: int) -> Iterator[tuple[int, object]]:
    """Yield the messages, (channel, frame), minute by minute: forwards, backwards, forwards ..."""
    for minute in range(minutes):
        moved = []
        for channel, frame in rows:
            at = frame.stamp - first
            if minute % 2:
                at = MINUTE - at
            shift = first + minute * MINUTE + at - frame.stamp
            # A message is as late as it was.
            moved.append(
                (
                    channel,
                    frame.replace(
                        stamp=frame.stamp + shift,
                        stamps=frame.stamps + shift,
                        log_time=frame.log_time + shift,
                    ),
                )
            )
        yield from sorted(moved, key=lambda pair: pair[1].log_time)


def take(run: subprocess.Popen, feeder: Feeder) -> dict[str, int]:
    """Read what comes back; print a line for each minute of input. Return messages by topic."""
    topics: dict[int, str] = {}
    counts: dict[str, int] = defaultdict(int)
    ids: dict[int, int] = defaultdict(int)
    decoder = Decoder(MODEL, exact=True)
    begin = results = 0
    minute, since = 1, time.monotonic()
    for record in StreamReader(os.fdopen(run.stdout.fileno(), "rb")).records:
        if isinstance(record, Channel):
            topics[record.id] = record.topic
        if not isinstance(record, Message):
            continue
        topic = topics[record.channel_id]
        counts[topic] += 1
        begin = begin or record.log_time
        if topic == RESULTS:
            (frame,) = decoder.decode_message(bytes(record.data), record.log_time)
            results += 1
            for person in frame.ids.tolist():
                ids[person] += 1
        if record.log_time - begin >= minute * MINUTE:
            behind = (feeder.latest - record.log_time) / SECOND
            shown = ", ".join(f"{person} ({n})" for person, n in sorted(ids.items()))
            took, since = time.monotonic() - since, time.monotonic()
            memory = memory_of(run.pid)
            print(
                f"{minute:6} {took:6.1f} {behind:6.2f} {memory:6.0f} {results:8}  {shown}",
                flush=True,
            )
            minute, results = minute + 1, 0
            ids.clear()
    for topic, n in sorted(counts.items()):
        print(f"{topic:24} {n:8} messages")
    return counts


def memory_of(process: int) -> float:
    """Memory that a process holds, MB."""
    pages = int(Path(f"/proc/{process}/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


if __name__ == "__main__":
    main()
