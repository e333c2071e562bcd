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
    """Return the only compiled version of a kernel, for calls from Python.

    A call of the kernel itself looks up the type of every array in its NamedTuples, which takes
    0.2 us each, more than many kernels need for one message. Without the look-up nothing refuses
    an array of a wrong type, so pass only arrays that the caller has made itself.
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


@inlined
def rows_of(people: People, begin: int, end: int) -> People:
    """People from row ``begin`` on and before row ``end``, as views; for kernels."""
    return People(
        people.ids[begin:end],
        people.stamps[begin:end],
        people.confidences[begin:end],
        people.markers[begin:end],
        people.marker_confidences[begin:end],
        people.links[begin:end],
        people.link_confidences[begin:end],
        people.boxes[begin:end],
    )
