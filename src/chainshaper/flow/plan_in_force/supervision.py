"""The loop that watches over a plan in force: threads that come and go, timers, servers."""

import subprocess
import threading
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

from chainshaper.enforcement.freezer import Freezer
from chainshaper.enforcement.guardian import Guardians
from chainshaper.enforcement.node_threads import NodeThread, new_and_ended
from chainshaper.enforcement.scheduling_memory import note_descendants
from chainshaper.enforcement.servers import BackEnd, ServerCounters
from chainshaper.enforcement.undoing import RunState, ServerState
from chainshaper.flow.anchoring import carried_out
from chainshaper.flow.phase import Phase
from chainshaper.flow.plan_in_force.anchor import AnchoredPlan
from chainshaper.flow.plan_in_force.followers import Followers
from chainshaper.flow.plan_in_force.loops import LoopsInStep
from chainshaper.flow.plan_in_force.origins import OriginWatches, follow_timer
from chainshaper.flow.plan_in_force.phases import PhaseMessages
from chainshaper.flow.plan_in_force.report import RunReport
from chainshaper.flow.plan_in_force.threads import (
    LOOK_S,
    RunThreads,
    assign_threads,
    note_absent,
    note_strangers,
)
from chainshaper.flow.server_tables import server_table
from chainshaper.planning.offsets import chain_name
from chainshaper.planning.plan import open_until_done, with_slots_moved
from chainshaper.values.durations import duration_text
from chainshaper.values.errors import ChainshaperError, OperationError

PHASE_BOUND_NS = 250_000  # nodes get the beginning of cycles again when it has moved by more
SLOTS_S = 0.1  # so often it is looked where slots are to be
_FLEETING = 3  # so many threads that a look finds, and the next does not, are worth a note


