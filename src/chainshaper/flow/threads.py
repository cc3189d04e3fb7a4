"""The threads of a running application, and what carrying out a plan would change of them.

What /proc shows is joined with what a recording of the same processes saw: their creation events
say which nodes a process has, the callbacks that ran which threads execute.
"""

import math
import os
import platform
import re
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from itertools import combinations, pairwise
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, TypeAlias, cast
from xml.etree import ElementTree

from chainshaper.enforcement.back_ends import choose_back_end, gates
from chainshaper.enforcement.litmus import litmus_commands
from chainshaper.enforcement.node_threads import (
    Allocation,
    RecordedProcess,
    RecordedThread,
    allocate,
    strangers_text,
    with_gates,
)
from chainshaper.enforcement.planned_threads import (
    absent_receivers,
    closed_before,
    first_planned,
    server_members,
    threads_for,
)
from chainshaper.enforcement.servers import ReservationServer, ServerTable
from chainshaper.enforcement.thread_scheduling import (
    WantedScheduling,
    left_by_back_end,
    plan_scheduling,
    waiting_receivers,
)
from chainshaper.flow.phase import Phase, measure_phase
from chainshaper.linux import processes as running
from chainshaper.linux.processes import list_processes
from chainshaper.linux.scheduling import available_cores
from chainshaper.linux.threads import RunningThread, ThreadRole, of_another_clock, read_proc
from chainshaper.planning.chain_plan import (
    Adaptation,
    ChainPlan,
    Server,
    publisher_servers,
    revised,
    shaping_nodes,
)
from chainshaper.planning.offsets import LEAD_NS, chain_name, linked, with_windows
from chainshaper.planning.overruns import Writer, check_publication, why_not_followed
from chainshaper.planning.plan import Plan, open_until_done, reach, with_slots_moved
from chainshaper.planning.request import simulated_stamps
from chainshaper.values.errors import (
    ChainshaperError,
    InputError,
    OperationError,
    PlatformError,
    shown,
    text_of,
)
from chainshaper.values.files import read_regular
from chainshaper.values.middleware import FAST_DDS_PUBLICATION, ROUTERS

if TYPE_CHECKING:
    from chainshaper.values.recording import Recording  # slow to import


_LONGEST_SETTINGS = 1 << 20  # of a file of a node's parameters or profiles (bytes)


def find_threads(
    where: int | Plan | None = None,
    recording: "Recording | None" = None,
    *,
    recorded: Sequence[RecordedProcess] | None = None,
    users: Collection[str | int] = (),
) -> Allocation:
    """Find the threads of an application and what each of them does.

    ``where`` is a process, which stands for its descendants too; a plan, for the nodes of its
    servers and its receivers; or None for all that looks like an application of ROS 2 or DDS.
    ``recording`` is one of the processes that still run, or of an earlier run (default: those that
    the plan names); who looks often gives what it says, ``recorded``, instead. Only processes of
    ``users`` (names or numbers; default: who launched us, and root) are nodes; a process that is
    asked for is, whoever runs it.

    Raises InputError: there is no such process, or no such user.
    """
    processes, taken = list_processes(), running.run_users(users)
    plan = None if where is None or isinstance(where, int) else where
    shaping, servers = ((), ()) if plan is None else (plan.shaping_nodes, plan.servers)
    notes, strangers = tuple[str, ...](), None
    if recorded is None:
        recorded, notes = recorded_in(*evidence_of(plan, recording))
    if isinstance(where, int):
        parent_of = {process.pid: process.parent for process in processes}
        if where not in parent_of:
            raise InputError(f"no process {where}: it has ended, or is the kernel's own")
        family = running.descendants(parent_of, where)
        chosen = [process for process in processes if process.pid in family]
        taken |= {process.user for process in chosen if process.user is not None}
    else:
        found = allocate(running.find_applications(processes), recorded, processes, taken)
        nodes = defaultdict[int, set[str]](set)
        for listed in with_gates(found, shaping).threads:
            nodes[listed.thread.pid].update(listed.nodes)
        planned = {thread.node: server.name for server in servers for thread in server.threads}
        hosted, chosen = None, [p for p in processes if nodes[p.pid] or p.participates]
        if plan is not None:  # receivers need not run
            hosted = ROUTERS.union(planned, *(node.receivers for node in shaping))
            chosen = [process for process in processes if nodes[process.pid] & hosted]
        chosen = [process for process in chosen if process.user in taken]
        strangers = strangers_text(processes, taken, hosted)
        there = sorted(set().union(*nodes.values()))
        seen = f"is not running, or cannot be recognised; running: {', '.join(there) or 'no node'}"
        missing = [(node, server) for node, server in planned.items() if node not in there]
        notes += tuple(f"node {node} of server {server} {seen}" for node, server in missing)
        notes += tuple(filter(None, [absent_receivers(shaping, there)]))
        if plan is None and not chosen:
            notes += ("no process looks like an application of ROS 2 or DDS",)
    found = with_gates(allocate(chosen, recorded, processes, taken), shaping)
    if recorded and not any(one.nodes_known_by == "recording" for one in found.threads):
        notes += ("none of these processes is in the recording: they were started after it",)
    notes += found.notes + (() if strangers is None else (strangers,))
    return replace(found, notes=notes, strangers=strangers)


