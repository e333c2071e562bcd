"""Load, store and copy at any byte offset of an array, which numba itself cannot do.

Every function here is compiled into its caller; arrays may be of any type and layout, offsets are
in bytes, and nothing is checked: the caller knows that the bytes are there.
"""

from __future__ import annotations

from typing import Any

from llvmlite import ir  # type: ignore[import-untyped]
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic


def _place(context: Any, builder: Any, kind: Any, array: Any, offset: Any) -> Any:
    """Emit the pointer to a byte of an array."""
    data = context.make_array(kind)(context, builder, array).data
    return builder.gep(builder.bitcast(data, ir.IntType(8).as_pointer()), [offset])


def _loader(bits: int, result: Any) -> Any:
    """Make a load of an integer: ``load(array, offset)``."""

    @intrinsic
    def load(typing_context: Any, data: Any, offset: Any) -> Any:
        def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            place = _place(context, builder, signature.args[0], args[0], args[1])
            word = builder.load(builder.bitcast(place, ir.IntType(bits).as_pointer()))
            word.align = 1
            return word

        return result(data, types.int64), generate

    return load


def _storer(bits: int, kind: Any) -> Any:
    """Make a store of an integer: ``store(array, offset, value)``."""

    @intrinsic
    def store(typing_context: Any, data: Any, offset: Any, value: Any) -> Any:
        def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            place = _place(context, builder, signature.args[0], args[0], args[1])
            builder.store(args[2], builder.bitcast(place, ir.IntType(bits).as_pointer())).align = 1
            return context.get_dummy_value()

        return types.void(data, types.int64, kind), generate

    return store


def _swapper(kind: Any) -> Any:
    """Make a reversal of the bytes of an integer."""

    @intrinsic
    def swap(typing_context: Any, value: Any) -> Any:
        def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            return builder.bswap(args[0])

        return kind(kind), generate

    return swap


def _cast(source: Any, target: Any, kind: Any) -> Any:
    """Make a change of the type of 64 bits."""

    @intrinsic
    def cast(typing_context: Any, value: Any) -> Any:
        def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            return builder.bitcast(args[0], kind)

        return target(source), generate

    return cast


@intrinsic
def _copy(typing_context: Any, to: Any, at: Any, source: Any, start: Any, size: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        target = _place(context, builder, signature.args[0], args[0], args[1])
        origin = _place(context, builder, signature.args[2], args[2], args[3])
        move: Any = cgutils.raw_memcpy
        move(builder, target, origin, args[4], 1)
        return context.get_dummy_value()

    return types.void(to, types.int64, source, types.int64, types.int64), generate


load32 = _loader(32, types.uint32)
load64 = _loader(64, types.uint64)
store32 = _storer(32, types.uint32)
store64 = _storer(64, types.uint64)
swap32 = _swapper(types.uint32)
swap64 = _swapper(types.uint64)

to_double: Any = _cast(types.uint64, types.float64, ir.DoubleType())
"""``to_double(word)``: the number with these 64 bits, the payload of a NaN included."""

to_word: Any = _cast(
    types.float64, types.uint64, ir.IntType(64)
)  # ``to_word(number)``: the 64 bits of a number

copy: Any = _copy  # ``copy(to, at, source, start, size)``: ``size`` bytes from one array to another
