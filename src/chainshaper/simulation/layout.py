"""What stands where in the one array of integers on which the compiled engine runs.

There is a row per thread (T), entity (E), publisher (P), reader (R), gate (G), input of a
synchroniser (I), core (C), message (M), stream of numbers (D) and event to come (H), and one for
the engine itself (X), which comes first; and the log. A row is referred to by its place in the
array, so ``m[thread + T.LEFT]`` is a field of a thread; NONE stands for no row. Each list begins
with the columns that are given; the others change as time goes on.

(One array, because every array that a compiled function is called with costs it more time than
most of these functions need. Lists of columns are enumerations, which Numba takes for numbers
behind a sum; what is an index by itself has to be a number.)
"""

from collections import namedtuple
from enum import IntEnum

import numpy as np
import numpy.typing as npt

from chainshaper.workload.event_log import LAYOUT, WIDTH

Int64s = npt.NDArray[np.int64]

NONE = -1
FOREVER = 2**62

# Threads. Executors run the callbacks of one process, publisher threads send for its asynchronous
# publishers, DDS threads receive for it. The smaller RANK runs; SERVER is a bit of the core's mask.
# FIRST to END are entities in the order in which the executor looks at them. Streams of CPU times:
# from being woken to being at work, from choosing a message to its callback, one publication (or
# send), one message received; DELIVERY is the time until a message is at the subscriber's process.
# POOL to POOL_END are the executor's threads; the first's OWNER waits, or takes what is next.
# From HEAD on: its queue (Q) of messages to receive, or of marks for what to execute or to send.
# LEFT is the CPU time to the next STEP, SEQUENCE the place among those of its rank; BEGAN is when
# sending began or the gate woke. SOURCE to ARRIVAL are those of its present message, as in M.
T = IntEnum(
    "T",
    "ROW CORE RANK SERVER KIND FIRST END WAKE TAKE PUBLISH RECEIVE DELIVERY PUBLISHER_THREAD"
    " DDS_THREAD POOL POOL_END OWNER RUNNABLE STEP LEFT SEQUENCE PREEMPTED USED ENTITY PUBLICATION"
    " HEAD TAIL WAITING SOURCE ORIGIN START NUMBER MODE ARRIVAL BEGAN COLUMNS",
    start=0,
)

SINGLE_THREADED, STATIC, EVENTS, MULTI_THREADED, PUBLISHER, DDS = range(6)
"""Kinds of threads: four executors, and what works for them."""

COLLECT, TURN, TAKE, PUBLISH, GATE_WAKE, GATE_PUBLISHED, GATE_PAUSED = range(7)
SEND, SENT, RECEIVE, RECEIVED = range(7, 11)
"""What a thread does next, when it has used the CPU time that is left to it."""

# Entities: what an executor waits for. BODY_ROW is that of the gate, or of the synchroniser's first
# input, INPUT which of its inputs it is. GROUP is where stands whether its mutually exclusive group
# is busy, NONE if its executor has one thread, or the group is reentrant. AFTERWARDS is NONE where
# the callback ends with its last publication. From HEAD on: its history (Q). READY: in the
# snapshot.
E = IntEnum(
    "E",
    "CALLBACK HANDLE RMW_HANDLE THREAD GROUP KIND BODY BODY_ROW INPUT PERIOD EXECUTION AFTERWARDS"
    " PUBLISHERS PUBLISHERS_END LIFESPAN STARTS_CHAIN ON_CHAIN HEAD TAIL WAITING DEPTH DUE READY"
    " COLUMNS",
    start=0,
)

TIMER, SUBSCRIPTION, SERVICE, CLIENT = range(4)
COMPUTE, GATE, MODE_LISTENER, SYNCHRONISE = range(4)