def evidence_of(
    plan: Plan | None, recording: "Recording | None" = None
) -> tuple[tuple["Recording", ...], tuple[str, ...]]:
    """The recordings that say which thread of an application does what: ``recording``, or else
    those that the plan names; and which of these cannot be read, in sentences.
    """
    if recording is not None:
        return (recording,), ()
    recordings, notes = list["Recording"](), list[str]()
    chains = () if plan is None else plan.chains
    for path in dict.fromkeys(one.evidence.recording for one in chains if one.evidence.recording):
        if not Path(path).is_dir():
            notes.append(f"the plan's recording {shown(path)} is not here")
            continue
        from chainshaper.sources import open_source  # only who has a recording pays for this

        try:
            recordings.append(open_source(path))
        except ChainshaperError as error:
            notes.append(f"the plan's recording cannot be read: {error}")
    return tuple(recordings), tuple(notes)


def recorded_in(
    recordings: Iterable["Recording"], notes: Iterable[str] = ()
) -> tuple[tuple[RecordedProcess, ...], tuple[str, ...]]:
    """The processes of several recordings, and behind ``notes`` what says nothing of them here."""
    found, said = list[RecordedProcess](), list(notes)
    for recording in recordings:
        processes, why_not = recorded_processes(recording)
        found += processes
        said += why_not
    return tuple(found), tuple(said)


def recorded_processes(
    recording: "Recording",
) -> tuple[tuple[RecordedProcess, ...], tuple[str, ...]]:
    """The processes of a recording, and why it says nothing about this machine, if that is so."""
    import polars as pl  # only who has a recording pays for this

    from chainshaper.analysis import data_flow, executors
    from chainshaper.sources.system import own_pid_namespace
    from chainshaper.values import events

    info, tables, taken_on = recording.info, recording.events, recording.info.host
    if platform.node() not in taken_on.split(", "):
        where = f"was taken on {taken_on or 'an unknown machine'}, so its thread ids say nothing"
        return (), (f"{recording.path} {where} about {platform.node()}",)
    names = ("rcl_node_init", "callback_start")
    seen = pl.concat(events.table(tables, name).select("pid", "time") for name in names)
    last = seen.drop_nulls().group_by("pid").agg(pl.col("time").max())
    last_seen: dict[int, int] = dict(last.iter_rows())
    if any(instant > time.monotonic_ns() for instant in last_seen.values()):
        when = "is from before this machine booted, so its thread ids say nothing"
        return (), (f"{recording.path} {when}",)
    nodes: dict[int, list[str]] = {}
    created = events.table(tables, "rcl_node_init").select("pid", node=events.NODE_NAME)
    for pid, node in created.unique(maintain_order=True).iter_rows():
        nodes.setdefault(pid, []).append(node)
    threads = defaultdict[int, dict[int, RecordedThread]](dict)
    for one in info.threads:
        node_of, role = (one.node,) if one.node else (), cast(ThreadRole, one.role)
        threads[one.pid][one.tid] = RecordedThread(one.tid, role, node_of, one.comm)
        nodes.setdefault(one.pid, list(node_of))
    ran = executors(data_flow(tables, info.clock_offset_ns))
    several = Counter(one.pid for one in ran)
    for pid, ran_of, _, names_of in ran:
        own, apart = threads[pid], names_of if several[pid] > 1 else ()
        for tid, nodes_of in ran_of.items():
            comm = own[tid].comm if tid in own else ""
            own[tid] = RecordedThread(tid, "executor", nodes_of, comm, apart)
    here = info.pid_namespace == own_pid_namespace()
    found = (
        RecordedProcess(pid, tuple(names), tuple(threads[pid].values()), last_seen[pid], here)
        for pid, names in nodes.items()
        if pid in last_seen
    )
    return tuple(found), ()


