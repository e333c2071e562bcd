"""Machine code of kernels: its files, and functions for Python from it.

numba compiles the code (``compile.py``). To run it takes LLVM's loader and two small libraries of
numba's. numba itself would cost each process a third of a second and 70 MB.
"""

from __future__ import annotations

import builtins
import ctypes
import hashlib
import json
import sys
from collections.abc import Callable
from functools import cache
from importlib.machinery import PathFinder
from importlib.util import find_spec, module_from_spec
from pathlib import Path
from types import FunctionType
from typing import Any, NamedTuple

import llvmlite.binding as llvm  # type: ignore[import-untyped]

from hiros_mcap.errors import HirosError

_CHECKSUM_BYTES = hashlib.sha256().digest_size


class MachineCode(NamedTuple):
    """A compiled kernel: an object file, and the names of two symbols in it."""

    kernel: str
    """Its module and its name."""
    function: str
    """Takes Python's objects, and returns one."""
    environment: str
    """Address of what the function needs of Python; it is set when the code is loaded."""
    machine: bytes


def read(path: Path, kernel: str) -> MachineCode | None:
    """Return the code of a kernel, or None if there is no file of it, or the file is damaged."""
    try:
        data = path.read_bytes()
    except OSError:
        return None
    checksum, rest = data[:_CHECKSUM_BYTES], data[_CHECKSUM_BYTES:]
    if checksum != hashlib.sha256(rest).digest():
        return None
    head, _, machine = rest.partition(b"\n")
    name, function, environment = json.loads(head)
    return MachineCode(name, function, environment, machine) if name == kernel else None


def write(path: Path, code: MachineCode) -> None:
    """Write a file, whole or not at all. Raises OSError or LogError if it cannot be written."""
    from hiros_mcap.outputs import replacing  # not above: its changes need no compilation

    for folder in (path.parent.parent, path.parent):  # which others must not write, by any umask
        folder.mkdir(mode=0o755, parents=True, exist_ok=True)
    head = json.dumps([code.kernel, code.function, code.environment])
    rest = f"{head}\n".encode() + code.machine
    with replacing(path) as temporary:
        temporary.write_bytes(hashlib.sha256(rest).digest() + rest)


def load(code: MachineCode, function: FunctionType) -> Callable[..., Any]:
    """Return a compiled function; it checks no types. ``function`` is what was compiled.

    Raises HirosError if the code has no such function, for example because of another LLVM.
    """
    engine, closures = _engine(), _library("_dynfunc")
    engine.add_object_file(llvm.ObjectFileRef.from_data(code.machine))
    engine.finalize_object()
    environment = closures.Environment(function.__globals__)
    place = engine.get_global_value_address(code.environment)
    start = engine.get_function_address(code.function)
    if not (place and start):
        raise HirosError(f"the compiled code of {code.kernel} has no such function")
    # The function reads a pointer to this object, whose address is its id in CPython.
    ctypes.c_void_p.from_address(place).value = id(environment)
    made: Callable[..., Any] = closures.make_function(
        sys.modules[function.__module__],
        function.__name__,
        function.__doc__ or "",
        start,
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
    for builtin in vars(builtins).values():
        if isinstance(builtin, type) and issubclass(builtin, BaseException):
            addresses[f"PyExc_{builtin.__name__}"] = id(builtin)
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
