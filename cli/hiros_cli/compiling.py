"""The compiled kernels' cache, as far as a user notices it."""

from __future__ import annotations

import atexit
import contextlib
import os
import re
import shutil
import sys
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path

import hiros_mcap
from hiros_mcap.defaults import DEFAULT_SYSTEM, LIVE_SYSTEM

NOTICE = "hiros: compiling kernels for this machine, once (about a minute with two cores)"

RUN = ("hiros_mcap.running.pipeline",)
"""What a run of any system imports."""
DEFAULT_RUN = (*RUN, "hiros_mcap.stages.window_smoother", "hiros_mcap.stages.align_links")
"""What a run of the default system imports, some of it when it sets up the stages."""
ALL = ("hiros_mcap.kernels.*",)
"""Every kernel."""

_ADDRESSES = 512 << 20  # bytes; below that, libraries abort the program while they are loaded
_SPACE = 32 << 20  # bytes; all kernels take half of that
_PACKAGE = Path(hiros_mcap.__file__).parent
_KERNELS = "hiros_mcap.kernels."
_IMPORT = re.compile(r"^from (hiros_mcap[\w.]*) import (?:\(([^)]*)\)|(.*)$)", re.MULTILINE)


def prepare(*, quiet: bool, roots: Sequence[str] = ()) -> None:
    """Announce a compilation that is about to happen. Call before anything imports numba.

    ``roots`` are modules that will be imported. Kernels that they need and that are not compiled
    yet are compiled now, in several processes. Raises MemoryError if a limit leaves too little.
    """
    from hiros_mcap import kernels

    _ensure_memory()
    _ensure_writable()
    done = kernels.compiled()
    needed = needed_by(roots, kernels.sources()) if roots else {}
    missing = {name: text for name, text in needed.items() if name not in done}
    if missing if roots else not done:
        if not quiet:
            print(NOTICE, file=sys.stderr, flush=True)
        _compile([(group,) for group in independent(missing)])


def run_roots(system: str) -> tuple[str, ...]:
    """Return what a run of a system imports."""
    return DEFAULT_RUN if system in (DEFAULT_SYSTEM, LIVE_SYSTEM) else RUN


def needed_by(roots: Sequence[str], sources: Mapping[str, str]) -> dict[str, str]:
    """Return those of the ``sources`` of kernels that are compiled when ``roots`` are imported."""
    if roots == ALL:
        return dict(sources)
    found: set[str] = set()
    waiting = list(roots)
    while waiting:
        name = waiting.pop()
        if name and name not in found:
            found.add(name)
            waiting += [name.rpartition(".")[0], *_imports(name)]
    return {name: text for name, text in sources.items() if _KERNELS + name in found}


def _imports(module: str) -> list[str]:
    """Return what a module imports of this package when it is imported itself."""
    path = _PACKAGE.joinpath(*module.split(".")[1:])
    path = path / "__init__.py" if path.is_dir() else path.with_suffix(".py")
    return imported(path.read_text()) if path.is_file() else []


def imported(source: str) -> list[str]:
    """Return the modules of this package that a source names in imports at its top level."""
    modules = []
    for package, many, few in _IMPORT.findall(source):
        names = re.findall(r"(\w+)(?: as \w+)?", many or few.partition("#")[0])
        modules += [package, *(f"{package}.{name}" for name in names)]
    return modules


def independent(sources: Mapping[str, str]) -> list[list[str]]:
    """Return modules of kernels in groups that do not import each other, the longest first."""
    groups: list[set[str]] = []
    for name, text in sources.items():
        imports = {module.removeprefix(_KERNELS) for module in imported(text)}
        joined = {name, *(imports & sources.keys())}
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
