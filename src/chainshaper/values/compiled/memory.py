"""Loads and stores at machine addresses for the compiled kernels.

Packets are bytes at any alignment, and columns are arrays of several types; an address is the one
thing that they share. Whoever calls these has checked the bounds. The machine is little-endian, as
all are that run ROS 2. Where Numba is not installed, Python interprets the same functions: some
hundred times slower, quick enough for what a robot decides on, and not for a long trace.
"""

# mypy: disallow_untyped_calls=False, disallow_untyped_decorators=False

import ctypes
from collections.abc import Callable
from typing import Any

import numpy as np

try:
    from llvmlite import ir  # type: ignore[import-untyped]
    from numba import njit, types
    from numba.extending import intrinsic as typed_intrinsic
except ModuleNotFoundError:
    INTERPRETED = True
else:
    INTERPRETED = False
    intrinsic: Any = typed_intrinsic  # which takes types, where kernels give numbers

_WORDS: dict[int, Any] = {
    8: ctypes.c_uint8, 16: ctypes.c_uint16, 32: ctypes.c_uint32, 64: ctypes.c_uint64
}  # fmt: skip


def compiled(*, inline: bool = False) -> Callable[[Callable[..., Any]], Any]:
    """``njit`` for functions of numbers that call each other, ``inline`` where a call costs more.

    Python calls them by way of :func:`~chainshaper.values.compiled.kernel`.
    """
    if INTERPRETED:
        return lambda function: function
    decorate: Any = njit(nogil=True, forceinline=inline, error_model="numpy")
    return decorate  # type: ignore[no-any-return]


def _instruction(signature: Any, build: Callable[..., Any]) -> Any:
    """A function of numbers whose instructions ``build`` gives, from LLVM's builder and values."""

    def generate(context: Any, builder: Any, _signature: Any, values: Any) -> Any:
        found = build(builder, *values)
        return context.get_dummy_value() if signature.return_type == types.void else found

    of_one, of_two = lambda _, __: (signature, generate), lambda _, __, ___: (signature, generate)
    return intrinsic(of_one if len(signature.args) == 1 else of_two)


def _pointer(builder: Any, address: Any, bits: int) -> Any:
    return builder.inttoptr(address, ir.IntType(bits).as_pointer())


def _load(bits: int) -> Any:
    """So many bits at an address, little-endian, as uint64."""
    if INTERPRETED:
        return lambda at: np.uint64(_WORDS[bits].from_address(int(at)).value)
    return _instruction(
        types.uint64(types.int64),
        lambda b, at: b.zext(b.load(_pointer(b, at, bits), align=1), ir.IntType(64)),
    )


def _store(bits: int) -> Any:
    """Write the low bits of a uint64 to an address."""
    if INTERPRETED:
        return lambda at, value: setattr(_WORDS[bits].from_address(int(at)), "value", int(value))
    return _instruction(
        types.void(types.int64, types.uint64),
        lambda b, at, value: b.store(
            b.trunc(value, ir.IntType(bits)), _pointer(b, at, bits), align=1
        ),
    )


load_byte, load_half, load_word = _load(8), _load(32), _load(64)
store_byte, store_half, store_word, store_long = _store(8), _store(16), _store(32), _store(64)


class _Table:
    """The int64 table at an address, interpreted."""

    def __init__(self, address: int) -> None:
        self._numbers = ctypes.cast(int(address), ctypes.POINTER(ctypes.c_int64))

    def __getitem__(self, index: int) -> Any:
        return np.int64(self._numbers[index])

    def __setitem__(self, index: int, value: int) -> None:
        self._numbers[index] = int(value)


# A uint64 with its bytes in reverse order; how many low bits of one are 0 (64 for 0), as int64; and
# the int64 table at an address, for ``table[index]``.
swap_bytes: Any = lambda value: np.uint64(int(value)).byteswap()  # noqa: E731 - as the compiled ones
trailing_zeros: Any = lambda value: (int(value) & -int(value)).bit_length() - 1 if value else 64  # noqa: E731
table_at: Any = _Table
if not INTERPRETED:
    word, number = types.uint64, types.int64
    swap_bytes = _instruction(word(word), lambda b, value: b.bswap(value))
    zeros = lambda b, value: b.cttz(value, ir.Constant(ir.IntType(1), 0))  # noqa: E731
    trailing_zeros = _instruction(number(word), zeros)
    table_at = _instruction(types.CPointer(number)(number), lambda b, at: _pointer(b, at, 64))


@compiled(inline=True)
def get(table: Any, index: Any) -> Any:
    """Number ``index`` of the int64 table at an address."""
    return table_at(table)[index]


@compiled(inline=True)
def put(table: Any, index: Any, value: Any) -> None:
    """Write number ``index`` of the int64 table at an address."""
    table_at(table)[index] = value
