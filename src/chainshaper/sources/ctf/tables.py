"""The tables that the kernels read and write, and the numbers in them.

Tables are of int64, a row per thing: a packet, a stream class, an event class, a stream file, a
cursor in it, an event that was read ahead, an operation.  A kernel is given the address of the one
whose words (``M_…``) are the addresses of the others.

(Kernels take addresses rather than arrays, since Numba counts references to arrays at every call,
at several times the cost of reading an event.)
"""

import numpy as np

(
    M_OPS,
    M_RANGES,  # of variants' tags: low, high, operation to go on with, 1 + option
    M_STATE,
    M_ROWS,  # the row counters,
    M_CAPS,  # how far each may go,
    M_SAVED,  # and room for some of them
    M_SLOTS,  # the dictionary's hash table, int32, as many as MASK + 1
    M_MASK,
    M_ENTRIES,  # its strings: address, length, hash, last word; ROOM rows
    M_ROOM,
    M_STREAMS,
    M_EVENTS,
    M_IDS,
    M_COUNTERS,  # number of row counters
    M_BATCHES,  # per event class: a count and BATCH pairs (address, row)
    MACHINE_WORDS,
) = range(16)

BATCH = 128
AHEAD = 64
"""Events of one file that are read ahead."""

NEVER = (1 << 63) - 2
"""Later than all times; one more is still a number."""

# The state: what a run reads and advances. BUDGET is what may still be spent (see `BUDGET`).
X_CLOCK, X_STRINGS, X_UNSORTED, X_LATEST, X_BUDGET, X_STACK = range(6)
STATE_WORDS = X_STACK + 16

# Packets, in order of the file.
(
    P_BYTE,  # offset in the file
    P_END,  # end of the content, bits from the packet's start
    P_STREAM,  # row of the table of stream classes
    P_INSTANCE,  # -1 where unknown, as the following
    P_BEGIN,  # clock cycles
    P_LAST,
    P_SEQUENCE,
    P_DISCARDED,
    P_CPU,
    P_ERROR,
    P_ERROR_AT,  # bits from the packet's start
    P_BYTES,
    PACKET_COLUMNS,
) = range(13)

# Stream classes of all folders.
(
    S_ID,
    S_HEADER,  # operations of the packet header: first, end
    S_HEADER_STOP,
    S_CONTEXT,  # of the packet context
    S_CONTEXT_STOP,
    S_EVENT,  # of the event header
    S_EVENT_STOP,
    S_ALIGN,  # LTTng's event headers in one load; 0 where the header is another
    S_ID_BITS,
    S_SHIFT,
    S_CLOCK_BITS,
    S_ID_FIRST,  # event ids in the table of ids: dense part, then pairs
    S_ID_DENSE,
    S_ID_PAIRS,
    S_DEFAULT,
    S_FREQUENCY,
    S_KNOWN,  # bit n: register n is read in the header or context
    S_UUID_LOW,
    S_UUID_HIGH,
    S_COST,  # of a packet
    STREAM_COLUMNS,
) = range(21)

# Event classes of all stream classes.
(
    E_WALK,  # operations that step over the context and payload: first, end
    E_WALK_STOP,
    E_ALIGN,  # where that is one constant step; 0 otherwise
    E_SIZE,
    E_FILL,
    E_FILL_STOP,
    E_COUNTER,  # row counter of level 0, -1 where nobody wants the event
    E_LEVELS,
    E_TIME,  # address of row 0
    E_CPU,  # address of row 0 or 0
    E_CONSTANT,  # 1 where every event is laid out alike, SIZE bits of it
    E_COST,
    EVENT_COLUMNS,
) = range(13)

# Stream files, for one span of time.
(
    F_BASE,
    F_SIZE,
    F_PACKET,  # first packet and position in it
    F_POSITION,  # -1 for the packet's first event
    F_CLOCK,
    F_LAST_PACKET,  # where the span ends
    F_LAST_POSITION,  # -1 for before the packet's first event
    FILE_COLUMNS,
) = range(8)

# Cursors, one per stream file.
(
    C_PACKET,
    C_POSITION,
    C_END,
    C_CLOCK,
    C_PLACE,  # of the next event among those that were read ahead
    C_COUNT,  # events that were read ahead
    C_CPU,  # of the packet
    CURSOR_COLUMNS,
) = range(8)

# Events that were read ahead; the address is that of what follows the header, 0 where the length is
# not known before.
A_TIME, A_EVENT, A_ADDRESS, AHEAD_COLUMNS = range(4)

# Operations.  Rows are two cache lines, and a shift away from each other.
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
    O_INNER,  # the element level's row counter, -1 where nobody wants it
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

An operation costs 1, a byte of a column as well. Fields of no bits would else cost anything: a
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

# Registers: the numbers that the decoder itself needs.
R_ID, R_MAGIC, R_STREAM, R_INSTANCE, R_BEGIN, R_END = range(6)
R_CONTENT, R_PACKET, R_SEQUENCE, R_DISCARDED, R_CPU, R_UUID_LOW, R_UUID_HIGH = range(6, 13)
REGISTERS = {
    "id": R_ID,
    "magic": R_MAGIC,
    "stream_id": R_STREAM,
    "stream_instance_id": R_INSTANCE,
    "timestamp_begin": R_BEGIN,
    "timestamp_end": R_END,
    "content_size": R_CONTENT,
    "packet_size": R_PACKET,
    "packet_seq_num": R_SEQUENCE,
    "events_discarded": R_DISCARDED,
    "cpu_id": R_CPU,
    "uuid_low": R_UUID_LOW,
    "uuid_high": R_UUID_HIGH,
}
"""By their TSDL name in the packet header and context."""

MAGIC = 0xC1FC1FC1
BILLION = 1_000_000_000
ONES = np.uint64(0x0101010101010101)
HIGHS = np.uint64(0x8080808080808080)
FACTOR = np.uint64(0x9E3779B97F4A7C15)
LOW = np.uint64(0xFFFFFFFF)
U0, U1, U8, U29, U32, U64 = (np.uint64(n) for n in (0, 1, 8, 29, 32, 64))
