"""How kernels are compiled, and numba's names for what they take."""

from __future__ import annotations

from functools import partial
from types import FunctionType
from typing import Any

from numba import njit, types

from hiros_mcap.skeletons import People

# Without numba's reference counts, which kernels that make no arrays have no use for, the code is
# four times as fast.
_njit: Any = partial(njit, cache=True, nogil=True, error_model="numpy", _nrt=False)


def kernel(signature: Any, **options: Any) -> Any:
    """Compile a function that makes no arrays: ``@kernel``, or ``@kernel(signature)``.

    A private one cannot be called from Python (the process would die of it), only from kernels: to
    make them callable, too, would take an eighth of the time that compiling all of them takes.
    """
    if isinstance(signature, FunctionType):
        private = signature.__name__.startswith("_")
        return _njit(no_cpython_wrapper=private, no_cfunc_wrapper=private)(signature)
    return _njit(signature, **options)


def inlined(function: Any) -> Any:
    """Compile a helper into the kernels that call it.

    A call that is left to the compiler's choice may cost more than the helper does: a NamedTuple of
    arrays is passed as some 100 numbers.
    """
    private = function.__name__.startswith("_")
    wrappers = {"no_cpython_wrapper": private, "no_cfunc_wrapper": private}
    return _njit(forceinline=True, **wrappers)(function)


def direct(function: Any) -> Any:
    """Return a kernel of one signature for calls from Python that do not look up their types.

    For each array in a NamedTuple the look-up takes .2 us, more than many kernels do for one
    message. It is what refuses a wrong type, so this is for callers whose types are certain.
    """
    (compiled,) = function.overloads.values()
    return compiled.entry_point


def named_tuple(kind: type[Any], *fields: Any) -> Any:
    """Return numba's type of a NamedTuple, for signatures, from those of its fields."""
    if len(set(fields)) == 1:  # numba has a type of its own for equal fields
        return types.NamedUniTuple(fields[0], len(fields), kind)  # type: ignore[no-untyped-call]
    return types.NamedTuple(fields, kind)  # type: ignore[no-untyped-call]


# C-contiguous arrays: floats, 64-bit integers, 32-bit integers and flags, of 1 to 4 dimensions.
F1, F2 = types.float64[::1], types.float64[:, ::1]
F3, F4 = types.float64[:, :, ::1], types.float64[:, :, :, ::1]
I1, I2 = types.int64[::1], types.int64[:, ::1]
J1, J2 = types.int32[::1], types.int32[:, ::1]
B1, B2 = types.boolean[::1], types.boolean[:, ::1]

PEOPLE = named_tuple(People, J1, I1, F1, F3, F2, F3, F2, F2)
