"""What must be fast: trace decoder, joins, band placement, simulator (C++, in core/)."""

from collections.abc import Callable, Sequence
from enum import Enum
from typing import Any

import numpy as np
from numpy.typing import NDArray
from typing_extensions import Buffer

# Bands

UNREACHABLE: int
"""The cost of bands that no placement reaches."""

def add_band(
    *,
    ends_ns: NDArray[np.int64],
    counts: NDArray[np.int64],
    nearest: NDArray[np.int64],
    farthest: NDArray[np.int64],
    behind: NDArray[np.int64],
    costs: NDArray[np.int64],
    successors: NDArray[np.int32],
) -> None:
    """Add one band to a placement: fill `costs` and `successors` for every place.

    See `chainshaper.planning.bands`. Raises ValueError for arrays of different lengths,
    and for places or windows that do not ascend.
    """

# Control loops

NO_EVENT: int
"""In place of a slot: time passes, and nothing happens."""

def propagate_covariance(
    *,
    sizes: tuple[int, int, int, int],
    longest_s: float,
    flows: NDArray[np.float64],
    rows: NDArray[np.float64],
    noise: NDArray[np.float64],
    waits_s: NDArray[np.float64],
    slots: NDArray[np.int32],
    covariance: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Carry the covariance of a control loop over events (:mod:`chainshaper.control.costs`).

    ``sizes`` are the numbers of inputs, of states of the plant and of the controller, and of slots.
    ``flows`` are :attr:`.Flows.table`, flat; ``rows`` and ``noise`` what a sample does. Before each
    event ``waits_s`` pass; its entry in ``slots`` is ~slot for a sample that computes into it, slot
    for an output that arrives from it, or :data:`NO_EVENT`. Returns the cost and the duration (s)
    from each sample to the next, and the covariance behind the last event.

    Raises ValueError for arrays of wrong lengths, and for events that do not follow each other.
    """

# Joins: rows of one table matched to rows of another by key and time

_KeyColumn = NDArray[np.int64] | NDArray[np.uint64] | NDArray[np.int32] | NDArray[np.uint32]

NO_ROW: int
"""The number of a row that matches nothing."""

def latest_before(
    *,
    left_keys: Sequence[_KeyColumn],
    left_times_ns: NDArray[np.int64],
    right_keys: Sequence[_KeyColumn],
    right_times_ns: NDArray[np.int64],
    strictly: bool = False,
) -> NDArray[np.uint32]:
    """For each row of the left table the latest row of the right one with its key; NO_ROW for none.

    Times ascend; up to three columns of keys have an entry for each row. Of rows of the right table
    with equal times the last counts; ``strictly`` leaves out rows at the very time of the left one.
    Raises ValueError for columns of different lengths or other types.
    """

def first_after(
    *,
    left_keys: Sequence[_KeyColumn],
    left_times_ns: NDArray[np.int64],
    right_keys: Sequence[_KeyColumn],
    right_times_ns: NDArray[np.int64],
    strictly: bool = False,
) -> NDArray[np.uint32]:
    """As :func:`latest_before`, but the first row at or after the left one's time."""

def ends_of_starts(
    *,
    start_keys: Sequence[_KeyColumn],
    start_times_ns: NDArray[np.int64],
    end_keys: Sequence[_KeyColumn],
    end_times_ns: NDArray[np.int64],
) -> NDArray[np.uint32]:
    """For each start the row of its end; NO_ROW for none.

    An instance ends with the next event of the same key, if that is an end. Arrays as for
    :func:`latest_before`.
    """

# Traces in the Common Trace Format: types of their metadata. Sizes and alignments are in bits.

CTF_MAGIC: int
"""The number that each packet begins with."""
CTF_BUDGET_PER_BYTE: int
"""What decoding may cost for each byte of a packet; a step costs 1, a byte of a column as well."""

class CtfType:
    """A type of a trace's metadata."""

    @staticmethod
    def integer(
        *,
        size: int,
        align: int,
        is_signed: bool,
        big_endian: bool,
        maps_clock: bool,
        labels: Sequence[tuple[str, int, int]],
    ) -> CtfType:
        """Make the type of an integer, or of an enumeration.

        ``labels``: each label, and the lowest and highest value that it stands for, as distances
        from the least integer of 64 bits, signed or not. Raises ValueError: impossible sizes.
        """

    @staticmethod
    def string() -> CtfType:
        """Make the type of a text: bytes up to and including the first NUL."""

    @staticmethod
    def array(*, element: CtfType, length: int | str, is_text: bool) -> CtfType:
        """Make the type of an array; of a sequence, if ``length`` is the path of a field."""

    @staticmethod
    def structure(*, fields: Sequence[tuple[str, CtfType]], align: int) -> CtfType:
        """Make the type of fields that follow each other."""

    @staticmethod
    def variant(*, tag: str | None, options: Sequence[tuple[str, CtfType]]) -> CtfType:
        """Make the type of a variant: the enumeration at the path ``tag`` chooses an option."""

class CtfEventClass:
    """What an event class declares; ``context`` and ``fields`` are structures."""

    def __init__(self, *, id: int, context: CtfType | None, fields: CtfType | None) -> None: ...

class CtfStreamClass:
    """What a stream class declares; contexts and header are structures."""

    def __init__(
        self,
        *,
        id: int,
        packet_context: CtfType | None,
        event_header: CtfType | None,
        event_context: CtfType | None,
        events: Sequence[CtfEventClass],
        frequency_hz: int,
    ) -> None: ...

class CtfTraceClass:
    """What a trace's metadata declares.

    ``uuid`` are its bytes as two little-endian numbers, ``referenced`` the names of the fields that
    lengths and tags refer to.
    """

    def __init__(
        self,
        *,
        big_endian: bool,
        of_kernel: bool,
        uuid: tuple[int, int] | None,
        packet_header: CtfType | None,
        referenced: set[str],
        streams: Sequence[CtfStreamClass],
    ) -> None: ...

# Where the bits of packets are

class CtfScope(Enum):
    """The scope that a field of an event is in."""

    STREAM_EVENT_CONTEXT = ...
    EVENT_CONTEXT = ...
    EVENT_FIELDS = ...

class CtfWantedEvent:
    """An event class that is wanted.

    * ``event``: its number, counted over all traces
    * ``table``: that its events go to; tables are numbered from 0 in order of their first event,
      and all events of a table have columns of the same types
    * ``columns``: scope and number of each field that gets a column, in order
    """

    def __init__(
        self, *, event: int, table: int, columns: Sequence[tuple[CtfScope, int]]
    ) -> None: ...

class CtfLayout:
    """Where the bits of some traces' packets are.

    Raises ValueError, whose ``args`` are the reason, and the number of the trace.
    """

    def __init__(
        self, traces: Sequence[CtfTraceClass], wanted: Sequence[CtfWantedEvent]
    ) -> None: ...
    @property
    def traces(self) -> list[tuple[int, int]]:
        """The stream classes of each trace, counted over all: the first, and the end."""

# Finding packets

class CtfDamage(Enum):
    """What is wrong at a place where a packet should be."""

    BAD_MAGIC = ...
    BAD_UUID = ...
    BAD_STREAM = ...
    BAD_SIZE = ...
    BAD_HEADER = ...
    CUT = ...
    COSTLY = ...

class CtfDamagedPlace:
    """Damage at an ``offset`` (bytes) of a file.

    ``following`` is the offset of the next packet; -1: the rest of the file is not read.
    """

    @property
    def damage(self) -> CtfDamage: ...
    @property
    def offset(self) -> int: ...
    @property
    def following(self) -> int: ...

class CtfPackets:
    """The packets of a stream file."""

    @property
    def columns(self) -> dict[str, NDArray[np.int64]]:
        """See :class:`chainshaper.sources.ctf.copies.CtfStream`; without earliest and latest."""

    @property
    def damaged(self) -> list[CtfDamagedPlace]: ...

def find_packets(layout: CtfLayout, trace: int, file: Buffer, *, beginning: bytes) -> CtfPackets:
    """Find the packets of a stream file of a trace.

    After damage it goes on at the next place with the bytes of ``beginning``, with which each
    packet begins; if there are no such bytes, it ends there.
    """

# Reading events

class CtfFailure(Enum):
    """Why an event cannot be read."""

    TRUNCATED = ...
    NO_OPTION = ...
    BAD_LENGTH = ...
    UNTERMINATED = ...
    UNKNOWN_EVENT = ...
    OVER_BUDGET = ...
    OTHER_TIME = ...
    NO_PROCESS = ...
    ALL_ZEROS = ...
    TABLE_FULL = ...

class CtfBadEvent:
    """An event at an ``offset`` (bytes) of a file that ends its ``packet``."""

    @property
    def packet(self) -> int: ...
    @property
    def offset(self) -> int: ...
    @property
    def failure(self) -> CtfFailure: ...

class CtfFileChangedError(Exception):
    """A file no longer has the events that were counted."""

class CtfChunk:
    """Packets [``first``, ``end``) of a file.

    ``rows_before`` and ``rows_after``: for each table, how many rows the events of the file up to
    the first of these packets have, and up to the last one.
    """

    @property
    def first(self) -> int: ...
    @property
    def end(self) -> int: ...
    @property
    def rows_before(self) -> NDArray[np.int64]: ...
    @property
    def rows_after(self) -> NDArray[np.int64]: ...

class CtfTable:
    """The arrays, all of the same length, that events of a table are written to.

    ``columns`` are integers as wide as the fields' integers, or uint32, the codes of texts. The
    arrays stay alive as long as this object.
    """

    def __init__(
        self,
        *,
        times_ns: NDArray[np.int64],
        cpus: NDArray[np.int32] | None,
        columns: Sequence[NDArray[Any]],
    ) -> None: ...
    def sort_by_time(self) -> None:
        """Sort the rows by time, in place; rows of equal times stay in their order."""

class CtfEventReader:
    """Reads the events of a stream file, which must not be written to meanwhile.

    The arrays have an entry for each packet: bytes from the file's beginning, bits, the stream
    class, the core, and the earliest and latest time of its events (clock cycles). Raises
    ValueError for packets that are not in the file.
    """

    def __init__(
        self,
        layout: CtfLayout,
        file: Buffer,
        *,
        offset: NDArray[np.int64],
        content_bits: NDArray[np.int64],
        stream_class: NDArray[np.int64],
        cpu: NDArray[np.int64],
        earliest: NDArray[np.int64],
        latest: NDArray[np.int64],
    ) -> None: ...
    def count(self, end: int) -> CtfChunk:
        """Count the events of the packets up to ``end`` that were not counted yet."""

    def write(
        self, chunk: CtfChunk, tables: Sequence[CtfTable], first_rows: NDArray[np.int64]
    ) -> list[bytes]:
        """Write a chunk's events to tables, whose rows of this file begin at ``first_rows``.

        Returns the texts in the order of their codes. Threads may write different chunks at once.
        Raises CtfFileChangedError, and ValueError for tables that are not those of the layout.
        """

    @property
    def counts(self) -> NDArray[np.int64]:
        """Events per event class, zeros included."""

    @property
    def rows(self) -> NDArray[np.int64]:
        """Rows per table."""

    @property
    def bad_events(self) -> list[CtfBadEvent]: ...

def recode(codes: NDArray[np.uint32], new_codes: NDArray[np.uint32]) -> None:
    """Replace each code of ``codes`` by ``new_codes[code]``, in place."""

# What is simulated (core/simulation/description.hpp). Parts are made with the fields that differ
# from the default, and refer to each other by their places in the lists of a `Description`. Times
# are ns; lists are copied, in both directions.

FOREVER_NS: int
"""Later than anything that happens in a simulation."""

class Role(Enum):
    """What a thread is for."""

    executor = 0
    publisher = 1
    dds = 2
    loop = 3

class ExecutorKind(Enum):
    """In which order an executor runs callbacks that are ready."""

    single_threaded = 0
    static_single_threaded = 1
    events = 2
    multi_threaded = 3

class EntityKind(Enum):
    """What an executor waits for."""

    timer = 0
    subscription = 1
    service = 2
    client = 3
    loop = 4

class Body(Enum):
    """What a callback does."""

    compute = 0
    gate = 1
    mode_listener = 2
    synchronise = 3
    store = 4

class CoreDescription:
    """A core.

    ``table``: offsets in the cycle (ns), and which servers are open from each on, a bit for each.
    """

    table: list[tuple[int, int]]
    open_servers: int
    next: int
    boundary_ns: int
    def __init__(
        self,
        *,
        table: Sequence[tuple[int, int]] = ...,
        open_servers: int = ...,
        next: int = ...,
        boundary_ns: int = ...,
    ) -> None: ...

class ThreadDescription:
    """A thread of a process; ``wake_up`` to ``delivery`` are places of streams."""

    core: int
    rank: int
    server: int | None
    role: Role
    process: int
    wake_up: int
    take: int
    publish: int
    receive: int | None
    delivery: int
    pid: int
    tid: int
    cpu: int
    def __init__(
        self,
        *,
        core: int = ...,
        rank: int = ...,
        server: int | None = ...,
        role: Role = ...,
        process: int = ...,
        wake_up: int = ...,
        take: int = ...,
        publish: int = ...,
        receive: int | None = ...,
        delivery: int = ...,
        pid: int = ...,
        tid: int = ...,
        cpu: int = ...,
    ) -> None: ...

class ProcessDescription:
    """A process: its executor, and its entities in the order in which the executor checks them."""

    executor: ExecutorKind
    first_entity: int
    entity_count: int
    def __init__(
        self,
        *,
        executor: ExecutorKind = ...,
        first_entity: int = ...,
        entity_count: int = ...,
    ) -> None: ...

class EntityDescription:
    """A timer, subscription, service or client with its callback."""

    callback: int
    handle: int
    rmw_handle: int
    process: int
    kind: EntityKind
    group: int | None
    body: Body
    gate: int
    synchroniser: int
    loop: int
    input: int
    period_ns: int
    due_ns: int
    execution: int
    afterwards: int | None
    first_publisher: int
    publisher_count: int
    lifespan_ns: int | None
    depth: int
    starts_chain: bool
    on_chain: bool
    def __init__(
        self,
        *,
        callback: int = ...,
        handle: int = ...,
        rmw_handle: int = ...,
        process: int = ...,
        kind: EntityKind = ...,
        group: int | None = ...,
        body: Body = ...,
        gate: int = ...,
        synchroniser: int = ...,
        loop: int = ...,
        input: int = ...,
        period_ns: int = ...,
        due_ns: int = ...,
        execution: int = ...,
        afterwards: int | None = ...,
        first_publisher: int = ...,
        publisher_count: int = ...,
        lifespan_ns: int | None = ...,
        depth: int = ...,
        starts_chain: bool = ...,
        on_chain: bool = ...,
    ) -> None: ...

class ReaderDescription:
    """An entity that reads a topic; ``delivery`` is the stream of its delivery times."""

    entity: int
    delivery: int | None
    def __init__(
        self,
        *,
        entity: int = ...,
        delivery: int | None = ...,
    ) -> None: ...

class PublisherDescription:
    """A callback's publisher of a topic."""

    handle: int
    rmw_handle: int
    readers: list[ReaderDescription]
    asynchronous: bool
    depth: int
    lifespan_ns: int | None
    ends_chain: bool
    modes: list[int]
    def __init__(
        self,
        *,
        handle: int = ...,
        rmw_handle: int = ...,
        readers: Sequence[ReaderDescription] = ...,
        asynchronous: bool = ...,
        depth: int = ...,
        lifespan_ns: int | None = ...,
        ends_chain: bool = ...,
        modes: Sequence[int] = ...,
    ) -> None: ...

class GateDescription:
    """A gate in a callback: a `chainshaper.robot.gate.Gate`; ``modes`` are their numbers."""

    slots: list[tuple[int, int]]
    cycle_ns: int
    anchor: str
    phase_ns: int
    overrun: str
    due_cycles: int
    mode_names: list[str]
    mode_slots: list[int]
    first_mode: int
    late: str
    messages: str
    depth: int
    into_open_slot: str
    modes: list[int]
    moves: list[tuple[int, int]]
    spin_ns: int
    pause_ns: int
    def __init__(
        self,
        *,
        slots: Sequence[tuple[int, int]] = ...,
        cycle_ns: int = ...,
        anchor: str = ...,
        phase_ns: int = ...,
        overrun: str = ...,
        due_cycles: int = ...,
        mode_names: Sequence[str] = ...,
        mode_slots: Sequence[int] = ...,
        first_mode: int = ...,
        late: str = ...,
        messages: str = ...,
        depth: int = ...,
        into_open_slot: str = ...,
        modes: Sequence[int] = ...,
        moves: Sequence[tuple[int, int]] = ...,
        spin_ns: int = ...,
        pause_ns: int = ...,
    ) -> None: ...

class InputDescription:
    """An input of a synchroniser."""

    on_chain: bool
    depth: int
    def __init__(
        self,
        *,
        on_chain: bool = ...,
        depth: int = ...,
    ) -> None: ...

class SynchroniserDescription:
    """Inputs that come together; ``trigger`` is the place of the one that completes sets."""

    inputs: list[InputDescription]
    trigger: int | None
    def __init__(
        self,
        *,
        inputs: Sequence[InputDescription] = ...,
        trigger: int | None = ...,
    ) -> None: ...

class LoopDescription:
    """A loop in a thread of its own, which uses the newest message of each of its ``inputs``."""

    thread: int
    inputs: int
    last_ns: int
    ends_chain: bool
    def __init__(
        self,
        *,
        thread: int = ...,
        inputs: int = ...,
        last_ns: int = ...,
        ends_chain: bool = ...,
    ) -> None: ...

class Description:
    """All of a simulation; ``streams`` are constants, or None for one that is drawn."""

    cores: list[CoreDescription]
    threads: list[ThreadDescription]
    processes: list[ProcessDescription]
    entities: list[EntityDescription]
    publishers: list[PublisherDescription]
    gates: list[GateDescription]
    synchronisers: list[SynchroniserDescription]
    loops: list[LoopDescription]
    streams: list[int | None]
    groups: int
    cycle_ns: int
    quantum_ns: int
    context_switch_ns: int
    preemption_ns: int
    interrupts_ppm: int
    last_timer_ns: int
    stop_ns: int
    record_from_ns: int
    events: bool
    switches: bool
    instances: int
    log_rows: int
    most_messages: int
    def __init__(
        self,
        *,
        cores: Sequence[CoreDescription] = ...,
        threads: Sequence[ThreadDescription] = ...,
        processes: Sequence[ProcessDescription] = ...,
        entities: Sequence[EntityDescription] = ...,
        publishers: Sequence[PublisherDescription] = ...,
        gates: Sequence[GateDescription] = ...,
        synchronisers: Sequence[SynchroniserDescription] = ...,
        loops: Sequence[LoopDescription] = ...,
        streams: Sequence[int | None] = ...,
        groups: int = ...,
        cycle_ns: int = ...,
        quantum_ns: int = ...,
        context_switch_ns: int = ...,
        preemption_ns: int = ...,
        interrupts_ppm: int = ...,
        last_timer_ns: int = ...,
        stop_ns: int = ...,
        record_from_ns: int = ...,
        events: bool = ...,
        switches: bool = ...,
        instances: int = ...,
        log_rows: int = ...,
        most_messages: int = ...,
    ) -> None: ...

class Pause(Enum):
    """Why the engine was left."""

    none = 0
    log_full = 1
    messages_full = 2
    endless = 3
    over = 4

class Simulation:
    """A simulated application, from its start on."""

    def __init__(self, description: Description, draw: Callable[[int], NDArray[np.int64]]) -> None:
        """``draw(stream)`` gives the next numbers of a stream. ValueError: it makes no sense."""

    def run(self, most_instants: int) -> Pause:
        """Go on until the end, until the log is full, or for so many instants."""

    def take_log(self) -> dict[str, dict[str, NDArray[Any]]]:
        """What was logged: columns by the names of entries and of fields; the log is empty then.

        Fields and `time` are int64; `thread`, its place, `pid`, `tid` and `cpu` are int32.
        """

    def latencies(self) -> NDArray[np.int64]:
        """Of each recorded instance of the chain that has started (ns); -1: it is incomplete."""

    @property
    def now_ns(self) -> int:
        """The present instant."""

def delta_packed(numbers: NDArray[np.int32] | NDArray[np.int64]) -> bytes:
    """A column, which must be contiguous, in Parquet's encoding DELTA_BINARY_PACKED."""
