"""The state of a simulated system: one array of integers, and the names of what stands where.

The compiled engine knows nothing but this array. It has areas: a row per thread, entity,
publisher, gate, synchroniser, stream and core, a pool of messages, a heap of events to come, and
the log of what happened. A row is referred to by its place in the array, so ``m[thread + T_LEFT]``
is a field of a thread, and NONE stands for no row. Columns above the line in each list are given,
those below it change as time goes on. Times are integer nanoseconds.

(One array, because every array that a compiled function is called with costs it more time than
most of these functions need.)
"""

from collections.abc import Mapping

import numpy as np
import numpy.typing as npt

from chainshaper.gate.decision import CHANGES

__all__ = ["Int64s", "Memory", "refer_to_places"]

Int64s = npt.NDArray[np.int64]

NONE = -1
FOREVER = 2**62

# Threads. Executors run the callbacks of one process, publisher threads send for its asynchronous
# publishers, DDS threads receive for it.
(
    T_ROW,  # which thread it is
    T_CORE,
    T_RANK,  # the smaller one runs; servers before all threads outside servers
    T_SERVER,  # bit of the core's mask, or NONE: always eligible
    T_KIND,
    T_FIRST,  # entities, in the order in which the executor looks at them
    T_END,
    T_WAKE,  # streams of CPU times: from being woken to being at work,
    T_TAKE,  # from choosing a message to its callback,
    T_PUBLISH,  # one publication (a publisher thread: one send),
    T_RECEIVE,  # one message (a DDS thread)
    T_DELIVERY,  # stream of the time from publishing to the subscriber's process
    T_PUBLISHER_THREAD,
    T_DDS_THREAD,
    # ---
    T_RUNNABLE,
    T_STEP,
    T_LEFT,  # CPU time to the next step
    T_SEQUENCE,  # place in the queue of its rank
    T_PREEMPTED,
    T_USED,  # CPU time so far
    T_ENTITY,
    T_PUBLICATION,  # the publisher that is next
    T_HEAD,  # a queue of messages: to send, to receive, or events to execute
    T_TAIL,
    T_SOURCE,  # what is known of the message that is being dealt with, as M_ below
    T_ORIGIN,
    T_START,
    T_NUMBER,
    T_MODE,
    T_BEGAN,  # when sending began, or the gate woke
    T_CAME,  # when the message that is being dealt with came
    THREAD_COLUMNS,
) = range(32)

SINGLE_THREADED, STATIC, EVENTS, PUBLISHER, DDS = range(5)
"""Kinds of threads: three executors, and what works for them."""

COLLECT, TAKE, PUBLISH, GATE_WAKE, GATE_PUBLISHED, GATE_PAUSED = range(6)
SEND, SENT, RECEIVE, RECEIVED = range(6, 10)
"""What a thread does next, when it has used the CPU time that is left to it."""

# Entities: what an executor waits for.
(
    E_ROW,
    E_THREAD,
    E_KIND,
    E_BODY,
    E_BODY_ROW,  # of the gate or synchroniser
    E_INPUT,  # which input of the synchroniser
    E_PERIOD,
    E_EXECUTION,  # stream
    E_PUBLISHERS,
    E_PUBLISHERS_END,
    E_LIFESPAN,
    E_STARTS_CHAIN,
    E_ON_CHAIN,
    E_HISTORY,  # a ring
    E_DEPTH,
    # ---
    E_HEAD,
    E_WAITING,
    E_DUE,
    E_READY,  # in the executor's snapshot
    E_INSTANCES,
    ENTITY_COLUMNS,
) = range(21)

TIMER, SUBSCRIPTION, SERVICE, CLIENT = range(4)
COMPUTE, GATE, MODE_LISTENER, SYNCHRONISE = range(4)

(
    P_ROW,
    P_FIRST,  # readers
    P_END,
    P_ASYNCHRONOUS,
    P_DEPTH,
    P_LIFESPAN,
    P_ENDS_CHAIN,
    P_MODES,  # that it announces in turn
    P_MODES_COUNT,
    # ---
    P_PUBLISHED,
    P_HELD,  # messages that wait for the publisher thread
    PUBLISHER_COLUMNS,
) = range(12)

# A reader is an entity and, after it, the time of the last delivery to it from this publisher.
R_ENTITY, R_LAST, READER_COLUMNS = range(3)

