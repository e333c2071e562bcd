"""numba's names for what kernels take: arrays, and NamedTuples of them."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from functools import cache
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
import numpy.typing as npt
from numba import types

from hiros_mcap.skeletons import Flags, Floats, Ints, People, Stamps

# C-contiguous arrays of 1 to 4 dimensions: floats, 64-bit integers, 32-bit integers, flags, floats
# of 32 bits, bytes (C1: only read) and words of 64 bits. They annotate what a kernel takes.
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
    S2 = npt.NDArray[np.float32]
    S3 = npt.NDArray[np.float32]
    C1 = npt.NDArray[np.uint8]
    U1 = npt.NDArray[np.uint8]
    W1 = npt.NDArray[np.uint64]
else:
    F1, F2 = types.float64[::1], types.float64[:, ::1]
    F3, F4 = types.float64[:, :, ::1], types.float64[:, :, :, ::1]
    I1, I2, I3 = types.int64[::1], types.int64[:, ::1], types.int64[:, :, ::1]
    J1, J2, J3 = types.int32[::1], types.int32[:, ::1], types.int32[:, :, ::1]
    B1, B2 = types.boolean[::1], types.boolean[:, ::1]
    S2, S3 = types.float32[:, ::1], types.float32[:, :, ::1]
    C1, U1, W1 = (
        types.Array(types.uint8, 1, "C", readonly=True),
        types.uint8[::1],
        types.uint64[::1],
    )

_BUILT_IN = {
    "float": types.float64, "int": types.int64, "bool": types.boolean, "None": types.void,
    "tuple[int, int]": types.UniTuple(types.int64, 2),  # type: ignore[no-untyped-call]
}  # fmt: skip

N = TypeVar("N", bound=tuple[Any, ...])


def numba_type(annotation: str, names: Mapping[str, Any]) -> Any:
    """Return the type that an annotation stands for, where a module defines ``names``."""
    if annotation in _BUILT_IN:
        return _BUILT_IN[annotation]
    return named_tuple(kind) if isinstance(kind := names[annotation], type) else kind


@cache
def named_tuple(kind: type[Any]) -> Any:
    """Return numba's type of a NamedTuple, from the annotations of its fields."""
    if kind is People:
        fields = [J1, I1, F1, F3, F2, F3, F2, F2]
        return types.NamedTuple(fields, kind)  # type: ignore[no-untyped-call]
    names = vars(sys.modules[kind.__module__])
    fields = [numba_type(each.__forward_arg__, names) for each in kind.__annotations__.values()]
    if len(set(fields)) == 1:  # numba has a type of its own for equal fields
        return types.NamedUniTuple(fields[0], len(fields), kind)  # type: ignore[no-untyped-call]
    return types.NamedTuple(fields, kind)  # type: ignore[no-untyped-call]


def arrays(kind: type[N], *shapes: Any) -> N:
    """Return a NamedTuple of zeros, from the shapes of its arrays; tuples in it are given whole."""
    fields = zip(shapes, named_tuple(kind).types, strict=True)
    return kind(*[s if hasattr(s, "_fields") else np.zeros(s, str(t.dtype)) for s, t in fields])


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
