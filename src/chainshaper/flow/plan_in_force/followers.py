"""Slots that follow the latencies of their chains while a plan is in force."""

import time
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial

from chainshaper.enforcement.freezer import Freezer
from chainshaper.enforcement.node_threads import Allocation
from chainshaper.enforcement.servers import BackEnd
from chainshaper.enforcement.undoing import ServerState
from chainshaper.flow.drift import SlotFollower
from chainshaper.flow.plan_in_force.anchor import AnchoredPlan
from chainshaper.flow.plan_in_force.report import RunReport
from chainshaper.flow.server_tables import server_table
from chainshaper.linux.scheduling import available_cores
from chainshaper.planning.plan import open_until_done, with_slots_moved
from chainshaper.values.errors import OperationError


@dataclass
class Followers:
    """The followers of chains, by the chains' places in the plan."""

    anchored: AnchoredPlan
    servers: BackEnd
    running: dict[int, SlotFollower] = field(default_factory=dict)

    def start(self, allocation: Allocation, reaches_ns: Mapping[int, tuple[int, int]]) -> None:
        """Have the slots of chains follow the latencies, each within its reach."""
        cores = set(available_cores()) - {server.core for server in self.anchored.plan.servers}
        pids = [listed.thread.pid for listed in allocation.threads]
        for place, reach_ns in reaches_ns.items():
            chain, move = self.anchored.given.chains[place], partial(self.move_slots, place)
            self.running[place] = SlotFollower(chain, pids, reach_ns, move, cores=cores)

    def move_slots(self, place: int, moved_ns: int) -> int:
        """Move a chain's slots in the servers, where they change; from when on the gate has to."""
        anchored = self.anchored
        with anchored.lock:
            moves = {**anchored.moved_ns, place: moved_ns}
            plan = open_until_done(with_slots_moved(anchored.given, moves), anchored.waits_ns)
            before, table = server_table(anchored.plan), server_table(plan)
            cycle_ns = anchored.plan.chains[place].cycle_ns
            since = time.monotonic_ns() + 2 * cycle_ns
            if table != before and isinstance(self.servers, Freezer):
                self.servers.change(table, anchored.anchor_ns)
                since = (self.servers.in_force_from() or since) - cycle_ns // 4
            anchored.plan, anchored.moved_ns = plan, moves
            return since + (anchored.begins(place) - since) % cycle_ns - cycle_ns // 2

    def show(self, report: RunReport) -> None:
        """Show where slots are by now; end followers that have failed, and note why."""
        slots = {server.name: server.slots for server in self.anchored.plan.servers}

        def with_slots(server: ServerState) -> ServerState:
            return replace(server, slots=slots[server.name])

        report.update_servers(with_slots)
        moves = [move for follower in self.running.values() for move in follower.moves]
        moves.sort(key=lambda move: move.from_ns)
        report.state = replace(report.state, moves=tuple(moves))
        for place, follower in tuple(self.running.items()):
            if follower.failure is not None:
                del self.running[place]
                follower.end()
                with suppress(OperationError):  # as it ends, or is lost
                    self.move_slots(place, 0)  # the gate's are there already
                failure = follower.failure
                report.note(f"slots are as planned, and do not follow any more: {failure}")

    def end(self) -> None:
        """The slots go back to where the plan has them."""
        for follower in self.running.values():
            follower.end()
