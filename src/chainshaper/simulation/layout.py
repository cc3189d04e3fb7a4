"""What stands where in the one array of integers on which the compiled engine runs.

There is a row per thread (T), entity (E), publisher (P), reader (R), gate (G), synchroniser (S),
input of one (I), core (C), message (M), stream of numbers (D), event to come (H) and kind of log
entry (A), and one for the engine itself (X), which comes first. A row is referred to by its place
in the array, so ``m[thread + T.LEFT]`` is a field of a thread; NONE stands for no row. Each list
begins with the columns that are given; the others change as time goes on. Times are integer
nanoseconds.

(One array, because every array that a compiled function is called with costs it more time than
most of these functions need. Lists of columns are enumerations, which Numba takes for numbers
behind a sum; what is an index by itself has to be a number.)
"""

from collections import namedtuple
from enum import IntEnum

import numpy as np
import numpy.typing as npt

Int64s = npt.NDArray[np.int64]

NONE = -1
FOREVER = 2**62

# Threads. Executors run the callbacks of one process, publisher threads send for its asynchronous
# publishers, DDS threads receive for it. The smaller RANK runs; SERVER is a bit of the core's mask.
# FIRST to END are entities in the order in which the executor looks at them. Streams of CPU times:
# from being woken to being at work, from choosing a message to its callback, one publication (or
# send), one message received; DELIVERY is the time until a message is at the subscriber's process.
# POOL to POOL_END are the executor's threads; the first's OWNER waits, or takes what is next.
# HEAD and TAIL are a queue of messages to send or to receive, or of events to execute. LEFT is the
# CPU time to the next STEP, SEQUENCE the place among those of its rank; BEGAN is when sending began
# or the gate woke. SOURCE to ARRIVAL are those of the message that it deals with, as in M.
T = IntEnum(
    "T",
    "ROW CORE RANK SERVER KIND FIRST END WAKE TAKE PUBLISH RECEIVE DELIVERY PUBLISHER_THREAD"
    " DDS_THREAD POOL POOL_END OWNER RUNNABLE STEP LEFT SEQUENCE PREEMPTED USED ENTITY PUBLICATION"
    " HEAD TAIL SOURCE ORIGIN START NUMBER MODE ARRIVAL BEGAN COLUMNS",
    start=0,
)

SINGLE_THREADED, STATIC, EVENTS, MULTI_THREADED, PUBLISHER, DDS = range(6)
"""Kinds of threads: four executors, and what works for them."""

COLLECT, TURN, TAKE, PUBLISH, GATE_WAKE, GATE_PUBLISHED, GATE_PAUSED = range(7)
SEND, SENT, RECEIVE, RECEIVED = range(7, 11)
"""What a thread does next, when it has used the CPU time that is left to it."""

# Entities: what an executor waits for. BODY_ROW is that of the gate or synchroniser, INPUT which
# input of the latter. GROUP is where stands whether its mutually exclusive group is busy, NONE if
# its executor has one thread, or the group is reentrant. HISTORY is a ring, whose columns are as in
# Q. READY: in the snapshot.
E = IntEnum(
    "E",
    "ROW THREAD GROUP KIND BODY BODY_ROW INPUT PERIOD EXECUTION PUBLISHERS PUBLISHERS_END LIFESPAN"
    " STARTS_CHAIN ON_CHAIN HISTORY DEPTH HEAD WAITING DUE READY COLUMNS",
    start=0,
)

TIMER, SUBSCRIPTION, SERVICE, CLIENT = range(4)
COMPUTE, GATE, MODE_LISTENER, SYNCHRONISE = range(4)

# Publishers. It announces MODES in turn; UNSENT messages wait for the publisher thread.
P = IntEnum(
    "P",
    "ROW FIRST END ASYNCHRONOUS DEPTH LIFESPAN ENDS_CHAIN MODES MODES_COUNT PUBLISHED UNSENT"
    " COLUMNS",
    start=0,
)

R = IntEnum("R", "ENTITY LAST COLUMNS", start=0)
"""Readers: an entity, and the time of the last delivery to it from this publisher."""

