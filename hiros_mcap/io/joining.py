"""The files of a recording: opened, joined to one MCAP file, and recovered."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path

from hiros_mcap.errors import LogError
from hiros_mcap.io.bag_files import files_of, kind_of, unpacked_name
from hiros_mcap.io.bag_tables import Bag, append_bag, open_bag, recover_bag
from hiros_mcap.io.channels import ChannelInfo, channels_of
from hiros_mcap.io.container import McapReader, McapWriter, RecoveringReader, Recovery
from hiros_mcap.io.container.file import MAX_WINDOW, LogFile
from hiros_mcap.io.container.losses import RECOVERY_METADATA, Damage, Lost, joined
from hiros_mcap.outputs import add_block, check_outputs

Part = McapReader | Bag
"""An open file of a recording."""


@contextmanager
def open_part(path: Path, *, recover: bool = False) -> Iterator[Part]:
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


def channels_in(part: Part) -> Sequence[ChannelInfo]:
    """Return the channels, or topics, of a file."""
    return channels_of(part) if isinstance(part, McapReader) else part.topics


def messages_in(
    part: Part, channels: Sequence[ChannelInfo]
) -> Iterator[tuple[ChannelInfo, int, bytes]]:
    """Yield the messages of some channels of a file, with their log times, ns; raises LogError."""
    if not isinstance(part, McapReader):
        yield from part.messages(channels)
        return
    by_id = {info.id: info for info in channels}
    for message in part.messages(by_id):
        yield by_id[message.channel_id], message.log_time, message.data


class Everything:
    """The choice of all that a recording has: messages, attachments and metadata."""

    def of(self, part: Part) -> list[int]:
        """Return the ids of a file's channels, or topics, that are taken over."""
        return [info.id for info in channels_in(part)]

    def finish(self, part: Part, path: Path, writer: McapWriter) -> None:
        """Take over what a file holds besides messages."""
        if isinstance(part, McapReader):
            writer.append_extras(part)


def join(
    parts: Sequence[Path], writer: McapWriter, choice: Everything, *, recover: bool = False
) -> Recovery:
    """Write what is chosen of files, in this order; return what is lost.

    Raises LogError, which names the file, if one is damaged; with ``recover``, only if nothing can
    be read of any.
    """
    recoveries: list[tuple[str, Recovery]] = []
    failed: LogError | None = None
    for path in parts:
        name = path.name if len(parts) > 1 else ""
        try:
            with open_part(path, recover=recover) as part:
                found = _append(part, choice.of(part), writer, recover=recover)
                choice.finish(part, path, writer)
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


def _append(part: Part, chosen: Sequence[int], writer: McapWriter, *, recover: bool) -> Recovery:
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
        recovery = join(parts, writer, Everything(), recover=True)
        if recovery.damages:
            writer.add_metadata(RECOVERY_METADATA, recovery.metadata())
        writer.commit()
    return recovery
