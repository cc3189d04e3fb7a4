"""Carrying out a plan on a running application: the function behind `chainshaper apply`.

    find the threads ─► priorities and cores ─► servers ─► anchor ─► arm ─► watch ─► all as before

Every change stands in a journal first (:mod:`chainshaper.enforcement.journal`): whatever ends the
run puts it back. Servers are armed only when all nodes run, and released before a command of ours
is to end, since a stopped thread cannot. A thread that appears later gets what the plan says at the
next look.
"""

import json
import os
import subprocess
import threading
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import repeat
from pathlib import Path
from typing import TYPE_CHECKING, Any

from chainshaper.enforcement import undoing
from chainshaper.enforcement.back_ends import Choice, choose_back_end, gates, make_back_end
from chainshaper.enforcement.freezer import Freezer, groups_of, run_of
from chainshaper.enforcement.guardian import Guardians, put_back
from chainshaper.enforcement.journal import PLAN_FILE, Journal
from chainshaper.enforcement.node_threads import (
    IN_ORDER,
    LEFT_ALONE,
    Allocation,
    NodeThread,
    RecordedProcess,
    new_and_ended,
)
from chainshaper.enforcement.planned_threads import (
    NOT_RECOGNISED,
    absent_receivers,
    closed_before,
    place_of,
    server_members,
)
from chainshaper.enforcement.scheduling_memory import change_all, look_alikes, note_descendants
from chainshaper.enforcement.servers import BackEnd, ServerCounters
from chainshaper.enforcement.thread_scheduling import (
    WantedScheduling,
    left_by_back_end,
    plan_scheduling,
    waiting_receivers,
)
from chainshaper.enforcement.undoing import RunState, ServerState
from chainshaper.flow import threads
from chainshaper.flow.drift import SlotFollower, TimerTrack
from chainshaper.flow.phase import DriftWatch, Phase, Telling, tell_phase
from chainshaper.linux.own_processes import end_command, end_in_words, start_command
from chainshaper.linux.processes import run_users
from chainshaper.linux.scheduling import available_cores, check_cores
from chainshaper.planning import application_plan as planned
from chainshaper.planning.application_plan import ApplicationPlan, open_until_done
from chainshaper.planning.offsets import LEAD_NS, chain_name
from chainshaper.planning.overruns import publication_warnings
from chainshaper.planning.plan import Plan, shaping_nodes
from chainshaper.planning.plan_file import plan_values
from chainshaper.values.durations import duration_text
from chainshaper.values.errors import ChainshaperError, OperationError
from chainshaper.values.files import write_whole

if TYPE_CHECKING:
    from chainshaper.values.recording import Recording  # slow to import


START_NS = 30_000_000_000  # for a command to start all nodes of the plan
PHASE_BOUND_NS = 250_000  # nodes get the beginning of cycles again when it has moved by more
_LOOK_S = 1.0
_SETTLING_LOOKS = 3  # nodes that have just started go on to start threads for a while
GATE_START_NS = 10_000_000_000  # a shaping node appears so long after all others, or never
_FLEETING = 3  # so many threads that a look finds, and the next does not, are worth a note


@dataclass(frozen=True)
class Applied:
    """How a run ended: its last state, and the exit code of the command (None: there was none)."""

    state: RunState
    exit_code: int | None


