"""What must be fast: trace decoder, joins, band placement, simulator (C++, in core/)."""

from collections.abc import Callable
from enum import Enum
from typing import Any

import numpy as np
from numpy.typing import NDArray

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

# What is simulated (core/simulation/description.hpp). Parts are made with the fields that differ
# from the default, and refer to each other by their places in the lists of a `Description`. Times
# are ns; lists are copied, in both directions.

FOREVER_NS: int
"""Later than anything that happens in a simulation."""

class Role(Enum):
    """Who works in a thread."""

    executor = 0
    publisher = 1
    dds = 2

class ExecutorKind(Enum):
    """In which order an executor does what is ready."""

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

class Body(Enum):
    """What a callback does."""

    compute = 0
    gate = 1
    mode_listener = 2
    synchronise = 3

class CoreDescription:
    """A core; ``table`` has offsets in the cycle, and from each on a bit for each open server."""

    table: list[tuple[int, int]]
    open_servers: int
    next: int
    boundary_ns: int
    def __init__(self, **fields: Any) -> None: ...

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
    def __init__(self, **fields: Any) -> None: ...

class ProcessDescription:
    """A process: its executor, and its entities in the order in which that looks at them."""

    executor: ExecutorKind
    first_entity: int
    entity_count: int
    def __init__(self, **fields: Any) -> None: ...

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
    def __init__(self, **fields: Any) -> None: ...

class ReaderDescription:
    """An entity that reads a topic; ``delivery`` is the stream of its delivery times."""

    entity: int
    delivery: int | None
    def __init__(self, **fields: Any) -> None: ...

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
    def __init__(self, **fields: Any) -> None: ...

class GateDescription:
    """A gate in a callback: a `chainshaper.gate.decision.Gate`; ``modes`` are their numbers."""

    slots: list[tuple[int, int]]
    cycle_ns: int
    anchor: str
    phase_ns: int
    overrun: str
    due_cycles: int
    mode_names: list[str]
    bands: list[int]
    first_mode: int
    late: str
    messages: str
    depth: int
    into_open_slot: str
    modes: list[int]
    moves: list[tuple[int, int]]
    spin_ns: int
    pause_ns: int
    def __init__(self, **fields: Any) -> None: ...

class InputDescription:
    """An input of a synchroniser."""

    on_chain: bool
    depth: int
    def __init__(self, **fields: Any) -> None: ...

class SynchroniserDescription:
    """Inputs that come together; ``trigger`` is the place of the one that completes sets."""

    inputs: list[InputDescription]
    trigger: int | None
    def __init__(self, **fields: Any) -> None: ...

class Description:
    """All of a simulation; ``streams`` are constants, or None for one that is drawn."""

    cores: list[CoreDescription]
    threads: list[ThreadDescription]
    processes: list[ProcessDescription]
    entities: list[EntityDescription]
    publishers: list[PublisherDescription]
    gates: list[GateDescription]
    synchronisers: list[SynchroniserDescription]
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
    def __init__(self, **fields: Any) -> None: ...

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
