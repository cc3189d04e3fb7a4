"""The columns of the tables that the kernels read and write."""

from __future__ import annotations

from enum import IntEnum

__all__ = [
    "AheadColumn",
    "Cursor",
    "EventColumn",
    "FileColumn",
    "PacketColumn",
    "ScanStatus",
    "StreamColumn",
]


class PacketColumn(IntEnum):
    """Columns of the table of packets, one row each in order of the file."""

    BYTE = 0  # offset in the file
    END = 1  # end of the content, bits from the packet's start
    STREAM = 2  # row of the table of stream classes
    INSTANCE = 3
    BEGIN = 4  # clock cycles, -1 where unknown
    LAST = 5
    SEQUENCE = 6  # -1 where unknown
    DISCARDED = 7  # -1 where unknown
    CPU = 8  # -1 where unknown
    ERROR = 9
    ERROR_AT = 10  # bits from the packet's start
    BYTES = 11


class StreamColumn(IntEnum):
    """Columns of the table of stream classes of all folders."""

    ID = 0
    FOLDER = 1
    HEADER = 2  # operations of the packet header: first, end
    HEADER_STOP = 3
    CONTEXT = 4  # of the packet context
    CONTEXT_STOP = 5
    EVENT = 6  # of the event header
    EVENT_STOP = 7
    ALIGN = 8  # LTTng's event headers in one load; 0 where the header is another
    ID_BITS = 9
    CLOCK_SHIFT = 10
    CLOCK_BITS = 11
    ID_FIRST = 12  # event ids in the table of ids: dense part, then pairs
    ID_DENSE = 13
    ID_PAIRS = 14
    DEFAULT_ID = 15
    FREQUENCY = 16
    KNOWN = 17  # bit n: register n of REGISTERS is read in the header or context
    UUID_LOW = 18
    UUID_HIGH = 19


class EventColumn(IntEnum):
    """Columns of the table of event classes of all stream classes."""

    WALK = 0  # operations that step over the context and payload: first, end
    WALK_STOP = 1
    SKIP_ALIGN = 2  # where that is one constant step; 0 otherwise
    SKIP_SIZE = 3
    FILL = 4
    FILL_STOP = 5
    COUNTER = 6  # row counter of level 0, -1 where nobody wants the event
    LEVELS = 7
    TIME = 8  # address of row 0
    CPU = 9  # address of row 0 or 0
    CONSTANT = 10  # 1 where every event is laid out alike, SKIP_SIZE bits of it


class FileColumn(IntEnum):
    """Columns of the table of stream files, for one span of time."""

    BASE = 0
    SIZE = 1
    PACKET = 2  # first packet and position in it
    POSITION = 3  # -1 for the packet's first event
    CLOCK = 4
    LAST_PACKET = 5  # where the span ends
    LAST_POSITION = 6  # -1 for before the packet's first event


class Cursor(IntEnum):
    """Columns of the table of cursors, one row per stream file."""

    PACKET = 0
    POSITION = 1
    END = 2
    CLOCK = 3
    PLACE = 4  # of the next event among those that were read ahead
    COUNT = 5  # events that were read ahead
    CPU = 6  # of the packet


class AheadColumn(IntEnum):
    """Columns of the table of events that were read ahead, `machine.AHEAD` rows per file."""

    TIME = 0
    EVENT = 1
    ADDRESS = 2  # of what follows the header; 0 where the length is not known before


class ScanStatus(IntEnum):
    """How a scan for packets ended, and what was wrong where."""

    DONE = 0
    FULL = 1
    BAD_MAGIC = 2
    BAD_UUID = 3
    BAD_STREAM = 4
    BAD_SIZE = 5
    BAD_HEADER = 6
    CUT = 7


# The same as plain numbers, which is what compiled code can use.
P_BYTE, P_END, P_STREAM, P_INSTANCE = (int(PacketColumn(n)) for n in range(4))
P_BEGIN, P_LAST, P_SEQUENCE, P_DISCARDED = (int(PacketColumn(n)) for n in range(4, 8))
P_CPU, P_ERROR, P_ERROR_AT, P_BYTES = (int(PacketColumn(n)) for n in range(8, 12))
S_ID, S_HEADER, S_HEADER_STOP = 0, 2, 3
S_CONTEXT, S_CONTEXT_STOP, S_EVENT, S_EVENT_STOP, S_ALIGN = 4, 5, 6, 7, 8
S_ID_BITS, S_SHIFT, S_CLOCK_BITS = 9, 10, 11
S_ID_FIRST, S_ID_DENSE, S_ID_PAIRS, S_DEFAULT, S_FREQUENCY, S_KNOWN = 12, 13, 14, 15, 16, 17
S_UUID_LOW, S_UUID_HIGH = 18, 19
E_WALK, E_WALK_STOP, E_ALIGN, E_SIZE, E_FILL, E_FILL_STOP = 0, 1, 2, 3, 4, 5
E_COUNTER, E_LEVELS, E_TIME, E_CPU, E_CONSTANT = 6, 7, 8, 9, 10
F_BASE, F_SIZE, F_PACKET, F_POSITION, F_CLOCK, F_LAST_PACKET, F_LAST_POSITION = range(7)
C_PACKET, C_POSITION, C_END, C_CLOCK, C_PLACE, C_COUNT, C_CPU = range(7)
A_TIME, A_EVENT, A_ADDRESS = range(3)
DONE, FULL, BAD_MAGIC, BAD_UUID = 0, 1, 2, 3
BAD_STREAM, BAD_SIZE, BAD_HEADER, CUT = 4, 5, 6, 7
# Registers, in the order of `layout.REGISTERS`.
R_ID, R_MAGIC, R_STREAM, R_INSTANCE, R_BEGIN, R_END = range(6)
R_CONTENT, R_PACKET, R_SEQUENCE, R_DISCARDED, R_CPU, R_UUID_LOW, R_UUID_HIGH = range(6, 13)
MAGIC = 0xC1FC1FC1
BILLION = 1_000_000_000
# Bytes per row.
P_ROW, S_ROW, E_ROW, F_ROW, C_ROW, A_ROW = 8 * 12, 8 * 20, 8 * 11, 8 * 7, 8 * 7, 8 * 3
