"""How kernels are compiled, and called."""

from __future__ import annotations

import gc
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import cached_property, partial
from types import FunctionType
from typing import Any

from hiros_mcap.errors import HirosError, LogError
from hiros_mcap.kernels import folder_of, is_private, shipped
from hiros_mcap.kernels.array_types import Array, Fields, check_of, type_of
from hiros_mcap.kernels.machine_code import MachineCode, load, read, write
from hiros_mcap.skeletons import People

_ALLOCATIONS = 50_000  # objects between two collections of the youngest: 10 MB, at most


class Kernel:
    """A kernel for other kernels. It is compiled when one of them is."""

    def __init__(self, function: FunctionType, **options: Any) -> None:
        self.function = function
        self._options = options

    def __call__(self, *arguments: Any) -> Any:
        """Compile for Python, which takes seconds in each process; tests do so."""
        return self._for_python(*arguments)

    @cached_property
    def _for_python(self) -> Any:
        return _numba(self.function)

    @cached_property
    def _for_kernels(self) -> Any:
        return _numba(self.function, no_cpython_wrapper=True, **self._options)

    @property
    def _numba_type_(self) -> Any:
        return self._for_kernels._numba_type_  # which does not keep it alive


class EntryKernel(Kernel):
    """A kernel that Python calls.

    Attributes
    ----------
    raw : the compiled function, which looks at no types. A check of every array costs 0.3 us, more
        than many kernels need for one message. Pass only what the caller has made itself.
    """

    def __init__(self, function: FunctionType, nogil: bool) -> None:
        super().__init__(function)
        self._nogil = nogil
        names = function.__globals__
        *takes, self._gives = [type_of(a, names) for a in function.__annotations__.values()]
        self._takes = Fields(tuple, tuple(takes))
        self._check = check_of(self._takes)
        self.raw: Callable[..., Any] = load(self._code(), function)

    def __call__(self, *arguments: Any) -> Any:
        """Call the kernel. Raises TypeError where it would read what is not there."""
        if not self._check(arguments):
            raise TypeError(f"{self.function.__name__} takes {self._takes.fields}, not {arguments}")
        return self.raw(*arguments)

    def _code(self) -> MachineCode:
        """Read the machine code, or compile it and keep it.

        Raises HirosError if the installation has brought a damaged one.
        """
        module = self.function.__module__
        name = f"{module}.{self.function.__name__}"
        if shipped.usable():
            if code := read(shipped.FOLDER / name, name):
                return code
            raise HirosError(
                f"the compiled code of {name} is damaged; install hiros-mcap again, "
                f"or set {shipped.CHOICE}=compile"
            )
        folder = folder_of(module)
        private = is_private(folder.parent)
        if private and (code := read(folder / name, name)):
            return code
        code = self._compile(name)
        if private:
            # Where the folder cannot be written, the next process compiles again.
            with suppress(OSError, LogError):
                write(folder / name, code)
        return code

    @cached_property
    def _for_kernels(self) -> Any:
        """Functions that other kernels call, too: a process compiles each of them once."""
        return _numba(self.function, nogil=self._nogil)

    def _compile(self, name: str) -> MachineCode:
        with _few_collections():
            signature = _numba_type(self._gives)(*map(_numba_type, self._takes.fields))
            self._for_kernels.compile(signature)
            compiled = self._for_kernels.overloads[signature.args]
            _, _, (machine, _) = compiled.library.serialize_using_object_code()
        names = compiled.fndesc
        return MachineCode(name, names.llvm_cpython_wrapper_name, names.env_name, machine)


@contextmanager
def _few_collections() -> Iterator[None]:
    """Look for garbage seldom: a twentieth of numba's time goes there, and it makes little."""
    usual = gc.get_threshold()
    gc.set_threshold(_ALLOCATIONS)
    try:
        yield
    finally:
        gc.set_threshold(*usual)


def _numba(function: FunctionType, **options: Any) -> Any:
    """Return what numba compiles for its callers.

    Without numba's reference counts, which kernels that make no arrays have no use for, the code is
    four times as fast.
    """
    import numba
    from numba import types

    njit: Any = numba.njit
    compiled = njit(error_model="numpy", _nrt=False, no_cfunc_wrapper=True, **options)(function)
    choose = compiled.get_call_template

    def choose_alike(arguments: Any, names: Any) -> Any:
        """Choose what is compiled for a call; not anew for each number that stands in one."""
        return choose([*map(types.unliteral, arguments)], names)

    compiled.get_call_template = choose_alike
    return compiled


def _numba_type(kind: Any) -> Any:
    """Return numba's type of what a kernel takes or gives."""
    from numba import types

    if isinstance(kind, Array):
        numbers = getattr(types, kind.numbers)
        return types.Array(numbers, kind.dimensions, "C", readonly=not kind.written)
    if isinstance(kind, Fields):
        fields = [*map(_numba_type, kind.fields)]
        named = () if kind.kind is tuple else (kind.kind,)
        numba: Any = types
        if len(set(fields)) > 1:
            return numba.NamedTuple(fields, *named)
        # numba has a type of its own for equal fields.
        equal = numba.NamedUniTuple if named else numba.UniTuple
        return equal(fields[0], len(fields), *named)
    return {float: types.float64, int: types.int64, bool: types.boolean, None: types.void}[kind]


def kernel(function: Any) -> Any:
    """Compile a function that makes no arrays, for other kernels."""
    return Kernel(function)


def inlined(function: Any) -> Any:
    """Compile a helper into the kernels that call it.

    A call that is left to the compiler's choice may cost more than the helper does: a NamedTuple of
    arrays is passed as some 100 numbers.
    """
    return Kernel(function, forceinline=True)


def entry(function: Any = None, *, nogil: bool = True) -> Any:
    """Compile a kernel that Python calls, when its module is imported.

    Its signature is what its annotations name: arrays (``array_types.py``), NamedTuples of them, or
    float, int and bool. ``nogil``: whether other threads run meanwhile.
    """
    return partial(EntryKernel, nogil=nogil) if function is None else EntryKernel(function, nogil)


@inlined
def rows_of(people: People, begin: int, end: int) -> People:
    """People from row ``begin`` on and before row ``end``, as views; for kernels."""
    return People(
        people.ids[begin:end], people.stamps[begin:end], people.confidences[begin:end],
        people.markers[begin:end], people.marker_confidences[begin:end], people.links[begin:end],
        people.link_confidences[begin:end], people.boxes[begin:end],
    )  # fmt: skip
