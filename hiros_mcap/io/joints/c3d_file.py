"""C3D files: their parameters and points, of three kinds of processors, as floats or integers.

https://www.c3d.org describes the format: a header, records of parameters, and frames of points and
analog samples. No number in a file is trusted before it fits: records into the parameters, frames
into the file. The number of frames is in the header and in POINT:FRAMES. Their 16 bits count 65535;
TRIAL:ACTUAL_START_FIELD and ACTUAL_END_FIELD (Vicon; two words each) and POINT:LONG_FRAMES count
more. Programs leave some of these wrong: what agrees with the size of the file is right.
"""

from __future__ import annotations

import math
import struct
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hiros_mcap.errors import ConfigError
from hiros_mcap.skeletons import Floats

MOST_FRAMES = 0xFFFF
"""Which the header of a C3D file counts."""
_BLOCK = 512
"""bytes; the data begin and end with a block."""
_DEC, _SGI = 85, 86
"""Processors; Intel's is 84."""
_GROUPS = {"POINT", "ANALOG", "TRIAL", "ROTATION"}
_NUMBERS = {1: "b", 2: "h", 4: "f"}
"""Types of a parameter that is no text."""


class C3dFile(NamedTuple):
    """What hiros takes from a C3D file."""

    parameters: dict[tuple[str, str], list[Any]]
    """Texts or numbers by the names of group and parameter."""
    points: Floats
    """(T, M, 3), in the file's unit; NaN where a point was not seen."""
    doubt: str = ""
    """Reason to doubt the number of frames; "" if there is none."""

    def numbers(self, group: str, name: str) -> list[float]:
        """Return the numbers of a parameter that are finite; [] if there are none."""
        values = self.parameters.get((group, name), [])
        return [v for v in values if not isinstance(v, str) and math.isfinite(v)]

    def texts(self, group: str, name: str) -> list[str]:
        """Return the texts of a parameter and of those that continue it, as LABELS2 LABELS."""
        texts: list[str] = []
        number = 1
        while more := self.parameters.get((group, f"{name}{number}" if number > 1 else name)):
            texts += [text for text in more if isinstance(text, str)]
            number += 1
        return texts


class _Header(NamedTuple):
    """What hiros takes from the first block."""

    points: int
    samples: int
    """Analog samples of a frame, of all channels."""
    first: int
    last: int
    """Numbers of the first and of the last frame."""
    block: int
    """Where the data begin; the first one is 1."""
    instants: int
    """Analog samples of a channel in a frame."""


def open_c3d(path: Path) -> C3dFile:
    """Read a C3D file; raises ConfigError if it is none, is cut off, or contradicts itself."""
    data = path.read_bytes()
    if data[1:2] != b"P":  # the second byte of every C3D file
        raise ConfigError(f"{path}: not a C3D file")
    begin = _BLOCK * (data[0] - 1)
    processor = data[begin + 3] if 0 < begin < len(data) - 3 else 0
    order = ">" if processor == _SGI else "<"
    header = _Header(*struct.unpack(f"{order}2x4H6x2H", data[:20].ljust(20, b"\0")))
    start = _BLOCK * (header.block - 1)
    if not 0 < begin < start:  # the first block is the header
        raise ConfigError(f"{path}: is cut off: its header names no block where the data begin")
    try:
        parameters = _parameters(data[begin:start], order, is_dec=processor == _DEC)
    except (ValueError, struct.error):
        raise ConfigError(f"{path}: its parameters are damaged; export it again") from None
    file = C3dFile(parameters, np.empty((0, 0, 3)))
    used, scale = (file.numbers("POINT", name)[:1] for name in ("USED", "SCALE"))
    n = int(used[0]) & MOST_FRAMES if used else header.points
    if not n:
        return file
    samples = [channels * header.instants for channels in file.numbers("ANALOG", "USED")[:1]]
    if n != header.points or samples not in ([], [header.samples]):
        raise ConfigError(
            f"{path}: header and parameters count other points or analog samples; one is damaged"
        )
    is_whole = bool(scale) and scale[0] > 0
    kind = np.dtype(order + ("i2" if is_whole else "f4"))
    width = 4 * n + header.samples
    count, doubt = _count(path, file, header, n, memoryview(data)[start:], width * kind.itemsize)
    words = np.frombuffer(data, kind, count * width, start).reshape(count, width)[:, : 4 * n]
    is_dec = processor == _DEC and not is_whole
    numbers: Floats = _of_dec(words) if is_dec else words.astype(np.float64)
    numbers = numbers.reshape(count, n, 4)
    numbers[numbers[:, :, 3] < 0] = np.nan  # the residual
    return C3dFile(parameters, numbers[:, :, :3] * (scale[0] if is_whole else 1.0), doubt)


