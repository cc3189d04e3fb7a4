"""Where chains begin while a plan is in force, and servers that follow a timer that drifts."""

import math
import threading
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import repeat

from chainshaper.enforcement.node_threads import Allocation
from chainshaper.enforcement.servers import BackEnd
from chainshaper.flow import anchoring
from chainshaper.flow.drift import TimerTrack
from chainshaper.flow.phase import DriftWatch
from chainshaper.flow.plan_in_force.anchor import AnchoredPlan
from chainshaper.flow.plan_in_force.report import RunReport
from chainshaper.linux.scheduling import available_cores
from chainshaper.planning.plan import Plan
from chainshaper.values.errors import OperationError


@dataclass
class OriginWatches:
    """Watches over the threads that begin chains."""

    watches: list[DriftWatch] = field(default_factory=list)  # one for each chain
    # The identities of the threads that are watched, for each chain
    identities: list[set[tuple[int, int]]] = field(default_factory=list)

    def start(self, anchored: AnchoredPlan, allocation: Allocation, report: RunReport) -> None:
        """Watch where chains begin, with one watch for each first executor."""
        plan = anchored.plan
        cores = set(available_cores()) - {server.core for server in plan.servers}
        origins = anchoring.first_threads(plan, allocation)
        self.identities = [{thread.identity for thread in origin} for origin in origins]
        watches: dict[tuple[int, ...], DriftWatch] = {}
        self.watches = []
        for place, (chain, origin) in enumerate(zip(plan.chains, origins, strict=True)):
            tids = tuple(thread.tid for thread in origin)
            if tids not in watches:
                # Where nothing stops the thread, short runs count too.
                is_stopped = anchored.gated and not anchored.early(place)
                containing = {
                    server.name for server in report.state.servers if tids[0] in server.threads
                }
                slots = (server.slots for server in chain.servers if server.name in containing)
                watches[tids] = DriftWatch(
                    origin[0].pid,
                    tids,
                    chain.cycle_ns,
                    anchored.begins(place),
                    next(slots, ()) if is_stopped else (),
                    cores=cores,
                )
            self.watches.append(watches[tids])

    def restarted(self, plan: Plan, allocation: Allocation) -> set[int]:
        """The places of chains whose first node was started again."""
        origins = anchoring.first_threads(plan, allocation)
        now = [{thread.identity for thread in origin} for origin in origins]
        # An executor that has got another thread was not started again.
        return {
            place
            for place, identities in enumerate(now)
            if identities.isdisjoint(self.identities[place])
        }

    def end(self) -> None:
        """Watch no longer where chains begin."""
        while self.watches:
            self.watches.pop().end()


def follow_timer(
    anchored: AnchoredPlan,
    servers: BackEnd,
    watches: Sequence[DriftWatch],
    report: RunReport,
    stop: threading.Event,
) -> Iterator[int]:
    """Move the slots with the chain's timer; yields how far they have moved (ns).

    Not where nothing gates, nor from a given phase, which need not be a timer's. Of several chains,
    whose timers have one clock, that with the shortest wait for its slot is followed.
    """
    waits = anchored.waits_ns
    if not anchored.gated or not waits:
        yield from repeat(0)
    began_ns = anchored.anchor_ns
    first = waits.index(min(waits))
    watch, cycle_ns = watches[first], anchored.plan.chains[first].cycle_ns
    stamped = all(chain.anchor == "stamp" for chain in anchored.plan.chains)
    track = TimerTrack(waits[first], time.monotonic_ns(), cycle_ns, looks=stamped)
    looks = 0
    while True:
        before_ns = track.opens_ns
        if saw := watch.looks > looks:
            looks = watch.looks
            early = anchored.early(first)
            # Where no server stops the thread, a single look may see it late by chance.
            seen_ns = watch.surely_ns if early else watch.latest_ns
            track.saw((seen_ns or 0) - early, time.monotonic_ns())
            if track.is_unsure:
                anchored.opens_early_until_ns = math.inf
            elif anchored.opens_early_until_ns == math.inf:  # they go back with the next cycle
                anchored.opens_early_until_ns = time.monotonic_ns() + 3 * cycle_ns
        if track.opens_ns != before_ns:
            moved_ns = (began_ns + track.opens_ns) % anchored.plan.cycle_ns
            try:
                with anchored.lock:
                    servers.arm(moved_ns)
                    anchored.anchor_ns = moved_ns
            except OperationError:
                if not stop.is_set():
                    raise
                yield before_ns  # asked to end meanwhile, which is no failure
                continue
            report.state = replace(report.state, anchor_ns=moved_ns)
            for place, other in enumerate(watches):
                other.expect(anchored.begins(place))
        # A chain begins elsewhere as long as its slots open early: that is over as soon as can be.
        watch.slots_wait |= saw and track.is_unsure
        yield track.opens_ns