def refuse_simulated(plan: Plan, found: Allocation) -> None:
    """Raises InputError: slots count from stamps of nodes that, by commands, follow `/clock`."""
    stamped = [one for one in plan.chains if one.anchor == "stamp" and shaping_nodes(one)]
    servers = [server for one in stamped for server in one.servers]
    nodes = {thread.node for server in servers for thread in server.threads}
    for node, pid in _processes_of(nodes, found):
        if _follows_clock(pid):
            raise InputError(simulated_stamps(node))


def refuse_other_clocks(plan: Plan, found: Allocation) -> None:
    """Raises PlatformError: a shaping node, which gets its slots in our clock, has another."""
    shaping = {node.thread.node for node in plan.shaping_nodes}
    for node, pid in _processes_of(shaping, found):
        if of_another_clock(pid):
            raise PlatformError(
                f"the shaping node {node} (process {pid}) has another clock than we, that of a"
                f" time namespace: apply the plan in there (`nsenter --time --target {pid} …`)"
            )


def _processes_of(nodes: set[str], found: Allocation) -> Iterator[tuple[str, int]]:
    """Those of the nodes whose threads were recognised, and the process of each thread."""
    for allocated in found.threads:
        for node in nodes.intersection(allocated.nodes):
            yield node, allocated.thread.pid


def _follows_clock(pid: int) -> bool:
    words = os.fsdecode(read_proc(f"/proc/{pid}/cmdline")).split("\0")
    texts = [one for one in words if one.startswith("use_sim_time")]
    for option, file in pairwise(words):
        if option == "--params-file":  # as `ros2 launch` writes one for each node
            with suppress(OSError):
                texts.append(
                    text_of(read_regular(Path(f"/proc/{pid}/cwd", file), _LONGEST_SETTINGS))
                )
    return any(re.search(r"\buse_sim_time\W+true\b", one, re.IGNORECASE) for one in texts)


def check_publishers(
    plan: Plan, found: Allocation, recordings: Iterable["Recording"] = ()
) -> list[str]:
    """What a person must know where a plan gates publishers' threads (design 1): whether processes
    publish so. Recordings know their writers. Raises InputError: as :func:`.check_publication`.
    """
    gating = [chain for chain in plan.chains if any(publisher_servers(chain))]
    endpoints = dict.fromkeys(one for recording in recordings for one in recording.info.endpoints)
    if not gating or not endpoints:
        return []
    process = {node: one.thread.pid for one in found.threads for node in one.nodes}
    modes = {pid: _asynchronous(pid) for pid in set(process.values())}
    writers = [
        Writer(one.node, one.topic, one.depth, modes[pid].get(one.topic, modes[pid].get("")), pid)
        for one in endpoints
        if one.kind == "publisher" and (pid := process.get(one.node)) is not None
    ]
    known = [c for c in gating if any(one.node == c.chain.publisher for one in writers)]
    return [said for chain in known for said in check_publication(chain, writers)]


