"""The SHA-256 of an input, by which a result names it; ``sha256sum`` prints the same."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from threading import Event

_BLOCK = 1 << 20  # bytes


class Digest:
    """A hash that a thread computes while a log is processed; made by :func:`digest_of`."""

    def __init__(self, path: Path) -> None:
        self._files = sorted(path.rglob("*")) if path.is_dir() else [path]
        self._stopped = Event()
        self._pool = ThreadPoolExecutor(1, thread_name_prefix="hiros-digest")
        self._found = self._pool.submit(self._compute)

    def result(self) -> str:
        """Wait for the hash, in hexadecimal; "" for what cannot be read twice, such as a pipe.

        Of a folder it is that of its files' contents one after the other, in the order of names.
        """
        return self._found.result()

    def stop(self) -> None:
        """Stop reading."""
        self._stopped.set()
        self._pool.shutdown()

    def _compute(self) -> str:
        files = [file for file in self._files if not file.is_dir()]
        if not all(file.is_file() for file in files):
            return ""
        found = hashlib.sha256()
        for file in files:
            with file.open("rb", buffering=0) as stream:
                while not self._stopped.is_set() and (block := stream.read(_BLOCK)):
                    found.update(block)
        return found.hexdigest()


@contextmanager
def digest_of(path: Path) -> Iterator[Digest]:
    """Start to hash a file, or the files of a folder."""
    digest = Digest(path)
    try:
        yield digest
    finally:
        digest.stop()
