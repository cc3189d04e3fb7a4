"""Loads and stores at machine addresses for the compiled kernels.

Packets are bytes at any alignment in several memory maps, and columns are arrays of several
types; an address is the one thing that they share.  Whoever calls these has checked the bounds:
nothing here does.  The machine is taken to be little-endian, as all are that run ROS 2.
"""

# mypy: disallow_untyped_calls=False, disallow_untyped_decorators=False

from collections.abc import Callable
from typing import Any

from llvmlite import ir  # type: ignore[import-untyped]
from numba import njit, types
from numba.extending import intrinsic as typed_intrinsic

intrinsic: Any = typed_intrinsic  # which takes types, where kernels give numbers


def compiled(*, inline: bool = False) -> Callable[[Callable[..., Any]], Any]:
    """``njit`` for functions of numbers, as they are called by each other.

    ``inline`` has the compiler put the function into its callers, where a call would cost more
    than what it does. Python calls them by way of :func:`~chainshaper.values.compiled.kernel`.
    """

    def decorate(function: Callable[..., Any]) -> Any:
        return njit(nogil=True, forceinline=inline, error_model="numpy")(function)

    return decorate


def _pointer(builder: ir.IRBuilder, address: ir.Value, bits: int) -> ir.Value:
    return builder.inttoptr(address, ir.IntType(bits).as_pointer())


def _load(bits: int) -> Any:
    """So many bits at an address, little-endian, as uint64."""

    def load(_typing: Any, _address: Any) -> Any:
        def generate(_context: Any, builder: ir.IRBuilder, _signature: Any, args: Any) -> Any:
            value = builder.load(_pointer(builder, args[0], bits), align=1)
            return value if bits == 64 else builder.zext(value, ir.IntType(64))

        return types.uint64(types.int64), generate

    return intrinsic(load)


def _store(bits: int) -> Any:
    """Write the low bits of a uint64 to an address."""

    def store(_typing: Any, _address: Any, _value: Any) -> Any:
        def generate(_context: Any, builder: ir.IRBuilder, _signature: Any, args: Any) -> Any:
            value = args[1] if bits == 64 else builder.trunc(args[1], ir.IntType(bits))
            builder.store(value, _pointer(builder, args[0], bits), align=1)
            return _context.get_dummy_value()

        return types.void(types.int64, types.uint64), generate

    return intrinsic(store)


load_byte, load_half, load_word = _load(8), _load(32), _load(64)
store_byte, store_half, store_word, store_long = _store(8), _store(16), _store(32), _store(64)


@intrinsic
def swap_bytes(_typing: Any, _value: Any) -> Any:
    """A uint64 with its bytes in reverse order."""

    def generate(_context: Any, builder: ir.IRBuilder, _signature: Any, args: Any) -> Any:
        return builder.bswap(args[0])

    return types.uint64(types.uint64), generate


@intrinsic
def trailing_zeros(_typing: Any, _value: Any) -> Any:
    """How many low bits of a uint64 are 0 (64 for 0), as int64."""

    def generate(_context: Any, builder: ir.IRBuilder, _signature: Any, args: Any) -> Any:
        return builder.cttz(args[0], ir.Constant(ir.IntType(1), 0))

    return types.int64(types.uint64), generate


@intrinsic
def table_at(_typing: Any, _address: Any) -> Any:
    """The int64 table at an address, for ``table[index]``."""

    def generate(_context: Any, builder: ir.IRBuilder, _signature: Any, args: Any) -> Any:
        return _pointer(builder, args[0], 64)

    return types.CPointer(types.int64)(types.int64), generate


@compiled(inline=True)
def get(table: Any, index: Any) -> Any:
    """Number ``index`` of the int64 table at an address."""
    return table_at(table)[index]


@compiled(inline=True)
def put(table: Any, index: Any, value: Any) -> None:
    """Write number ``index`` of the int64 table at an address."""
    table_at(table)[index] = value
