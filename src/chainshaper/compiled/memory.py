"""Loads and stores at machine addresses for the compiled kernels.

Packets are bytes at any alignment in several memory maps, and columns are arrays of several
types; an address is the one thing that they share.  Whoever calls these has checked the bounds:
nothing here does.  The machine is taken to be little-endian, as all are that run ROS 2.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from llvmlite import ir  # type: ignore[import-untyped]
from numba import njit, types
from numba.extending import intrinsic

__all__ = [
    "compiled",
    "get",
    "load_byte",
    "load_half",
    "load_word",
    "put",
    "store_byte",
    "store_half",
    "store_long",
    "store_word",
    "swap_bytes",
    "trailing_zeros",
]


def compiled(*, inline: bool = False) -> Callable[[Callable[..., Any]], Any]:
    """``njit`` for functions of numbers, as they are called by each other.

    ``inline`` has the compiler put the function into its callers, where a call would cost more
    than what it does. Python calls them by way of :func:`~chainshaper.compiled.loading.kernel`.
    """

    def decorate(function: Callable[..., Any]) -> Any:
        return njit(nogil=True, forceinline=inline, error_model="numpy")(function)

    return decorate


def _pointer(builder: ir.IRBuilder, address: ir.Value, bits: int) -> ir.Value:
    return builder.inttoptr(address, ir.IntType(bits).as_pointer())


def _load_word(_typing: Any, _address: Any) -> Any:
    """The 8 bytes at an address, little-endian, as uint64."""

    def generate(_context: Any, builder: ir.IRBuilder, _signature: Any, args: Any) -> Any:
        return builder.load(_pointer(builder, args[0], 64), align=1)

    return types.uint64(types.int64), generate


def _load_half(_typing: Any, _address: Any) -> Any:
    """The 4 bytes at an address, little-endian, as uint64."""

    def generate(_context: Any, builder: ir.IRBuilder, _signature: Any, args: Any) -> Any:
        value = builder.load(_pointer(builder, args[0], 32), align=1)
        return builder.zext(value, ir.IntType(64))

    return types.uint64(types.int64), generate


def _load_byte(_typing: Any, _address: Any) -> Any:
    """The byte at an address as uint64."""

    def generate(_context: Any, builder: ir.IRBuilder, _signature: Any, args: Any) -> Any:
        value = builder.load(_pointer(builder, args[0], 8), align=1)
        return builder.zext(value, ir.IntType(64))

    return types.uint64(types.int64), generate


def _store(bits: int) -> Any:
    def generate(_context: Any, builder: ir.IRBuilder, _signature: Any, args: Any) -> Any:
        value = args[1] if bits == 64 else builder.trunc(args[1], ir.IntType(bits))
        builder.store(value, _pointer(builder, args[0], bits), align=1)
        return _context.get_dummy_value()

    return generate


def _store_byte(_typing: Any, _address: Any, _value: Any) -> Any:
    """Write the low 8 bits of a uint64."""
    return types.void(types.int64, types.uint64), _store(8)


def _store_half(_typing: Any, _address: Any, _value: Any) -> Any:
    """Write the low 16 bits of a uint64."""
    return types.void(types.int64, types.uint64), _store(16)


def _store_word(_typing: Any, _address: Any, _value: Any) -> Any:
    """Write the low 32 bits of a uint64."""
    return types.void(types.int64, types.uint64), _store(32)


def _store_long(_typing: Any, _address: Any, _value: Any) -> Any:
    """Write a uint64."""
    return types.void(types.int64, types.uint64), _store(64)


def _swap_bytes(_typing: Any, _value: Any) -> Any:
    """A uint64 with its bytes in reverse order."""

    def generate(_context: Any, builder: ir.IRBuilder, _signature: Any, args: Any) -> Any:
        return builder.bswap(args[0])

    return types.uint64(types.uint64), generate


def _trailing_zeros(_typing: Any, _value: Any) -> Any:
    """How many low bits of a uint64 are 0 (64 for 0), as int64."""

    def generate(_context: Any, builder: ir.IRBuilder, _signature: Any, args: Any) -> Any:
        return builder.cttz(args[0], ir.Constant(ir.IntType(1), 0))

    return types.int64(types.uint64), generate


def _get(_typing: Any, _table: Any, _index: Any) -> Any:
    """Number ``index`` of the int64 table at an address."""

    def generate(_context: Any, builder: ir.IRBuilder, _signature: Any, args: Any) -> Any:
        return builder.load(builder.gep(_pointer(builder, args[0], 64), [args[1]]), align=8)

    return types.int64(types.int64, types.int64), generate


def _put(_typing: Any, _table: Any, _index: Any, _value: Any) -> Any:
    """Write number ``index`` of the int64 table at an address."""

    def generate(_context: Any, builder: ir.IRBuilder, _signature: Any, args: Any) -> Any:
        place = builder.gep(_pointer(builder, args[0], 64), [args[1]])
        builder.store(args[2], place, align=8)
        return _context.get_dummy_value()

    return types.void(types.int64, types.int64, types.int64), generate


# Numba calls the generators above with types; what kernels call takes numbers.
load_word: Any = intrinsic(_load_word)
load_byte: Any = intrinsic(_load_byte)
load_half: Any = intrinsic(_load_half)
store_byte: Any = intrinsic(_store_byte)
store_half: Any = intrinsic(_store_half)
store_word: Any = intrinsic(_store_word)
store_long: Any = intrinsic(_store_long)
swap_bytes: Any = intrinsic(_swap_bytes)
trailing_zeros: Any = intrinsic(_trailing_zeros)
get: Any = intrinsic(_get)
put: Any = intrinsic(_put)
