"""Cost of reading and writing a 60 s log of 5 cameras, 30 Hz, 4 people, 32 markers, 31 links.

    python benchmarks/bench_log.py [--seconds 60] [--flips 300] [--seed 0] [--folder DIR]

Prints CPU and wall time of each path, best of three, for the log compressed and not; the same of
the mcap library's reader and writer; and how many flipped bits and cuts each reader notices, in
these logs and in one of RGB cameras' keypoints.

Only the time counts here, so the simulated detector is the ideal one.
"""

from __future__ import annotations

import argparse
import random
import tempfile
import time
from collections.abc import Callable, Iterator
from functools import partial
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from mcap.reader import NonSeekingReader, SeekingReader
from mcap.writer import CompressionType, Writer

import hiros_schemas
from hiros_mcap.body.transforms import transform_to_fixed
from hiros_mcap.io.channels import add_skeleton_channel
from hiros_mcap.io.codec import Encoder
from hiros_mcap.io.container import ChunkCopier, McapReader, McapWriter
from hiros_mcap.io.log import open_log
from hiros_mcap.simulate import SimulateParams
from hiros_mcap.simulate.simulation import write_log
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


def library_read(path: Path) -> None:
    """Hand out every message, by the mcap library."""
    with path.open("rb") as file:
        for _ in SeekingReader(file, validate_crcs=True).iter_messages():
            pass


def library_write(path: Path, messages: list[tuple[int, int, bytes]], compression: str) -> None:
    """Write the log, by the mcap library."""
    kinds = {"zstd": CompressionType.ZSTD, "lz4": CompressionType.LZ4, "": CompressionType.NONE}
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=2 << 20, compression=kinds[compression])
        writer.start("ros2", "benchmark")
        text = hiros_schemas.text(hiros_schemas.SKELETON_GROUP).encode()
        schema = writer.register_schema(hiros_schemas.SKELETON_GROUP, "ros2msg", text)
        names = [f"/camera_{k}/skeletons" for k in range(CAMERAS)]
        channels = [writer.register_channel(name, "cdr", schema) for name in names]
        for camera, stamp, data in messages:
            writer.add_message(channels[camera], stamp, data, stamp)
        writer.finish()


Content = list[tuple[int, int, bytes]]


def read_by_hiros(path: Path) -> Content:
    with McapReader(path) as reader:
        return [(m.channel_id, m.log_time, bytes(m.data)) for m in reader.messages()]


def read_by_library(kind: Any, path: Path, **options: bool) -> Content:
    reader = kind(BytesIO(path.read_bytes()), **options)
    return [(m.channel_id, m.log_time, bytes(m.data)) for _, _, m in reader.iter_messages()]


READERS: dict[str, Callable[[Path], Content]] = {
    "hiros": read_by_hiros,
    "mcap, seeking (make_reader)": partial(read_by_library, SeekingReader),
    "mcap, seeking, validate_crcs": partial(read_by_library, SeekingReader, validate_crcs=True),
    "mcap, streaming": partial(read_by_library, NonSeekingReader),
    "mcap, streaming, validate_crcs": partial(
        read_by_library, NonSeekingReader, validate_crcs=True
    ),
}


def damaged(path: Path, n: int, seed: int) -> Iterator[None]:
    """Flip another random bit of the file each time, or, one time of four, cut the file."""
    whole, rng = path.read_bytes(), random.Random(seed)
    for k in range(n):
        data, at = bytearray(whole), rng.randrange(8 * len(whole))
        data[at // 8] ^= 1 << at % 8
        path.write_bytes(data if k % 4 else whole[: at // 8])
        yield
    path.write_bytes(whole)


def flips(path: Path, n: int, seed: int) -> None:
    """Print how many of ``n`` flipped bits and cuts each reader takes without an error."""
    wanted = {name: read(path) for name, read in READERS.items()}
    for name, read in READERS.items():
        unnoticed, wrong = 0, 0
        for _ in damaged(path, n, seed):
            try:
                found = read(path)
            except Exception:  # noqa: BLE001 - whatever a reader says against the file
                continue
            unnoticed += 1
            wrong += found != wanted[name]
        share = f"{unnoticed / n:5.0%} unnoticed, {wrong / n:4.0%} with other messages"
        print(f"  {name:32} {share}")


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
    parser.add_argument("--flips", type=int, default=300)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--folder", type=Path)
    arguments = parser.parse_args()
    messages = make_messages(arguments.seconds)
    megabytes = sum(len(data) for _, _, data in messages) / 1e6
    print(f"{len(messages)} messages, {megabytes:.0f} MB of data, CPU s / wall s\n")
    names = "write", "open", "read", "frames", "copy", "mcap write", "mcap read"
    print(f"{'':10}{'MB':>6}" + "".join(f"{name:>14}" for name in names))
    with tempfile.TemporaryDirectory(dir=arguments.folder) as folder:
        path, other = Path(folder) / "log.mcap", Path(folder) / "other.mcap"
        for compression in ("zstd", "lz4", ""):
            jobs = [
                partial(write, path, messages, compression),
                *(partial(job, path) for job in (open_only, read, decode, copy)),
                partial(library_write, other, messages, compression),
                partial(library_read, path),
            ]
            times = [measure(job) for job in jobs]
            cells = "".join(f"{cpu:8.3f}/{wall:.3f}" for cpu, wall in times)
            print(f"{compression or 'none':10}{path.stat().st_size / 1e6:6.1f}{cells}")
        for compression in ("zstd", "") if arguments.flips else ():
            for job in (write, library_write):
                job(path, messages[:20], compression)
                written = f"{job.__name__}, {compression or 'none'}"
                print(f"\n{arguments.flips} flipped bits and cuts in a log by {written}:")
                flips(path, arguments.flips, arguments.seed)
        if arguments.flips:
            rgb = {"cameras": 3, "seconds": 8.0, "rig": {"kinds": ["rgb"] * 3}}
            write_log(path, SimulateParams.model_validate(rgb))
            print(f"\n{arguments.flips} flipped bits and cuts in a log of RGB cameras:")
            flips(path, arguments.flips, arguments.seed)


if __name__ == "__main__":
    main()
