"""Files that a run writes: which ones it may replace, and how each appears whole or not at all."""

from __future__ import annotations

import os
import re
import secrets
import shutil
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from multiprocessing import parent_process
from pathlib import Path
from typing import BinaryIO, Literal

from hiros_mcap.errors import LogError

Kind = Literal[
    "log", "HTML page", "Rerun recording", "JUnit report", "Markdown summary", "limb table",
    "camera file", "PNG picture", "export", "table of logs", "table of scores",
]  # fmt: skip

HTML_MARK = '<meta name="generator" content="hiros">'
JUNIT_MARK = "<!-- hiros check -->"
MARKDOWN_MARK = "### hiros check: "
TABLE_MARK = "log,verdict,"
LIMBS_MARK = "# hiros limb lengths\n"
CAMERAS_MARK = "# hiros cameras\n"

EXPORT_MARK = "written by hiros"
BVH_START = "HIERARCHY \t "
"""BVH has no comments; blanks at the end of its first line mean nothing."""
CSV_START, JSONL_START = "person,time (s),", '{"person":'

_SCORES = re.compile(rb"(Log,)?(Channel|System|Left out|Cameras),[^\n]*\(mm\)")
"""First line of a table of scores as CSV."""

HEAD = 1 << 16
"""Bytes at the start of a file within which every mark lies, but that of Parquet at its end."""
_RESERVE = 256 << 20  # bytes of the disk that a temporary copy leaves free
_MCAP = b"\x89MCAP0\r\n"


def check_outputs(
    outputs: Iterable[tuple[Path | None, Kind]],
    inputs: Iterable[str | os.PathLike[str] | None] = (),
    *,
    force: bool = False,
    remedy: str = "force=True",
) -> None:
    """Refuse outputs that must not be written, before a run starts.

    hiros overwrites its own files by files of the same kind, since a run can be repeated, and
    empty files (``mktemp``). Anything else may be the only copy of a recording.

    Parameters
    ----------
    outputs : files with their kinds; None = not asked for.
    inputs : files that the run reads, or folders with a log in them.
    force : replace any regular file except an input.
    remedy : how the user asks for ``force``.

    Raises LogError if an output is an input or another output, is not a regular file, belongs to
    somebody else, or lies in a folder that does not exist or may not be written into.
    """
    given = [Path(path) for path in inputs if path is not None]
    read = [file for path in given for file in (path.iterdir() if path.is_dir() else [path])]
    taken: list[Path] = []
    for path, kind in outputs:
        if path is None:
            continue
        _check_place(path)
        if any(_same(path, other) for other in read):
            raise LogError("is an input; choose another output", path=path)
        if any(_same(path, other) for other in taken):
            raise LogError("would be written twice; choose another output", path=path)
        if not (force or _may_replace(path, kind)):
            raise LogError(f"{_reason(kind)}; {remedy} overwrites it", path=path)
        taken.append(path)


def _reason(kind: Kind) -> str:
    """Return why an existing file is not replaced."""
    article = "an" if kind in ("HTML page", "export") else "a"
    return f"exists and is not {article} {kind} of hiros"


def _check_place(path: Path) -> None:
    if path.is_dir():
        raise LogError("is a folder, not a file to write", path=path)
    if path.exists() and not path.is_file():
        raise LogError("is a device or a pipe, not a file to write", path=path)
    folder = Path(os.path.realpath(path)).parent
    if not folder.is_dir():
        raise LogError("no such folder", path=path.parent)
    if not os.access(folder, os.W_OK):
        raise LogError("cannot be written: Permission denied", path=path)


def _same(one: Path, other: Path) -> bool:
    if one.exists() and other.exists():
        return one.samefile(other)
    return os.path.realpath(one) == os.path.realpath(other)


