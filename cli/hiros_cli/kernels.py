"""The compiled kernels' cache, as far as a user notices it."""

from __future__ import annotations

import os
import sys
import tempfile
from pathlib import Path

NOTICE = "hiros: compiling kernels for this machine, once (about half a minute)"


def prepare(*, quiet: bool) -> None:
    """Announce a compilation that is about to happen. Call before anything imports numba."""
    from hiros_mcap import kernels

    _ensure_writable()
    if not quiet and not kernels.is_compiled():
        print(NOTICE, file=sys.stderr, flush=True)


def _ensure_writable() -> None:
    """Use a private folder, removed at exit, where the user's cache cannot be written.

    Without a folder numba refuses to import a cached kernel at all. The folder is private to the
    process: compiled code that another user could have put there must not be loaded.
    """
    folder = Path(os.environ["NUMBA_CACHE_DIR"])
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return
    except OSError:
        import atexit
        import shutil

        private = tempfile.mkdtemp(prefix="hiros-kernels-")
        atexit.register(shutil.rmtree, private, ignore_errors=True)
        os.environ["NUMBA_CACHE_DIR"] = private
