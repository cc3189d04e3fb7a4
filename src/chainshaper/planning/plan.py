"""The plan: one or more chains of an application whose servers and shaping nodes act together.

What belongs to one chain (evidence, margin, anchor, servers, shaping nodes, prediction) stands in
its :class:`~chainshaper.planning.chain_plan.ChainPlan`. The cycles of a chain start ``offset``
after the instant from which those of all chains count, so all slots repeat with the
**hyper-period**, the least common multiple of the cycles. Chains that begin at the same callback
share the servers that run it. Chains of different beginnings that pass the same node each reserve
slots for its thread, which then runs in all of them: :attr:`Plan.servers` is what back ends carry
out.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from functools import cached_property
from itertools import combinations, product
from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from chainshaper.planning import chain_plan as plans
from chainshaper.planning.chain_plan import (
    PER_CALLBACK,
    ChainPlan,
    ReceiverPlace,
    Server,
    ShapingNode,
    Slot,
    Thread,
    Wrong,
)
from chainshaper.planning.offsets import BEFORE_NS, BEHIND_NS, chain_name
from chainshaper.planning.overruns import in_cycle, slots_without, united, with_output_moved
from chainshaper.planning.overruns import open_until_done as chain_open_until_done
from chainshaper.values.durations import duration_text
from chainshaper.values.errors import InputError
from chainshaper.values.handed_over import Through, parse_through
from chainshaper.values.notebook import notebook_html
from chainshaper.values.yaml_file import Part, wrong_value, wrong_values_refused

_GRID_NS = 1_000  # moved slots are found to microseconds
MOST_SLOTS = 10_000  # of all servers in a hyper-period
MOST_OPENED = 64  # of a server that is opened for overruns: sched_ext's tables have no more room
WAITING_NS = 1_000_000  # so long before a timer expires its thread's server is closed already


class Plan(Part):
    """The chains of a plan, one or more.

    A server that several chains share stands in each of them and is equal there; a plan's file has
    it once.
    """

    format: Literal[2] = 2
    chains: Annotated[tuple[ChainPlan, ...], Field(min_length=1)]

    def __repr__(self) -> str:
        chains = "; ".join(repr(chain)[len("ChainPlan(") : -1] for chain in self.chains)
        return f"Plan({chains})"

    __str__ = __repr__
    _repr_html_ = notebook_html

    @model_validator(mode="before")
    @classmethod
    def _named_servers(cls, values: Any) -> Any:
        """Put servers in place of their names, where an earlier chain has them."""
        chains = values.get("chains") if isinstance(values, dict) else None
        if not isinstance(chains, tuple | list):
            return values
        if not all(isinstance(chain, dict) for chain in chains):
            return values
        known: dict[str, Any] = {}
        complete = []
        for place, chain in enumerate(chains):
            given = chain.get("servers")
            servers = list(given) if isinstance(given, tuple | list) else []
            for number, server in enumerate(servers):
                name = server.get("name") if isinstance(server, dict) else server
                if not isinstance(name, str):
                    continue  # the server's own model refuses it
                if isinstance(server, dict):
                    known.setdefault(name, server)
                elif name in known:
                    servers[number] = known[name]
                else:
                    reason = f"no chain before this one has a server {name!r}: write it out"
                    raise wrong_value(reason, "chains", place, "servers", number)
            complete.append({**chain, "servers": tuple(servers)} if servers else chain)
        return {**values, "chains": tuple(complete)}

    @model_validator(mode="after")
    def _consistent(self) -> "Plan":
        return plans.checked(self, _outputs, _shared_servers, _threads, _slot_count, _apart)

    @classmethod
    def of(cls, *chains: ChainPlan) -> "Plan":
        """Return the plan of these chains. Raises InputError: they make no plan together."""
        with wrong_values_refused(cls):
            return cls(chains=chains)

    @property
    def cycle_ns(self) -> int:
        """The hyper-period: all slots repeat with it."""
        return math.lcm(*(chain.cycle_ns for chain in self.chains))

    @cached_property
    def servers(self) -> tuple[Server, ...]:
        """Each server once, with all its slots in the hyper-period: ascending and joined.

        A thread that several chains have in servers of their own gets one that is open in the
        slots of all of these, at the best of their priorities.
        """
        named = {
            server.name: (server, chain_plan)
            for chain_plan in self.chains
            for server in chain_plan.servers
        }
        homes: dict[Thread, tuple[str, ...]] = {}
        for name, (server, _) in named.items():
            for thread in server.threads:
                homes[thread] = (*homes.get(thread, ()), name)
        without_threads = ((name,) for name, (server, _) in named.items() if not server.threads)
        servers = []
        for names in dict.fromkeys((*homes.values(), *without_threads)):
            joined = [named[name] for name in names]
            slots = [
                slot
                for server, chain_plan in joined
                for begin_ns in _cycle_starts(chain_plan, self.cycle_ns)
                for start, end in _in_force(server, chain_plan)
                for slot in in_cycle(begin_ns + start, begin_ns + end, self.cycle_ns)
            ]
            servers.append(
                Server(
                    name="+".join(names),
                    core=joined[0][0].core,
                    priority=min(server.priority for server, _ in joined),
                    slots=united(slots),
                    threads=tuple(thread for thread, home in homes.items() if home == names),
                    best_effort=all(server.best_effort for server, _ in joined),
                )
            )
        return tuple(servers)

    @property
    def moves_timers(self) -> bool:
        """Whether chains' cycles start at other instants than their timers would by themselves."""
        return len(self.chains) > 1 or self.chains[0].offset_ns > 0

    @property
    def shaping_nodes(self) -> tuple[ShapingNode, ...]:
        """The shaping nodes of all chains."""
        return tuple(node for chain in self.chains for node in plans.shaping_nodes(chain))

    @property
    def receivers_at(self) -> dict[str, ReceiverPlace]:
        """The places of nodes that receive outputs; of several outputs, that of the first."""
        places: dict[str, ReceiverPlace] = {}
        for shaping in self.shaping_nodes:
            if shaping.receivers_at is not None:
                places = dict.fromkeys(shaping.receivers, shaping.receivers_at) | places
        return places

    @property
    def loops_at(self) -> dict[str, ReceiverPlace]:
        """Where the threads of loops run that read outputs, by their nodes; the first counts.

        Loops that are not here run where, and as, they do by themselves.
        """
        places: dict[str, ReceiverPlace] = {}
        for loop in (chain.loop for chain in self.chains):
            if loop is not None and loop.runs_at is not None:
                places.setdefault(loop.node, loop.runs_at)
        return places

    @property
    def takes_turns(self) -> bool:
        """Whether threads of all servers of one priority take turns."""
        return any(chain.equal_priorities == "round-robin" for chain in self.chains)

    @property
    def most_urgent_first(self) -> tuple[str, ...]:
        """The nodes whose threads have an order in their server: that of the plan.

        Where threads take turns, no node has an order. Where slots are as long as single callbacks
        took, only the node that begins the chain has: a callback that another interrupts takes
        longer than its slot. In a pipeline the nodes downstream come first: they work on the older
        instance. Shaping nodes of outputs have no order: the one that wakes up first publishes
        first, and watches the clock until then.
        """
        ordered: dict[str, None] = {}
        gates = {node.thread for node in self.shaping_nodes}
        for chain in () if self.takes_turns else self.chains:
            threads = [thread for server in chain.servers for thread in server.threads]
            nodes = [thread.node for thread in threads if thread not in gates]
            if chain.policy == "pipelined":
                nodes.reverse()
            elif chain.policy in PER_CALLBACK:
                nodes = nodes[:1]
            ordered |= dict.fromkeys(nodes)
        return tuple(ordered)

    @property
    def behind_outputs(self) -> set[str]:
        """The names of the servers of shaping nodes inside a chain, which must delay no output.

        Their threads run behind the first thread of each server of their priority. Where threads
        take turns, there are none.
        """
        if self.takes_turns:
            return set()
        inner = {node.thread for chain in self.chains for node in plans.inner_gates(chain)}
        return {server.name for server in self.servers if not inner.isdisjoint(server.threads)}

    @property
    def free_threads(self) -> set[Thread]:
        """Threads that stand in servers, but that no back end stops: their gates time them."""
        free = (chain for chain in self.chains if chain.shaping_thread == "free")
        return {node.thread for chain in free for node in plans.shaping_nodes(chain)}


