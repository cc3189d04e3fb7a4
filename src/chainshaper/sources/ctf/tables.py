"""The tables that the kernels read and write, and the numbers in them.

Tables are of int64, a row per thing: a packet, a stream class, an event class, a stream file, a
cursor in it, an event that was read ahead, an operation. A kernel gets the address of the one
whose words (``M_…``) are the addresses of the others.

(Kernels take addresses rather than arrays, since Numba counts references to arrays at every call,
at several times the cost of reading an event.)
"""

# fmt: off
# A table's columns stand together, with what they hold behind them.

import numpy as np

# The machine. RANGES of variants' tags: low, high, operation to go on with, 1 + option. ROWS are
# the row counters (COUNTERS of them), CAPS how far each may go, SAVED room for some. SLOTS is the
# dictionary's hash table, int32, MASK + 1 of them; ENTRIES are its strings: address, length, hash,
# last word; ROOM of them. BATCHES has per event class a count and BATCH pairs (address, row).
(
    M_OPS, M_RANGES, M_STATE, M_ROWS, M_CAPS, M_SAVED, M_SLOTS, M_MASK, M_ENTRIES, M_ROOM,
    M_STREAMS, M_EVENTS, M_IDS, M_COUNTERS, M_BATCHES, MACHINE_WORDS,
) = range(16)

BATCH = 128
AHEAD = 64
"""Events of one file that are read ahead."""
NEVER = (1 << 63) - 2
"""Later than all times; one more is still a number."""

# The state: what a run reads and advances. BUDGET is what may still be spent (see `BUDGET`).
X_CLOCK, X_STRINGS, X_UNSORTED, X_LATEST, X_BUDGET, X_STACK = range(6)
STATE_WORDS = X_STACK + 16

# Packets, in order of the file: BYTE its offset there, END the end of the content and ERROR_AT in
# bits from the packet's start, STREAM the row of its class; from INSTANCE to CPU -1 where unknown;
# BEGIN and LAST in clock cycles.
(
    P_BYTE, P_END, P_STREAM, P_INSTANCE, P_BEGIN, P_LAST, P_SEQUENCE, P_DISCARDED, P_CPU,
    P_ERROR, P_ERROR_AT, P_BYTES, PACKET_COLUMNS,
) = range(13)

# Stream classes of all folders: operations (first, end) of packet HEADER, packet CONTEXT and EVENT
# header; LTTng's event headers in one load, ALIGN 0 where the header is another; event ids in the
# table of ids, a dense part, then pairs; bit n of KNOWN: register n is read in header or context;
# the COST of a packet.
(
    S_ID, S_HEADER, S_HEADER_STOP, S_CONTEXT, S_CONTEXT_STOP, S_EVENT, S_EVENT_STOP,
    S_ALIGN, S_ID_BITS, S_SHIFT, S_CLOCK_BITS, S_ID_FIRST, S_ID_DENSE, S_ID_PAIRS, S_DEFAULT,
    S_FREQUENCY, S_KNOWN, S_UUID_LOW, S_UUID_HIGH, S_COST, STREAM_COLUMNS,
) = range(21)

# Event classes of all stream classes: operations (first, end) that WALK over context and payload,
# and that FILL columns; ALIGN and SIZE where the former is one constant step, else 0; the row
# COUNTER of level 0, -1 where the event is not wanted; addresses of row 0 of TIME and CPU (or 0);
# CONSTANT 1 where every event is laid out alike, SIZE bits of it.
(
    E_WALK, E_WALK_STOP, E_ALIGN, E_SIZE, E_FILL, E_FILL_STOP, E_COUNTER, E_LEVELS,
    E_TIME, E_CPU, E_CONSTANT, E_COST, EVENT_COLUMNS,
) = range(13)

# Stream files, for one span of time: its first packet and the position in it, -1 for the packet's
# first event; where it ends, LAST_POSITION -1 for before the packet's first event.
(
    F_BASE, F_SIZE, F_PACKET, F_POSITION, F_CLOCK, F_LAST_PACKET, F_LAST_POSITION, FILE_COLUMNS,
) = range(8)

# Cursors, one per stream file; PLACE of the next event among the COUNT that were read ahead, CPU
# of the packet.
(
    C_PACKET, C_POSITION, C_END, C_CLOCK, C_PLACE, C_COUNT, C_CPU, CURSOR_COLUMNS,
) = range(8)

