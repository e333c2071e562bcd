"""Types of the parameters of kernels: arrays, and NamedTuples of them."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from operator import attrgetter, call
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

import numpy as np
import numpy.typing as npt

from hiros_mcap.skeletons import Flags, Floats, Ints, People, Stamps


class Array(NamedTuple):
    """A C-contiguous array: its numbers by NumPy's name, and whether a kernel writes into it."""

    numbers: str
    dimensions: int
    written: bool = True


class Fields(NamedTuple):
    """A NamedTuple of arrays and numbers, or a tuple."""

    kind: type[Any]
    fields: tuple[Any, ...]


# C-contiguous arrays of 1 to 4 dimensions: floats, 64-bit integers, 32-bit integers, flags, bytes
# (C1: only read) and words of 64 bits. They annotate what a kernel takes.
if TYPE_CHECKING:
    F1 = Floats
    F2 = Floats
    F3 = Floats
    F4 = Floats
    I1 = Stamps
    I2 = Stamps
    I3 = Stamps
    J1 = Ints
    J2 = Ints
    J3 = Ints
    B1 = Flags
    B2 = Flags
    C1 = npt.NDArray[np.uint8]
    U1 = npt.NDArray[np.uint8]
    W1 = npt.NDArray[np.uint64]
    W2 = npt.NDArray[np.uint64]
else:
    F1, F2, F3, F4 = (Array("float64", n) for n in (1, 2, 3, 4))
    I1, I2, I3 = (Array("int64", n) for n in (1, 2, 3))
    J1, J2, J3 = (Array("int32", n) for n in (1, 2, 3))
    B1, B2 = (Array("bool", n) for n in (1, 2))
    C1, U1 = Array("uint8", 1, written=False), Array("uint8", 1)
    W1, W2 = (Array("uint64", n) for n in (1, 2))

_BUILT_IN = {
    "float": float, "int": int, "bool": bool, "None": None,
    "tuple[int, int]": Fields(tuple, (int,) * 2),
    "tuple[int, int, int, int]": Fields(tuple, (int,) * 4),
}  # fmt: skip
_NUMBERS: dict[Any, Any] = {
    float: (float, int, np.floating, np.integer),
    int: (int, np.integer),
    bool: (bool, np.bool_),
}
_READ = attrgetter("dtype", "ndim", "flags.c_contiguous")
_WRITTEN = attrgetter("dtype", "ndim", "flags.carray")

N = TypeVar("N", bound=tuple[Any, ...])


def type_of(annotation: str, names: Mapping[str, Any]) -> Any:
    """Return what an annotation stands for, where a module defines ``names``.

    An :class:`Array`, a :class:`Fields`, float, int, bool or None.
    """
    if annotation in _BUILT_IN:
        return _BUILT_IN[annotation]
    return fields_of(kind) if isinstance(kind := names[annotation], type) else kind


@cache
def fields_of(kind: type[Any]) -> Fields:
    """Return what a NamedTuple holds, from the annotations of its fields."""
    if kind is People:
        return Fields(kind, (J1, I1, F1, F3, F2, F3, F2, F2))
    names = vars(sys.modules[kind.__module__])
    fields = kind.__annotations__.values()
    return Fields(kind, tuple(type_of(each.__forward_arg__, names) for each in fields))


def check_of(kind: Fields) -> Callable[[Any], bool]:
    """Return what tells whether a value is such a tuple.

    It is one call of Python for each tuple: what the fields look like is looked up in C.
    """
    named, (looks, right) = kind.kind, zip(*map(_look_of, kind.fields), strict=True)
    wanted = [*right]

    def is_right(value: Any) -> bool:
        try:
            return (
                type(value) is named
                and len(value) == len(wanted)
                and [*map(call, looks, value)] == wanted
            )
        except AttributeError:  # what is no array has no dtype
            return False

    return is_right


def _look_of(kind: Any) -> tuple[Callable[[Any], Any], Any]:
    """Return what looks at a value, and what it finds if the value is of a kind."""
    if isinstance(kind, Array):
        look = _WRITTEN if kind.written else _READ
        return look, (np.dtype(kind.numbers), kind.dimensions, True)
    if isinstance(kind, Fields):
        return check_of(kind), True
    return lambda value: isinstance(value, _NUMBERS[kind]), True


def arrays(kind: type[N], *shapes: Any) -> N:
    """Return a NamedTuple of zeros, from the shapes of its arrays; tuples in it are given whole."""
    fields = zip(shapes, fields_of(kind).fields, strict=True)
    return kind(*[s if hasattr(s, "_fields") else np.zeros(s, t.numbers) for s, t in fields])


def settings_of(kind: type[N], params: object, **others: Any) -> N:
    """Return those parameters of a stage that its kernels take, and what else these take."""
    names = kind.__annotations__
    return kind(*[others[n] if n in others else getattr(params, n) for n in names])


def chosen(arrays: N, rows: Any) -> N:
    """Return some rows of a NamedTuple of arrays: a slice, which shares them, a mask or indices."""
    return type(arrays)(*[array[rows] for array in arrays])


def joined(parts: Sequence[N]) -> N:
    """Return NamedTuples of arrays, one behind the other."""
    return type(parts[0])(*map(np.concatenate, zip(*parts, strict=True)))