@dataclass
class Supervision:
    """Watches over a run until it is to end."""

    anchored: AnchoredPlan
    threads: RunThreads
    report: RunReport
    phases: PhaseMessages
    followers: Followers
    loops: LoopsInStep
    origins: OriginWatches
    servers: BackEnd
    stop: threading.Event
    go_on: Callable[[], None]  # raises when the run is to end
    command: subprocess.Popen[bytes] | None = None
    guardians: Guardians | None = None
    descendants: set[tuple[int, int]] = field(default_factory=set)  # at the last look

    def watch_over(self, watch: Callable[[RunState], None]) -> None:
        """Look every second until the run is to end; the report then has its last state."""
        latest: tuple[NodeThread, ...] = ()
        unsaved = untaken = ""
        following: Iterator[int] = iter(())
        messages = _MovedOrigins()
        while True:
            if not self.origins.watches:  # at first, and when a chain begins anew
                self.origins.start(self.anchored, self.threads.latest, self.report)
                following = follow_timer(
                    self.anchored, self.servers, self.origins.watches, self.report, self.stop
                )
                messages = _MovedOrigins()
            is_over = self.command_has_ended or self.stop.is_set()
            self.note_blind_watches()
            followed_ns = next(following)
            moved = {place: ns + followed_ns for place, ns in self.seen_drifts().items()}
            self.end_messages()
            self.followers.show(self.report)
            self.loops.show(self.report, self.threads.latest)
            self.report.show_loops(kept.state for kept in self.loops.running.values())
            self.look_at_servers(max(moved.values(), key=abs, default=None))
            if is_over := is_over or self.report.state.failure is not None:
                self.report.state = replace(self.report.state, ended_ns=time.monotonic_ns())
            trouble = filter(None, (unsaved, untaken))
            shown = self.report.state
            shown = replace(shown, notes=(*shown.notes, *trouble))  # while it lasts
            unsaved = self.report.save(shown)
            watch(shown)
            if is_over:
                self.report.state = shown
                return
            self.send_moves(moved, followed_ns, messages)
            if self.follow_until_next_look(following):
                continue
            if self.guardians is not None:
                self.guardians.renew()
            latest, untaken = self.look_again(latest)

    def follow_until_next_look(self, following: Iterator[int]) -> bool:
        """Wait until it is time to look again; return whether the run is to end.

        Slots that open early for a chain's timer to be seen go back as soon as it was.
        """
        until = time.monotonic() + LOOK_S
        while (left := until - time.monotonic()) > 0:
            if self.stop.wait(min(left, SLOTS_S)):
                return True
            next(following)
        return self.stop.is_set()

    def note_blind_watches(self) -> None:
        """Note why it is not known any more where cycles begin."""
        for failure in {watch.failure for watch in self.origins.watches} - {None}:
            self.report.note(
                f"whether cycles begin elsewhere by now is not known any more: {failure}"
            )

    def seen_drifts(self) -> dict[int, int]:
        """How far (ns) chains begin from where they are expected, by their places.

        Where a look saw far more than the one before, the next one comes soon.
        """
        seen = {}
        for place, watch in enumerate(self.origins.watches):
            if (drift_ns := watch.surely_ns) is not None:
                seen[place] = drift_ns
                watch.look_soon |= (watch.latest_ns or 0) - drift_ns > PHASE_BOUND_NS
        return seen

    @property
    def command_has_ended(self) -> bool:
        return self.command is not None and self.command.poll() is not None

    def end_messages(self) -> bool:
        """Whether shaping nodes know where cycles begin, or never will, which is noted."""
        problems = self.phases.finished()
        if problems is None:
            return False
        self.report.note(*problems)
        return True

    def send_moves(
        self, moved: Mapping[int, int], followed_ns: int, messages: "_MovedOrigins"
    ) -> None:
        """Give shaping nodes the beginnings of cycles that have moved, and note these."""
        sent = messages.sent_ns
        new = {
            place: ns
            for place, ns in moved.items()
            if abs(ns - sent.get(place, 0)) > PHASE_BOUND_NS
        }
        if not new or self.phases.under_way:
            return
        sent.update(new)
        by_ns = {place: ns - followed_ns for place, ns in new.items()}
        self.phases.send(self.anchored, self.threads.latest, by_ns)
        notes = [
            f"the beginning of {chain_name(self.anchored.plan.chains[place])} has moved by"
            f" {duration_text(ns)} since the plan was put in force; shaping nodes get it,"
            " and outputs without a stamp follow from the next cycle"
            for place, ns in sent.items()
        ]
        self.report.note(*notes, instead=messages.notes)
        messages.notes = notes

    def look_at_servers(self, drift_ns: int | None) -> None:
        """Show what the servers have done, and why the plan is no longer in force, if so."""
        counters: Mapping[str, ServerCounters] = defaultdict(
            ServerCounters, self.servers.counters()
        )
        reason = self.servers.failure()
        failure = None if reason is None else f"the servers failed: {reason}"
        # What we have started ends by itself, and has perhaps still to write down what it saw; and
        # a person may have ended both the application and us.
        ours = self.command is not None or self.stop.is_set()
        has_threads = any(server.threads for server in self.report.state.servers)
        if failure is None and not ours and not has_threads:
            failure = "the application has ended: no thread of the plan's nodes is left"

        def with_counters(server: ServerState) -> ServerState:
            return replace(server, counters=counters[server.name])

        self.report.update_servers(with_counters)
        self.report.state = replace(self.report.state, drift_ns=drift_ns, failure=failure)

    def look_again(self, latest: Sequence[NodeThread]) -> tuple[tuple[NodeThread, ...], str]:
        """Give threads that are new what the plan says.

        ``latest`` are those that the look before found. Returns those that this one found, and why
        they were not taken in ("": they were).
        """
        plan, before = self.anchored.plan, self.threads.latest
        now = self.threads.find(plan)
        new, ended = new_and_ended(before, now)
        self.note_fleeting(latest, ended)
        note_strangers(self.report, now)
        note_absent(self.report, plan, now, self.threads.unread)
        gone = {listed.thread.tid for listed in ended}

        def with_living(server: ServerState) -> ServerState:
            return replace(server, threads=tuple(tid for tid in server.threads if tid not in gone))

        self.report.update_servers(with_living)
        self.threads.latest = now
        try:
            self.descendants = note_descendants(self.threads.journal, self.descendants)
            if new:
                self.threads.schedule(self.anchored.plan, self.anchored.back_end)
                self.anchor_again()
                assign_threads(self.threads, self.anchored, self.servers, self.report, self.go_on)
        except ChainshaperError as error:
            self.threads.latest = before
            reason = f"threads that have appeared are as they were: {error}"
            return new, "" if self.stop.is_set() else reason
        return new, ""

    def note_fleeting(self, latest: Sequence[NodeThread], ended: Sequence[NodeThread]) -> None:
        """Note processes of which a look finds threads that are gone at the next."""
        over = {listed.thread.identity for listed in ended}
        fleeting = Counter(item.thread.pid for item in latest if item.thread.identity in over)
        for pid, times in fleeting.items():
            if times >= _FLEETING:
                self.report.note(
                    f"threads of process {pid} come and go: each has the class, cores and cgroup of"
                    " the thread that started it, and is left so"
                )

    def anchor_again(self) -> None:
        """Count slots from the new timer of a node that begins a chain and was started again.

        The timer is measured before a server stops its thread, which would hide it.

        Raises OperationError: it has no regular beginning yet, or slots cannot be moved there.
        """
        anchored = self.anchored
        again = self.origins.restarted(anchored.plan, self.threads.latest)
        if not again:
            return
        if anchored.waits_ns:
            self.measure_again(again)
            anchored.save(self.report.folder)
            self.report.state = replace(self.report.state, anchor_ns=anchored.anchor_ns)
            places = range(len(anchored.plan.chains))
            self.phases.send(anchored, self.threads.latest, dict.fromkeys(places, 0))
            for place in sorted(again):
                self.report.note(
                    f"the node that begins {chain_name(anchored.plan.chains[place])} was started"
                    " again: slots count from its new timer since"
                )
        self.origins.end()

    def measure_again(self, again: set[int]) -> None:
        """Measure the timers of chains (by their places), and move the servers' slots there."""
        anchored = self.anchored
        timers = zip(anchored.plan.chains, anchored.waits_ns, strict=True)
        known = {
            place: Phase((anchored.anchor_ns + chain.offset_ns - wait_ns) % chain.cycle_ns, 0)
            for place, (chain, wait_ns) in enumerate(timers)
            if place not in again
        }
        given, anchor_ns, waits_ns, _ = carried_out(
            anchored.given,
            self.threads.latest,
            None,
            gated=anchored.gated,
            progress=lambda _: self.go_on(),
            known=known,
        )
        with anchored.lock:
            plan = open_until_done(with_slots_moved(given, anchored.moved_ns), waits_ns)
            table = server_table(plan)
            if isinstance(self.servers, Freezer):
                self.servers.change(table, anchor_ns)
            elif anchored.gated and table != server_table(anchored.plan):
                raise OperationError(
                    f"the back end {anchored.back_end} cannot move slots of some chains only:"
                    " end the run, and apply the plan again"
                )
            else:
                self.servers.arm(anchor_ns)
            anchored.given, anchored.plan = given, plan
            anchored.anchor_ns, anchored.waits_ns = anchor_ns, waits_ns


@dataclass
class _MovedOrigins:
    """What shaping nodes were given since chains' origins are watched."""

    sent_ns: dict[int, int] = field(default_factory=dict)  # by chains' places, how far they moved
    notes: list[str] = field(default_factory=list)  # what was noted of that