def plan_of_chain(plan: Plan, output: str | None) -> ChainPlan | None:
    """Return the plan of the chain with this output, or of one that names none; None: no such."""
    for chain_plan in plan.chains:
        named = (
            chain_plan.chain.output,
            *(node.output for node in plans.shaping_nodes(chain_plan)),
        )
        if chain_plan.chain.output is None or output in named:
            return chain_plan
    return None


def declared_in(plan: Plan) -> Through:
    """Return what is declared of the plan's chains that no event shows."""
    return parse_through([text for chain_plan in plan.chains for text in chain_plan.chain.through])


def open_until_done(plan: Plan, waits_ns: Sequence[int] = ()) -> Plan:
    """Return the plan as back ends and the simulator carry it out: overruns may finish.

    See :func:`chainshaper.planning.overruns.open_until_done`. Slots that are planned for other
    chains are left out; where that makes a server's slots too many, it stays as planned. No such
    slot begins or ends while an output is due on the core: switching the server would delay it.

    ``waits_ns`` is how long before its cycle each chain's timer expires. Of several chains, and of
    the first stage of a pipeline, the thread waits, so that cycles start at their offsets.
    """
    opened: dict[str, Server] = {}
    known_ns = waits_ns or [-WAITING_NS] * len(plan.chains)
    for chain_plan, wait_ns in zip(plan.chains, known_ns, strict=True):
        waits = plan.moves_timers or chain_plan.policy in ("pipelined", "server-per-callback")
        closed_ns = wait_ns + WAITING_NS if waits else 0
        shared = {
            server.core
            for beside in plan.chains
            for server in beside.servers
            if beside is not chain_plan
        }
        longer = chain_open_until_done(chain_plan, closed_ns, shared).servers
        for planned, server in zip(chain_plan.servers, longer, strict=True):
            slots = slots_without(server.slots, [*_of_other_chains(plan, chain_plan, server)])
            switched = {instant for slot in slots for instant in slot}
            switched -= {instant for slot in planned.slots for instant in slot}
            due = united([*_due_while_switched(plan, chain_plan, server, switched)])
            slots = slots_without(slots, slots_without(due, planned.slots))
            candidate = server.model_copy(update={"slots": slots})
            if len(slots) * plan.cycle_ns > MOST_OPENED * chain_plan.cycle_ns:
                candidate = planned
            # A server of several chains stays open as long as the chain needs that needs longest.
            known = opened.get(server.name, candidate)
            opened[server.name] = max(candidate, known, key=lambda server: server.slots[-1][1])
    chains = (
        chain_plan.model_copy(
            update={"servers": tuple(opened[server.name] for server in chain_plan.servers)}
        )
        for chain_plan in plan.chains
    )
    # Not checked: behind what is planned, slots of several chains may meet.
    return Plan.model_construct(chains=tuple(chains))


