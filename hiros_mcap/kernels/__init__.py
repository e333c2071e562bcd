"""Compiled inner loops: ``@njit`` functions on bare arrays, no objects, no input/output.

Importing this package chooses numba's cache folder *before* numba is imported. The folder's name
holds a hash of every kernel source: numba itself does not notice that a callee in another module
changed, and would go on running the old code.

Kernels state their signatures, so they are compiled (or loaded) when their module is imported,
never in the middle of a run, and a wrong array layout is a TypeError rather than a silent second
compilation.
"""

from __future__ import annotations

import hashlib
import os
import re
from collections.abc import Mapping, Sequence
from importlib import import_module
from importlib.metadata import version
from pathlib import Path

# A kernel that states its signature; one without is compiled into its callers.
_SIGNED = re.compile(r"^@(?:kernel|njit)\((?!\s*\w+=)", re.MULTILINE)


def sources() -> Mapping[str, str]:
    """Name -> source of every module that is compiled when it is imported."""
    texts = {path.stem: path.read_text() for path in sorted(Path(__file__).parent.glob("*.py"))}
    return {name: text for name, text in texts.items() if _SIGNED.search(text)}


def cache_folder() -> Path:
    """Folder for compiled kernels of exactly this source, at this place, and this numba.

    numba takes no kernel that was compiled for a source at another place. In one folder for both,
    a second installation would seem to be compiled.
    """
    import platformdirs

    digest = hashlib.sha256(version("numba").encode())
    digest.update(str(Path(__file__).parent).encode())
    for source in sorted(Path(__file__).parent.glob("*.py")):
        digest.update(source.name.encode())
        digest.update(source.read_bytes())
    return Path(platformdirs.user_cache_dir("hiros")) / f"kernels-{digest.hexdigest()[:16]}"


def compiled() -> set[str]:
    """Modules of which a former run on this machine has compiled kernels."""
    folder = Path(os.environ["NUMBA_CACHE_DIR"])
    return {path.name.partition(".")[0] for path in folder.rglob("*.nbi")}


def load(modules: Sequence[str]) -> None:
    """Import modules of kernels, which compiles them unless that was done before."""
    for module in modules:
        import_module(f"{__name__}.{module}")


os.environ.setdefault("NUMBA_CACHE_DIR", str(cache_folder()))
