"""A plan on the clock of this machine: from when on its slots count, and where they are by now."""

import json
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

from chainshaper.enforcement.back_ends import gates
from chainshaper.enforcement.journal import PLAN_FILE
from chainshaper.enforcement.node_threads import Allocation
from chainshaper.enforcement.planned_threads import closed_before
from chainshaper.enforcement.servers import ServerCounters
from chainshaper.enforcement.undoing import ServerState
from chainshaper.flow import anchoring
from chainshaper.flow.phase import Phase
from chainshaper.flow.server_tables import places_in, server_table
from chainshaper.planning.offsets import LEAD_NS
from chainshaper.planning.plan import Plan, open_until_done
from chainshaper.planning.plan_file import plan_values
from chainshaper.values.errors import OperationError
from chainshaper.values.files import write_whole


@dataclass
class AnchoredPlan:
    """A plan, and where its cycles begin on CLOCK_MONOTONIC."""

    given: Plan  # as planned, with offsets that fit the timers once these are known
    plan: Plan  # as it is carried out: with room for overruns, and slots that have moved
    back_end: str
    anchor_ns: int = 0  # from when on slots count, where they have been moved to by now
    waits_ns: list[int] = field(default_factory=list)  # from each timer to its slot, if measured
    moved_ns: dict[int, int] = field(default_factory=dict)  # by how much chains' slots have moved
    # Slots open early until then (CLOCK_MONOTONIC), for a timer to be seen: chains begin sooner.
    opens_early_until_ns: float = 0
    # Threads that follow latencies move slots too: it is held while slots change.
    lock: threading.Lock = field(default_factory=threading.Lock)

    @property
    def gated(self) -> bool:
        """Whether the back end stops threads outside their slots, or sets priorities only."""
        return gates(self.back_end)

    def measure(
        self, allocation: Allocation, phase_ns: int | None, progress: Callable[[float], None]
    ) -> list[Phase]:
        """Find from when on slots count; returns where chains begin, if that was measured."""
        self.given, self.anchor_ns, self.waits_ns, phases = anchoring.carried_out(
            self.given, allocation, phase_ns, gated=self.gated, progress=progress
        )
        self.plan = open_until_done(self.given, self.waits_ns)
        return phases

    def begins(self, place: int) -> int:
        """Where the chain at this place begins in its cycles (ns)."""
        chain = self.plan.chains[place]
        return (self.anchor_ns + chain.offset_ns - self.early(place)) % chain.cycle_ns

    def early(self, place: int) -> int:
        """How long (ns) before its slot a chain begins: with its timer, if no server stops it."""
        closed = closed_before(self.plan.chains[place]) is not None
        if self.gated and (closed or not self.waits_ns):
            return 0
        return self.waits_ns[place] if self.waits_ns else LEAD_NS

    @property
    def opens_early(self) -> bool:
        """Whether chains begin sooner now than they do as a rule."""
        return time.monotonic_ns() < self.opens_early_until_ns

    def save(self, folder: Path) -> None:
        """Write the plan into the run's folder, for recordings of the run."""
        with suppress(OperationError):  # a full /run ends no plan; recordings lack it then
            write_whole(folder / PLAN_FILE, [json.dumps(plan_values(self.given)).encode()])

    def server_states(self) -> tuple[ServerState, ...]:
        """The servers as a run shows them before they have threads."""
        keeper = self.back_end if self.gated else "none: priority only"
        by_back_end = {server.name for server in server_table(self.plan).servers}
        return tuple(
            ServerState(
                name=server.name,
                core=server.core,
                priority=server.priority,
                slots=server.slots,
                threads=(),
                places=places_in(server, self.plan.most_urgent_first),
                kept_by=keeper if server.name in by_back_end else "gate",
                counters=ServerCounters(),
            )
            for server in self.plan.servers
        )
