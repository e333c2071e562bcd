"""Load, store and copy at any byte offset of an array, which numba itself cannot do.

Every operation here is compiled into its caller; arrays may be of any type and layout, offsets are
in bytes, and nothing is checked: the caller knows that the bytes are there. numba is imported where
it is needed, to compile: a process that runs compiled kernels does without.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from typing import Any


class Operation:
    """An operation that numba gets from us, for kernels.

    ``make(ir, types, *given)``, with LLVM's instructions and numba's types, returns its intrinsic.
    """

    def __init__(self, make: Callable[..., Any], *given: Any) -> None:
        self._make, self._given = make, given

    def __call__(self, *arguments: Any) -> Any:
        """Refuse: it is there for kernels, and for what checks their types."""
        raise TypeError("only kernels call this")

    @cached_property
    def _numba_type_(self) -> Any:
        from llvmlite import ir  # type: ignore[import-untyped]
        from numba import types
        from numba.core.registry import cpu_target
        from numba.extending import intrinsic

        self._intrinsic = intrinsic(self._make(ir, types, *self._given))
        context = cpu_target.typing_context
        context.refresh()
        return context.resolve_value_type(self._intrinsic)


def _place(ir: Any, context: Any, builder: Any, kind: Any, array: Any, offset: Any) -> Any:
    """Emit the pointer to a byte of an array."""
    data = context.make_array(kind)(context, builder, array).data
    return builder.gep(builder.bitcast(data, ir.IntType(8).as_pointer()), [offset])


def _load(ir: Any, types: Any, bits: int) -> Any:
    """Make a load of an integer: ``load(array, offset)``."""

    def load(typing_context: Any, data: Any, offset: Any) -> Any:
        def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            place = _place(ir, context, builder, signature.args[0], args[0], args[1])
            word = builder.load(builder.bitcast(place, ir.IntType(bits).as_pointer()))
            word.align = 1
            return word

        return getattr(types, f"uint{bits}")(data, types.int64), generate

    return load


def _store(ir: Any, types: Any, bits: int) -> Any:
    """Make a store of an integer: ``store(array, offset, value)``."""

    def store(typing_context: Any, data: Any, offset: Any, value: Any) -> Any:
        def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            place = _place(ir, context, builder, signature.args[0], args[0], args[1])
            builder.store(args[2], builder.bitcast(place, ir.IntType(bits).as_pointer())).align = 1
            return context.get_dummy_value()

        return types.void(data, types.int64, getattr(types, f"uint{bits}")), generate

    return store


def _swap(ir: Any, types: Any, bits: int) -> Any:
    """Make a reversal of the bytes of an integer."""

    def swap(typing_context: Any, value: Any) -> Any:
        def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            return builder.bswap(args[0])

        kind = getattr(types, f"uint{bits}")
        return kind(kind), generate

    return swap


def _cast(ir: Any, types: Any, source: str, target: str) -> Any:
    """Make a change of the type of 64 bits."""
    bits = ir.DoubleType() if target == "float64" else ir.IntType(64)

    def cast(typing_context: Any, value: Any) -> Any:
        def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            return builder.bitcast(args[0], bits)

        return getattr(types, target)(getattr(types, source)), generate

    return cast


def _copy(ir: Any, types: Any) -> Any:
    """Make a copy of bytes."""
    from numba.core import cgutils

    def copy(typing_context: Any, to: Any, at: Any, source: Any, start: Any, size: Any) -> Any:
        def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            target = _place(ir, context, builder, signature.args[0], args[0], args[1])
            origin = _place(ir, context, builder, signature.args[2], args[2], args[3])
            move: Any = cgutils.raw_memcpy
            move(builder, target, origin, args[4], 1)
            return context.get_dummy_value()

        return types.void(to, types.int64, source, types.int64, types.int64), generate

    return copy


load32 = Operation(_load, 32)
load64 = Operation(_load, 64)
store32 = Operation(_store, 32)
store64 = Operation(_store, 64)
swap32 = Operation(_swap, 32)
swap64 = Operation(_swap, 64)

to_double = Operation(_cast, "uint64", "float64")
"""``to_double(word)``: the number with these 64 bits, the payload of a NaN included."""

to_word = Operation(_cast, "float64", "uint64")
"""``to_word(number)``: the 64 bits of a number."""

copy = Operation(_copy)
"""``copy(to, at, source, start, size)``: ``size`` bytes from one array to another."""
