"""What the compiled kernels share: their state, their tables' addresses, plain constants."""

from __future__ import annotations

from enum import IntEnum

import numpy as np

from chainshaper.sources.ctf.program import ROW, Code, Op

__all__ = ["AHEAD", "BATCH", "NEVER", "STATE_SIZE", "Failure", "Machine", "State"]


class Failure(IntEnum):
    """Why a run ended early."""

    TRUNCATED = -1
    NO_OPTION = -2
    BAD_LENGTH = -3
    UNTERMINATED = -4
    UNKNOWN_EVENT = -5
    FULL_DICTIONARY = -6
    FULL_TABLE = -7


class State(IntEnum):
    """Places in the state array that a run reads and advances."""

    CLOCK = 0
    STRINGS = 1
    UNSORTED = 2
    LATEST = 3
    STACK = 8


class Machine(IntEnum):
    """Words of the table that every kernel is given: addresses of the other tables.

    Kernels take addresses rather than arrays, since Numba counts references to arrays at every
    call, at several times the cost of reading an event.
    """

    OPS = 0
    RANGES = 1
    STATE = 2
    ROWS = 3
    CAPS = 4
    SAVED = 5
    SLOTS = 6  # int32, as many as MASK + 1
    MASK = 7
    ENTRIES = 8  # ROOM rows
    ROOM = 9
    STREAMS = 10
    EVENTS = 11
    IDS = 12
    COUNTERS = 13  # number of row counters
    BATCHES = 14  # per event class: a count and BATCH pairs (address, row)


_DEEPEST = 16
BATCH = 128
AHEAD = 64
NEVER = (1 << 63) - 2  # later than all times; one more is still a number
STATE_SIZE = State.STACK + _DEEPEST

# The same as plain numbers, which is what compiled code can use.
CODE, ALIGN, SIZE, FLAGS = int(Op.CODE), int(Op.ALIGN), int(Op.SIZE), int(Op.FLAGS)
ADDRESS, WIDTH, COUNTER = int(Op.ADDRESS), int(Op.WIDTH), int(Op.COUNTER)
REGISTER, COUNT, TARGET, LEAST = int(Op.REGISTER), int(Op.COUNT), int(Op.TARGET), int(Op.LEAST)
INNER, INNER_ADDRESS = int(Op.INNER), int(Op.INNER_ADDRESS)
SKIP, NUMBER, TEXT, CHARACTERS = (
    int(Code.SKIP),
    int(Code.NUMBER),
    int(Code.TEXT),
    int(Code.CHARACTERS),
)
SKIP_MANY, COPY, LOOP, AGAIN = (
    int(Code.SKIP_MANY),
    int(Code.COPY),
    int(Code.LOOP),
    int(Code.AGAIN),
)
SWITCH, OFFSET = int(Code.SWITCH), int(Op.OFFSET)
MOVE_LONG, MOVE_WORD, MOVE_HALF = (
    int(Code.MOVE_LONG),
    int(Code.MOVE_WORD),
    int(Code.MOVE_HALF),
)
TRUNCATED, NO_OPTION, BAD_LENGTH = (
    int(Failure.TRUNCATED),
    int(Failure.NO_OPTION),
    int(Failure.BAD_LENGTH),
)
UNTERMINATED, FULL_DICTIONARY, FULL_TABLE = (
    int(Failure.UNTERMINATED),
    int(Failure.FULL_DICTIONARY),
    int(Failure.FULL_TABLE),
)
CLOCK, STRINGS, STACK = (
    int(State.CLOCK),
    int(State.STRINGS),
    int(State.STACK),
)
M_OPS, M_RANGES, M_STATE, M_ROWS, M_CAPS = (
    int(Machine.OPS),
    int(Machine.RANGES),
    int(Machine.STATE),
    int(Machine.ROWS),
    int(Machine.CAPS),
)
M_SLOTS, M_MASK, M_ENTRIES, M_ROOM = (
    int(Machine.SLOTS),
    int(Machine.MASK),
    int(Machine.ENTRIES),
    int(Machine.ROOM),
)
ONES = np.uint64(0x0101010101010101)
HIGHS = np.uint64(0x8080808080808080)
FACTOR = np.uint64(0x9E3779B97F4A7C15)
OP_BYTES = 8 * ROW
LOW = np.uint64(0xFFFFFFFF)
U0, U1, U8, U29, U32, U64 = (np.uint64(n) for n in (0, 1, 8, 29, 32, 64))
