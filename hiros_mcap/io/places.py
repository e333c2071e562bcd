"""Folders that results go to, on this machine or behind an address."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path, PurePosixPath

from hiros_mcap.errors import LogError
from hiros_mcap.io import remote
from hiros_mcap.outputs import HEAD, Kind, check_outputs, may_replace, write_text

_READ_ONLY = frozenset({"http", "https"})  # protocols


def place_of(folder: str) -> Place:
    """Return the folder that a path or an address names."""
    return RemotePlace(folder) if remote.is_remote(folder) else Place(folder)


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
        local = (path for path in inputs if not remote.is_remote(path))
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
        if not remote.has_whole_files(self._address):
            with remote.reached(self._address) as (system, path):
                system.makedirs(path, exist_ok=True)

    def sizes(self) -> Mapping[str, int]:
        """Return the size of each file by name, bytes."""
        if remote.protocol_of(self._address) in _READ_ONLY:
            raise LogError("can only be read; choose another output", path=self._address)
        with remote.reached(self._address) as (system, path):
            if not system.exists(path):
                # A store has no folders, but its bucket must be there.
                bucket = path.split("/")[0] if remote.has_whole_files(self._address) else "/"
                system.ls(bucket)
                return {}
            rows = remote.files_in(system, path)
            return {PurePosixPath(row["name"]).name: row["size"] for row in rows}

    def read_text(self, name: str) -> str | None:
        """Return the content of a file, None if there is none."""
        if name not in self.sizes():
            return None
        return self._read(name).decode(errors="replace")

    def _read(self, name: str, end: int | None = None) -> bytes:
        with remote.reached(f"{self._address}/{name}") as (system, path):
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
                remote.send(file, f"{self._address}/{file.name}")
