"""The start of a command: its imports, and the kernels that may have to be compiled first."""

from __future__ import annotations

import atexit
import contextlib
import gc
import os
import shutil
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence

_ADDRESSES = 512 << 20  # bytes; below that, libraries abort the program while they are loaded
_SPACE = 32 << 20  # bytes; all kernels take a tenth of that


@contextlib.contextmanager
def importing() -> Iterator[None]:
    """Import without garbage collections: they take time, and what is imported stays anyway."""
    gc.disable()
    try:
        yield
    finally:
        gc.freeze()
        gc.enable()


def prepare(*, quiet: bool, everything: bool = False) -> None:
    """Announce a compilation that is about to happen. Call before anything imports kernels.

    There is none where the installation brings compiled kernels. ``everything``: kernels that are
    not compiled yet are compiled now, in several processes, rather than where they are imported.
    Raises MemoryError if a limit leaves too little.
    """
    from hiros_mcap import kernels
    from hiros_mcap.kernels import shipped
    from hiros_mcap.threads import share_heap

    _ensure_memory()
    share_heap()
    if shipped.usable():
        return
    _ensure_writable()
    done = kernels.compiled()
    missing = {name: text for name, text in kernels.sources().items() if name not in done}
    if missing if everything else not done:
        if not quiet:
            print(f"hiros: {kernels.NOTICE}", file=sys.stderr, flush=True)
        if everything:
            _compile([(group,) for group in independent(missing)])


def independent(sources: Mapping[str, str]) -> list[list[str]]:
    """Return modules of kernels in groups that do not import each other, the longest first."""
    from hiros_mcap import kernels

    groups: list[set[str]] = []
    for name, text in sources.items():
        joined = {name, *(sources.keys() & kernels.imported(text))}
        linked = [group for group in groups if group & joined]
        groups = [group for group in groups if not group & joined]
        groups.append(joined.union(*linked))
    groups.sort(key=lambda group: -sum(len(sources[name]) for name in group))
    return [sorted(group) for group in groups]


def _compile(tasks: Sequence[tuple[Sequence[str]]]) -> None:
    from hiros_mcap.errors import HirosError
    from hiros_mcap.kernels import load
    from hiros_mcap.workers import run_tasks

    # Where there is no memory for several processes, this one compiles what is left, as it goes.
    with contextlib.suppress(HirosError):
        for _ in run_tasks(load, tasks):
            pass


def _ensure_memory() -> None:
    """Raise MemoryError where ``ulimit -v`` leaves too little to load the libraries."""
    try:
        import resource
    except ImportError:  # Windows has no such limit
        return
    limit, _ = resource.getrlimit(resource.RLIMIT_AS)
    if limit != resource.RLIM_INFINITY and limit < _ADDRESSES:
        raise MemoryError(
            f"the process may take {limit >> 20} MiB (ulimit -v), and needs {_ADDRESSES >> 20} MiB"
        )


def _ensure_writable() -> None:
    """Use a private folder, removed at exit, where the user's cache cannot be written, or is full.

    Without a folder each process would compile all that it uses. The folder is private to this one
    and its workers: code that another user could have put there must not be loaded.
    """
    from hiros_mcap.kernels import cache_folder

    folder = cache_folder()
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
        if shutil.disk_usage(folder).free >= _SPACE:
            return
    except OSError:
        pass
    private = tempfile.mkdtemp(prefix="hiros-kernels-")
    atexit.register(shutil.rmtree, private, ignore_errors=True)
    os.environ["NUMBA_CACHE_DIR"] = private
