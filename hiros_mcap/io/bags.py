"""Bags and recordings of several files, read as one MCAP file.

hiros reads one MCAP file. The skeletons and transforms of any other recording become one in memory:
ROS 2 messages byte for byte, ROS 1 messages as ROS 2 messages of the same fields, by the rosbags
library. Its chunks are compressed, so that it takes as much memory as the file.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import hiros_schemas
from hiros_mcap.errors import LogError
from hiros_mcap.io.bag_files import (
    METADATA,
    files_of,
    kind_of,
    other_parts,
)
from hiros_mcap.io.channels import (
    HUMANS,
    OTHER_TYPES,
    TRANSFORM_TYPES,
    ChannelInfo,
    without_definition,
)
from hiros_mcap.io.container import (
    McapReader,
    McapWriter,
    MemorySink,
    RecoveringReader,
    Recovery,
)
from hiros_mcap.io.container.reader import MEMORY
from hiros_mcap.io.detectors import types_read
from hiros_mcap.io.detectors.keypoint_messages import KEYPOINT_TYPES
from hiros_mcap.io.detectors.rgb_keypoints import RgbRig
from hiros_mcap.io.joining import Everything, Part, channels_in, join
from hiros_mcap.wording import quantity

PACKED_FILES = (
    "its files are compressed with zstd (ros2 bag record --compression-mode file); hiros reads "
    "temporary copies"
)


def _shows_people(info: ChannelInfo) -> bool:
    """Whether a channel may hold skeletons, or says that transforms do."""
    return info.type.startswith(HUMANS) or info.type in types_read() - {*TRANSFORM_TYPES}


class MemoryReader(McapReader):
    """Reads an MCAP in memory that was made of another recording.

    Parameters
    ----------
    path : of the recording. write : writes the MCAP. memory : bytes that reading may take.

    Attributes
    ----------
    checked : whether checksums cover every message of the recording; rosbags compares none.
    """

    checked = False
    rig: RgbRig | None = None  # the RGB cameras whose keypoints became skeletons in it

    def __init__(self, path: Path, write: Callable[[McapWriter], object], memory: int) -> None:
        sink = MemorySink(path)
        with McapWriter(sink) as writer:
            write(writer)
            writer.commit()
        super().__init__(sink.file, memory=memory)

    @property
    def has_checksums(self) -> bool:
        """Whether a damaged message of the recording is noticed."""
        return self.checked


class _People(Everything):
    """The choice of the messages of people.

    Attributes
    ----------
    left_out : type and number of messages of the other topics, see :class:`McapReader`.
    checked : whether checksums cover every message. remarks : of the files.
    count : messages of all topics. shows_people : whether any may.
    recovery : what is lost of the files.
    """

    def __init__(self) -> None:
        self.left_out: dict[str, tuple[str, int]] = {}
        self.count = 0
        self.remarks: dict[str, None] = {}
        self.checked, self.shows_people = True, False
        self.recovery = Recovery()
        self._listed: dict[str, None] = {}

    def of(self, part: Part) -> list[int]:
        """Return the ids of a file's channels, or topics, that are taken over."""
        taken = []
        self.checked &= isinstance(part, McapReader) and part.has_checksums
        channels, wanted = channels_in(part), types_read()
        if any(info.type in KEYPOINT_TYPES for info in channels):
            wanted |= {hiros_schemas.short_name(hiros_schemas.CAMERA_INFO)}
        for info in channels:
            name = info.schema or "no type"
            self.count += info.count
            self.shows_people |= isinstance(part, McapReader) or _shows_people(info)
            self._listed[f"{info.topic} ({name})"] = None
            if info.type in wanted:
                taken.append(info.id)
            else:
                _, before = self.left_out.get(info.topic, ("", 0))
                self.left_out[info.topic] = name, before + info.count
        return taken

    def finish(self, part: Part, path: Path, writer: McapWriter) -> None:
        """Keep the remarks on a file."""
        packed = [PACKED_FILES] if "zstd" in kind_of(path) else []
        self.remarks.update(dict.fromkeys([*packed, *part.remarks]))

    def check(self, path: Path) -> None:
        """Raise LogError if nothing can show people."""
        if not self.shows_people:
            topics = ", ".join(sorted(self._listed)) or "none"
            fault = f"has no SkeletonGroup topic, {OTHER_TYPES}"
            raise LogError(fault, path=path, listing=f"it has {topics}")


def open_recording(path: Path, *, recover: bool = False, memory: int = MEMORY) -> McapReader:
    """Open the files of a recording of any kind as one MCAP.

    One MCAP file is read as it is. Of anything else, the skeletons and transforms become an MCAP in
    memory.

    Parameters
    ----------
    path : a file or a folder.
    recover : take what can be read of damaged files; ``recovery`` says what is lost.
    memory : bytes that reading may take.

    Raises LogError if a file is missing or damaged, or holds no skeletons.
    """
    files = files_of(path, recover=recover)
    if len(files.parts) == 1 and not kind_of(files.parts[0]):
        reader = (RecoveringReader if recover else McapReader)(files.parts[0], memory=memory)
        found = sum(reader.counts.values())
    else:
        reader, found = _read_parts(path, files.parts, recover, memory)
    reader.remarks = (*reader.remarks, *files.remarks, *without_definition(reader, types_read()))
    reader.warnings = files.warnings
    if found < files.promised:
        lost = (
            f"{METADATA} counts {quantity(files.promised, 'message')}, and the recording holds "
            f"{found}; copy the recording again if it is not complete"
        )
        reader.warnings = (*files.warnings, lost)
    return reader


def _read_parts(
    path: Path, parts: Sequence[Path], recover: bool, memory: int
) -> tuple[McapReader, int]:
    """Read a recording into memory; return also how many messages it has."""
    choice = _People()

    def write(writer: McapWriter) -> None:
        choice.recovery = join(parts, writer, choice, recover=recover)
        choice.check(path)

    reader = MemoryReader(path, write, memory)
    reader.checked, reader.left_out = choice.checked, choice.left_out
    reader.remarks = tuple(choice.remarks)
    reader.recovery = choice.recovery if recover else None
    return reader, choice.count


def transforms_beside(path: Path) -> str:
    """Return where what may be a part of a recording finds /tf_static; "" if it has no others.

    Publishers send it once, so that the recorder writes it into one part only.
    """
    if not path.is_file() or not (others := other_parts(path)):
        return ""
    return (
        f"{others[0]} beside it may be a part of the same recording, one part of which has "
        f"/tf_static: name the folder {path.parent}, or join its parts by `hiros recover FOLDER "
        "-o OUT`"
    )
