"""Logs behind an address: ``s3://``, ``gs://``, ``https://``, ``sftp://`` and others by fsspec.

A file is copied to a temporary file first, some MB at a time, since a log is read more than once
and at many places. Results are written to this machine.
"""

from __future__ import annotations

import re
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path, PurePosixPath
from typing import Any

from hiros_mcap.errors import ConfigError, LogError
from hiros_mcap.io.bag_files import other_parts
from hiros_mcap.outputs import add_block
from hiros_mcap.wording import quantity

_ADDRESS = re.compile(r"[A-Za-z][A-Za-z0-9+.-]+://")
_BLOCK = 8 << 20  # bytes


def is_remote(text: str) -> bool:
    """Whether a text is an address, not a path of this machine."""
    return _ADDRESS.match(text) is not None


def protocol_of(address: str) -> str:
    """Return what stands before ``://``."""
    return address.partition("://")[0].lower()


_LIBRARIES = {
    "s3": ("s3fs",),
    "gs": ("gcsfs",),
    "http": ("aiohttp",),
    "https": ("aiohttp",),
    "sftp": ("paramiko",),
}
"""Protocol -> libraries that fsspec needs for it."""


@contextmanager
def reached(address: str) -> Iterator[tuple[Any, str]]:
    """Yield the file system of an address, and the path in it.

    Whatever the store has to say against it becomes one LogError with a remedy.
    """
    try:
        import fsspec

        system, path = fsspec.core.url_to_fs(address)
        system.invalidate_cache()
        yield system, path
    except LogError:
        raise
    except Exception as error:
        raise LogError(_fault(address, error), path=address) from error


def _fault(address: str, error: Exception) -> str:
    kind, protocol = type(error).__name__, protocol_of(address)
    reason = " ".join(str(error).split()).rstrip(".") or kind
    status = getattr(error, "status", None) or getattr(error, "code", None)
    if isinstance(error, ImportError):
        libraries = " ".join(("fsspec", *_LIBRARIES.get(protocol, ())))
        return f"{protocol}:// needs further libraries: pip install {libraries} ({reason})"
    if isinstance(error, ValueError) and "rotocol" in reason:
        return f"nobody knows the protocol {protocol}://; there are s3, gs, https, sftp and others"
    if isinstance(error, FileNotFoundError) or status == 404:
        return f"does not exist: neither the file nor perhaps the bucket; check the name ({reason})"
    refused = isinstance(error, PermissionError) or status in (401, 403)
    if refused or "Credential" in kind or "Authentic" in kind:
        return (
            f"permission denied; sign in as for the store's own tools, e.g. with AWS_PROFILE or "
            f"an SSH key ({reason})"
        )
    return (
        f"cannot be reached; check the network, and AWS_ENDPOINT_URL if the store is not "
        f"Amazon's ({kind}: {reason})"
    )


def files_in(system: Any, folder: str) -> list[dict[str, Any]]:
    """Return what a file system tells of the files of a folder."""
    rows = system.ls(folder, detail=True)
    return [row for row in rows if row["type"] == "file" and row["name"].rstrip("/") != folder]


@contextmanager
def local_copy(log: str) -> Iterator[Path]:
    """Yield where a file or a folder of files can be read; a copy is removed afterwards.

    Raises LogError if an address cannot be read, or the disk has no room for a copy.
    """
    if not is_remote(log):
        yield Path(log)
        return
    with tempfile.TemporaryDirectory(prefix="hiros-") as temporary:
        target = Path(temporary) / PurePosixPath(log.rstrip("/")).name
        with reached(log) as (system, path):
            is_folder = system.isdir(path)
            if is_folder:
                target.mkdir()
                for row in files_in(system, path):
                    _fetch(system, row["name"], target / PurePosixPath(row["name"]).name, log)
            else:
                _fetch(system, path, target, log)
        try:
            yield target
        except LogError as error:
            hint = "" if is_folder or "/tf_static" not in error.fault else _beside(log)
            raise type(error)(
                error.fault.replace(str(target), log) + hint,
                path=str(error.path or log).replace(str(target), log),
                topic=error.topic,
            ) from None
        except ConfigError as error:
            raise ConfigError(str(error).replace(str(target), log)) from None


def _names_in(folder: str) -> list[str]:
    with reached(folder) as (system, path):
        return [PurePosixPath(row["name"]).name for row in files_in(system, path)]


def _beside(log: str) -> str:
    """Say which files of the same folder may be parts of the same recording; "" for none."""
    folder, _, name = log.rpartition("/")
    with suppress(LogError):
        if parts := other_parts(name, _names_in(folder)):
            more = f" and {quantity(len(parts) - 1, 'more file')}" if len(parts) > 1 else ""
            return (
                f"; {parts[0]}{more} beside it may be parts of the same recording, one of which "
                f"has /tf_static: name the folder {folder} instead"
            )
    return ""


def _fetch(system: Any, path: str, target: Path, address: str) -> None:
    """Copy a file, block by block, as long as the disk has room."""
    with (
        system.open(path, "rb", block_size=_BLOCK, cache_type="readahead") as source,
        target.open("wb") as copy,
    ):
        while block := source.read(_BLOCK):
            add_block(copy, block, address)
        if copy.tell() < (source.size or 0):
            raise LogError(f"is cut off: {copy.tell()} of {source.size} bytes came", path=address)
