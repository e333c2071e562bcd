"""Compiled kernels that a wheel brings, made for every processor of one kind (``hatch_build.py``).

They are used all or none: where a source, Python or the processor differs from what the manifest
names, or numba is of a version that nobody has tried, numba compiles for this machine, as in a
checkout.
"""

from __future__ import annotations

import hashlib
import json
import logging
import os
import platform
import sys
from functools import cache
from importlib.metadata import version
from pathlib import Path

from hiros_mcap import kernels

FOLDER = Path(__file__).parent.parent / "_compiled"
MANIFEST = FOLDER / "manifest.json"

CPU = "x86-64-v3"  # LLVM's name of processors with AVX2: Intel's since 2013, AMD's since 2015
NUMBA = ((0, 60), (0, 68))
"""The oldest and the newest numba whose libraries have been seen to run code of all between them;
``.ci/run`` tries both."""
NEEDS = ("avx", "avx2", "bmi", "bmi2", "cx16", "f16c", "fma", "lzcnt", "movbe", "popcnt", "sse4.2")
"""LLVM's names of what :data:`CPU` can do."""

CHOICE = "HIROS_KERNELS"
"""Environment variable: "compile" does without shipped kernels, in a build and in a run."""


@cache
def usable() -> bool:
    """Whether there are kernels for this source, Python and processor, and a numba to run them."""
    if os.environ.get(CHOICE) == "compile":
        return False
    try:
        manifest = json.loads(MANIFEST.read_text())
    except (OSError, ValueError):
        return False
    return manifest == identity() and runs_on(_features()) and runs_with(version("numba"))


@cache
def announce() -> None:
    """Log, once in a process, that a minute will go by, if the kernels are to be compiled."""
    if not usable() and kernels.missing().keys() == kernels.sources().keys():
        logging.getLogger(__name__).warning(kernels.NOTICE)


def identity() -> dict[str, str]:
    """Return what compiled kernels depend on, apart from the processor."""
    return {
        "sources": digest(),
        "python": f"{sys.implementation.cache_tag}{getattr(sys, 'abiflags', '')}",
        "platform": f"{sys.platform}-{platform.machine()}",
    }


def digest() -> str:
    """Hash of the sources of all kernels, and of all that they import."""
    parts = [
        kernels.digest(module) for module in (*kernels.sources(), f"{kernels.__name__}.compile")
    ]
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()


def runs_on(features: dict[str, bool]) -> bool:
    """Whether a processor with these features, by LLVM's names, runs code made for :data:`CPU`."""
    return all(features.get(name) for name in NEEDS)


def runs_with(numba: str) -> bool:
    """Whether a version of numba has the libraries that compiled kernels call."""
    oldest, newest = NUMBA
    major, minor = numba.split(".")[:2]
    return oldest <= (int(major), int(minor)) <= newest


def _features() -> dict[str, bool]:
    import llvmlite.binding as llvm  # type: ignore[import-untyped]

    return dict(llvm.get_host_cpu_features())