def _parameters(data: bytes, order: str, *, is_dec: bool) -> dict[tuple[str, str], list[Any]]:
    """Return texts or numbers by the names of group and parameter, of the groups that count.

    Raises ValueError or struct.error if a record does not fit.
    """
    groups: dict[int, str] = {}
    records: dict[tuple[int, str], bytes] = {}
    at = 4
    while at + 2 < len(data):
        length, group = struct.unpack_from("bb", data, at)
        if not length or not group:
            break
        end = at + 2 + abs(length)  # a locked parameter has a negative length
        name = data[at + 2 : end].decode("latin-1").strip().upper()
        (step,) = struct.unpack_from(order + "h", data, end)
        if step < 0 or (step and step < 3) or end + step > len(data):
            raise ValueError("leads nowhere")
        record = data[end + 2 : end + step if step else len(data)]  # 0: the last one
        if group < 0:
            groups[-group] = name
        else:
            records[group, name] = record
        if not step:
            break
        at = end + step
    return {
        (groups[group], name): _values(record, order, is_dec=is_dec)
        for (group, name), record in records.items()
        if groups.get(group) in _GROUPS
    }


def _values(record: bytes, order: str, *, is_dec: bool) -> list[Any]:
    """Return the texts or numbers of a parameter: type, number of dimensions, these, data."""
    kind, dimensions = struct.unpack_from("bB", record)
    sizes = struct.unpack_from(f"{dimensions}B", record, 2)
    count, begin = math.prod(sizes), 2 + dimensions
    data = record[begin : begin + count]
    if kind not in (-1, *_NUMBERS) or len(data) < count:
        raise ValueError("does not fit")
    if kind == -1:
        length = sizes[0] if sizes else 1
        return [_text(data[k : k + length]) for k in range(0, count, length)] if count else []
    if kind == 4 and is_dec:
        words = np.frombuffer(record, "<f4", count, begin)
        return list(_of_dec(words).tolist())
    return list(struct.unpack_from(f"{order}{count}{_NUMBERS[kind]}", record, begin))


def _text(data: bytes) -> str:
    try:
        return data.decode().strip(" \0")
    except UnicodeDecodeError:
        return data.decode("latin-1").strip(" \0")


def _of_dec(numbers: NDArray[np.float32]) -> Floats:
    """Return DEC's F_floating numbers: words are in the other order, and the exponent is 2 more."""
    words = np.ascontiguousarray(numbers).view("<u2").reshape(-1, 2)
    return np.ascontiguousarray(words[:, ::-1]).view("<f4").reshape(numbers.shape) / 4.0


def _count(
    path: Path, file: C3dFile, header: _Header, points: int, data: memoryview, size: int
) -> tuple[int, str]:
    """Return how many frames of so many bytes the data hold, and what is doubtful about it.

    Raises ConfigError if they are fewer than the file says, or its numbers contradict each other.
    """
    held, rest = divmod(len(data), size)
    least = max(held - _BLOCK // size, 1)  # more would fill the last block
    said = {header.last - header.first + 1}
    for frames in map(int, file.numbers("POINT", "FRAMES")[:1]):
        said.add(frames & MOST_FRAMES if abs(frames) <= MOST_FRAMES else frames)
    longer = {int(frames) for frames in file.numbers("POINT", "LONG_FRAMES")[:1]}
    trial = [file.numbers("TRIAL", f"ACTUAL_{end}_FIELD") for end in ("START", "END")]
    if all(trial):
        longer.add(1 + _long(trial[1]) - _long(trial[0]))
    if fits := {n for n in said | longer if least <= n <= held}:
        return _without_filling(data, size, min(fits), max(fits)), ""
    most = max(said | longer if MOST_FRAMES in said else said)
    if most > held:
        raise ConfigError(f"{path}: is cut off: it has {held} of {most} frames")
    if file.numbers("ROTATION", "USED")[:1] > [0]:  # which follow, so that the size tells nothing
        return most, ""
    if held >= MOST_FRAMES:
        if rest and len(data) % _BLOCK:
            raise ConfigError(f"{path}: is cut off: it ends within the frame {held + 1}")
        return _without_filling(data, size, least, held), ""
    if len(said) > 1 or len(file.texts("POINT", "LABELS")) > points:
        raise ConfigError(
            f"{path}: its {most} frames of {points} points are too few or too short for its size; "
            "one of these is damaged"
        )
    return most, f"counts {most} frames, and its size is that of {held}; the others are not read"


def _without_filling(data: memoryview, size: int, least: int, most: int) -> int:
    """Return how many frames there are before those, all zeros, that fill the last block."""
    while most > least and not any(data[(most - 1) * size : most * size]):
        most -= 1
    return most


def _long(words: list[float]) -> int:
    """Return a number from two words of 16 bits, the lower one first."""
    return sum((int(word) & 0xFFFF) << 16 * k for k, word in enumerate(words[:2]))