(
    G_SLOTS,  # pairs of start and end
    G_SLOTS_END,
    G_CYCLE,
    G_STAMPED,
    G_OVERRUN,
    G_DUE,
    G_LATE,
    G_SPIN,
    G_PAUSE,
    G_DEFAULT,  # NONE: knows no modes
    G_BANDS,  # one per mode, NONE for those that it does not know
    G_CHANGES,  # a ring of pairs: time, mode
    G_MESSAGES,
    # ---
    G_PHASE,
    G_CHANGED,  # how many changes of mode so far
    G_LEAVING,  # starts of cycles, as `Queue` has them
    G_LEFT,
    G_FREE,
    # what was decided about the message that it holds:
    G_ARRIVAL,
    G_AT,
    G_ORIGIN,
    G_SLOT,
    G_CYCLES,
    G_BY_STAMP,
    G_TREATED,
    G_MODE,
    G_DROPPED,
    G_OTHER,  # as many for one that waits behind it
) = range(28)
GATE_COLUMNS = G_OTHER + G_OTHER - G_ARRIVAL

WAIT, DISCARD, PUBLISH_LATE, NEXT_SLOT = range(4)
ALL_IN_ORDER, NEWEST, FIRST = range(3)
REPLACED, SURPLUS, OVERFLOWED, DISCARDED = range(4)
"""Policies and reasons, as :data:`chainshaper.workload.event_log.WORDS` numbers them."""

CHANGES_KEPT = CHANGES

S_FIRST, S_END, SYNCHRONISER_COLUMNS = range(3)
# Inputs of synchronisers.
I_ON_CHAIN, I_RING, I_DEPTH, I_HEAD, I_WAITING, INPUT_COLUMNS = range(6)

# A ring of messages, in entities and inputs: where its places are, and how many messages wait.
Q_PLACES, Q_DEPTH, Q_HEAD, Q_WAITING = range(4)

(
    C_FIRST,  # a list of threads
    C_END,
    C_TABLE,  # its slot table: pairs of an offset in the cycle and a mask of open servers
    C_TABLE_END,
    # ---
    C_RUNNING,
    C_SINCE,
    C_UNTIL,
    C_LAST,  # which thread ran last
    C_QUANTUM,  # what is left of it
    C_MASK,  # open servers
    C_NEXT,  # pair of the table
    C_BOUNDARY,  # when that is in force
    C_DIRTY,  # another thread may have to run
    CORE_COLUMNS,
) = range(14)

# Messages: M_NEXT links the free ones, and those in a thread's queue.
(
    M_NEXT,
    M_ENTITY,
    M_PUBLISHER,
    M_SOURCE,  # source timestamp
    M_ORIGIN,  # header stamp
    M_START,  # when the chain that it belongs to started; NONE: it is not on the chain
    M_NUMBER,  # of that chain's instance
    M_ADDRESS,
    M_MODE,
    M_ARRIVAL,
    MESSAGE_COLUMNS,
) = range(11)

# Streams of numbers. A constant needs no values.
D_CONSTANT, D_NEXT, D_LIMIT, STREAM_COLUMNS = range(4)

H_TIME, H_ORDER, H_KIND, H_ROW, HEAP_COLUMNS = range(5)
EXPIRY, DELIVERY, SLEEP_OVER = range(3)

(
    X_NOW,
    X_COUNTER,
    X_CORES,
    X_CORES_END,
    X_HEAP,
    X_HEAP_END,  # behind the last event
    X_HEAP_LIMIT,
    X_LOGS,
    X_LATENCIES,
    X_LATENCIES_END,
    X_FREE,  # first free message
    X_UNUSED,  # how many of them there are
    X_PAUSED,  # why the engine has to be left for a moment
    X_STOP,
    X_LAST_TIMER,
    X_RECORD_FROM,
    X_LOGGING,
    X_SWITCHES,  # log them, too
    X_SWITCH_COST,
    X_PREEMPTION_COST,
    X_QUANTUM,
    X_AWAY,  # by how much longer (ppm) everything takes because of interrupts
    X_CYCLE,
    X_WARM_UP,  # chain instances before the recorded ones
    CONTROL_COLUMNS,
) = range(25)

RESERVE = 1024
"""So much of everything is left when the engine pauses: more than one step can use."""

RUNNING, MORE_DRAWS, LOG_FULL, MESSAGES_FULL, OVER = range(5)

# The log, by kind of entry; after time and thread:
(
    L_START,  # entity, CPU time
    L_END,  # entity, CPU time
    L_PUBLISH,  # publisher, address
    L_TAKE,  # entity, address, source timestamp, taken
    L_WAIT,  # timeout
    L_EXECUTE,  # entity
    L_SEND,  # publisher, source timestamp, outcome, duration
    L_SWITCH,  # core, previous thread, whether it is still runnable
    L_RELEASE,  # entity, source, and the gate's G_ARRIVAL to G_DROPPED
    LOG_KINDS,
) = range(10)
LOG_FIELDS = (6, 6, 6, 6, 6, 6, 6, 6, 13)

