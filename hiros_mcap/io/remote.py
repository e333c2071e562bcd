"""Files behind an address: ``s3://``, ``gs://``, ``https://``, ``sftp://`` and others by fsspec.

A file that is read is copied to a temporary file first, some MB at a time, since a log is read more
than once and at many places. A file that is written is sent when it is complete. A folder for
results may be of this machine, too.
"""

from __future__ import annotations

import glob
import os
import re
import tempfile
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path, PurePosixPath
from typing import Any

from hiros_mcap.errors import ConfigError, LogError
from hiros_mcap.io.bag_files import other_parts
from hiros_mcap.outputs import HEAD, Kind, add_block, check_outputs, may_replace, write_text
from hiros_mcap.wording import quantity

_ADDRESS = re.compile(r"[A-Za-z][A-Za-z0-9+.-]+://")
_BLOCK = 8 << 20  # bytes
_WHOLE = frozenset({"s3", "s3a", "gs", "gcs", "az", "abfs", "abfss", "memory"})
"""Protocols of stores where a file appears only when all of it has arrived."""


def is_remote(text: str) -> bool:
    """Whether a text is an address, not a path of this machine."""
    return _ADDRESS.match(text) is not None


def protocol_of(address: str) -> str:
    """Return what stands before ``://``."""
    return address.partition("://")[0].lower()


def has_whole_files(address: str) -> bool:
    """Whether a store has no folders, and a file appears in it when all of it has arrived."""
    return protocol_of(address) in _WHOLE


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


def find(address: str) -> list[str]:
    """Return the addresses of all files that a glob or a folder (it ends in a slash) has.

    Anything else is returned as it is. Raises LogError.
    """
    if not (address.endswith("/") or glob.has_magic(address)):
        return [address]
    with reached(address) as (system, path):
        before = address.rstrip("/").removesuffix(path.rstrip("/"))
        if glob.has_magic(address):
            return sorted(before + name for name in system.glob(path))
        system.ls(path)  # `find` says nothing of a bucket that does not exist
        return sorted(before + name for name in system.find(path))


def names_in(folder: str) -> list[str]:
    """Return the names of the files in a folder behind an address; raises LogError."""
    with reached(folder) as (system, path):
        return [PurePosixPath(row["name"]).name for row in files_in(system, path)]


def text_of(address: str) -> str:
    """Return what a small file of text behind an address says; raises LogError."""
    with reached(address) as (system, path):
        return bytes(system.cat_file(path, end=1 << 20)).decode(errors="replace")


def size_and_date(address: str) -> tuple[int, str]:
    """Return the size, bytes, and what tells whether a file has changed; of a folder, of its files.

    Raises LogError.
    """
    with reached(address) as (system, path):
        info = system.info(path)
        rows = [info] if info["type"] == "file" else files_in(system, path)
        marks = [str(_changed(row)) for row in rows]
        return sum(row["size"] or 0 for row in rows), max(marks, default="")


def _changed(info: Mapping[str, Any]) -> object:
    names = ("ETag", "etag", "mtime", "LastModified", "updated")
    return next((info[name] for name in names if info.get(name)), "")


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


def _beside(log: str) -> str:
    """Say which files of the same folder may be parts of the same recording; "" for none."""
    folder, _, name = log.rpartition("/")
    with suppress(LogError):
        if parts := other_parts(name, names_in(folder)):
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


def send(file: Path, address: str) -> None:
    """Store a complete file; until it has arrived, a former one stays.

    Raises LogError.
    """
    with reached(address) as (system, path):
        if has_whole_files(address):
            system.put_file(str(file), path)
            return
        folder, _, name = path.rpartition("/")
        temporary = f"{folder}/.hiros-{name}.tmp"
        try:
            system.put_file(str(file), temporary)
            system.mv(temporary, path)
        except BaseException:
            if system.exists(temporary):
                system.rm_file(temporary)
            raise


_READ_ONLY = frozenset({"http", "https"})  # protocols


def place_of(folder: str) -> Place:
    """Return the folder that a path or an address names."""
    return RemotePlace(folder) if is_remote(folder) else Place(folder)


