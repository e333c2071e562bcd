"""All frames of a C3D file, also beyond the 65535 that its 16 bits count.

ezc3d (1.7.2) returns 65535 frames of a longer file. Their number is in TRIAL:ACTUAL_START_FIELD and
ACTUAL_END_FIELD (Vicon; two words each), in POINT:LONG_FRAMES, or in the size of the file alone.
https://www.c3d.org describes these parameters.
"""

from __future__ import annotations

import re
import shutil
import struct
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np

from hiros_mcap.errors import ConfigError
from hiros_mcap.skeletons import Floats

MOST_FRAMES = 0xFFFF
"""Which the header of a C3D file counts."""
_BLOCK = 512
"""bytes; the data fill whole blocks."""


_PARAMETERS = 256 * _BLOCK
"""bytes, which the header and the parameters never exceed."""
_FLOAT_FRAMES = re.compile(rb"([\x06\xfa].FRAMES..)\x04\0(....)", re.DOTALL)
"""The parameter FRAMES: length of its name, group, name, offset of the next one, float, value."""


class FrameLayout(NamedTuple):
    """Where the frames lie in a file."""

    start: int
    """bytes, of the first frame."""
    size: int
    """bytes of a frame; 0 if it has no points."""
    held: int
    """Whole frames between there and the end of the file, with what fills the last block."""
    is_ragged: bool = False
    """Whether the file ends within a frame and within a block."""
    tells_count: bool = True
    """Whether nothing follows the frames, so that the size of the file tells their number."""

    @property
    def filling(self) -> int:
        """Most frames that are no frames but fill the last block."""
        return _BLOCK // max(self.size, 1) + 1


def layout_of(path: Path, file: Any, start: int) -> FrameLayout:
    """Return the layout of a file that ezc3d has read, whose data start at these bytes."""
    points = file["data"]["points"]
    if not points.size:
        return FrameLayout(start, 0, 0)
    parameters = file["parameters"]
    words = 4 * points.shape[1] + file["data"]["analogs"].size // points.shape[-1]
    scale = _numbers(parameters, "POINT", "SCALE")
    size = words * (2 if scale and scale[0] > 0 else 4)  # integers, or floats
    end = path.stat().st_size
    held, rest = divmod(max(end - start, 0), size)
    # Their place is in 16 bits, too: in a file of more than 32 MiB it tells nothing.
    rotations = any(_numbers(parameters, "ROTATION", "USED"))
    return FrameLayout(start, size, held, bool(rest and end % _BLOCK), tells_count=not rotations)


def all_points(path: Path, file: Any, layout: FrameLayout, said: int) -> Floats:
    """(4, M, T) points of all frames of a file, of which ezc3d may have read the first ones.

    ``said`` is the number of frames in the header.

    Raises ConfigError if the file is shorter than it says.
    """
    points = np.asarray(file["data"]["points"])
    count = _count(path, file, layout, said)
    if count <= (read := points.shape[-1]):
        return points
    parts = [points]
    with TemporaryDirectory() as folder, path.open("rb") as data:
        head = data.read(layout.start)
        part = Path(folder) / "part.c3d"
        while read < count:  # the same header before the frames that follow
            data.seek(layout.start + read * layout.size)
            part.write_bytes(head + data.read(layout.size * min(MOST_FRAMES, count - read)))
            parts.append(parsed(part, path)["data"]["points"])
            read += parts[-1].shape[-1]
            if not parts[-1].size:
                raise ConfigError(f"{path}: is cut off: it has {read} of {count} frames")
    return np.concatenate(parts, axis=-1)


def _count(path: Path, file: Any, layout: FrameLayout, said: int) -> int:
    """Return how many frames a file has, by what it says or by its size."""
    read: int = file["data"]["points"].shape[-1]
    parameters = file["parameters"]
    trial = [_long(parameters, f"ACTUAL_{end}_FIELD") for end in ("START", "END")]
    longer = [0, 1 + trial[1] - trial[0]]
    longer += [int(frames) for frames in _numbers(parameters, "POINT", "LONG_FRAMES")[:1]]
    sure = max(read, said, max(longer) if read == MOST_FRAMES else 0)
    if sure > layout.held:
        raise ConfigError(f"{path}: is cut off: it has {layout.held} of {sure} frames")
    # Otherwise these may be those of a longer file, from which this one was cut out.
    count = max(sure, *(frames for frames in longer if frames <= layout.held))
    if layout.held < MOST_FRAMES or not layout.tells_count:
        return count
    if layout.held > count and layout.is_ragged:
        raise ConfigError(f"{path}: is cut off: it ends within the frame {layout.held + 1}")
    return _held(path, layout, count)


def _held(path: Path, layout: FrameLayout, least: int) -> int:
    """Return how many frames follow each other up to what fills the last block with zeros."""
    count = layout.held
    with path.open("rb") as data:
        for k in range(layout.held - 1, max(least, layout.held - layout.filling) - 1, -1):
            data.seek(layout.start + k * layout.size)
            if any(data.read(layout.size)):
                break
            count = k
    return count


def parsed(path: Path, name: Path) -> Any:
    """Return a file as ezc3d reads it; raises ConfigError that names ``name`` if it does not.

    ezc3d refuses a POINT:FRAMES that is a float, as some programs write it beyond 32767 frames. A
    copy gets a whole number of 16 bits in its place, as a matrix of 1 x 1, which is as long.
    """
    import ezc3d

    try:
        with path.open("rb") as data:
            head = data.read(_PARAMETERS)
            whole = _FLOAT_FRAMES.sub(_whole_frames, head, count=1)
            if whole == head:
                return ezc3d.c3d(str(path))
            with TemporaryDirectory() as folder:
                copy = Path(folder) / "copy.c3d"
                with copy.open("wb") as written:
                    written.write(whole)
                    shutil.copyfileobj(data, written)
                return ezc3d.c3d(str(copy))
    except Exception as error:  # noqa: BLE001 - a reader of another project, on a faulty file
        raise ConfigError(f"{name}: not a C3D file: {error}") from None


def _whole_frames(match: re.Match[bytes]) -> bytes:
    (frames,) = struct.unpack("<f", match[2])
    return match[1] + struct.pack("<BBBBH", 2, 2, 1, 1, int(min(max(frames, 0), MOST_FRAMES)))


def _long(parameters: Any, name: str) -> int:
    """Return a number that TRIAL has as two words of 16 bits, the lower one first; 0 if none."""
    words = _numbers(parameters, "TRIAL", name)[:2]
    return sum((int(word) & 0xFFFF) << 16 * k for k, word in enumerate(words))


def _numbers(parameters: Any, group: str, name: str) -> list[float]:
    """Return the numbers of a parameter that are finite; [] if there are none."""
    if group not in parameters or name not in parameters[group]:
        return []
    values = np.ravel(np.asarray(parameters[group][name]["value"]))
    if values.dtype.kind not in "iuf":
        return []
    return [float(value) for value in values if np.isfinite(value)]
