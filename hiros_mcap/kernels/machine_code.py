"""Machine code of kernels: its files, and functions for Python from it.

numba compiles the code (``compile.py``). To run it takes LLVM's loader and two small libraries of
numba's. numba itself would cost each process a third of a second and 70 MB.
"""

from __future__ import annotations

import builtins
import ctypes
import json
import sys
import zlib
from collections.abc import Callable
from functools import cache
from importlib.machinery import PathFinder
from importlib.util import find_spec, module_from_spec
from pathlib import Path
from types import FunctionType
from typing import Any, NamedTuple

import llvmlite.binding as llvm  # type: ignore[import-untyped]


class MachineCode(NamedTuple):
    """A compiled kernel: an object file, and the names of two symbols in it."""

    function: str
    """Takes Python's objects, and returns one."""
    environment: str
    """Address of what the function needs of Python; it is set when the code is loaded."""
    machine: bytes


def read(path: Path) -> MachineCode | None:
    """Return what was written, or None if there is no such file, or it is damaged."""
    try:
        head, _, machine = path.read_bytes().partition(b"\n")
        function, environment, checksum = json.loads(head)
    except (OSError, ValueError):
        return None
    if checksum != zlib.crc32(machine):
        return None
    return MachineCode(function, environment, machine)


def write(path: Path, code: MachineCode) -> None:
    """Write a file, whole or not at all. Raises OSError or LogError if it cannot be written."""
    from hiros_mcap.outputs import replacing  # not above: its changes need no compilation

    path.parent.mkdir(parents=True, exist_ok=True)
    head = json.dumps([code.function, code.environment, zlib.crc32(code.machine)])
    with replacing(path) as temporary:
        temporary.write_bytes(f"{head}\n".encode() + code.machine)


def load(code: MachineCode, function: FunctionType) -> Callable[..., Any]:
    """Return a compiled function; it checks no types. ``function`` is what was compiled."""
    engine, closures = _engine(), _library("_dynfunc")
    engine.add_object_file(llvm.ObjectFileRef.from_data(code.machine))
    engine.finalize_object()
    environment = closures.Environment(function.__globals__)
    place = engine.get_global_value_address(code.environment)
    ctypes.c_void_p.from_address(place).value = id(environment)
    made: Callable[..., Any] = closures.make_function(
        sys.modules[function.__module__],
        function.__name__,
        function.__doc__ or "",
        engine.get_function_address(code.function),
        environment,
        (engine,),
    )
    return made


@cache
def _engine() -> Any:
    """LLVM's loader, which knows what compiled kernels call by the names that numba gives it.

    Raises OSError where the system lets no process make code.
    """
    llvm.check_jit_execution()
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    addresses = {"_Py_NoneStruct": id(None)}
    for each in vars(builtins).values():
        if isinstance(each, type) and issubclass(each, BaseException):
            addresses[f"PyExc_{each.__name__}"] = id(each)
    for library in (_library("_helperlib"), _library("_dynfunc")):
        addresses |= {f"numba_{name}": at for name, at in library.c_helpers.items()}
    for name, address in addresses.items():
        llvm.add_symbol(name, address)
    machine = llvm.Target.from_default_triple().create_target_machine()
    return llvm.create_mcjit_compiler(llvm.parse_assembly(""), machine)


@cache
def _library(name: str) -> Any:
    """Load a library of numba's, without numba."""
    full = f"numba.{name}"
    if full in sys.modules:
        return sys.modules[full]
    package = find_spec("numba")
    spec = PathFinder.find_spec(full, package.submodule_search_locations if package else None)
    if spec is None or spec.loader is None:
        raise ImportError(f"{full} is missing")
    library = module_from_spec(spec)
    spec.loader.exec_module(library)
    return library
