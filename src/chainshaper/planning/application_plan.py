"""A plan for a whole application: several chains whose servers and shaping nodes act together.

Each chain has a :class:`~chainshaper.planning.plan.Plan`, whose cycles start ``offset`` after the
instant from which those of all chains count, so all slots repeat with the **hyper-period**, the
least common multiple of the cycles. Chains that begin at the same callback share the servers that
run it; chains of different beginnings that pass the same node each reserve slots for its thread,
which then runs in all of them.

:attr:`ApplicationPlan.servers` is what back ends and the simulator carry out: every server once,
its slots played out over the hyper-period. A plan for one chain is the same with one chain.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from functools import cached_property
from itertools import combinations, product
from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from chainshaper.planning.offsets import chain_name
from chainshaper.planning.overruns import open_until_done as chain_open_until_done
from chainshaper.planning.overruns import slots_without, united, with_output_moved
from chainshaper.planning.plan import (
    PER_CALLBACK,
    Plan,
    Server,
    ShapingNode,
    Slot,
    Thread,
    publish_slots,
    publishing_servers,
    shaping_nodes,
    slot_text,
    with_slots,
)
from chainshaper.values.durations import duration_text
from chainshaper.values.errors import InputError
from chainshaper.values.yaml_file import Part, wrong_value, wrong_values_refused

_GRID_NS = 1_000  # moved slots are found to microseconds
MOST_SLOTS = 10_000  # of all servers in a hyper-period
MOST_OPENED = 64  # of a server that is opened for overruns: sched_ext's tables have no more room
WAITING_NS = 1_000_000  # so long before a timer expires its thread's server is closed already
# Where a shaping node's server is in force, it is open for so long before the node watches for its
# slot: 2 ms to take messages, and 2 ms for cycles whose beginning no server holds back (`LEAD_NS`
# of `flow/threads.py`); and behind its pause, for its notes.
BEFORE_NS, BEHIND_NS = 4_000_000, 2_000_000


class ApplicationPlan(Part):
    """The plans of an application's chains; what they share stands in each, and is equal."""

    format: Literal[2] = 2
    chains: Annotated[tuple[Plan, ...], Field(min_length=1)]

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
    def _consistent(self) -> "ApplicationPlan":
        for check in (_outputs, _shared_servers, _threads, _slot_count, _apart):
            check(self)
        return self

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
        homes: dict[Thread, list[str]] = {}
        for name, (server, _) in named.items():
            for thread in server.threads:
                homes.setdefault(thread, []).append(name)
        members: dict[tuple[str, ...], list[Thread]] = {}
        for thread, names in homes.items():
            members.setdefault(tuple(names), []).append(thread)
        for name, (server, _) in named.items():
            if not server.threads:
                members[name,] = []
        found = []
        for together, threads in members.items():
            own = [named[name] for name in together]
            slots = [slot for one in own for slot in _played_out(*one, self.cycle_ns)]
            found.append(
                Server(
                    name="+".join(together),
                    core=own[0][0].core,
                    priority=min(server.priority for server, _ in own),
                    slots=united(slots),
                    threads=tuple(threads),
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
        return tuple(node for chain in self.chains for node in shaping_nodes(chain))

    @property
    def takes_turns(self) -> bool:
        """Whether threads of all servers of one priority take turns."""
        return any(chain.equal_priorities == "round-robin" for chain in self.chains)

    @property
    def most_urgent_first(self) -> tuple[str, ...]:
        """The nodes that have an order among the threads of their server, which is the plan's.

        None has where they take turns, and only that which begins the chain where slots are made of
        what single callbacks took: one that is interrupted by another takes longer.
        """
        found: dict[str, None] = {}
        for chain in () if self.takes_turns else self.chains:
            nodes = [thread.node for server in chain.servers for thread in server.threads]
            found |= dict.fromkeys(nodes[:1] if chain.policy in PER_CALLBACK else nodes)
        return tuple(found)

    @property
    def free_threads(self) -> set[Thread]:
        """Threads that stand in servers, and that no back end keeps there: their gates do."""
        free = (chain for chain in self.chains if chain.shaping_thread == "free")
        return {node.thread for chain in free for node in shaping_nodes(chain)}


def whole(plan: "Plan | ApplicationPlan") -> ApplicationPlan:
    """A plan as that of an application, which one chain is as well."""
    return plan if isinstance(plan, ApplicationPlan) else combined([plan])


def plan_of_chain(plan: "Plan | ApplicationPlan", output: str | None) -> Plan | None:
    """The plan of the chain with this output, or of one that names none; None: there is no such."""
    for chain in whole(plan).chains:
        named = (chain.chain.output, *(node.output for node in shaping_nodes(chain)))
        if chain.chain.output is None or output in named:
            return chain
    return None


def open_until_done(plan: ApplicationPlan, waits_ns: Sequence[int] = ()) -> ApplicationPlan:
    """The plan as back ends and the simulator carry it out: what overruns may finish.

    See :func:`chainshaper.planning.overruns.open_until_done`; slots that are planned for other
    chains are left out, so that an overrun delays none of these; where that makes a server's slots
    too many, it stays as planned. No such slot begins or ends while an output is due on the core:
    whoever opens and closes servers would delay it. Of several chains, ``waits_ns`` is how long
    before its cycle each one's timer expires: its thread waits, so that cycles start at their
    offsets. So does the first stage of a pipeline, for slots of further stages to count from the
    same instant.
    """
    opened: dict[str, Server] = {}
    known_ns = waits_ns or [-WAITING_NS] * len(plan.chains)
    for chain, wait in zip(plan.chains, known_ns, strict=True):
        waits = plan.moves_timers or chain.policy in ("pipelined", "server-per-callback")
        for server in chain_open_until_done(chain, wait + WAITING_NS if waits else 0).servers:
            slots = slots_without(server.slots, [*_of_others(plan, chain, server)])
            slots = _switched_beside_outputs(plan, chain, server, slots)
            apart = server.model_copy(update={"slots": slots})
            if len(slots) * plan.cycle_ns > MOST_OPENED * chain.cycle_ns:
                apart = next(one for one in chain.servers if one.name == server.name)
            known = opened.get(server.name, apart)  # of a server of several chains, the longest
            opened[server.name] = max(apart, known, key=lambda one: one.slots[-1][1])
    chains = (
        chain.model_copy(update={"servers": tuple(opened[one.name] for one in chain.servers)})
        for chain in plan.chains
    )
    # Not checked: behind what is planned, slots of several chains may meet.
    return ApplicationPlan.model_construct(chains=tuple(chains))


def _of_others(plan: ApplicationPlan, chain: Plan, server: Server) -> Iterator[Slot]:
    """What is planned for other chains at a server's core and priority, in any of its cycles."""
    for other in plan.chains:
        if other is chain or chain.equal_priorities == other.equal_priorities == "round-robin":
            continue
        for one in other.servers:
            if one in chain.servers or one.best_effort or one.name == server.name:
                continue
            if (one.core, one.priority) != (server.core, server.priority):
                continue
            yield from _in_cycles_of(chain, other, one)


def _in_cycles_of(chain: Plan, other: Plan, server: Server) -> Iterator[Slot]:
    """The slots of another chain's server in a chain's cycle, of all cycles that they meet in."""
    common = math.gcd(chain.cycle_ns, other.cycle_ns)
    for start, end in server.slots:
        first = (start + other.offset_ns - chain.offset_ns) % common - common
        yield from ((again, again + end - start) for again in range(first, chain.cycle_ns, common))


def _switched_beside_outputs(
    plan: ApplicationPlan, chain: Plan, server: Server, slots: Sequence[Slot]
) -> tuple[Slot, ...]:
    """The slots without those of outputs on the core in which one of them began or ended, where
    that is not planned.
    """
    planned = next(one for one in chain.servers if one.name == server.name).slots
    edges = {edge for slot in slots for edge in slot} - {edge for slot in planned for edge in slot}
    due = [
        slot
        for other in plan.chains
        for one in publishing_servers(other)
        if one.core == server.core and one.name != server.name
        for slot in _in_cycles_of(chain, other, one)
        if any(slot[0] < edge < slot[1] for edge in edges)
    ]
    return slots_without(slots, slots_without(united(due), planned))


def combined(plans: Sequence[Plan]) -> ApplicationPlan:
    """The plan of an application from those of its chains. Raises InputError: they make none."""
    with wrong_values_refused(ApplicationPlan):
        return ApplicationPlan(chains=tuple(plans))


def with_slots_moved(plan: ApplicationPlan, moved_ns: Mapping[int, int]) -> ApplicationPlan:
    """The plan with the slots of some chains' outputs moved, see :func:`.with_output_moved`."""
    chains = list(plan.chains)
    for place, by_ns in moved_ns.items():
        own = with_output_moved(chains[place], by_ns)
        slots = {server.name: server.slots for server in own.servers}  # others may share these
        others = ({"servers": with_slots(one.servers, slots)} for one in chains)
        chains = [one.model_copy(update=change) for one, change in zip(chains, others, strict=True)]
        chains[place] = own
    return combined(chains)


def reach(plan: ApplicationPlan, place: int, latest_ns: int | None = None) -> tuple[int, int]:
    """How far the slots of a chain's output may be moved, earlier (negative) and later (ns), none
    to end behind ``latest_ns``. Raises InputError: not at all, and why.
    """
    slots, cycle_ns = publish_slots(plan.chains[place]), plan.chains[place].cycle_ns
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


def _played_out(server: Server, chain: Plan, hyper_period_ns: int) -> Iterator[Slot]:
    """A server's slots over the hyper-period; one that reaches beyond its end becomes two."""
    for start_ns in range(chain.offset_ns, chain.offset_ns + hyper_period_ns, chain.cycle_ns):
        for slot in _in_force(server, chain):
            start = (slot[0] + start_ns) % hyper_period_ns
            end = start + slot[1] - slot[0]
            yield start, min(end, hyper_period_ns)
            if end > hyper_period_ns:
                yield 0, end - hyper_period_ns


def _in_force(server: Server, chain: Plan) -> Sequence[Slot]:
    """A server's slots as they are carried out, from the start of a cycle of its chain on.

    Around these a shaping node's thread needs time to take messages, to watch the clock, to pause,
    and for its notes; and until the cycle's end, where what missed its slot leaves at once.
    """
    nodes = [node for node in shaping_nodes(chain) if node.thread in server.threads]
    if not nodes or chain.shaping_thread == "free":
        return server.slots
    before = BEFORE_NS + max(node.spin_ns for node in nodes)
    behind = BEHIND_NS + max(node.pause_ns for node in nodes)
    slots = [(start - before, end + behind) for start, end in server.slots]
    if "publish" in (chain.overrun, chain.modes and chain.modes.late):
        slots[-1] = slots[-1][0], max(slots[-1][1], chain.cycle_ns)
    return [(start, min(end, start + chain.cycle_ns)) for start, end in slots]


# The rules: each raises what is wrong, and where -------------------------------------------------


def _pairs(plan: ApplicationPlan) -> Iterator[tuple[Plan, Plan, tuple[str, int]]]:
    """Every two chains, and where the later one stands."""
    for (_, one), (place, two) in combinations(enumerate(plan.chains), 2):
        yield one, two, ("chains", place)


def _outputs(plan: ApplicationPlan) -> None:
    for one, two, where in _pairs(plan):
        if one.chain.output is not None and one.chain.output == two.chain.output:
            reason = f"{one.chain.output} is the output of an earlier chain too: plan it once"
            raise wrong_value(reason, *where, "chain", "output")
        ours = {name for node in shaping_nodes(one) for name in (node.name, node.output)}
        for node in shaping_nodes(two):
            if ours & {node.name, node.output}:
                reason = f"an earlier chain has {node.name} or {node.output} too: write its own"
                raise wrong_value(reason, *where, "shaping_node")


def _shared_servers(plan: ApplicationPlan) -> None:
    for one, two, where in _pairs(plan):
        known = {server.name: server for server in one.servers}
        for number, server in enumerate(two.servers):
            if server.name not in known:
                continue
            if known[server.name] != server:
                reason = f"an earlier chain has another server {server.name!r}: rename one"
                raise wrong_value(reason, *where, "servers", number, "name")
            if (one.cycle_ns, one.offset_ns) != (two.cycle_ns, two.offset_ns):
                reason = f"{server.name!r} is an earlier chain's too, whose cycles have another"
                reason += " length or offset: write a server of its own"
                raise wrong_value(reason, *where, "servers", number)


def _threads(plan: ApplicationPlan) -> None:
    homes: dict[Thread, Server] = {}
    for place, chain in enumerate(plan.chains):
        for number, server in enumerate(chain.servers):
            where = ("chains", place, "servers", number)
            for thread in server.threads:
                for other_thread in filter(thread.overlaps, tuple(homes)):
                    if other_thread != thread:
                        reason = f"{thread.text} may be {other_thread.text} in server"
                        reason += f" {homes[other_thread].name!r}: name the same callbacks in both"
                        raise wrong_value(reason, *where, "threads")
                if (other := homes.setdefault(thread, server)).core != server.core:
                    reason = f"{thread.text} would run on core {server.core} here and on core"
                    reason += f" {other.core} in server {other.name!r}: write one core"
                    raise wrong_value(reason, *where, "core")


def _slot_count(plan: ApplicationPlan) -> None:
    chains = plan.chains
    slots = [sum(len(server.slots) for server in chain.servers) for chain in chains]
    counts = [plan.cycle_ns // one.cycle_ns * own for one, own in zip(chains, slots, strict=True)]
    if len(chains) > 1 and sum(counts) > MOST_SLOTS:
        raise wrong_value(
            f"all cycles repeat together after {duration_text(plan.cycle_ns)}, with {sum(counts)}"
            f" slots; {MOST_SLOTS} is the most: use periods with a larger common divisor",
            *("chains", len(chains) - 1, "cycle"),
        )


def _apart(plan: ApplicationPlan) -> None:
    """Slots of one core and priority are disjoint in all cycles, across chains as inside one."""
    for one, two, where in _pairs(plan):
        if one.equal_priorities == two.equal_priorities == "round-robin":
            continue
        for text in _collisions(one, two):
            reason = f"{text}: move a slot, change an offset (`chainshaper offsets`), or give their"
            raise wrong_value(f"{reason} servers other cores or priorities", *where, "offset")


def _collisions(one: Plan, two: Plan) -> Iterator[str]:
    """The slots of two chains that meet in some cycle, in words."""
    common = math.gcd(one.cycle_ns, two.cycle_ns)
    shared = {server.name for server in one.servers} & {server.name for server in two.servers}
    for server, other in product(one.servers, two.servers):
        if (server.core, server.priority) != (other.core, other.priority):
            continue
        if shared & {server.name, other.name} or server.best_effort or other.best_effort:
            continue
        for (start, end), (other_start, other_end) in product(server.slots, other.slots):
            later = (other_start + two.offset_ns - start - one.offset_ns) % common
            if later < end - start or common - later < other_end - other_start:
                yield (
                    f"the slot {slot_text((other_start, other_end))} of server {other.name!r} meets"
                    f" {slot_text((start, end))} of server {server.name!r} of {chain_name(one)} in"
                    f" some cycles, on core {server.core} at the same priority {server.priority}"
                )
