"""Compiled inner loops: numba functions on bare arrays, no objects, no input/output.

Those that several folders use are here. Those of one step lie beside its page, in its folder of
stages or in calibrate.

Kernels state their signatures, so they are compiled (or loaded) when their module is imported,
never in the middle of a run, and a wrong array layout is a TypeError rather than a silent second
compilation.

A wheel brings them compiled (``shipped.py``). Elsewhere numba compiles them once (``compile.py``)
into a folder of the user. It has a folder for each module, whose name holds a hash of the module
and of all that it imports: a change of a callee in another module compiles it anew. To run them
takes no numba (``machine_code.py``).
"""

from __future__ import annotations

import hashlib
import os
import re
import sys
from collections.abc import Mapping, Sequence
from functools import cache
from importlib import import_module
from importlib.metadata import version
from pathlib import Path

NOTICE = "compiling kernels for this machine, once (1 to 2 minutes of CPU time)"

# A kernel that Python calls; the others are compiled into their callers.
_ENTRY = re.compile(r"^@entry\b.*\ndef (\w+)", re.MULTILINE)
_IMPORT = re.compile(r"^from (hiros_mcap[\w.]*) import (?:\(([^)]*)\)|(.*)$)", re.MULTILINE)
_PACKAGE = Path(__file__).parent.parent
_PLACES = ("kernels/*.py", "calibrate/*.py", "stages/*.py", "stages/*/*.py", "rays/*.py")


def sources() -> Mapping[str, str]:
    """Name -> source of every module that is compiled when it is imported."""
    texts = {}
    for path in sorted(path for place in _PLACES for path in _PACKAGE.glob(place)):
        name = ".".join(path.relative_to(_PACKAGE.parent).with_suffix("").parts)
        texts[name] = path.read_text()
    return {name: text for name, text in texts.items() if _ENTRY.search(text)}


def imported(source: str) -> list[str]:
    """Return the modules of hiros_mcap that a source names in imports at its top level."""
    modules = []
    for package, many, few in _IMPORT.findall(source):
        names = re.findall(r"(\w+)(?: as \w+)?", many or few.partition("#")[0])
        modules += [package, *(f"{package}.{name}" for name in names)]
    return modules


@cache
def reached(module: str) -> frozenset[str]:
    """Return the modules of hiros_mcap that a module of it imports, directly or not."""
    path = _PACKAGE.joinpath(*module.split(".")[1:]).with_suffix(".py")
    direct = imported(path.read_text()) if path.is_file() else []
    return frozenset(direct).union(*map(reached, direct))


@cache
def digest(module: str) -> str:
    """Hash of a module of hiros_mcap and of all modules of it that it imports; "" if none is so."""
    path = _PACKAGE.joinpath(*module.split(".")[1:]).with_suffix(".py")
    if not path.is_file():
        return ""
    source = path.read_text()
    parts = [source, *map(digest, sorted(set(imported(source))))]
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()


@cache
def _compiler() -> str:
    """Python, numba (which is not imported for it), this processor, and a hash of what it can."""
    import llvmlite.binding as llvm  # type: ignore[import-untyped]

    can = hashlib.sha256(llvm.get_host_cpu_features().flatten().encode()).hexdigest()[:8]
    numba, python = version("numba"), sys.implementation.cache_tag
    return f"{python}-numba-{numba}-{llvm.get_host_cpu_name()}-{can}"


def cache_folder() -> Path:
    """Folder for what this Python and this numba have compiled for this processor."""
    import platformdirs

    root = os.environ.get("NUMBA_CACHE_DIR") or platformdirs.user_cache_dir("hiros")
    return Path(root, f"kernels-{_compiler()}")


def folder_of(module: str) -> Path:
    """Folder for the compiled code of a module of kernels as it is now."""
    return cache_folder() / f"{module.rpartition('.')[2]}-{digest(module)[:16]}"


@cache
def is_private(folder: Path) -> bool:
    """Whether only this user, or root, can have put code into a folder of compiled kernels."""
    if not hasattr(os, "geteuid"):  # Windows, where the user's folder is private
        return True
    folders = [folder, *filter(Path.is_dir, folder.iterdir())] if folder.is_dir() else []
    states = [path.stat() for path in folders]
    return all(s.st_uid in (0, os.geteuid()) and not s.st_mode & 0o022 for s in states)


def missing() -> dict[str, list[Path]]:
    """Return module -> files of its kernels that no former run on this machine has compiled."""
    files = {
        module: [folder_of(module) / f"{module}.{name}" for name in _ENTRY.findall(source)]
        for module, source in sources().items()
    }
    absent = {module: [f for f in paths if not f.exists()] for module, paths in files.items()}
    return {module: paths for module, paths in absent.items() if paths}


def load(modules: Sequence[str]) -> None:
    """Import modules of kernels, which compiles them unless that was done before."""
    for module in modules:
        import_module(module)