class Place:
    """A folder for results: of this machine, or one that several machines share.

    ``str()`` is its path or address. All methods raise LogError.
    """

    def __init__(self, folder: str) -> None:
        self._folder = Path(folder).absolute()

    def __str__(self) -> str:
        return str(self._folder)

    def create(self) -> None:
        """Make the folder unless it is there."""
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            is_file = isinstance(error, FileExistsError | NotADirectoryError)
            reason = "it is a file" if is_file else error.strerror or error
            fault = f"is no folder that can be written: {reason}"
            raise LogError(fault, path=self._folder) from None

    def sizes(self) -> Mapping[str, int]:
        """Return the size of each file by name, bytes."""
        if not self._folder.is_dir():
            return {}
        return {path.name: path.stat().st_size for path in self._folder.iterdir() if path.is_file()}

    def read_text(self, name: str) -> str | None:
        """Return the content of a file, None if there is none."""
        try:
            return (self._folder / name).read_text(encoding="utf-8", errors="replace")
        except FileNotFoundError:
            return None

    def write_text(self, name: str, text: str) -> None:
        """Write a file, whole or not at all."""
        write_text(self._folder / name, text)

    def check(self, names: Iterable[str], kind: Kind, inputs: Iterable[str], force: bool) -> None:
        """Raise LogError if a file must not be written."""
        folder = os.path.realpath(self._folder)
        local = (path for path in inputs if not is_remote(path))
        beside = [path for path in local if os.path.realpath(Path(path).parent) == folder]
        for name in names:
            check_outputs([(self._folder / name, kind)], beside, force=force, remedy="--force")

    @contextmanager
    def locked(self) -> Iterator[None]:
        """Keep other runs away; the lock ends with the process, however it ends."""
        try:
            import fcntl
        except ImportError:  # Windows
            yield
            return
        folder = os.open(self._folder, os.O_RDONLY)
        try:
            try:
                fcntl.flock(folder, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                fault = "another run of hiros writes there; wait for it, or choose another folder"
                raise LogError(fault, path=self._folder) from None
            except OSError:
                pass  # not every file system has locks
            yield
        finally:
            os.close(folder)

    @contextmanager
    def writing(self) -> Iterator[Path]:
        """Yield a folder of this machine; what is in there at the end becomes part of the place."""
        yield self._folder


class RemotePlace(Place):
    """A folder behind an address."""

    def __init__(self, folder: str) -> None:
        self._address = folder.rstrip("/")

    def __str__(self) -> str:
        return self._address

    def create(self) -> None:
        """Make the folder where the store has folders; the bucket must be there."""
        self.sizes()
        if not has_whole_files(self._address):
            with reached(self._address) as (system, path):
                system.makedirs(path, exist_ok=True)

    def sizes(self) -> Mapping[str, int]:
        """Return the size of each file by name, bytes."""
        if protocol_of(self._address) in _READ_ONLY:
            raise LogError("can only be read; choose another output", path=self._address)
        with reached(self._address) as (system, path):
            if not system.exists(path):
                # A store has no folders, but its bucket must be there.
                bucket = path.split("/")[0] if has_whole_files(self._address) else "/"
                system.ls(bucket)
                return {}
            rows = files_in(system, path)
            return {PurePosixPath(row["name"]).name: row["size"] for row in rows}

    def read_text(self, name: str) -> str | None:
        """Return the content of a file, None if there is none."""
        if name not in self.sizes():
            return None
        return self._read(name).decode(errors="replace")

    def _read(self, name: str, end: int | None = None) -> bytes:
        with reached(f"{self._address}/{name}") as (system, path):
            return bytes(system.cat_file(path, start=None if end is None else 0, end=end))

    def write_text(self, name: str, text: str) -> None:
        """Write a file, whole or not at all."""
        with self.writing() as folder:
            (folder / name).write_text(text, encoding="utf-8")

    def check(self, names: Iterable[str], kind: Kind, inputs: Iterable[str], force: bool) -> None:
        """Raise LogError if a file must not be written."""
        present, read = self.sizes(), set(inputs)
        for name in names:
            address = f"{self._address}/{name}"
            if address in read:
                raise LogError("is an input; choose another output", path=address)
            if force or not present.get(name):
                continue
            if not may_replace(self._read(name, HEAD), kind):
                fault = "exists and was not written by hiros; --force overwrites it"
                raise LogError(fault, path=address)

    @contextmanager
    def locked(self) -> Iterator[None]:
        """Do nothing: stores have no locks."""
        yield

    @contextmanager
    def writing(self) -> Iterator[Path]:
        """Yield a temporary folder; its files are sent when the block succeeds."""
        with tempfile.TemporaryDirectory(prefix="hiros-") as temporary:
            yield Path(temporary)
            for file in sorted(Path(temporary).iterdir()):
                send(file, f"{self._address}/{file.name}")