def _may_replace(path: Path, kind: Kind) -> bool:
    """Whether a file is not there, empty, or of this kind and by hiros."""
    if not path.exists():
        return True
    with path.open("rb") as file:
        ends = file.read(HEAD)
        file.seek(-min(HEAD, path.stat().st_size), os.SEEK_END)
        ends += file.read()
    return not ends or _IS_OURS[kind](ends)


def _is_log(head: bytes) -> bool:
    # Magic, opcode 1, u64 length, then two strings with u32 lengths: profile and library.
    profile_at = len(_MCAP) + 1 + 8
    profile_length = int.from_bytes(head[profile_at : profile_at + 4], "little")
    library = head[profile_at + 4 + profile_length + 4 :]
    return head.startswith(_MCAP) and library.startswith(b"hiros")


_IS_OURS: Mapping[Kind, Callable[[bytes], bool]] = {
    "log": _is_log,
    "HTML page": lambda head: HTML_MARK.encode() in head,
    # The name of the application, a protobuf field of the first message.
    "Rerun recording": lambda head: head.startswith(b"RRF") and b"\n\x05hiros" in head,
    "JUnit report": lambda head: JUNIT_MARK.encode() in head,
    "Markdown summary": lambda head: head.startswith(MARKDOWN_MARK.encode()),
    "limb table": lambda head: head.startswith(LIMBS_MARK.encode()),
    "camera file": lambda head: head.startswith(CAMERAS_MARK.encode()),
    "PNG picture": lambda head: head.startswith(b"\x89PNG") and b"tEXtSoftware\0hiros" in head,
    "table of logs": lambda head: head.startswith(TABLE_MARK.encode()),
    "table of scores": lambda head: bool(_SCORES.match(head)),
    "export": lambda head: (
        head.startswith(tuple(map(str.encode, (CSV_START, JSONL_START, BVH_START))))
        or EXPORT_MARK.encode() in head
    ),
}


def add_block(copy: BinaryIO, block: bytes, name: object) -> None:
    """Append to a temporary copy of an input as long as the disk has room; raises LogError."""
    if shutil.disk_usage(Path(copy.name).parent).free < len(block) + _RESERVE:
        raise LogError(
            f"there is no room for a copy in {tempfile.gettempdir()}; name a folder with TMPDIR, "
            "or use fewer --jobs",
            path=name,
        )
    copy.write(block)


def temporary_name(target: Path) -> Path:
    """Return a new name beside ``target``: the number of the run's first process, and the time.

    The time is for whoever finds what a run has left that was killed.
    """
    parent = parent_process()
    run = os.getpid() if parent is None else parent.pid
    now = time.strftime("%Y-%m-%d-%H%M%S")
    return target.with_name(f".hiros-{run}-{now}-{secrets.token_hex(6)}.tmp")


def sync_folder(folder: Path) -> None:
    """Write the names of a folder's files to the disk, where the system can do that."""
    if not hasattr(os, "O_DIRECTORY"):
        return
    with suppress(OSError):  # some network drives refuse it
        descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


def remove_parts(folder: Path) -> None:
    """Remove what killed workers of this process have left of their outputs below a folder."""
    for path in folder.rglob(f".hiros-{os.getpid()}-*.tmp"):
        path.unlink(missing_ok=True)


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yield a path beside ``path`` to write to; it gets that name when the block succeeds.

    Until then an older file stays as it is. An error or a signal leaves nothing behind.

    Raises LogError if the file cannot be written.
    """
    target = Path(os.path.realpath(path))
    temporary = temporary_name(target)
    try:
        yield temporary
        temporary.replace(target)
    except OSError as error:
        fault = error.strerror or str(error)
        raise LogError(f"cannot be written: {fault}", path=path) from error
    finally:
        temporary.unlink(missing_ok=True)


def write_text(path: Path, text: str) -> None:
    """Write a text file, whole or not at all; raises LogError if it cannot be written."""
    with replacing(path) as temporary:
        temporary.write_text(text, encoding="utf-8")
