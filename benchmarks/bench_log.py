"""What reading and writing cost: a 60 s log of 5 cameras, 30 Hz, 4 people, 32 markers, 31 links.

    python benchmarks/bench_log.py [--seconds 60] [--folder DIR]

Prints CPU and wall time of each path, best of three, for the log compressed and not.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from hiros_mcap.body.transforms import transform_to_fixed
from hiros_mcap.io.channels import add_skeleton_channel
from hiros_mcap.io.codec import Encoder
from hiros_mcap.io.container import ChunkCopier, McapReader, McapWriter
from hiros_mcap.io.log import open_log
from hiros_mcap.skeletons import ORIENTATION, POSITION, Frame, SkeletonModel

CAMERAS, RATE, PEOPLE, MARKERS = 5, 30, 4, 32
START = 1_700_000_000 * 10**9


def make_messages(seconds: int) -> list[tuple[int, int, bytes]]:
    """Camera, log time and bytes of each message: people who sway, noise of 12 mm."""
    model = SkeletonModel.of(
        (f"marker_{k}" for k in range(MARKERS)),
        ((f"link_{k}", k, k + 1) for k in range(MARKERS - 1)),
    )
    rng, encoder = np.random.default_rng(0), Encoder(model)
    rest = rng.uniform(-1, 1, (PEOPLE, MARKERS, 3))
    messages = []
    for k in range(seconds * RATE * CAMERAS):
        stamp = START + k * 10**9 // (RATE * CAMERAS)
        frame = Frame.empty(PEOPLE, model, stamp=stamp, source=f"camera_{k % CAMERAS}")
        frame.markers[..., POSITION] = rest + np.sin(k / 300) + rng.normal(0, 0.012, rest.shape)
        frame.links[..., ORIENTATION] = rng.normal(size=(PEOPLE, MARKERS - 1, 4))
        frame.links[..., ORIENTATION] /= np.linalg.norm(frame.orientations, axis=-1)[..., None]
        frame.marker_confidences[:] = frame.link_confidences[:] = frame.confidences[:, None] = 0.66
        messages.append((k % CAMERAS, stamp, encoder.encode(frame.replace(frame_id="world"))))
    return messages


def write(path: Path, messages: list[tuple[int, int, bytes]], compression: str) -> None:
    """Write the log."""
    with McapWriter(path, compression=compression) as writer:
        channels = [add_skeleton_channel(writer, f"/camera_{k}/skeletons") for k in range(CAMERAS)]
        for camera, stamp, data in messages:
            writer.write(channels[camera], stamp, data)
        writer.commit()


def open_only(path: Path) -> None:
    """Walk the file, checksum of the data section included."""
    McapReader(path).close()


def read(path: Path) -> None:
    """Hand out every message."""
    with McapReader(path) as reader:
        for _ in reader.messages():
            pass


def decode(path: Path) -> None:
    """Read every message as a frame in the fixed frame."""
    with open_log(path) as log:
        for _ in transform_to_fixed(log.frames(), log.transforms, log.fixed_frame):
            pass


def copy(path: Path) -> None:
    """Copy every channel into another log."""
    with McapReader(path) as reader, McapWriter(path.with_name("copy.mcap")) as writer:
        ChunkCopier(reader, writer, reader.channels).finish()
        writer.commit()


def measure(job: Callable[[], None]) -> tuple[float, float]:
    """Return the best CPU and wall time of three runs, s."""
    runs = []
    for _ in range(3):
        cpu, wall = time.process_time(), time.perf_counter()
        job()
        runs.append((time.process_time() - cpu, time.perf_counter() - wall))
    return min(cpu for cpu, _ in runs), min(wall for _, wall in runs)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=int, default=60)
    parser.add_argument("--folder", type=Path)
    arguments = parser.parse_args()
    messages = make_messages(arguments.seconds)
    megabytes = sum(len(data) for _, _, data in messages) / 1e6
    print(f"{len(messages)} messages, {megabytes:.0f} MB of data, CPU s / wall s\n")
    print(f"{'':10}{'MB':>6}{'write':>14}{'open':>14}{'read':>14}{'frames':>14}{'copy':>14}")
    with tempfile.TemporaryDirectory(dir=arguments.folder) as folder:
        for compression in ("zstd", "lz4", ""):
            path = Path(folder) / "log.mcap"
            jobs = [
                lambda p=path, c=compression: write(p, messages, c),
                *(lambda p=path, job=job: job(p) for job in (open_only, read, decode, copy)),
            ]
            times = [measure(job) for job in jobs]
            cells = "".join(f"{cpu:8.3f}/{wall:.3f}" for cpu, wall in times)
            print(f"{compression or 'none':10}{path.stat().st_size / 1e6:6.1f}{cells}")


if __name__ == "__main__":
    main()