def _asynchronous(pid: int) -> dict[str, bool]:
    """Topic → whether the middleware of a process publishes it asynchronously, as its settings say.

    "" is all other topics.
    """
    from chainshaper.sources.ros import environment_of  # only who gates publishers pays for this

    try:
        asked = environment_of(pid).variables
    except OperationError:
        return {}
    settings = FAST_DDS_PUBLICATION
    mode = asked.get(settings.mode)
    if mode != "AUTO" and asked.get(settings.prefer_profiles) != "1":
        return {"": mode == "ASYNCHRONOUS"} if mode in ("ASYNCHRONOUS", "SYNCHRONOUS") else {}
    files = [asked.get(variable) for variable in settings.profile_variables]
    modes: dict[str, bool] = {}
    for name in (*files, *settings.profile_files):
        with suppress(OSError, ElementTree.ParseError):
            content = read_regular(Path(f"/proc/{pid}/cwd", name or ""), _LONGEST_SETTINGS)
            for one in ElementTree.fromstring(content).iter():  # noqa: S314 - expat bounds entities
                if one.tag.rpartition("}")[2] in ("data_writer", "publisher"):
                    kind = one.findtext(".//{*}publishMode/{*}kind", "").strip()
                    modes.setdefault(one.get("profile_name", ""), kind == "ASYNCHRONOUS")
                    if one.get("is_default_profile") == "true":
                        modes[""] = kind == "ASYNCHRONOUS"
            modes.setdefault("", False)
    return modes


@dataclass(frozen=True)
class Changes:
    """What a plan would change: threads, or with the commands of LITMUS^RT's tools."""

    back_end: str
    reason: str
    threads: tuple[WantedScheduling, ...]
    commands: tuple[tuple[str, ...], ...]
    notes: tuple[str, ...]


def planned_changes(
    plan: Plan,
    back_end: str = "auto",
    *,
    recording: "Recording | None" = None,
    phase_ns: int | None = None,
    users: Collection[str | int] = (),
) -> Changes:
    """What :func:`.apply_plan` would do, with the same errors; of LITMUS^RT on any kernel."""
    given, plan = plan, open_until_done(plan)
    table = server_table(plan)
    found = find_threads(plan, recording, users=users)
    if back_end != "litmus":
        choice = choose_back_end(back_end)
        refuse_unfit(plan, choice.name)
        refuse_simulated(plan, found)
        refuse_other_clocks(plan, found)
        wanted = plan_scheduling(plan, found, available_cores())
        threads = left_by_back_end(choice.name, wanted, plan.free_threads)
        notes = (*found.notes, *waiting_receivers(plan, threads))
        return Changes(choice.name, choice.reason, threads, (), notes)
    notes, anchor_ns, members = found.notes, 0, dict[str, list[int | str]]()
    try:
        given, anchor_ns, waits_ns, _ = carried_out(given, found, phase_ns)
        table = server_table(open_until_done(given, waits_ns))
        for name, group in server_members(plan, found).items():
            members[name] = [member.thread.tid for member in group]
    except OperationError:
        members = {s.name: [f"TID:{t.node}" for t in s.threads] for s in plan.servers}
        notes += ("slots are counted from a beginning that is measured when the chain runs",)
    return Changes("litmus", "asked for", (), litmus_commands(table, members, anchor_ns), notes)


def refuse_unfit(plan: Plan, back_end: str) -> None:
    """Raises InputError: this back end cannot carry out all of the plan."""
    if not gates(back_end) and any(chain.offset_ns for chain in plan.chains):
        raise InputError(
            f"the back end {back_end} sets priorities only, and chains whose cycles start at"
            " offsets have to be stopped until then: choose freezer or scx"
        )
    if not gates(back_end) and any(chain.slot_ends == "closed" for chain in plan.chains):
        raise InputError(
            f"the back end {back_end} sets priorities only, and the plan's servers close at their"
            " slots' ends (slot_ends: closed): choose freezer, scx or litmus (--backend freezer)"
        )
    if plan.takes_turns and back_end == "scx":
        raise InputError(
            "equal_priorities: round-robin, but under the back end scx servers of one priority run"
            " in the plan's order: choose another (--backend freezer)"
        )


