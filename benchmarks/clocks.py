"""Clock faults of one camera: what is used, the error against the truth, and what is named.

    python benchmarks/clocks.py [--quick] [--detector ideal] [LOG TRUTH ...]
    python benchmarks/clocks.py offsets    what is found of offsets that the log times hide

Without a log, two people walk before three simulated cameras. Every fault is put into each of the
first three cameras in turn. A row holds: messages of the other cameras and of this one that were
used, error of the run, of the healthy run and of the run without the camera (mm), and the warnings
about the camera.
"""

from __future__ import annotations

import re
import sys
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import scenes

from hiros_mcap.config import load_config
from hiros_mcap.evaluate import Truth, load_truth
from hiros_mcap.evaluate.logs import evaluate_log
from hiros_mcap.io.codec import Decoder, Encoder
from hiros_mcap.io.container import McapWriter
from hiros_mcap.io.log import open_log
from hiros_mcap.running.observe import Stopwatch
from hiros_mcap.running.pipeline import ProcessOptions, process
from hiros_mcap.running.preparation import prepare
from hiros_mcap.running.summary import Summary
from hiros_mcap.skeletons import Frame

SECOND = 10**9
Change = Callable[[Frame, int, int], tuple[Frame, int]]
"""(message, its log time, middle of the log) -> the message and the log time with a fault, ns."""


def later(frame: Frame, seconds: float) -> Frame:
    """Return the same by another clock."""
    ns = round(seconds * SECOND)
    times = np.where(frame.stamps > 0, frame.stamps + ns, frame.stamps)
    return frame.replace(stamp=frame.stamp + ns, stamps=times)


def step(seconds: float) -> Change:
    return lambda f, logged, middle: (later(f, seconds if logged >= middle else 0.0), logged)


def offset(seconds: float) -> Change:
    return lambda f, logged, middle: (later(f, seconds), logged)


def drift(rate: float) -> Change:
    return lambda f, logged, middle: (later(f, rate * (logged - middle) / SECOND), logged)


def late(seconds: float) -> Change:
    def change(frame: Frame, logged: int, middle: int) -> tuple[Frame, int]:
        is_late = middle <= logged < middle + 3 * SECOND
        return frame, logged + round(seconds * SECOND) * is_late

    return change


def burst(frame: Frame, logged: int, middle: int) -> tuple[Frame, int]:
    """Hold messages back for 3 s."""
    end = middle + 3 * SECOND
    return frame, end + (logged - middle) // 100 if middle <= logged < end else logged


STEPS = (-5, -2, -0.5, -0.1, 0.1, 0.5, 1, 2, 10, 30)
OFFSETS = (0.02, 0.05, 0.1, 0.2, 0.5, 1.5)
FAULTS: dict[str, Change] = {
    **{f"step {s:+g} s": step(s) for s in STEPS},
    **{f"offset {sign * s:+g} s": offset(sign * s) for s in OFFSETS for sign in (1, -1)},
    **{f"drift {d:+g} ms/s": drift(d * 1e-3) for d in (-5, -1, 1, 5)},
    "late 1 s for 3 s": late(1.0),
    "late 3 s for 3 s": late(3.0),
    "burst after 3 s": burst,
}
QUICK = ("step -5 s", "step +0.1 s", "step +2 s", "offset +0.1 s", "offset -1.5 s", "drift +5 ms/s",
         "late 3 s for 3 s")  # fmt: skip


def changed(source: Path, target: Path, topic: str, change: Change) -> None:
    """Copy a log; ``change`` one camera."""
    with open_log(source) as log, McapWriter(target) as writer:
        writer.copy_definitions(log.reader, log.reader.channels)
        decoder, encoder = Decoder(log.model, exact=True), Encoder(log.model)
        middle = sum(log.span) // 2
        rows = []
        for message in log.reader.messages():
            time, data = message.log_time, bytes(message.data)
            if log.reader.channels[message.channel_id].topic == topic:
                (frame,) = decoder.decode_message(data, time)
                frame, time = change(frame, time, middle)
                data = encoder.encode(frame)
            rows.append((time, message.channel_id, data))
        for time, channel, data in sorted(rows, key=lambda row: row[0]):
            writer.write(channel, time, data)
        writer.commit()


