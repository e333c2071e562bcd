"""Bags and recordings of several files, read as one MCAP file.

hiros reads one MCAP file. The skeletons and transforms of any other recording become one in memory:
ROS 2 messages byte for byte, ROS 1 messages as ROS 2 messages of the same fields, by the rosbags
library. Its chunks are compressed, so that it takes as much memory as the file.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path

import hiros_schemas
from hiros_mcap.errors import LogError
from hiros_mcap.io.bag_files import (
    METADATA,
    STORAGES,
    files_of,
    is_log_name,
    is_recording,
    kind_of,
    other_parts,
)
from hiros_mcap.io.channels import HUMANS, OTHER_TYPES, without_definition
from hiros_mcap.io.container import (
    McapReader,
    McapWriter,
    MemorySink,
    RecoveringReader,
    Recovery,
)
from hiros_mcap.io.container.reader import MEMORY
from hiros_mcap.io.detectors import detector_readers
from hiros_mcap.io.detectors.keypoint_messages import KEYPOINT_TYPES
from hiros_mcap.io.detectors.rgb_keypoints import RgbRig
from hiros_mcap.io.joining import Everything, Part, join, open_part, topics_of
from hiros_mcap.wording import quantity

_LISTED = 6
_LOOKED_INTO = 20
PACKED_FILES = (
    "its files are compressed with zstd (ros2 bag record --compression-mode file); hiros reads "
    "temporary copies"
)


def _wanted() -> set[str]:
    """Types that are taken over: those of the detectors, and transforms."""
    return {name for reader in detector_readers() for name in reader.types}


def _short(name: str) -> str:
    """Return a type as ``pkg/Type``, "" for a name that is none."""
    try:
        return hiros_schemas.short_name(name)
    except hiros_schemas.DefinitionError:
        return ""


def _shows_people(name: str) -> bool:
    """Whether a type may hold skeletons, or says that transforms do."""
    short = _short(name)
    transforms = ("tf2_msgs/TFMessage", "tf/tfMessage")
    return short.startswith(HUMANS) or (short in _wanted() and short not in transforms)


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
    counts : messages of each topic. shows_people : whether any may.
    recovery : what is lost of the files.
    """

    def __init__(self) -> None:
        self.left_out: dict[str, tuple[str, int]] = {}
        self.counts: Counter[str] = Counter()
        self.remarks: dict[str, None] = {}
        self.checked, self.shows_people = True, False
        self.recovery = Recovery()
        self._listed: dict[str, None] = {}

    def of(self, part: Part) -> list[int]:
        """Return the ids of a file's channels, or topics, that are taken over."""
        taken = []
        self.checked &= isinstance(part, McapReader) and part.has_checksums
        topics = list(topics_of(part))
        wanted = _wanted()
        if any(name and _short(name) in KEYPOINT_TYPES for _, _, name, _ in topics):
            wanted |= {hiros_schemas.short_name(hiros_schemas.CAMERA_INFO)}
        for ident, topic, name, n in topics:
            self.counts[topic] += n
            self.shows_people |= isinstance(part, McapReader) or _shows_people(name)
            self._listed[f"{topic} ({name or 'no type'})"] = None
            if name and _short(name) in wanted:
                taken.append(ident)
            else:
                _, before = self.left_out.get(topic, ("", 0))
                self.left_out[topic] = name or "no type", before + n
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
        topics = {i: channel.topic for i, channel in reader.channels.items()}
        counts: Counter[str] = Counter()
        for ident, n in reader.counts.items():
            counts[topics[ident]] += n
    else:
        reader, counts = _read_parts(path, files.parts, recover, memory)
    reader.remarks = (*reader.remarks, *files.remarks, *without_definition(reader, _wanted()))
    reader.warnings = (*files.warnings, *_missing(files.promised, counts))
    return reader


def _read_parts(
    path: Path, parts: Sequence[Path], recover: bool, memory: int
) -> tuple[McapReader, Counter[str]]:
    """Read a recording into memory; return also how many messages its topics have."""
    choice = _People()

    def write(writer: McapWriter) -> None:
        choice.recovery = join(parts, writer, choice, recover=recover)
        choice.check(path)

    reader = MemoryReader(path, write, memory)
    reader.checked, reader.left_out = choice.checked, choice.left_out
    reader.remarks = tuple(choice.remarks)
    reader.recovery = choice.recovery if recover else None
    return reader, choice.counts


def _missing(promised: Mapping[str, int], counts: Mapping[str, int]) -> Iterator[str]:
    """Yield a warning if there are fewer messages than metadata.yaml counts."""
    lost = {t: n - counts.get(t, 0) for t, n in promised.items() if t and n > counts.get(t, 0)}
    total, found = sum(promised.values()), sum(counts.values())
    if not lost and total <= found:
        return
    losses = [f"{promised[t] - n} of {promised[t]} of {t}" for t, n in sorted(lost.items())]
    more = f" and {len(losses) - _LISTED} more topics" if len(losses) > _LISTED else ""
    listing = f" ({', '.join(losses[:_LISTED])}{more})" if losses else ""
    yield (
        f"{METADATA} counts {quantity(total, 'message')}, and the recording holds {found}"
        f"{listing}; copy the recording again if it is not complete"
    )


def transforms_beside(path: Path) -> str:
    """Return where a part of a recording that has no /tf_static finds it; "" if nowhere.

    Publishers send it once, so that the recorder writes it into one part only.
    """
    if not path.is_file() or not is_log_name(path.name, STORAGES):
        return ""
    names = [file.name for file in path.parent.iterdir()]
    for name in other_parts(path.name, names)[:_LOOKED_INTO]:
        with suppress(LogError), open_part(path.with_name(name)) as part:
            if any(n and topic.endswith("/tf_static") for _, topic, _, n in topics_of(part)):
                place = f"name the folder {path.parent} instead"
                if not is_recording(path.parent):
                    place = "join its parts in a folder by `hiros recover FOLDER -o OUT`"
                return (
                    f"{name} beside it has /tf_static, as one part of a split recording does: "
                    f"{place}"
                )
    return ""
