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

    @model_validator(mode="before")
    @classmethod
    def _named_servers(cls, values: Any) -> Any:
        """Names of servers that stand in an earlier chain, by these servers."""
        chains = values.get("chains") if isinstance(values, dict) else None
        if not isinstance(chains, tuple | list) or not all(isinstance(one, dict) for one in chains):
            return values
        known: dict[str, Any] = {}
        complete = []
        for place, chain in enumerate(chains):
            servers = chain.get("servers")
            own = list(servers) if isinstance(servers, tuple | list) else []
            for number, server in enumerate(own):
                name = server.get("name") if isinstance(server, dict) else server
                if not isinstance(name, str):
                    continue  # the server's own model refuses it
                if isinstance(server, dict):
                    known.setdefault(name, server)
                elif name in known:
                    own[number] = known[name]
                else:
                    reason = f"no chain before this one has a server {name!r}: write it out"
                    raise wrong_value(reason, "chains", place, "servers", number)
            complete.append({**chain, "servers": tuple(own)} if own else chain)
        return {**values, "chains": tuple(complete)}

    @model_validator(mode="after")
    def _consistent(self) -> "Plan":
        return plans.checked(self, _outputs, _shared_servers, _threads, _slot_count, _apart)

    @classmethod
    def of(cls, *chains: ChainPlan) -> "Plan":
        """The plan of these chains. Raises InputError: they make none together, and why."""
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
        named = {server.name: (server, one) for one in self.chains for server in one.servers}
        homes: dict[Thread, tuple[str, ...]] = {}
        for name, (server, _) in named.items():
            for thread in server.threads:
                homes[thread] = (*homes.get(thread, ()), name)
        empty = ((name,) for name, (server, _) in named.items() if not server.threads)
        found = []
        for together in dict.fromkeys((*homes.values(), *empty)):
            own = [named[name] for name in together]
            slots = [
                slot
                for server, chain in own
                for begin in range(chain.offset_ns, chain.offset_ns + self.cycle_ns, chain.cycle_ns)
                for start, end in _in_force(server, chain)
                for slot in in_cycle(begin + start, begin + end, self.cycle_ns)
            ]
            found.append(
                Server(
                    name="+".join(together),
                    core=own[0][0].core,
                    priority=min(server.priority for server, _ in own),
                    slots=united(slots),
                    threads=tuple(thread for thread, names in homes.items() if names == together),
                    best_effort=all(server.best_effort for server, _ in own),
                )
            )
        return tuple(found)

    @property
    def moves_timers(self) -> bool:
        """Whether chains' cycles start at other instants than their timers would by themselves."""
        return len(self.chains) > 1 or self.chains[0].offset_ns > 0

    @property
    def shaping_nodes(self) -> tuple[ShapingNode, ...]:
        """Those of all chains."""
        return tuple(node for chain in self.chains for node in plans.shaping_nodes(chain))

    @property
    def receivers_at(self) -> dict[str, ReceiverPlace]:
        """The places of nodes that receive outputs; of several, the first."""
        found: dict[str, ReceiverPlace] = {}
        for shaping in self.shaping_nodes:
            if shaping.receivers_at is not None:
                found = dict.fromkeys(shaping.receivers, shaping.receivers_at) | found
        return found

    @property
    def takes_turns(self) -> bool:
        """Whether threads of all servers of one priority take turns."""
        return any(chain.equal_priorities == "round-robin" for chain in self.chains)

    @property
    def most_urgent_first(self) -> tuple[str, ...]:
        """The nodes that have an order among the threads of their server, which is the plan's.

        None has where they take turns, and only that which begins the chain where slots are made of
        what single callbacks took: one that is interrupted by another takes longer. In a pipeline
        those downstream come first: they work on the older instance. Shaping nodes of outputs have
        none: the one that wakes first publishes first, and watches the clock until then.
        """
        found: dict[str, None] = {}
        gates = {node.thread for node in self.shaping_nodes}
        for chain in () if self.takes_turns else self.chains:
            threads = [thread for server in chain.servers for thread in server.threads]
            nodes = [thread.node for thread in threads if thread not in gates]
            if chain.policy == "pipelined":
                nodes.reverse()
            elif chain.policy in PER_CALLBACK:
                nodes = nodes[:1]
            found |= dict.fromkeys(nodes)
        return tuple(found)

    @property
    def behind_outputs(self) -> set[str]:
        """The names of servers whose threads run behind the first of each server of their priority:
        those of shaping nodes inside a chain, which delay no output. None where they take turns.
        """
        if self.takes_turns:
            return set()
        inner = {node.thread for chain in self.chains for node in plans.inner_gates(chain)}
        return {server.name for server in self.servers if not inner.isdisjoint(server.threads)}

    @property
    def free_threads(self) -> set[Thread]:
        """Threads that stand in servers, and that no back end keeps there: their gates do."""
        free = (chain for chain in self.chains if chain.shaping_thread == "free")
        return {node.thread for chain in free for node in plans.shaping_nodes(chain)}


