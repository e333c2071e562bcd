"""The compiled kernels' cache, as far as a user notices it."""

from __future__ import annotations

import atexit
import contextlib
import os
import shutil
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

NOTICE = "hiros: compiling kernels for this machine, once (about 20 s with two cores)"

_SPACE = 32 << 20  # bytes; all kernels take half of that

RUN = (
    ("tracking", "averaging", "merging", "record_index"),
    ("cdr", "encode", "batch", "gathering", "optimizing", "state_space", "link_lengths"),
)
"""Modules that a run by the default system needs, in parts that take about as long to compile and
share nothing that is to be compiled."""
ALL = (
    (*RUN[0], "clustering", "joint_filter", "limb_lengths", "predicting"),
    (*RUN[1], "butterworth", "cleaning", "drawing", "transforming", "distance"),
)
"""Every module, in such parts."""


def prepare(*, quiet: bool, parts: Sequence[Sequence[str]] = ()) -> None:
    """Announce a compilation that is about to happen. Call before anything imports numba.

    ``parts`` are modules of kernels that will be needed: those that are not compiled yet are
    compiled here and now, each part in a process of its own.
    """
    from hiros_mcap import kernels

    _ensure_writable()
    done = kernels.compiled()
    needed = [[name for name in part if name not in done] for part in parts]
    if any(needed) if parts else not done:
        if not quiet:
            print(NOTICE, file=sys.stderr, flush=True)
        _compile([(part,) for part in needed if part])


def _compile(tasks: Sequence[tuple[Sequence[str]]]) -> None:
    from hiros_mcap.errors import HirosError
    from hiros_mcap.kernels import load
    from hiros_mcap.workers import run_tasks

    # Where there is no memory for several processes, this one compiles what is left, as it goes.
    with contextlib.suppress(HirosError):
        for _ in run_tasks(load, tasks):
            pass


def _ensure_writable() -> None:
    """Use a private folder, removed at exit, where the user's cache cannot be written, or is full.

    Without a folder numba refuses to import a cached kernel at all. The folder is private to the
    process: compiled code that another user could have put there must not be loaded.
    """
    folder = Path(os.environ["NUMBA_CACHE_DIR"])
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