def apply_plan(
    plan: Plan | ApplicationPlan,
    command: Sequence[str] = (),
    *,
    command_stdout: int | None = None,
    back_end: str = "auto",
    recording: "Recording | None" = None,
    phase_ns: int | None = None,
    adapt: bool = False,
    max_latency_ns: int | None = None,
    wait_ns: int | None = None,
    users: Collection[str | int] = (),
    plan_path: str = "",
    folder: Path | None = None,
    stop: threading.Event | None = None,
    watch: Callable[[RunState], None] = lambda _: None,
    progress: Callable[[float, str], None] = lambda *_: None,
) -> Applied:
    """Put a plan in force until ``stop`` is set, the command or the application ends, or it fails.

    ``command`` is started first (its output goes to ``command_stdout``); without one, the
    application runs already. Its nodes have ``wait_ns`` to appear (default: 30 s with a command,
    else none). ``phase_ns`` is where in a cycle the first chain's timer expires, on CLOCK_MONOTONIC
    (None: those of all chains are measured). With ``adapt`` slots follow the latencies, to no later
    end than ``max_latency_ns`` (None: as the plan says). ``recording`` is one of the very
    processes, or of an earlier run (None: those that the plan names); ``users`` are as for
    :func:`.find_threads`. ``watch`` gets the state every second; ``folder`` is where runs stand
    (default: `/run/chainshaper`).

    Raises InputError: no such user, or the plan cannot be carried out. PlatformError: the machine
    lacks a core or the back end, or we a privilege. OperationError: another run governs a core or
    node, a node does not appear, a chain has no regular beginning, the kernel refuses something,
    the servers failed, the application ended, or ``stop`` was set before the plan was in force.
    """
    given, taken = planned.whole(plan), run_users(users)
    threads.server_table(given)
    check_cores({server.core: f"server {server.name}" for server in given.servers})
    choice = choose_back_end(back_end)
    threads.refuse_unfit(given, choice.name)
    reaches_ns, why_not = dict[int, tuple[int, int]](), list[str]()
    if adapt:
        given, reaches_ns, why_not = threads.followed_chains(given, choice.name, max_latency_ns)
    nodes = {thread.node for server in given.servers for thread in server.threads}
    nodes.update(receiver for node in given.shaping_nodes for receiver in node.receivers)
    # Looked up once: that takes longer than looking at processes.
    recordings, unread = threads.evidence_of(given, recording)
    recorded, unread = threads.recorded_in(recordings, unread)
    cores, stop = {server.core for server in given.servers}, stop or threading.Event()
    journal = undoing.claim_run(cores, nodes, folder, lambda: _go_on(stop))
    run = _Run(given, given, choice, journal, recorded, taken, stop, unread)
    try:
        run.guardians = Guardians(journal)
        if command:
            run.command = start_command(command, stdout=command_stdout)
        run.await_nodes((START_NS if command else 0) if wait_ns is None else wait_ns, progress)
        run.guardians.await_ready(run.go_on)
        threads.refuse_simulated(given, run.found)
        threads.refuse_other_clocks(given, run.found)
        said = threads.check_publishers(given, run.found, recordings)
        said += waiting_receivers(given, run.schedule())
        run.begin_state(command, plan_path)
        run.note(*said, *(one for one in run.found.notes if one.endswith(IN_ORDER)))
        run.find_anchor(phase_ns, progress)
        table = threads.server_table(run.plan)
        servers = run.servers = make_back_end(choice.name, table, journal, run.go_on)
        run.arm(servers, progress)
        run.note(*why_not)
        run.start_followers(reaches_ns)
        run.watch_over(servers, watch)
        strangers = look_alikes(journal, groups_of(run_of(journal)))
    finally:
        run.put_back()
    if run.state.failure is not None:
        ending = "; ".join(("everything is as it was before", *strangers))
        raise OperationError(f"{run.state.failure}; {ending}")
    run.note(*strangers)
    return Applied(run.state, run.command.returncode if run.command else None)


def _go_on(stop: threading.Event) -> None:
    if stop.is_set():
        raise OperationError("the run was asked to end before the plan was in force")