def followed_chains(
    plan: Plan, back_end: str, max_latency_ns: int | None = None
) -> tuple[Plan, dict[int, tuple[int, int]], list[str]]:
    """The plan, with ``max_latency_ns`` in it; how far slots that can follow their latencies may
    be moved (ns), by their chains' places; why others stay. Raises InputError: none can.
    """
    chains, reaches, why_not = list(plan.chains), dict[int, tuple[int, int]](), list[str]()
    for place, chain in enumerate(plan.chains):
        rules = chain.adaptation or Adaptation()
        if max_latency_ns is not None:
            rules = rules.model_copy(update={"max_latency_ns": max_latency_ns})
        try:
            if (reason := why_not_followed(chain)) is not None:
                raise InputError(reason)
            followed = {s.name: plan.chains[k] for k in reaches for s in plan.chains[k].servers}
            for server in (one for one in chain.servers if one.name in followed):
                other = chain_name(followed[server.name])
                raise InputError(f"its server {server.name} is also that of {other}, which follows")
            chains[place] = revised(chain, adaptation=rules)
            found = reach(plan, place, rules.max_latency_ns)
            furthest = (with_slots_moved(plan, {place: by}) for by in found)
            tables = {server_table(open_until_done(one)) for one in (plan, *furthest)}
            if len(tables) > 1 and back_end not in ("freezer", "fifo"):
                remedy = "choose freezer, or `shaping_thread: free`"
                raise InputError(f"the back end {back_end} does not move slots: {remedy}")
        except InputError as error:
            why_not.append(f"slots of {chain_name(chain)} cannot follow its latencies: {error}")
        else:
            reaches[place] = found
    if not reaches:
        raise InputError("; ".join(why_not))
    return Plan.of(*chains), reaches, why_not


def server_table(plan: Plan) -> ServerTable:
    """The servers of a plan whose threads a back end has to keep inside their slots."""
    servers = [s for s in plan.servers if set(s.threads) - plan.free_threads]
    if not servers:
        raise OperationError(
            "the plan's servers name no threads of the application, so there is nothing to apply:"
            " plan from a recording (`chainshaper plan REC --chain FIRST..LAST`)"
        )
    return table_of(plan.cycle_ns, servers, plan.most_urgent_first)


def table_of(cycle_ns: int, servers: Iterable[Server], order: Sequence[str] = ()) -> ServerTable:
    """Servers of a plan without their nodes, whose threads are in this order."""

    def bare(one: Server) -> ReservationServer:
        own = (one.name, one.core, one.priority, one.slots)
        return ReservationServer(*own, places=places_in(one, order))

    return ServerTable(cycle_ns, tuple(map(bare, servers)))


def order_in(server: Server, order: Sequence[str]) -> list[str]:
    """The nodes of a server that are in the order, in that."""
    own = {thread.node for thread in server.threads}
    return [node for node in order if node in own]


def places_in(server: Server, order: Sequence[str]) -> int:
    """How many places threads of a server have: one for each node in the order, one for others."""
    nodes, ordered = {thread.node for thread in server.threads}, order_in(server, order)
    return max(1, len(ordered) + (len(ordered) < len(nodes)))


def first_threads(plan: Plan, found: Allocation) -> list[tuple[RunningThread, ...]]:
    """The running threads that begin each chain: any of an executor's may, where it has several."""
    server_members(plan, found)  # none is in two servers
    begin: list[tuple[RunningThread, ...]] = []
    for chain in plan.chains:
        planned = first_planned(chain)
        if planned is None:
            raise OperationError(
                f"no server of {chain_name(chain)} holds an executor, so nothing says where in a"
                " cycle the chain begins: give its phase (--phase)"
            )
        begin.append(tuple(listed.thread for listed in threads_for(planned, found)))
    return begin


def chain_phases(
    plan: Plan,
    found: Allocation,
    progress: Callable[[float], None] = lambda _: None,
    known: Mapping[int, Phase] = MappingProxyType({}),
) -> list[Phase]:
    """Where in its cycle each chain begins; some are ``known``, by their chains' places."""
    wanted = [
        (origin[0].pid, tuple(one.tid for one in origin), chain.cycle_ns)
        for chain, origin in zip(plan.chains, first_threads(plan, found), strict=True)
    ]
    # Chains of one graph begin alike.
    parts = dict.fromkeys(one for place, one in enumerate(wanted) if place not in known)
    phases = {}
    for number, one in enumerate(parts):
        report = partial(lambda number, share: progress((number + share) / len(parts)), number)
        phases[one] = measure_phase(*one, progress=report)
    return [known[k] if k in known else phases[one] for k, one in enumerate(wanted)]