def plan_of_chain(plan: Plan, output: str | None) -> ChainPlan | None:
    """The plan of the chain with this output, or of one that names none; None: there is no such."""
    for chain in plan.chains:
        named = (chain.chain.output, *(node.output for node in plans.shaping_nodes(chain)))
        if chain.chain.output is None or output in named:
            return chain
    return None


def open_until_done(plan: Plan, waits_ns: Sequence[int] = ()) -> Plan:
    """The plan as back ends and the simulator carry it out: what overruns may finish.

    See :func:`chainshaper.planning.overruns.open_until_done`; slots that are planned for other
    chains are left out; where that makes a server's slots too many, it stays as planned. No such
    slot begins or ends while an output is due on the core: whoever opens and closes servers would
    delay it. ``waits_ns`` is how long before its cycle each chain's timer expires: of several
    chains, and of the first stage of a pipeline, the thread waits, so that cycles start at their
    offsets.
    """
    opened: dict[str, Server] = {}
    known_ns = waits_ns or [-WAITING_NS] * len(plan.chains)
    for chain, wait in zip(plan.chains, known_ns, strict=True):
        waits = plan.moves_timers or chain.policy in ("pipelined", "server-per-callback")
        longer = chain_open_until_done(chain, wait + WAITING_NS if waits else 0).servers
        for planned, server in zip(chain.servers, longer, strict=True):
            slots = slots_without(server.slots, [*_of_others(plan, chain, server)])
            switched = {at for slot in slots for at in slot}
            switched -= {at for slot in planned.slots for at in slot}
            due = united([*_due_while_switched(plan, chain, server, switched)])
            slots = slots_without(slots, slots_without(due, planned.slots))
            apart = server.model_copy(update={"slots": slots})
            if len(slots) * plan.cycle_ns > MOST_OPENED * chain.cycle_ns:
                apart = planned
            known = opened.get(server.name, apart)  # of a server of several chains, the longest
            opened[server.name] = max(apart, known, key=lambda one: one.slots[-1][1])
    chains = (
        chain.model_copy(update={"servers": tuple(opened[one.name] for one in chain.servers)})
        for chain in plan.chains
    )
    # Not checked: behind what is planned, slots of several chains may meet.
    return Plan.model_construct(chains=tuple(chains))


def _of_others(plan: Plan, chain: ChainPlan, server: Server) -> Iterator[Slot]:
    """What is planned for other chains at a server's core and priority, in any of its cycles."""
    for other in plan.chains:
        for one in other.servers if other is not chain else ():
            own = one in chain.servers or one.name == server.name
            if not own and _in_the_way(chain, server, other, one):
                yield from _in_cycles_of(chain, other, one)


def _in_cycles_of(chain: ChainPlan, other: ChainPlan, server: Server) -> Iterator[Slot]:
    """The slots of another chain's server in a chain's cycle, of all cycles that they meet in."""
    common = math.gcd(chain.cycle_ns, other.cycle_ns)
    for start, end in server.slots:
        first = (start + other.offset_ns - chain.offset_ns) % common - common
        yield from ((again, again + end - start) for again in range(first, chain.cycle_ns, common))


def _due_while_switched(
    plan: Plan, chain: ChainPlan, server: Server, switched: set[int]
) -> Iterator[Slot]:
    """The slots of outputs on a server's core in which it is switched, in any of its cycles."""
    for other in plan.chains:
        for one in plans.publishing_servers(other):
            for slot in _in_cycles_of(chain, other, one) if one.core == server.core else ():
                if one.name != server.name and any(slot[0] < at < slot[1] for at in switched):
                    yield slot


def with_slots_moved(plan: Plan, moved_ns: Mapping[int, int]) -> Plan:
    """The plan with the slots of some chains' outputs moved, see :func:`.with_output_moved`."""
    chains = list(plan.chains)
    for place, by_ns in moved_ns.items():
        own = with_output_moved(chains[place], by_ns)
        slots = {server.name: server.slots for server in own.servers}  # others may share these
        others = ({"servers": plans.with_slots(one.servers, slots)} for one in chains)
        chains = [one.model_copy(update=change) for one, change in zip(chains, others, strict=True)]
        chains[place] = own
    return Plan.of(*chains)