# Gates. SLOTS are pairs of start and end, BANDS has one per mode, NONE for those that the gate does
# not know (DEFAULT is NONE where it knows none), CHANGES is a ring of pairs: time, mode. MOVES are
# pairs of an instant, ascending, and how far slots are moved from then on. AT_ONCE: a message may
# leave in a slot that is open when it comes. LEAVING and LEFT are starts of cycles, as `Queue` has
# them. From ARRIVAL on: what was decided about the message in it; from OTHER on, the same about one
# that waits behind.
G = IntEnum(
    "G",
    "SLOTS SLOTS_END CYCLE STAMPED OVERRUN DUE LATE SPIN PAUSE DEFAULT BANDS CHANGES MESSAGES"
    " AT_ONCE MOVES MOVES_END"
    " PHASE CHANGED LEAVING LEFT FREE"
    " ARRIVAL AT ORIGIN SLOT CYCLES BY_STAMP TREATED MODE DROPPED MOVED OTHER",
    start=0,
)
GATE_COLUMNS = int(G.OTHER + G.OTHER - G.ARRIVAL)

WAIT, DISCARD, PUBLISH_LATE, NEXT_SLOT = range(4)
ALL_IN_ORDER, NEWEST, FIRST = range(3)
REPLACED, SURPLUS, OVERFLOWED, DISCARDED = range(4)
"""Policies and reasons, as :data:`chainshaper.workload.event_log.WORDS` numbers them."""

S = IntEnum("S", "FIRST END COLUMNS", start=0)
I = IntEnum("I", "ON_CHAIN RING DEPTH HEAD WAITING COLUMNS", start=0)  # noqa: E741 - an input

Q = IntEnum("Q", "PLACES DEPTH HEAD WAITING", start=0)
"""A ring of messages, in entities and inputs: where its places are, how many messages wait."""

# Cores. FIRST to END is a list of threads; TABLE has pairs of an offset in the cycle and a mask of
# open servers, of which NEXT is in force from BOUNDARY on. QUANTUM is what is left of it; DIRTY:
# another thread may have to run.
C = IntEnum(
    "C",
    "FIRST END TABLE TABLE_END RUNNING SINCE UNTIL LAST QUANTUM MASK NEXT BOUNDARY DIRTY COLUMNS",
    start=0,
)

# Messages. NEXT links the free ones, and those in a thread's queue. SOURCE is the source timestamp,
# ORIGIN the header's stamp, START when the chain that it belongs to started (NONE: it is not on the
# chain), NUMBER that of the chain's instance.
M = IntEnum(
    "M", "NEXT ENTITY PUBLISHER ADDRESS SOURCE ORIGIN START NUMBER MODE ARRIVAL COLUMNS", start=0
)

D = IntEnum("D", "CONSTANT NEXT LIMIT COLUMNS", start=0)
"""Streams of numbers. A constant needs no values."""

H = IntEnum("H", "TIME ORDER KIND ROW COLUMNS", start=0)
EXPIRY, DELIVERY, SLEEP_OVER = range(3)

# The engine itself. HEAP to HEAP_END are the events to come, LOGS the rows of A, FREE the first of
# the UNUSED messages. PAUSED: why the engine has to be left for a moment. AWAY: by how much longer
# (ppm) everything takes because of interrupts. STARTED: recorded instances of the chain.
_Engine = namedtuple(
    "_Engine",
    "NOW COUNTER CORES CORES_END HEAP HEAP_END HEAP_LIMIT LOGS LATENCIES LATENCIES_END FREE UNUSED"
    " PAUSED STOP LAST_TIMER RECORD_FROM LOGGING SWITCHES SWITCH_COST PREEMPTION_COST QUANTUM AWAY"
    " CYCLE STARTED COLUMNS",
)
X = _Engine(*range(25))

RESERVE = 1024
"""So much of everything is left when the engine pauses: more than one step can use."""

RUNNING, MORE_DRAWS, LOG_FULL, MESSAGES_FULL, OVER = range(5)

# The log, by kind of entry; fields behind time and thread.
L_START, L_END = 0, 1  # entity, CPU time
L_PUBLISH = 2  # publisher, address
L_TAKE = 3  # entity, address, source timestamp, taken
L_WAIT = 4  # timeout
L_EXECUTE = 5  # entity
L_SEND = 6  # publisher, source timestamp, outcome, duration
L_SWITCH = 7  # core, previous thread, whether it is still runnable
L_RELEASE = 8  # entity, source timestamp, and the gate's ARRIVAL to MOVED
LOG_FIELDS = (4, 4, 4, 6, 3, 3, 6, 5, 14)

A = IntEnum("A", "FIRST STRIDE COUNT COLUMNS", start=0)
"""Logs: entries stand column by column, which are STRIDE apart."""

SENT_OUTCOME, EXPIRED, OVERWRITTEN = range(3)