def _of_other_chains(plan: Plan, chain_plan: ChainPlan, server: Server) -> Iterator[Slot]:
    """Yield slots of other chains at a server's core and priority, in any of its cycles."""
    for beside in plan.chains:
        for taken in beside.servers if beside is not chain_plan else ():
            is_shared = taken in chain_plan.servers or taken.name == server.name
            if not is_shared and _in_the_way(chain_plan, server, beside, taken):
                yield from _in_cycles_of(chain_plan, beside, taken)


def _in_cycles_of(chain_plan: ChainPlan, server_plan: ChainPlan, server: Server) -> Iterator[Slot]:
    """Yield the slots of a server of ``server_plan`` as they lie in cycles of a chain."""
    common = math.gcd(chain_plan.cycle_ns, server_plan.cycle_ns)
    for start, end in server.slots:
        first = (start + server_plan.offset_ns - chain_plan.offset_ns) % common - common
        for again in range(first, chain_plan.cycle_ns, common):
            yield again, again + end - start


def _due_while_switched(
    plan: Plan, chain_plan: ChainPlan, server: Server, switched: set[int]
) -> Iterator[Slot]:
    """Yield the slots of outputs on a server's core in which it is switched, in any of its cycles.

    ``switched`` are the instants at which it opens or closes.
    """
    for publishing_plan in plan.chains:
        for publishing in plans.publishing_servers(publishing_plan):
            if publishing.core != server.core or publishing.name == server.name:
                continue
            for start, end in _in_cycles_of(chain_plan, publishing_plan, publishing):
                if any(start < instant < end for instant in switched):
                    yield start, end