@dataclass
class _Run:
    """What belongs together, and is to be put back, while a plan is in force."""

    given: ApplicationPlan
    plan: ApplicationPlan  # as it is carried out: with room for overruns, once timers are known
    choice: Choice
    journal: Journal
    recorded: tuple[RecordedProcess, ...]
    users: frozenset[int]
    stop: threading.Event
    unread: tuple[str, ...] = ()  # recordings that say nothing of this machine, or cannot be read
    guardians: Guardians | None = None
    command: subprocess.Popen[bytes] | None = None
    servers: BackEnd | None = None
    telling: list[Telling] = field(default_factory=list)
    anchor_ns: int = 0  # from when on slots count, where they have been moved to by now
    waits_ns: list[int] = field(default_factory=list)  # from each timer to its slot, if measured
    followers: dict[int, SlotFollower] = field(default_factory=dict)  # by their chains' places
    drifts: list[DriftWatch] = field(default_factory=list)  # one for each chain
    origins: list[set[tuple[int, int]]] = field(default_factory=list)  # the threads they watch
    moved_ns: dict[int, int] = field(default_factory=dict)  # by how much their slots are
    arming: threading.Lock = field(default_factory=threading.Lock)  # followers move slots as well
    descendants: set[tuple[int, int]] = field(default_factory=set)  # at the last look
    found: Allocation = field(init=False)
    state: RunState = field(init=False)

    @property
    def folder(self) -> Path:
        return self.journal.path.parent

    @property
    def gated(self) -> bool:
        """Whether a back end stops threads outside their slots, or sets priorities only."""
        return gates(self.choice.name)

    @property
    def command_ended(self) -> bool:
        return self.command is not None and self.command.poll() is not None

    def go_on(self) -> None:
        _go_on(self.stop)

    def show(self, **changes: Any) -> None:
        self.state = replace(self.state, **changes)

    def show_servers(self, **changes: Mapping[str, Any]) -> None:
        """Set fields of the servers' states, each from what it is by the server's name."""

        def changed(one: ServerState) -> ServerState:
            return replace(one, **{field: of[one.name] for field, of in changes.items()})

        self.show(servers=tuple(map(changed, self.state.servers)))

    def note(self, *notes: str, instead: Collection[str] = ()) -> None:
        """Add notes, each once; ``instead`` of others."""
        others = (one for one in self.state.notes if one not in instead)
        self.show(notes=tuple(dict.fromkeys((*others, *notes))))

    def find(self) -> Allocation:
        return threads.find_threads(self.plan, recorded=self.recorded, users=self.users)

    def await_nodes(self, wait_ns: int, progress: Callable[[float, str], None]) -> None:
        """Look until all nodes of the plan run; where there is time, a little for late threads."""
        begun, looks, before, others_ns = time.monotonic_ns(), 0, None, 0
        shaping = {node.thread.node for node in self.given.shaping_nodes}
        wanted = {one.node for server in self.given.servers for one in server.threads}
        while True:
            self.go_on()
            self.found = self.find()
            waited = time.monotonic_ns() - begun
            try:
                server_members(self.plan, self.found)
                looks += 1
            except OperationError:
                missing = wanted - {node for one in self.found.threads for node in one.nodes}
                looks, named = 0, ", ".join(sorted(missing))
                others_ns = waited if missing - shaping else others_ns
                over = self.command_ended or waited >= min(wait_ns, others_ns + GATE_START_NS)
                if over and missing and missing <= shaping:
                    raise OperationError(
                        f"the plan's shaping node {named} is not running, all other nodes are:"
                        " start it too (`chainshaper splice`, or `shape` where it is described),"
                        " or plan without one (--policy server-per-chain)"
                    ) from None
                if self.command_ended and self.command is not None:
                    ended = f"the command {end_in_words(self.command.returncode)} before all nodes"
                    said = f"{ended} of the plan were running: {named or 'all'} were not"
                    raise OperationError(said) from None
                if waited >= wait_ns:
                    raise
            quiet = before is not None and not any(new_and_ended(before, self.found))
            if looks and (quiet or looks > _SETTLING_LOOKS or waited >= wait_ns):
                return
            before = self.found
            progress(min(1.0, waited / wait_ns), "finding the nodes")
            self.stop.wait(min(_LOOK_S, (wait_ns - waited) / 1e9))

    def schedule(self) -> tuple[WantedScheduling, ...]:
        """Give threads their priorities and cores, as far as the back end leaves that to us."""
        wanted = plan_scheduling(self.plan, self.found, available_cores())
        left = left_by_back_end(self.choice.name, wanted, self.plan.free_threads)
        change_all(self.journal, ((one.node_thread.thread, one.scheduling) for one in left))
        return left

    def begin_state(self, command: Sequence[str], plan_path: str) -> None:
        self.state = RunState(
            run=self.folder.name,
            owner=os.getpid(),
            plan=plan_path,
            command=tuple(command),
            back_end=self.choice.name,
            reason=self.choice.reason,
            started_ns=time.monotonic_ns(),
            cycle_ns=self.plan.cycle_ns,
            notes=tuple(note for one in self.plan.chains for note in publication_warnings(one)),
        )
        self.name_strangers(self.found)
        self.name_absent(self.found)

    def find_anchor(self, phase_ns: int | None, progress: Callable[[float, str], None]) -> None:
        """Measure where chains begin, and see from when on their slots count."""

        def measured(share: float) -> None:
            self.go_on()
            progress(share, "measuring where in a cycle the chain begins")

        self.given, self.anchor_ns, self.waits_ns, phases = threads.carried_out(
            self.given, self.found, phase_ns, gated=self.gated, progress=measured
        )
        for chain, phase in zip(self.given.chains, phases, strict=False):
            if phase.spread_ns > LEAD_NS:
                self.note(
                    f"the beginning of {chain_name(chain)} varies by"
                    f" {duration_text(phase.spread_ns)} from cycle to cycle: it is started by"
                    " something less regular than a timer"
                )
        if phases:
            self.show(phase_spread_ns=max(phase.spread_ns for phase in phases))
        elif self.gated:
            self.note("slots stay where --phase puts them, also when the chain's timer drifts")
        self.plan = open_until_done(self.given, self.waits_ns)
        keeper = self.choice.name if self.gated else "none: priority only"
        kept = {one.name for one in threads.server_table(self.plan).servers}
        servers = (
            ServerState(
                *(one.name, one.core, one.priority, one.slots, ()),
                places=threads.places_in(one, self.plan.most_urgent_first),
                kept_by=keeper if one.name in kept else "gate",
                counters=ServerCounters(),
            )
            for one in self.plan.servers
        )
        self.show(servers=tuple(servers))

    def arm(self, servers: BackEnd, progress: Callable[[float, str], None]) -> None:
        """Put the threads into the servers, and close these."""
        anchor, cycle_ns = self.anchor_ns, self.plan.cycle_ns
        self.tell(dict.fromkeys(range(len(self.plan.chains)), 0))
        while not self.end_telling() and not (self.stop.wait(0.05) or self.command_ended):
            progress(1.0, "telling shaping nodes where cycles begin")
        self.assign(servers)
        servers.arm(anchor)
        since = servers.in_force_from() or time.monotonic_ns()
        self.save_plan()
        self.show(anchor_ns=anchor, in_force_ns=since + (anchor - since) % cycle_ns)

    def save_plan(self) -> None:
        with suppress(OperationError):  # a full /run ends no plan; recordings lack it then
            write_whole(self.folder / PLAN_FILE, [json.dumps(plan_values(self.given)).encode()])

    def begins(self, place: int) -> int:
        """Where the chain at this place begins in its cycles."""
        chain = self.plan.chains[place]
        return (self.anchor_ns + chain.offset_ns - self.early(place)) % chain.cycle_ns

    def early(self, place: int) -> int:
        """How long before its slot a chain begins: with its timer, unless a server stops it."""
        closed = closed_before(self.plan.chains[place]) is not None
        if self.gated and (closed or not self.waits_ns):
            return 0
        return self.waits_ns[place] if self.waits_ns else LEAD_NS

    def tell(self, moved_ns: Mapping[int, int]) -> None:
        """Begin to give shaping nodes of these chains where cycles, moved by so much, begin."""
        for place, by_ns in moved_ns.items():
            chain = self.plan.chains[place]
            begins = (self.begins(place) + by_ns) % chain.cycle_ns
            self.telling.append(tell_phase(shaping_nodes(chain), self.found, begins))

    def end_telling(self) -> bool:
        """Whether shaping nodes know where cycles begin, or never will, which is noted."""
        is_over = all(one.is_over() for one in self.telling)
        if is_over:
            self.note(*(said for one in self.telling for said in one.end()))
            self.telling.clear()
        return is_over

    def start_followers(self, reaches_ns: Mapping[int, tuple[int, int]]) -> None:
        """Have the slots of chains follow the latencies, each within its reach."""
        cores = set(available_cores()) - {server.core for server in self.plan.servers}
        pids = [one.thread.pid for one in self.found.threads]
        for place, reach_ns in reaches_ns.items():
            chain, move = self.given.chains[place], partial(self.move_slots, place)
            self.followers[place] = SlotFollower(chain, pids, reach_ns, move, cores=cores)

    def move_slots(self, place: int, moved_ns: int) -> int:
        """Move a chain's slots in the servers, where they change; from when on the gate has to."""
        with self.arming:
            moves = {**self.moved_ns, place: moved_ns}
            plan = open_until_done(planned.with_slots_moved(self.given, moves), self.waits_ns)
            before, table = threads.server_table(self.plan), threads.server_table(plan)
            cycle_ns = self.plan.chains[place].cycle_ns
            since = time.monotonic_ns() + 2 * cycle_ns
            if table != before and isinstance(self.servers, Freezer):
                self.servers.change(table, self.anchor_ns)
                since = (self.servers.in_force_from() or since) - cycle_ns // 4
            self.plan, self.moved_ns = plan, moves
            return since + (self.begins(place) - since) % cycle_ns - cycle_ns // 2

    def show_moves(self) -> None:
        """The state shows where slots are by now, and what does not follow any more."""
        self.show_servers(slots={server.name: server.slots for server in self.plan.servers})
        moves = [move for one in self.followers.values() for move in one.moves]
        self.show(moves=tuple(sorted(moves, key=lambda move: move.from_ns)))
        for place, follower in tuple(self.followers.items()):
            if follower.failure is not None:
                del self.followers[place]
                follower.end()
                with suppress(OperationError):  # as it ends, or is lost
                    self.move_slots(place, 0)  # the gate's are there already
                self.note(f"slots are as planned, and do not follow any more: {follower.failure}")

    def assign(self, servers: BackEnd) -> None:
        """Put the threads that are not in their servers yet there."""
        themselves = {thread.node for thread in self.plan.free_threads}
        already = {one.name: one.threads for one in self.state.servers}
        members = server_members(self.plan, self.found)
        urgency = self.plan.most_urgent_first
        order = {one.name: threads.order_in(one, urgency) for one in self.plan.servers}
        for name, one in ((name, one) for name, group in members.items() for one in group):
            self.go_on()
            if one.thread.tid not in already[name] and themselves.isdisjoint(one.nodes):
                with self.arming:
                    servers.assign(one.thread.tid, name, place_of(one, order[name]))
        tids = {name: tuple(one.thread.tid for one in group) for name, group in members.items()}
        self.show_servers(threads=tids)

    def watch_over(self, servers: BackEnd, watch: Callable[[RunState], None]) -> None:
        """Watch over the run until it is to end; the state is then as it was last."""
        latest: tuple[NodeThread, ...] = ()
        unsaved = untaken = ""
        while True:
            if not self.drifts:  # at first, and when a chain begins anew
                drifts = self.drifts = self.drift_watches()
                following, sent, said = self.follow(servers, drifts), dict[int, int](), list[str]()
            is_over = self.command_ended or self.stop.is_set()
            for failure in {one.failure for one in drifts} - {None}:
                self.note(f"whether cycles begin elsewhere by now is not known any more: {failure}")
            followed_ns = next(following)
            seen = {k: ns for k, one in enumerate(drifts) if (ns := one.surely_ns) is not None}
            for k, ns in seen.items():
                drifts[k].look_soon |= (drifts[k].latest_ns or 0) - ns > PHASE_BOUND_NS
            moved = {k: ns + followed_ns for k, ns in seen.items()}
            self.end_telling()
            self.show_moves()
            self.look_at(servers, max(moved.values(), key=abs, default=None))
            if is_over := is_over or self.state.failure is not None:
                self.show(ended_ns=time.monotonic_ns())
            trouble = filter(None, (unsaved, untaken))
            shown = replace(self.state, notes=(*self.state.notes, *trouble))  # while it lasts
            unsaved = ""
            try:
                undoing.save_run_state(self.folder, shown)
            except OSError as error:  # the plan is in force all the same
                reason = f"`status` cannot show how this run is doing ({error.strerror})"
                unsaved = f"{self.folder}: {reason}"
            watch(shown)
            if is_over:
                self.state = shown
                return
            new = {k: ns for k, ns in moved.items() if abs(ns - sent.get(k, 0)) > PHASE_BOUND_NS}
            if new and not self.telling:
                sent.update(new)
                self.tell({k: ns - followed_ns for k, ns in new.items()})
                notes = [
                    f"the beginning of {chain_name(self.plan.chains[place])} has moved by"
                    f" {duration_text(ns)} since the plan was put in force; shaping nodes get it,"
                    " and outputs without a stamp follow from the next cycle"
                    for place, ns in sent.items()
                ]
                self.note(*notes, instead=said)
                said = notes
            if self.stop.wait(_LOOK_S):
                continue
            if self.guardians is not None:
                self.guardians.renew()
            latest, untaken = self.look_again(servers, latest)

    def follow(self, servers: BackEnd, drifts: Sequence[DriftWatch]) -> Iterator[int]:
        """Move the slots with the chain's timer; yields how far they have moved (ns).

        Not where nothing gates, nor from a given phase, which need not be a timer's. Of several
        chains, whose timers have one clock, that with the shortest wait for its slot is followed.
        """
        anchor_ns, waits = self.anchor_ns, self.waits_ns
        if not self.gated or not waits:
            yield from repeat(0)
        first = waits.index(min(waits))
        drift, cycle_ns = drifts[first], self.plan.chains[first].cycle_ns
        stamped = all(chain.anchor == "stamp" for chain in self.plan.chains)
        track = TimerTrack(waits[first], time.monotonic_ns(), cycle_ns, looks=stamped)
        looks = 0
        while True:
            before_ns = track.opens_ns
            if drift.looks > looks:
                looks = drift.looks
                early = self.early(first)  # nothing stops it: one look alone may just be late
                seen_ns = drift.surely_ns if early else drift.latest_ns
                track.saw((seen_ns or 0) - early, time.monotonic_ns())
                drift.look_soon = track.is_unsure
            if track.opens_ns != before_ns:
                moved_ns = (anchor_ns + track.opens_ns) % self.plan.cycle_ns
                try:
                    with self.arming:
                        servers.arm(moved_ns)
                        self.anchor_ns = moved_ns
                except OperationError:
                    if not self.stop.is_set():
                        raise
                    yield before_ns  # asked to end meanwhile, which is no failure
                    continue
                self.show(anchor_ns=moved_ns)
                for place, one in enumerate(drifts):
                    one.expect(self.begins(place))
            yield track.opens_ns

    def drift_watches(self) -> list[DriftWatch]:
        """Watches over where chains begin, one for each first executor."""
        cores = set(available_cores()) - {server.core for server in self.plan.servers}
        watches: dict[tuple[int, ...], DriftWatch] = {}
        origins = threads.first_threads(self.plan, self.found)
        self.origins = [{one.identity for one in origin} for origin in origins]
        tids = [tuple(one.tid for one in origin) for origin in origins]
        for place, (chain, own) in enumerate(zip(self.plan.chains, tids, strict=True)):
            holding = {state.name for state in self.state.servers if own[0] in state.threads}
            slots = (one.slots for one in chain.servers if one.name in holding)
            # Where nothing stops it, short runs count too.
            stopped = self.gated and not self.early(place)
            if own not in watches:
                watches[own] = DriftWatch(
                    *(origins[place][0].pid, own, chain.cycle_ns),
                    self.begins(place),
                    next(slots, ()) if stopped else (),
                    cores=cores,
                )
        return [watches[one] for one in tids]

    def look_at(self, servers: BackEnd, drift_ns: int | None) -> None:
        """What the servers have done so far, and why the plan is no longer in force, if so."""
        counters, reason = servers.counters(), servers.failure()
        failure = None if reason is None else f"the servers failed: {reason}"
        # What we have started ends by itself, and has perhaps still to write down what it saw; and
        # a person may have ended both the application and us.
        ours = self.command is not None or self.stop.is_set()
        if failure is None and not ours and not any(one.threads for one in self.state.servers):
            failure = "the application has ended: no thread of the plan's nodes is left"
        self.show_servers(counters=defaultdict(ServerCounters, counters))
        self.show(drift_ns=drift_ns, failure=failure)

    def look_again(
        self, servers: BackEnd, latest: tuple[NodeThread, ...]
    ) -> tuple[tuple[NodeThread, ...], str]:
        """Threads that are new get what the plan says: these, and why they were not taken in."""
        before, now = self.found, self.find()
        new, ended = new_and_ended(before, now)
        over = {one.thread.identity for one in ended}
        fleeting = Counter(one.thread.pid for one in latest if one.thread.identity in over)
        for pid, times in fleeting.items():
            if times >= _FLEETING:
                self.note(
                    f"threads of process {pid} come and go: each has the class, cores and cgroup of"
                    " the thread that started it, and is left so"
                )
        self.name_strangers(now)
        self.name_absent(now)
        gone, servers_now = {one.thread.tid for one in ended}, self.state.servers
        left = {one.name: tuple(t for t in one.threads if t not in gone) for one in servers_now}
        self.show_servers(threads=left)
        self.found = now
        try:
            self.descendants = note_descendants(self.journal, self.descendants)
            if new:
                self.schedule()
                self.anchor_again(servers)
                self.assign(servers)
        except ChainshaperError as error:
            self.found = before
            reason = f"threads that have appeared are as they were: {error}"
            return new, "" if self.stop.is_set() else reason
        return new, ""

    def anchor_again(self, servers: BackEnd) -> None:
        """Where a node that begins a chain was started again, slots count from its new timer. That
        is measured before a server stops its thread, which would hide it.

        Raises OperationError: it has no regular beginning yet, or slots cannot be moved there.
        """
        origins = threads.first_threads(self.plan, self.found)
        now = [{one.identity for one in origin} for origin in origins]
        # An executor that has got another thread was not started again.
        again = {place for place, own in enumerate(now) if own.isdisjoint(self.origins[place])}
        if not again:
            return
        if self.waits_ns:
            timers = zip(self.plan.chains, self.waits_ns, strict=True)
            known = {
                place: Phase((self.anchor_ns + chain.offset_ns - wait_ns) % chain.cycle_ns, 0)
                for place, (chain, wait_ns) in enumerate(timers)
                if place not in again
            }
            given, anchor_ns, waits_ns, _ = threads.carried_out(
                *(self.given, self.found, None),
                gated=self.gated,
                progress=lambda _: self.go_on(),
                known=known,
            )
            with self.arming:
                moved = planned.with_slots_moved(given, self.moved_ns)
                plan = open_until_done(moved, waits_ns)
                table = threads.server_table(plan)
                if isinstance(servers, Freezer):
                    servers.change(table, anchor_ns)
                elif self.gated and table != threads.server_table(self.plan):
                    raise OperationError(
                        f"the back end {self.choice.name} cannot move slots of some chains only:"
                        " end the run, and apply the plan again"
                    )
                else:
                    servers.arm(anchor_ns)
                self.given, self.plan = given, plan
                self.anchor_ns, self.waits_ns = anchor_ns, waits_ns
            self.save_plan()
            self.show(anchor_ns=anchor_ns)
            self.tell(dict.fromkeys(range(len(origins)), 0))
            for chain in (self.plan.chains[place] for place in sorted(again)):
                self.note(
                    f"the node that begins {chain_name(chain)} was started again: slots count from"
                    " its new timer since"
                )
        self.end_drifts()

    def end_drifts(self) -> None:
        """Watch no longer where chains begin."""
        while self.drifts:
            self.drifts.pop().end()

    def name_strangers(self, found: Allocation) -> None:
        """One line about strangers who say they are nodes: the latest replaces the one before."""
        if found.strangers is not None:
            said = [one for one in self.state.notes if one.startswith(LEFT_ALONE)]
            self.note(found.strangers, instead=said)

    def name_absent(self, found: Allocation) -> None:
        """One line about receivers that do not run, or are not recognised, for as long as so."""
        running = {node for one in found.threads for node in one.nodes}
        absent = absent_receivers(self.plan.shaping_nodes, running)
        said = [one for one in self.state.notes if one.startswith(NOT_RECOGNISED)]
        reasons = "".join(f"; {reason}" for reason in self.unread)
        self.note(*filter(None, [absent and absent + reasons]), instead=said)

    def put_back(self) -> None:
        """Everything as it was: first let all threads go, then end our command, then the rest."""
        problems: list[str] = []
        self.end_drifts()
        for follower in self.followers.values():
            follower.end()
        if self.servers is not None:
            try:
                self.servers.release()
            except OperationError as error:
                problems.append(str(error))
        for telling in self.telling:
            telling.end()
        if self.command is not None:
            end_command(self.command)
        put_back(self.journal, self.guardians, problems)
