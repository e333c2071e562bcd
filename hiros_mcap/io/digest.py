"""The SHA-256 of an input, by which a result names it; ``sha256sum`` prints the same."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from threading import Event

_BLOCK = 1 << 20  # bytes


@contextmanager
def digest_of(path: Path) -> Iterator[Future[str]]:
    """Hash a file, or the files of a folder, in a thread; the hash is hexadecimal.

    It is "" for what cannot be read twice, such as a pipe. That of a folder is the hash of its
    files' contents one after the other, in the order of names.
    """
    stopped = Event()
    with ThreadPoolExecutor(1, thread_name_prefix="hiros-digest") as pool:
        try:
            yield pool.submit(_hash, path, stopped)
        finally:
            stopped.set()


def _hash(path: Path, stopped: Event) -> str:
    inside = sorted(path.rglob("*")) if path.is_dir() else [path]
    files = [file for file in inside if not file.is_dir()]
    if not all(file.is_file() for file in files):
        return ""
    digest = hashlib.sha256()
    for file in files:
        with file.open("rb", buffering=0) as stream:
            while not stopped.is_set() and (block := stream.read(_BLOCK)):
                digest.update(block)
    return digest.hexdigest()
