"""Where a command may write."""

from __future__ import annotations

from pathlib import Path

from hiros_mcap.errors import ConfigError

MAGIC = b"\x89MCAP0\r\n"


def check_target(target: Path, *, force: bool) -> None:
    """Refuse to replace a file that hiros did not write: it may be a recording, the only copy.

    An output of an earlier run is replaced without asking, because trying parameters means
    running again and the run can always be repeated. So is an empty file (``mktemp``).

    Raises
    ------
    ConfigError
        ``target`` is not a regular file, its folder does not exist, or it is somebody else's.
    """
    if target.is_dir():
        raise ConfigError(f"{target}: is a folder, not a file to write")
    if not target.parent.is_dir():
        raise ConfigError(f"{target.parent}: no such folder to write into")
    if not target.exists():
        return
    if not target.is_file():
        raise ConfigError(f"{target}: is a device or a pipe, not a file to write")
    if not force and target.stat().st_size and not _written_by_hiros(target):
        raise ConfigError(f"{target}: exists and was not written by hiros; --force replaces it")


def _written_by_hiros(path: Path) -> bool:
    """Whether the MCAP header names hiros as the library that wrote the file."""
    with path.open("rb") as file:
        start = file.read(256)
    # Magic, opcode 1, u64 length, then two strings with u32 lengths: profile and library.
    profile_at = len(MAGIC) + 1 + 8
    profile_length = int.from_bytes(start[profile_at : profile_at + 4], "little")
    library_at = profile_at + 4 + profile_length + 4
    return start.startswith(MAGIC) and start[library_at:].startswith(b"hiros")