def reach(plan: Plan, place: int, latest_ns: int | None = None) -> tuple[int, int]:
    """How far the slots of a chain's output may be moved, earlier (negative) and later (ns), none
    to end behind ``latest_ns``. Raises InputError: not at all, and why.
    """
    slots, cycle_ns = plans.publish_slots(plan.chains[place]), plan.chains[place].cycle_ns
    latest = min(cycle_ns, cycle_ns if latest_ns is None else latest_ns)
    reason = "they begin and end where they have to"
    found = [0, 0]
    shortest = min(end - start for start, end in slots)
    for side, room in enumerate((slots[0][0], latest - slots[-1][1])):
        # No step is longer than a slot, which would jump over another chain's.
        step = _GRID_NS << max(0, (shortest // _GRID_NS).bit_length() - 1)
        while step >= _GRID_NS:
            further = found[side] + (step if side else -step)
            try:
                if abs(further) <= room:
                    with_slots_moved(plan, {place: further})
                    found[side] = further
                    continue
            except InputError as error:
                reason = str(error)
            step //= 2
    if found == [0, 0]:
        raise InputError(reason)
    return found[0], found[1]


def _in_force(server: Server, chain: ChainPlan) -> Sequence[Slot]:
    """A server's slots as they are carried out, from the start of a cycle of its chain on.

    Around these a shaping node's thread needs time to take messages, to watch the clock, to pause,
    and for its notes; and until the cycle's end, where what missed its slot leaves at once.
    """
    nodes = [node for node in plans.shaping_nodes(chain) if node.thread in server.threads]
    if not nodes or chain.shaping_thread == "free":
        return server.slots
    before = BEFORE_NS + max(node.spin_ns for node in nodes)
    behind = BEHIND_NS + max(node.pause_ns for node in nodes)
    slots = [(start - before, end + behind) for start, end in server.slots]
    if "publish" in (chain.overrun, chain.modes and chain.modes.late):
        slots[-1] = slots[-1][0], max(slots[-1][1], chain.cycle_ns)
    return [(start, min(end, start + chain.cycle_ns)) for start, end in slots]


# The rules ------------------------------------------------------------------------------------


def _pairs(plan: Plan) -> Iterator[tuple[ChainPlan, ChainPlan, tuple[str, int]]]:
    """Every two chains, and where the later one stands."""
    for (_, one), (place, two) in combinations(enumerate(plan.chains), 2):
        yield one, two, ("chains", place)


def _outputs(plan: Plan) -> Wrong:
    for one, two, where in _pairs(plan):
        if one.chain.output is not None and one.chain.output == two.chain.output:
            reason = f"{one.chain.output} is the output of an earlier chain too: plan it once"
            yield reason, *where, "chain", "output"
        ours = {name for node in plans.shaping_nodes(one) for name in (node.name, node.output)}
        for node in plans.shaping_nodes(two):
            if ours & {node.name, node.output}:
                reason = f"an earlier chain has {node.name} or {node.output} too: write its own"
                yield reason, *where, "shaping_node"


def _shared_servers(plan: Plan) -> Wrong:
    for one, two, where in _pairs(plan):
        known = {server.name: server for server in one.servers}
        for number, server in enumerate(two.servers):
            if known.get(server.name, server) != server:
                reason = f"an earlier chain has another server {server.name!r}: rename one"
                yield reason, *where, "servers", number, "name"
            other_cycle = (one.cycle_ns, one.offset_ns) != (two.cycle_ns, two.offset_ns)
            if server.name in known and other_cycle:
                reason = f"{server.name!r} is an earlier chain's too, whose cycles have another"
                reason += " length or offset: write a server of its own"
                yield reason, *where, "servers", number


def _threads(plan: Plan) -> Wrong:
    homes: dict[Thread, Server] = {}
    for place, chain in enumerate(plan.chains):
        for number, server in enumerate(chain.servers):
            where = ("chains", place, "servers", number)
            for thread in server.threads:
                for other_thread in filter(thread.overlaps, tuple(homes)):
                    if other_thread != thread:
                        reason = f"{thread.text} may be {other_thread.text} in server"
                        reason += f" {homes[other_thread].name!r}: name the same callbacks in both"
                        yield reason, *where, "threads"
                if (other := homes.setdefault(thread, server)).core != server.core:
                    reason = f"{thread.text} would run on core {server.core} here and on core"
                    reason += f" {other.core} in server {other.name!r}: write one core"
                    yield reason, *where, "core"


def _slot_count(plan: Plan) -> Wrong:
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
    for one, two, where in _pairs(plan):
        common = math.gcd(one.cycle_ns, two.cycle_ns)
        shared = {server.name for server in one.servers} & {server.name for server in two.servers}
        for server, other in product(one.servers, two.servers):
            if not _in_the_way(one, server, two, other) or shared & {server.name, other.name}:
                continue
            for (start, end), (other_start, other_end) in product(server.slots, other.slots):
                later = (other_start + two.offset_ns - start - one.offset_ns) % common
                if later < end - start or common - later < other_end - other_start:
                    reason = f"the slot {plans.slot_text((other_start, other_end))} of server"
                    reason += f" {other.name!r} meets {plans.slot_text((start, end))} of server"
                    reason += f" {server.name!r} of {chain_name(one)} in some cycles, on core"
                    reason += f" {server.core} at the same priority {server.priority}: move a slot,"
                    reason += " change an offset (`chainshaper offsets`), or give their servers"
                    yield f"{reason} other cores or priorities", *where, "offset"


def _in_the_way(one: ChainPlan, server: Server, two: ChainPlan, other: Server) -> bool:
    """Whether the slots of two chains' servers have to be apart."""
    turns = one.equal_priorities == two.equal_priorities == "round-robin"
    same = (server.core, server.priority) == (other.core, other.priority)
    return same and not (turns or server.best_effort or other.best_effort)
