"""The start of a command: its imports, and the kernels that may have to be compiled first."""

from __future__ import annotations

import atexit
import contextlib
import gc
import os
import shutil
import sys
import tempfile
import threading
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

_ADDRESSES = 512 << 20  # bytes; below that, libraries abort the program while they are loaded
_POLL_S = 0.3
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


def prepare(*, quiet: bool) -> None:
    """Compile the kernels that are missing. Call before anything imports kernels.

    None are missing where the installation brings them. Raises MemoryError if a limit leaves too
    little.
    """
    from hiros_mcap import kernels
    from hiros_mcap.kernels import shipped
    from hiros_mcap.threads import share_heap

    _ensure_memory()
    share_heap()
    if shipped.usable() or _is_complete():
        return
    lasts, missing = _ensure_writable(), kernels.missing()
    if missing and not quiet:
        print(f"hiros: {kernels.NOTICE}", file=sys.stderr, flush=True)
    if missing and lasts:
        _compile(missing, quiet=quiet)


def independent(sources: Mapping[str, str]) -> list[list[str]]:
    """Return modules of kernels in groups that do not import each other, in the order to compile.

    The groups that need nothing of the others come first, so that two processes do not compile the
    same; then the longest.
    """
    from hiros_mcap import kernels

    groups: list[set[str]] = []
    for name, text in sources.items():
        joined = {name, *(sources.keys() & kernels.imported(text))}
        linked = [group for group in groups if group & joined]
        groups = [group for group in groups if not group & joined]
        groups.append(joined.union(*linked))

    def rank(group: set[str]) -> tuple[bool, int]:
        reached = sources.keys() & frozenset().union(*map(kernels.reached, group))
        return not reached <= group, -sum(len(sources[name]) for name in group)

    return [sorted(group) for group in sorted(groups, key=rank)]


def _compile(missing: Mapping[str, Sequence[Path]], *, quiet: bool) -> None:
    """Compile modules in several processes, and show how many of their kernels are ready."""
    from hiros_mcap.errors import HirosError
    from hiros_mcap.kernels import load, sources
    from hiros_mcap.progress import bar
    from hiros_mcap.workers import run_tasks

    files, over = [file for paths in missing.values() for file in paths], threading.Event()
    texts = {name: text for name, text in sources().items() if name in missing}

    def show() -> None:
        while not over.wait(_POLL_S):
            shown.update(sum(file.exists() for file in files), len(files))

    # Where there is no memory for several processes, this one compiles what is left, as it goes.
    with bar("compiling kernels", quiet=quiet) as shown, contextlib.suppress(HirosError):
        threading.Thread(target=show, daemon=True).start()
        try:
            for _ in run_tasks(load, [(group,) for group in independent(texts)]):
                pass
        finally:
            over.set()


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


def _is_complete() -> bool:
    """Whether the cache, which may be read-only, has the kernels, from this user or root."""
    from hiros_mcap import kernels

    try:
        return not kernels.missing() and kernels.is_private(kernels.cache_folder())
    except OSError:  # it is closed to this user
        return False


def _ensure_writable() -> bool:
    """Return whether the user's cache can be used; otherwise use a folder that goes at exit.

    The cache may be full, or closed to this user, or open to others, whose code must not run.
    Without a folder each process would compile all that it uses.
    """
    from hiros_cli.output import warn
    from hiros_mcap.kernels import cache_folder, is_private

    folder = cache_folder()
    why = "it is full or cannot be written, so each run compiles its kernels anew; mend that"
    try:
        folder.mkdir(mode=0o755, parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
        if not is_private(folder):
            why = "other users may write there, so its compiled kernels are not used; remove it"
        elif shutil.disk_usage(folder).free >= _SPACE:
            return True
    except OSError:
        pass
    warn(f"{folder}: {why}, or name a folder of your own in NUMBA_CACHE_DIR")
    private = tempfile.mkdtemp(prefix="hiros-kernels-")
    atexit.register(shutil.rmtree, private, ignore_errors=True)
    os.environ["NUMBA_CACHE_DIR"] = private
    return False