# Publishers. It announces MODES in turn. From HEAD on: what waits for the publisher thread (Q).
P = IntEnum(
    "P",
    "ROW HANDLE RMW_HANDLE FIRST END ASYNCHRONOUS LIFESPAN ENDS_CHAIN MODES MODES_COUNT PUBLISHED"
    " HEAD TAIL WAITING DEPTH COLUMNS",
    start=0,
)

R = IntEnum("R", "ENTITY LAST DELIVERY COLUMNS", start=0)
"""Readers: an entity, the time of the last delivery to it from this publisher, and how long
deliveries take (NONE: as all of the sending thread's)."""

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

I = IntEnum("I", "ON_CHAIN TRIGGER END HEAD TAIL WAITING DEPTH COLUMNS", start=0)  # noqa: E741 - an input
"""Inputs of a synchroniser; END is where the last one ends. TRIGGER is the row of the one whose
messages complete sets, with the newest of the others; NONE: the last one to come does."""

Q = IntEnum("Q", "HEAD TAIL WAITING DEPTH", start=0)
"""A queue of messages, which M.NEXT links; those of threads have no DEPTH."""

# Cores. FIRST to END is a list of threads; TABLE has pairs of an offset in the cycle and a mask of
# open servers, of which NEXT is in force from BOUNDARY on. QUANTUM is what is left of it; DIRTY:
# another thread may have to run.
C = IntEnum(
    "C",
    "FIRST END TABLE TABLE_END RUNNING SINCE UNTIL LAST QUANTUM MASK NEXT BOUNDARY DIRTY COLUMNS",
    start=0,
)

# Messages. NEXT links the free ones, and those in a queue. SOURCE is the source timestamp, ORIGIN
# the header's stamp, START when the chain that it belongs to started (NONE: it is not on the
# chain), NUMBER that of the chain's instance.
M = IntEnum(
    "M", "NEXT ENTITY PUBLISHER ADDRESS SOURCE ORIGIN START NUMBER MODE ARRIVAL COLUMNS", start=0
)
CARRIED = int(M.COLUMNS - M.SOURCE)

D = IntEnum("D", "CONSTANT NEXT LIMIT COLUMNS", start=0)
"""Streams of numbers. A constant needs no values."""

H = IntEnum("H", "TIME KIND ROW COLUMNS", start=0)
EXPIRY, DELIVERY, SLEEP_OVER = range(3)

# The engine itself. EVENTS to EVENTS_END are the events to come, the next one last. FREE is the
# first of the UNUSED messages. PAUSED: why the engine has to be left for a moment. AWAY: by how
# much longer (ppm) everything takes because of interrupts. STARTED: recorded instances of a chain.
_Engine = namedtuple(
    "_Engine",
    "NOW COUNTER CORES CORES_END EVENTS EVENTS_END EVENTS_LIMIT LOGGED LOG LOG_ROWS LATENCIES"
    " LATENCIES_END FREE UNUSED PAUSED STOP LAST_TIMER RECORD_FROM LOGGING SWITCHES SWITCH_COST"
    " PREEMPTION_COST QUANTUM AWAY CYCLE STARTED COLUMNS",
)
X = _Engine(*range(len(_Engine._fields)))

RESERVE = 1024
"""So much of everything is left when the engine pauses: more than one step can use."""

RUNNING, MORE_DRAWS, LOG_FULL, MESSAGES_FULL, OVER = range(5)

L_START, L_END, L_PUBLISH, L_TAKE, L_EXECUTE, L_WAIT, L_RELEASE, L_SEND = range(8)
L_SWITCH = len(LAYOUT)  # core, previous thread, whether it is still runnable
"""Kinds of entries of the log: the first are those of :mod:`chainshaper.workload.event_log`. From
X.LOGGED on stands how many there are of each. Of each the columns stand one after the other: time,
number of the thread, and fields, in X.LOG_ROWS places each."""
LOG_COLUMNS = WIDTH - 1

SENT_OUTCOME, EXPIRED, OVERWRITTEN = range(3)