CarriedOut: TypeAlias = tuple[Plan, int, list[int], list[Phase]]
"""A plan as it is carried out, and from when on its cycles count (CLOCK_MONOTONIC, modulo the
hyper-period). Where timers were measured: how long before slots they expire, and where.
"""


def carried_out(
    plan: Plan,
    found: Allocation,
    phase_ns: int | None,
    *,
    gated: bool = True,
    progress: Callable[[float], None] = lambda _: None,
    known: Mapping[int, Phase] = MappingProxyType({}),
) -> CarriedOut:
    """A plan on what runs, whose first timer expires at ``phase_ns`` (None: all are measured that
    are not ``known``, see :func:`chain_phases`).

    Raises OperationError: a chain has no regular beginning, or as :func:`placed`.
    """
    if phase_ns is not None:
        return plan, (phase_ns + LEAD_NS - plan.chains[0].offset_ns) % plan.cycle_ns, [], []
    phases = chain_phases(plan, found, progress, known)
    plan, anchor_ns = placed(plan, phases, gated=gated)
    waits_ns = [
        (anchor_ns + chain.offset_ns - phase.at_ns) % chain.cycle_ns
        for chain, phase in zip(plan.chains, phases, strict=True)
    ]
    return plan, anchor_ns, waits_ns, phases


def placed(plan: Plan, phases: Sequence[Phase], *, gated: bool = True) -> tuple[Plan, int]:
    """The plan, and the instant of CLOCK_MONOTONIC, modulo the hyper-period, from which its cycles
    count, so that every slot opens :data:`LEAD_NS` after its chain's timer at least.

    The longest wait of chains that share a core is as short as can be, but no timer is to expire
    while its slot is open (``gated``): the thread would begin in that of the instance before. Where
    it does with the plan's offsets, the chains get others. Timers of chains that share no core
    expire independently: their offsets are moved, so that these do not wait for each other's.

    Raises OperationError: no offsets help.
    """
    cores = [{server.core for server in chain.servers} for chain in plan.chains]
    pairs = combinations(range(len(cores)), 2)
    groups = linked(len(cores), [(j, k) for j, k in pairs if cores[j] & cores[k]])
    chains, first_ns = list(plan.chains), None
    for group in groups:
        own, anchor_ns = _around([chains[k] for k in group], [phases[k] for k in group], gated)
        first_ns = anchor_ns if first_ns is None else first_ns
        for k, chain in zip(group, own, strict=True):
            offset_ns = (chain.offset_ns + anchor_ns - first_ns) % chain.cycle_ns
            chains[k] = revised(chain, offset_ns=offset_ns)
    return Plan.of(*chains), first_ns or 0


def _around(
    chains: Sequence[ChainPlan], phases: Sequence[Phase], gated: bool
) -> tuple[Sequence[ChainPlan], int]:
    """Chains that share cores, and from when on their cycles count."""
    # Waits only grow with the anchor, but where one starts again: the best is at such a place.
    hyper = math.lcm(*(chain.cycle_ns for chain in chains))
    ready = [phase.at_ns + LEAD_NS for phase in phases]
    begin = [(at - one.offset_ns, one.cycle_ns) for at, one in zip(ready, chains, strict=True)]
    candidates = {(at + n * cycle) % hyper for at, cycle in begin for n in range(hyper // cycle)}
    most = [closed_before(chain) if gated else None for chain in chains]

    def cost(at: int) -> tuple[int, int]:
        waits = [LEAD_NS + (at - one) % cycle for one, cycle in begin]
        inside = (m is not None and w > max(LEAD_NS, m) for w, m in zip(waits, most, strict=True))
        return sum(inside), max(waits)

    best = min(sorted(candidates), key=cost)
    if not cost(best)[0]:
        return chains, best
    windows = [
        None if m is None else (at, at + max(0, m - LEAD_NS))
        for at, m in zip(ready, most, strict=True)
    ]
    try:
        return with_windows(chains, windows), 0
    except OperationError as error:
        names = ", ".join(map(chain_name, chains))
        raise OperationError(
            f"the timers of {names} expire so that, whatever their offsets, one does while the slot"
            f" of its instance before is open: start the nodes again, one by one ({error})"
        ) from error