# Events that were read ahead; the address is that of what follows the header, 0 where the length
# is not known before.
A_TIME, A_EVENT, A_ADDRESS, AHEAD_COLUMNS = range(4)

# Operations. Rows are two cache lines, and a shift away from each other.
(
    O_CODE,
    O_ALIGN,  # bits
    O_SIZE,  # bits; of one element for SKIP_MANY and COPY
    O_FLAGS,  # 1 signed, 2 big-endian, 4 advances the clock
    O_ADDRESS,  # where row 0 of the slot lies, 0 for no slot
    O_WIDTH,  # bytes per row of the slot
    O_COUNTER,  # the level's row counter
    O_REGISTER,  # written by NUMBER, the length or tag for others; -1 for none
    O_COUNT,  # constant length; first range of SWITCH
    O_TARGET,  # operation to go on with
    O_INNER,  # the element level's row counter, -1 where it is not wanted
    O_INNER_ADDRESS,  # where COPY writes
    O_LEAST,  # the least bits an element takes; number of ranges of SWITCH
    O_OFFSET,  # bytes from the aligned start of an event of constant layout
    O_COST,  # of an element of SKIP_MANY, COPY and LOOP
) = range(15)
OPERATION_COLUMNS = 16

SKIP, NUMBER, TEXT, CHARACTERS, SKIP_MANY, COPY, LOOP, AGAIN, SWITCH, JUMP = range(10)
MOVE_LONG, MOVE_WORD, MOVE_HALF, MOVE_BYTE = range(10, 14)
"""A NUMBER of 8, 4, 2 or 1 bytes as they lie in the packet, one per event."""

# Bytes per row.
P_ROW, S_ROW, E_ROW = 8 * PACKET_COLUMNS, 8 * STREAM_COLUMNS, 8 * EVENT_COLUMNS
F_ROW, C_ROW, A_ROW = 8 * FILE_COLUMNS, 8 * CURSOR_COLUMNS, 8 * AHEAD_COLUMNS
O_ROW, B_ROW = 8 * OPERATION_COLUMNS, 8 * (1 + 2 * BATCH)

BUDGET = 64
"""What decoding may cost for each byte of a packet, and finding packets for each byte of a file.

An operation costs 1, a byte of a column as well. Fields of no bits would else cost nothing: a
few bytes of a packet could fill the memory. A bit that becomes a number of its own costs 3.
"""

ENDLESS = 1 << 40
"""More elements than any packet has, even of no bits; times what one costs it is still a number."""

# Why a run ended early.
OVER_BUDGET = -8
FULL_TABLE, FULL_DICTIONARY, UNKNOWN_EVENT = -7, -6, -5
UNTERMINATED, BAD_LENGTH, NO_OPTION, TRUNCATED = -4, -3, -2, -1

# How a scan for packets ended, and what was wrong where.
DONE, FULL, BAD_MAGIC, BAD_UUID, BAD_STREAM, BAD_SIZE, BAD_HEADER, CUT, COSTLY = range(9)

REGISTERS = {
    name: number
    for number, name in enumerate((
        "id", "magic", "stream_id", "stream_instance_id", "timestamp_begin", "timestamp_end",
        "content_size", "packet_size", "packet_seq_num", "events_discarded", "cpu_id",
        "uuid_low", "uuid_high",
    ))
}
"""The numbers that the decoder itself needs, by their TSDL name in packet header and context."""
R_ID, R_MAGIC, R_STREAM, R_INSTANCE, R_BEGIN, R_END = range(6)
R_CONTENT, R_PACKET, R_SEQUENCE, R_DISCARDED, R_CPU, R_UUID_LOW, R_UUID_HIGH = range(6, 13)

MAGIC = 0xC1FC1FC1
BILLION = 1_000_000_000
ONES = np.uint64(0x0101010101010101)
HIGHS = np.uint64(0x8080808080808080)
FACTOR = np.uint64(0x9E3779B97F4A7C15)
LOW = np.uint64(0xFFFFFFFF)
U0, U1, U8, U29, U32, U64 = (np.uint64(n) for n in (0, 1, 8, 29, 32, 64))
