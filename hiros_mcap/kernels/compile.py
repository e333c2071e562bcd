"""How kernels are compiled."""

from __future__ import annotations

from contextlib import suppress
from functools import partial
from types import FunctionType
from typing import Any

from numba import njit
from numba.core import caching
from numba.core.runtime.nrt import rtsys

from hiros_mcap.kernels import folder_of, shipped
from hiros_mcap.kernels.array_types import numba_type
from hiros_mcap.skeletons import People

# Without numba's reference counts, which kernels that make no arrays have no use for, the code is
# four times as fast.
_njit: Any = partial(njit, nogil=True, error_model="numpy", _nrt=False)


class _Folder(caching._CacheLocator):
    """Tells numba where the code of a kernel lies.

    numba's own setting for that would hold for all other functions of the process, too.
    """

    def __init__(self, function: FunctionType) -> None:
        self._module = function.__module__
        self._line = function.__code__.co_firstlineno

    def get_cache_path(self) -> str:
        return str(shipped.FOLDER if shipped.usable() else folder_of(self._module))

    def get_source_stamp(self) -> str:
        return ""  # the folder holds code of the present sources only

    def get_disambiguator(self) -> str:
        return str(self._line)

    @classmethod
    def from_function(cls, function: FunctionType, _: str) -> _Folder:
        return cls(function)


class _Files(caching.CompileResultCacheImpl):
    _locator_classes = [_Folder]  # type: ignore[list-item]  # noqa: RUF012


class _KernelCache(caching.FunctionCache):
    """numba's cache of compiled code, which shipped code comes from as well."""

    _impl_class = _Files

    def _index_key(self, signature: Any, codegen: Any) -> Any:
        signature, target, code = super()._index_key(signature, codegen)  # type: ignore[no-untyped-call]
        if shipped.usable():
            target = target[0], shipped.CPU, ""  # this processor runs it, whatever its own name is
        return signature, target, code

    def load_overload(self, signature: Any, context: Any) -> Any:
        if not shipped.usable():
            return super().load_overload(signature, context)  # type: ignore[no-untyped-call]
        # numba's own way loads all that a compilation would need, a fifth of a second.
        rtsys.initialize(context)
        return self._load_overload(signature, context)  # type: ignore[no-untyped-call]

    def save_overload(self, signature: Any, data: Any) -> None:
        if not shipped.usable():
            with suppress(OSError):  # the folder cannot be written: the next process compiles again
                super().save_overload(signature, data)  # type: ignore[no-untyped-call]


def kernel(function: Any) -> Any:
    """Compile a function that makes no arrays, for other kernels; see :func:`entry`.

    A private one cannot be called from Python: the process would die of it. To make those callable,
    too, would take an eighth of the time that compiling all of them takes. A public one must not be
    called from Python either: nothing ships it.
    """
    private = function.__name__.startswith("_")
    return _cached(function, no_cpython_wrapper=private, no_cfunc_wrapper=private)


def entry(function: Any = None, *, signature: Any = None, **options: Any) -> Any:
    """Compile a kernel that Python calls, when its module is imported.

    Its signature is what its annotations name: numba's types, NamedTuples of them, or float, int
    and bool. ``_nrt=True`` is for a kernel that makes arrays after all.
    """
    if function is None:
        return partial(entry, signature=signature, **options)
    if signature is None:
        names = function.__globals__
        *given, result = [numba_type(name, names) for name in function.__annotations__.values()]
        signature = result(*given)
    compiled = _cached(function, **options)
    compiled.compile(signature)
    compiled.disable_compile()
    return compiled


def _cached(function: FunctionType, **options: Any) -> Any:
    dispatcher = _njit(**options)(function)
    dispatcher._cache = _KernelCache(function)  # type: ignore[no-untyped-call]
    return dispatcher


def inlined(function: Any) -> Any:
    """Compile a helper into the kernels that call it.

    A call that is left to the compiler's choice may cost more than the helper does: a NamedTuple of
    arrays is passed as some 100 numbers.
    """
    private = function.__name__.startswith("_")
    wrappers = {"no_cpython_wrapper": private, "no_cfunc_wrapper": private}
    return _cached(function, forceinline=True, **wrappers)


def direct(function: Any) -> Any:
    """Return the only compiled version of a kernel, for calls from Python.

    A call of the kernel itself looks up the type of every array in its NamedTuples, which takes
    0.2 us each, more than many kernels need for one message. Without the look-up nothing refuses
    an array of a wrong type, so pass only arrays that the caller has made itself.
    """
    (compiled,) = function.overloads.values()
    return compiled.entry_point


@inlined
def rows_of(people: People, begin: int, end: int) -> People:
    """People from row ``begin`` on and before row ``end``, as views; for kernels."""
    return People(
        people.ids[begin:end], people.stamps[begin:end], people.confidences[begin:end],
        people.markers[begin:end], people.marker_confidences[begin:end], people.links[begin:end],
        people.link_confidences[begin:end], people.boxes[begin:end],
    )  # fmt: skip
