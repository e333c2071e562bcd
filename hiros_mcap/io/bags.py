"""Bags and recordings of several files: read as one MCAP file, or recovered to one.

hiros reads one MCAP file. The skeletons and transforms of any other recording become one in memory:
ROS 2 messages byte for byte, ROS 1 messages as ROS 2 messages of the same fields, by the rosbags
library. Its chunks are compressed, so that it takes as much memory as the file.
"""

from __future__ import annotations

import os
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
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
    unpacked_name,
)
from hiros_mcap.io.bag_tables import Bag, append_bag, open_bag, recover_bag
from hiros_mcap.io.channels import HUMANS, OTHER_FILES
from hiros_mcap.io.container import (
    McapReader,
    McapWriter,
    MemorySink,
    RecoveringReader,
    Recovery,
)
from hiros_mcap.io.container.file import MAX_WINDOW, LogFile
from hiros_mcap.io.container.losses import RECOVERY_METADATA, Damage, Lost, joined
from hiros_mcap.io.container.reader import MEMORY
from hiros_mcap.io.detectors import detector_readers
from hiros_mcap.outputs import (
    add_block,
    check_outputs,
)
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


@contextmanager
def open_part(path: Path, *, recover: bool = False) -> Iterator[McapReader | Bag]:
    """Open a file of a recording: an MCAP, a SQLite or ROS 1 bag; or one compressed with zstd.

    Raises LogError.
    """
    kind, file = kind_of(path), path
    with ExitStack() as stack:
        if "zstd" in kind:
            file = stack.enter_context(_unzipped(path, kind, recover=recover))
            kind = kind_of(file)
        if kind:
            yield stack.enter_context(open_bag(file, kind, path))
            return
        log_file = LogFile(file)
        log_file.path = path
        yield stack.enter_context((RecoveringReader if recover else McapReader)(log_file))


@contextmanager
def _unzipped(path: Path, kind: str, *, recover: bool) -> Iterator[Path]:
    """Yield a temporary copy of what is in a zstd file, as much as there is with ``recover``."""
    import zstandard

    with tempfile.TemporaryDirectory(prefix="hiros-") as folder:
        target = Path(folder) / unpacked_name(path.name)
        unpacker = zstandard.ZstdDecompressor(max_window_size=MAX_WINDOW)
        frame = unpacker.decompressobj()
        try:
            with path.open("rb") as packed, target.open("wb") as copy:
                while block := packed.read(1 << 12):  # bytes: zstd may make 100 MB of them
                    while block:
                        frame = unpacker.decompressobj() if frame.eof else frame
                        add_block(copy, frame.decompress(block), path)
                        block = frame.unused_data
            fault = "" if frame.eof else "it ends within a frame"
        except (zstandard.ZstdError, OSError) as error:
            fault = str(error)
        if fault and not recover:
            raise LogError(f"is {kind} that cannot be read: {fault}", path=path)
        yield target


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


class _Choice:
    """Which messages of a recording are taken over: those of people, or a wanted topic.

    Attributes
    ----------
    left_out : type and number of messages of the other topics, see :class:`McapReader`.
    checked : whether checksums cover every message. remarks : of the files.
    counts : messages of each topic. shows_people : whether any may.
    recovery : what is lost of the files.
    """

    def __init__(self, topic: str) -> None:
        self._topic = topic
        self.left_out: dict[str, tuple[str, int]] = {}
        self.counts: Counter[str] = Counter()
        self.remarks: dict[str, None] = {}
        self.checked, self.shows_people = True, bool(topic)
        self.recovery = Recovery()
        self._listed: dict[str, None] = {}

    def of(self, part: McapReader | Bag) -> list[int]:
        """Return the ids of a file's channels, or topics, that are taken over."""
        taken = []
        self.checked &= isinstance(part, McapReader) and part.has_checksums
        for ident, topic, name, n in _topics(part):
            self.counts[topic] += n
            self.shows_people |= isinstance(part, McapReader) or _shows_people(name)
            self._listed[f"{topic} ({name or 'no type'})"] = None
            if name and (topic == self._topic if self._topic else _short(name) in _wanted()):
                taken.append(ident)
            else:
                _, before = self.left_out.get(topic, ("", 0))
                self.left_out[topic] = name or "no type", before + n
        return taken

    def check(self, path: Path) -> None:
        """Raise LogError if nothing can show people."""
        if not self.shows_people:
            topics = ", ".join(sorted(self._listed)) or "none"
            fault = f"has no SkeletonGroup topic; {OTHER_FILES}"
            raise LogError(fault, path=path, listing=f"it has {topics}")


def _topics(part: McapReader | Bag) -> Iterator[tuple[int, str, str, int]]:
    """Yield the id, topic, type and number of messages of each channel of a file."""
    if not isinstance(part, McapReader):
        yield from ((topic.id, topic.name, topic.type, topic.n_messages) for topic in part.topics)
        return
    for channel in part.channels.values():
        schema = part.schema(channel)
        yield channel.id, channel.topic, schema.name if schema else "", part.counts[channel.id]