def with_slots_moved(plan: Plan, moved_ns: Mapping[int, int]) -> Plan:
    """Return the plan with the slots of some chains' outputs moved.

    ``moved_ns`` is how far, by the place of the chain. See :func:`.with_output_moved`.
    """
    chains = list(plan.chains)
    for place, by_ns in moved_ns.items():
        moved = with_output_moved(chains[place], by_ns)
        slots = {server.name: server.slots for server in moved.servers}
        # Other chains may share the servers.
        chains = [
            chain_plan.model_copy(update={"servers": plans.with_slots(chain_plan.servers, slots)})
            for chain_plan in chains
        ]
        chains[place] = moved
    return Plan.of(*chains)


def reach(plan: Plan, place: int, latest_ns: int | None = None) -> tuple[int, int]:
    """Return how far the slots of a chain's output may move, earlier (negative) and later (ns).

    No slot ends behind ``latest_ns``. Raises InputError: they may not move, and why.
    """
    slots, cycle_ns = plans.publish_slots(plan.chains[place]), plan.chains[place].cycle_ns
    latest = min(cycle_ns, cycle_ns if latest_ns is None else latest_ns)
    reason = "they begin and end where they have to"
    shortest = min(end - start for start, end in slots)
    reached = []
    for sign, room in ((-1, slots[0][0]), (1, latest - slots[-1][1])):
        moved = 0
        # No step is longer than a slot: it would jump over the slot of another chain.
        step = _GRID_NS << max(0, (shortest // _GRID_NS).bit_length() - 1)
        while step >= _GRID_NS:
            further = moved + sign * step
            try:
                if abs(further) <= room:
                    with_slots_moved(plan, {place: further})
                    moved = further
                    continue
            except InputError as error:
                reason = str(error)
            step //= 2
        reached.append(moved)
    earlier, later = reached
    if earlier == later == 0:
        raise InputError(reason)
    return earlier, later


def _cycle_starts(chain_plan: ChainPlan, hyper_period_ns: int) -> range:
    """Return when the cycles of a chain start in the hyper-period (ns)."""
    first = chain_plan.offset_ns
    return range(first, first + hyper_period_ns, chain_plan.cycle_ns)


def _in_force(server: Server, chain_plan: ChainPlan) -> Sequence[Slot]:
    """Return a server's slots as they are carried out, from the start of a cycle of its chain on.

    Around its slots a shaping node's thread needs time to take messages, to watch the clock, to
    pause, and to log; and until the cycle's end, where an output that missed its slot leaves at
    once.
    """
    nodes = [node for node in plans.shaping_nodes(chain_plan) if node.thread in server.threads]
    if not nodes or chain_plan.shaping_thread == "free":
        return server.slots
    before = BEFORE_NS + max(node.spin_ns for node in nodes)
    behind = BEHIND_NS + max(node.pause_ns for node in nodes)
    slots = [(start - before, end + behind) for start, end in server.slots]
    if "publish" in (chain_plan.overrun, chain_plan.modes and chain_plan.modes.late):
        slots[-1] = slots[-1][0], max(slots[-1][1], chain_plan.cycle_ns)
    return [(start, min(end, start + chain_plan.cycle_ns)) for start, end in slots]


# The rules ------------------------------------------------------------------------------------


def _pairs(plan: Plan) -> Iterator[tuple[ChainPlan, ChainPlan, tuple[str, int]]]:
    """Yield every two chains, and the keys of the later one in the file."""
    for (_, earlier), (place, later) in combinations(enumerate(plan.chains), 2):
        yield earlier, later, ("chains", place)


def _outputs(plan: Plan) -> Wrong:
    """No two chains have one output, or shaping nodes of one name."""
    for earlier, later, where in _pairs(plan):
        if earlier.chain.output is not None and earlier.chain.output == later.chain.output:
            reason = f"{earlier.chain.output} is the output of an earlier chain too: plan it once"
            yield reason, *where, "chain", "output"
        taken = {name for node in plans.shaping_nodes(earlier) for name in (node.name, node.output)}
        for node in plans.shaping_nodes(later):
            if taken & {node.name, node.output}:
                reason = f"an earlier chain has {node.name} or {node.output} too: write its own"
                yield reason, *where, "shaping_node"


def _shared_servers(plan: Plan) -> Wrong:
    """A server that several chains have is equal in them, and so are their cycles."""
    for earlier, later, where in _pairs(plan):
        known = {server.name: server for server in earlier.servers}
        same_cycle = (earlier.cycle_ns, earlier.offset_ns) == (later.cycle_ns, later.offset_ns)
        for number, server in enumerate(later.servers):
            if known.get(server.name, server) != server:
                reason = f"an earlier chain has another server {server.name!r}: rename one"
                yield reason, *where, "servers", number, "name"
            if server.name in known and not same_cycle:
                reason = f"{server.name!r} is an earlier chain's too, whose cycles have another"
                reason += " length or offset: write a server of its own"
                yield reason, *where, "servers", number


def _threads(plan: Plan) -> Wrong:
    """A thread has one core, and the same callbacks wherever it stands."""
    homes: dict[Thread, Server] = {}
    for place, chain_plan in enumerate(plan.chains):
        for number, server in enumerate(chain_plan.servers):
            where = ("chains", place, "servers", number)
            for thread in server.threads:
                for known in filter(thread.overlaps, tuple(homes)):
                    if known != thread:
                        reason = f"{thread.text} may be {known.text} in server"
                        reason += f" {homes[known].name!r}: name the same callbacks in both"
                        yield reason, *where, "threads"
                home = homes.setdefault(thread, server)
                if home.core != server.core:
                    reason = f"{thread.text} would run on core {server.core} here and on core"
                    reason += f" {home.core} in server {home.name!r}: write one core"
                    yield reason, *where, "core"


def _slot_count(plan: Plan) -> Wrong:
    """The hyper-period of several chains is short enough for tables of slots."""
    count = sum(
        plan.cycle_ns // chain.cycle_ns * len(server.slots)
        for chain in plan.chains
        for server in chain.servers
    )
    if len(plan.chains) > 1 and count > MOST_SLOTS:
        reason = f"all cycles repeat together after {duration_text(plan.cycle_ns)}, with {count}"
        reason += f" slots; {MOST_SLOTS} is the most: use periods with a larger common divisor"
        yield reason, "chains", len(plan.chains) - 1, "cycle"


def _apart(plan: Plan) -> Wrong:
    """Slots of one core and priority are disjoint in all cycles, across chains as inside one."""
    for earlier, later, where in _pairs(plan):
        common = math.gcd(earlier.cycle_ns, later.cycle_ns)
        offset_ns = later.offset_ns - earlier.offset_ns
        shared = {server.name for server in earlier.servers}
        shared &= {server.name for server in later.servers}
        for known, server in product(earlier.servers, later.servers):
            if shared & {known.name, server.name}:
                continue
            if not _in_the_way(earlier, known, later, server):
                continue
            for taken, slot in product(known.slots, server.slots):
                behind = (slot[0] + offset_ns - taken[0]) % common
                if behind < taken[1] - taken[0] or common - behind < slot[1] - slot[0]:
                    reason = f"the slot {plans.slot_text(slot)} of server {server.name!r} meets"
                    reason += f" {plans.slot_text(taken)} of server {known.name!r} of"
                    reason += f" {chain_name(earlier)} in some cycles, on core {server.core} at the"
                    reason += f" same priority {server.priority}: move a slot, change an offset"
                    reason += " (`chainshaper offsets`), or give their servers other cores or"
                    yield f"{reason} priorities", *where, "offset"


def _in_the_way(
    first_plan: ChainPlan, first: Server, second_plan: ChainPlan, second: Server
) -> bool:
    """Whether the slots of two chains' servers have to be apart."""
    if first_plan.equal_priorities == second_plan.equal_priorities == "round-robin":
        return False
    same = (first.core, first.priority) == (second.core, second.priority)
    return same and not (first.best_effort or second.best_effort)