def error(log: Path, truth: Truth, topics: tuple[str, ...] = ()) -> tuple[float, Summary]:
    """Return the error of a run, mm, and its summary."""
    out = log.with_name("out.mcap")
    summary = process(log, out, options=ProcessOptions(topics=topics), force=True)
    result = evaluate_log(out, truth, ["/hiros/filtered"])["/hiros/filtered"]
    return result.scores.mean, summary


def said(summary: Summary, topic: str) -> Iterator[str]:
    """Yield what a summary says about clocks and losses."""
    name = topic.split("/")[1]
    for text in (*summary.warnings, *summary.notes):
        if name in text and re.search(r"clock|late|not used", text):
            yield text.partition(";")[0]


def table(log: Path, truth: Truth, folder: Path, faults: dict[str, Change]) -> None:
    with open_log(log) as opened:
        topics = tuple(camera.channel.topic for camera in opened.cameras)
    healthy, _ = error(log, truth)
    print(
        f"{'fault':18} {'camera':9} {'others used':>13} {'own':>5} {'mm':>6} {'healthy':>7} "
        f"{'without':>7}"
    )
    failed = 0
    for topic in topics[:3]:
        others = tuple(other for other in topics if other != topic)
        without, _ = error(log, truth, others)
        for name, change in faults.items():
            faulty = folder / "faulty.mcap"
            changed(log, faulty, topic, change)
            found, summary = error(faulty, truth)
            rest = [camera for camera in summary.cameras if camera.topic != topic]
            (own,) = (camera for camera in summary.cameras if camera.topic == topic)
            used, sent = sum(c.used for c in rest), sum(c.messages for c in rest)
            is_good = used == sent and found <= 1.2 * without
            failed += not is_good
            print(
                f"{name:18} {topic.split('/')[1]:9} {used:6}/{sent:6} "
                f"{own.used / own.messages:5.0%} {found:6.1f} {healthy:7.1f} "
                f"{without:7.1f} {'  ' if is_good else '!!'} {' | '.join(said(summary, topic))}",
                flush=True,
            )
    print(f"{failed} of {3 * len(faults)} rows failed\n")


OFFSETS_MS = (0, 5, -6, 8, -10, 12, 40, 800)
ROOMS = ((1, 2, 30.0), (1, 3, 30.0), (2, 3, 15.0), (3, 4, 30.0), (6, 4, 30.0), (2, 4, 60.0))
"""People, cameras, messages per second."""


def offsets(seeds: range) -> None:
    """Print by how much the clock that a run measures is off, for one camera's offset."""
    for people, cameras, rate in ROOMS:
        cells = []
        for ms in OFFSETS_MS:
            found, corrected = [], 0
            for seed in seeds:
                params = {
                    "people": people,
                    "cameras": cameras,
                    "rig": {"rate": rate},
                    "seconds": 20.0,
                }
                scene = scenes.published(seed, **params)
                frames = [
                    scenes.late(f, ms / 1000.0) if f.source == "camera_1" else f
                    for f in scene.frames
                ]
                with tempfile.TemporaryDirectory() as folder:
                    log = Path(folder) / "log.mcap"
                    replace(scene, frames=frames).write(log, transforms=True)
                    with open_log(log) as opened:
                        done = prepare(opened, load_config(), ProcessOptions(), Stopwatch())
                clocks = {pose.name: pose.clock_ms for pose in done.poses.cameras}
                rest = [clock for name, clock in clocks.items() if name != "camera_1"]
                found.append(float(np.median(rest) - clocks["camera_1"]) - ms)
                corrected += any(fault.corrected for fault in done.clocks.faults)
            worst = max(found, key=abs)
            cells.append(f"{ms:+} ms: off by {worst:+.1f} at most, {corrected} corrected")
        print(f"{people} people, {cameras} cameras, {rate:g} Hz: {'; '.join(cells)}", flush=True)


def main() -> None:
    given = scenes.use_detector(sys.argv[1:])
    if given == ["offsets"]:
        offsets(range(700, 704))
        return
    arguments = [a for a in given if a != "--quick"]
    faults = {k: f for k, f in FAULTS.items() if "--quick" not in given or k in QUICK}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        if not arguments:
            log = folder / "simulated.mcap"
            scenes.write_scene(log, 7, people=2, cameras=3, seconds=20.0)
            print("2 people, 3 cameras, 20 s, simulated")
            table(log, load_truth(log), folder, faults)
        for log, truth in zip(arguments[::2], arguments[1::2], strict=True):
            print(Path(log).name)
            table(Path(log), load_truth(truth), folder, faults)


if __name__ == "__main__":
    main()