def open_recording(
    path: Path, *, recover: bool = False, memory: int = MEMORY, topic: str = ""
) -> McapReader:
    """Open the files of a recording of any kind as one MCAP.

    One MCAP file is read as it is. Of anything else, the skeletons and transforms become an MCAP in
    memory.

    Parameters
    ----------
    path : a file or a folder.
    recover : take what can be read of damaged files; ``recovery`` says what is lost.
    memory : bytes that reading may take. topic : what to take instead of skeletons.

    Raises LogError if a file is missing or damaged, or holds no skeletons and no topic was named.
    """
    files = files_of(path, recover=recover)
    if len(files.parts) == 1 and not kind_of(files.parts[0]):
        reader = (RecoveringReader if recover else McapReader)(files.parts[0], memory=memory)
        topics = {i: channel.topic for i, channel in reader.channels.items()}
        counts: Counter[str] = Counter()
        for ident, n in reader.counts.items():
            counts[topics[ident]] += n
    else:
        reader, counts = _read_parts(path, files.parts, recover, memory, topic)
    reader.remarks = (*reader.remarks, *files.remarks)
    reader.warnings = tuple(_missing(files.promised, counts))
    return reader


def _read_parts(
    path: Path, parts: Sequence[Path], recover: bool, memory: int, topic: str
) -> tuple[McapReader, Counter[str]]:
    """Read a recording into memory; return also how many messages its topics have."""
    choice = _Choice(topic)

    def write(writer: McapWriter) -> None:
        choice.recovery = join(parts, writer, recover=recover, choice=choice)
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
            if any(n and topic.endswith("/tf_static") for _, topic, _, n in _topics(part)):
                place = f"name the folder {path.parent} instead"
                if not is_recording(path.parent):
                    place = "join its parts in a folder by `hiros recover FOLDER -o OUT`"
                return (
                    f"{name} beside it has /tf_static, as one part of a split recording does: "
                    f"{place}"
                )
    return ""


def join(
    parts: Sequence[Path],
    writer: McapWriter,
    *,
    recover: bool = False,
    choice: _Choice | None = None,
) -> Recovery:
    """Write the content of files, in this order; return what is lost.

    ``choice`` chooses channels of a file; without it, everything is written, attachments and
    metadata too. Raises LogError, which names the file, if one is damaged; with ``recover``, only
    if nothing can be read of any.
    """
    recoveries: list[tuple[str, Recovery]] = []
    failed: LogError | None = None
    for path in parts:
        name = path.name if len(parts) > 1 else ""
        try:
            with open_part(path, recover=recover) as part:
                chosen = choice.of(part) if choice else [ident for ident, *_ in _topics(part)]
                found = _append(part, chosen, writer, recover=recover)
                if choice is None and isinstance(part, McapReader):
                    writer.append_extras(part)
                if choice:
                    packed = [PACKED_FILES] if "zstd" in kind_of(path) else []
                    choice.remarks.update(dict.fromkeys([*packed, *part.remarks]))
                recoveries.append((name, found))
        except LogError as error:
            if not recover or error.path != path:
                raise
            failed = failed or error
            size = path.stat().st_size if path.is_file() else 0
            recoveries.append((name, Recovery((Damage(0, size, error.fault, Lost.REST),))))
    if failed is not None and not any(recovery.recovered for _, recovery in recoveries):
        raise failed
    return joined(recoveries)


def _append(
    part: McapReader | Bag, chosen: Sequence[int], writer: McapWriter, *, recover: bool
) -> Recovery:
    """Write some channels of a file; return what is lost of it."""
    if isinstance(part, McapReader):
        writer.append(part, chosen)
        return part.recovery or Recovery()
    topics = [topic for topic in part.topics if topic.id in chosen]
    if not recover:
        append_bag(part, topics, writer)
        return Recovery()
    return recover_bag(part, topics, writer)


def recover(
    source: str | os.PathLike[str], target: str | os.PathLike[str], *, force: bool = False
) -> Recovery:
    """Write everything that can be read of a recording to one indexed MCAP file with checksums.

    Messages keep their bytes, times and numbers. A metadata record, ``hiros.recovery``, marks the
    file if anything was damaged.

    Parameters
    ----------
    source : an MCAP file, a SQLite bag, or a folder with the files of one recording.
    target : the output.
    force : replace a file that hiros did not write.

    Raises
    ------
    LogError
        nothing can be read; ``source`` is a bag of another kind; ``target`` cannot be written.
    """
    path, out = Path(source), Path(target)
    parts = files_of(path, recover=True).parts
    if (kind := kind_of(path)) == "a ROS 1 bag":
        raise LogError(f"is {kind}; hiros recovers MCAP files and SQLite bags", path=path)
    check_outputs([(out, "log")], [path], force=force)
    with McapWriter(out, inputs=parts) as writer:
        recovery = join(parts, writer, recover=True)
        if recovery.damages:
            writer.add_metadata(RECOVERY_METADATA, recovery.metadata())
        writer.commit()
    return recovery