# Logs: entries stand column by column, which are A_STRIDE apart.
A_FIRST, A_STRIDE, A_COUNT, LOG_COLUMNS = range(4)

SENT_OUTCOME, EXPIRED, OVERWRITTEN = range(3)


class Memory:
    """One array with areas of rows, and what it takes to refer to their rows."""

    def __init__(self, areas: Mapping[str, Int64s]) -> None:
        self._columns = {name: area.shape[1] for name, area in areas.items()}
        self._first: dict[str, int] = {}
        self._areas: dict[str, Int64s] = {}
        self.array = np.zeros(sum(area.size for area in areas.values()), dtype=np.int64)
        first = 0
        for name, area in areas.items():
            self._first[name] = first
            self._areas[name] = self.array[first : first + area.size].reshape(area.shape)
            self._areas[name][:] = area
            first += area.size

    def __getitem__(self, name: str) -> Int64s:
        """An area, as a view with a row per thing."""
        return self._areas[name]

    def place(self, name: str, row: int) -> int:
        """Where a row of an area begins."""
        return int(self._first[name] + row * self._columns[name])

    def refer(
        self, name: str, column: int, target: str, rows: npt.NDArray[np.bool_] | None = None
    ) -> None:
        """Turn a column's numbers of rows of ``target`` into their places."""
        numbers = self._areas[name][:, column]
        chosen = numbers != NONE if rows is None else rows & (numbers != NONE)
        numbers[chosen] = self._first[target] + numbers[chosen] * self._columns[target]


_REFERENCES: Mapping[str, Mapping[str, tuple[int, ...]]] = {
    "threads": {
        "cores": (T_CORE,),
        "entities": (T_FIRST, T_END),
        "streams": (T_WAKE, T_TAKE, T_PUBLISH, T_RECEIVE, T_DELIVERY),
        "threads": (T_PUBLISHER_THREAD, T_DDS_THREAD),
    },
    "entities": {
        "threads": (E_THREAD,),
        "streams": (E_EXECUTION,),
        "publishers": (E_PUBLISHERS, E_PUBLISHERS_END),
        "rings": (E_HISTORY,),
    },
    "publishers": {"readers": (P_FIRST, P_END), "announced": (P_MODES,)},
    "readers": {"entities": (R_ENTITY,)},
    "gates": {"slots": (G_SLOTS, G_SLOTS_END), "bands": (G_BANDS,), "changes": (G_CHANGES,)},
    "synchronisers": {"inputs": (S_FIRST, S_END)},
    "inputs": {"rings": (I_RING,)},
    "cores": {"core_threads": (C_FIRST, C_END), "boundaries": (C_TABLE, C_TABLE_END, C_NEXT)},
    "core_threads": {"threads": (0,)},
}
"""Columns that refer to rows: by area, and by the area whose rows they mean."""


def refer_to_places(memory: Memory) -> None:
    """Turn the numbers of rows into places, and note where the areas are."""
    for area, targets in _REFERENCES.items():
        for target, columns in targets.items():
            for column in columns:
                memory.refer(area, column, target)
    synchronising = memory["entities"][:, E_BODY] == SYNCHRONISE
    memory.refer("entities", E_BODY_ROW, "gates", ~synchronising)
    memory.refer("entities", E_BODY_ROW, "synchronisers", synchronising)
    messages = memory["messages"]
    messages[:-1, M_NEXT] = [memory.place("messages", row) for row in range(1, len(messages))]
    for kind in range(LOG_KINDS):
        stride = memory[f"log {kind}"].shape[1]
        memory["counts"][kind] = (memory.place(f"log {kind}", 0), stride, 0)
    control = memory["control"][0]
    control[X_CORES] = memory.place("cores", 0)
    control[X_CORES_END] = memory.place("cores", len(memory["cores"]))
    control[X_FREE] = memory.place("messages", 0)
    control[X_HEAP] = control[X_HEAP_END] = memory.place("heap", 0)
    control[X_HEAP_LIMIT] = memory.place("heap", len(memory["heap"]) - RESERVE)
    control[X_LOGS] = memory.place("counts", 0)
    control[X_LATENCIES] = memory.place("latencies", 0)
    control[X_LATENCIES_END] = control[X_LATENCIES] + memory["latencies"].shape[1]
