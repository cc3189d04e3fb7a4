"""Watching the chains of an application that runs: `chainshaper watch`.

    memories of the nodes ─► events of the last seconds ─► traversals ─► figures over three spans

The library of :mod:`chainshaper.sources.preload` is in front of ROS 2 in each process. The watch
reads its memory in the process, and changes nothing there. Every look runs the analysis of
`chainshaper latency` over the last few seconds and adds the cycles that are surely over: those that
began longer ago than a cycle may take. So the figures are those of a recording of the same time.
Memory does not grow: events are kept for seconds, and cycles, as four numbers each, for an hour.
"""

import contextlib
import time
from collections import Counter, deque
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
from numpy.typing import NDArray

from chainshaper.analysis import (
    DataFlow,
    SeveralPathsError,
    data_flow,
    find_chain,
    graph_of,
    traverse,
)
from chainshaper.analysis.data_age import count_uses, data_age, use_shares
from chainshaper.analysis.disturbance import Due, with_punctuality
from chainshaper.analysis.latency import Longest, longest_times
from chainshaper.analysis.messages import has_stampless
from chainshaper.analysis.objects import Objects, resolve_objects
from chainshaper.analysis.statistics import LatencyStatistics, latency_statistics
from chainshaper.analysis.traversals import OWES_NO_OUTPUT, Traversals
from chainshaper.enforcement.undoing import LoopState, find_runs
from chainshaper.monitor.metrics import (
    EVERY_MS,
    LONGEST_END_MS,
    check_endpoint,
    delivery_news,
    serving,
)
from chainshaper.monitor.watched_loops import LoopNow, WatchedLoops
from chainshaper.planning import ChainPlan, Plan
from chainshaper.planning.plan import declared_in
from chainshaper.planning.plan_file import plan_values
from chainshaper.robot.clocks import clock_offset
from chainshaper.sources.preload import (
    NO_PROCESS,
    TracedProcess,
    creation_tables,
    event_tables,
    joined_tables,
    memories,
    named_loops,
)
from chainshaper.sources.system import info_of, own_pid_namespace, processes_of
from chainshaper.sources.tracing_library import TracingLibrary
from chainshaper.splicing.shaped_outputs import find_outputs
from chainshaper.values import events
from chainshaper.values.application import ApplicationGraph, Callback, Chain
from chainshaper.values.errors import InputError, OperationError, extra_library
from chainshaper.values.events import EventTables
from chainshaper.values.handed_over import Through
from chainshaper.values.recording import InForceInfo, Recording, refuse_existing, write_recording
from chainshaper.verify.measure import PARTS
from chainshaper.verify.predictions import due_of
from chainshaper.verify.promises import OutputsDue

SECOND = 1_000_000_000
SPANS = {"second": SECOND, "minute": 60 * SECOND, "hour": 3600 * SECOND}
RECORDER_NS = 10 * SECOND
"""How much of the past :meth:`Watch.save` writes."""

_SEARCH_NS = 5 * SECOND  # between two searches for new processes
_FIRST_SEARCH_NS = SECOND  # the same, while there are none
_STEP_NS = 1_000_000  # of CLOCK_REALTIME: more than reading its offset can be off
_AHEAD_NS = 100_000  # stamps and phases are not exact: outputs seem to leave before their slot


@dataclass(frozen=True)
class Hop:
    """A callback of the chain: its shares of the latency over the last minute."""

    node: str
    topic: str  # that it publishes
    communication_ns: float  # mean
    computation_ns: float  # mean
    waiting_ns: float  # mean
    longest_ns: tuple[int | None, ...]  # of each share, in the order of `PARTS`


@dataclass(frozen=True)
class CallbackNow:
    """A callback and its longest times over the last minute."""

    node: str
    starts: str  # the topic that starts it, or its timer's declared period
    longest_ns: Longest  # response and execution time; None: not known


@dataclass(frozen=True)
class AgeNow:
    """What the chain's loop worked with over the last minute, over all of its cycles."""

    at_loop: LatencyStatistics  # how old the messages were when it read them
    never: float | None  # share of the messages that no cycle used; None: none came
    again: float | None  # share of those that several cycles used


@dataclass(frozen=True)
class ChainNow:
    """The figures of one chain at one look.

    ``counted`` has the cycles since the watch began:

    * ``complete``, and of these ``late``;
    * ``incomplete``;
    * ``unclear``: CLOCK_REALTIME was set, and before Iron no event says which message was whose;
    * ``not_used``: the chain's timer or synchroniser used a newer message, so no output is missing.
    """

    chain: str
    spans: Mapping[str, LatencyStatistics]  # by span (SPANS), over all cycles that began in it
    rate_hz: float  # at which cycles began, over the last minute
    hops: tuple[Hop, ...]
    shares: tuple[float, ...]  # of outputs in each of the plan's slots, over the hour; () without
    early: float  # share of outputs before the first slot, over the hour
    promised_ns: int | None  # the end of the last slot, as it is now
    moved_ns: int  # how far slots are behind those of the plan
    counted: Mapping[str, int]
    problem: str | None  # why nothing goes through the chain
    outputs: OutputsDue  # over the hour
    kept: bool | None  # whether they keep the plan's promise; None: no plan, or no cycle
    age: AgeNow | None = None  # None: no loop reads what the chain stores


@dataclass(frozen=True)
class Seen:
    """What one look shows."""

    at_ns: int  # its instant (CLOCK_MONOTONIC)
    processes: Mapping[int, str]  # the node of each, by pid
    lost: int  # events that were overwritten before they were read, or found no room
    chains: tuple[ChainNow, ...]
    callbacks: tuple[CallbackNow, ...] = ()  # where the watch was asked for them
    left_out: tuple[str, ...] = ()  # which processes with the library are not seen, and why
    loops: tuple[LoopNow, ...] = ()
    missed: tuple[str, ...] = ()  # which loops missed their rate, when, and who ran on their core
    in_step: tuple[LoopState, ...] = ()  # loops that runs of this machine keep in step

    def as_json(self) -> dict[str, Any]:
        return asdict(self)

    def as_diagnostics(self) -> list[dict[str, Any]]:
        """Return a status for each chain, and each loop in step, as `/diagnostics` has it.

        ERROR: there was no output in the last minute, or the loop is not there. WARN: an output was
        late or never came; the loop is not in step, or missed it in the last minute. They are for
        :func:`~chainshaper.sources.ros.publishing_diagnostics`.
        """
        statuses = []
        for chain in self.chains:
            minute = chain.spans["minute"]
            missing = OutputsDue.of(minute.count, minute.late, minute.incomplete).missed
            level, text = 2, chain.problem or "no output in the last minute"
            if minute.count:
                level = int(missing > 0)
                text = f"{minute.count} outputs in the last minute, {missing} late or missing"
            values = {"cycles per second": f"{chain.rate_hz:.3f}"}
            for span, figures in chain.spans.items():
                shown = (("p50", figures.percentiles_ns.get("50")), ("max", figures.max_ns))
                for statistic, ns in shown:
                    if ns is not None:
                        values[f"{statistic} of the last {span} [ms]"] = f"{ns / 1e6:.3f}"
            about = {"name": f"chainshaper: {chain.chain}", "level": level, "message": text}
            statuses.append({**about, "values": values})
        return [*statuses, *map(self._status_of, self.in_step)]

    def _status_of(self, loop: LoopState) -> dict[str, Any]:
        """Return the status of a loop in step."""
        level = 2 if not loop.is_there else int(loop.misses > 0 or not loop.in_step)
        times = {
            "lead [ms]": loop.lead_ns,
            "phase error [ms]": loop.error_ns,
            "moved by [ms]": loop.moved_ns,
            "age of its data [ms]": loop.age_ns,
        }
        values = {name: f"{ns / 1e6:.3f}" for name, ns in times.items() if ns is not None}
        if loop.drift_ppm is not None:
            values["drift [ppm]"] = f"{loop.drift_ppm:.1f}"
        values["moved"] = loop.moves
        values["starts in the last minute"] = str(loop.starts)
        values["misses in the last minute"] = str(loop.misses)
        missed = [watched.misses for watched in self.loops if watched.rate.node == loop.loop]
        if missed:
            values["misses of its rate in the last minute"] = str(sum(missed))
        about = {"name": f"chainshaper: {loop.name} in step", "level": level, "message": loop.text}
        return {**about, "values": values}


_SAME = ("node", "kind", "topic", "declared_ns")
"""Two callbacks that agree in these are one callback, whose node was started again."""
_CYCLE = pl.Schema(
    {"start": pl.Int64, "latency_ns": pl.Int64, "late": pl.Boolean, "place_ns": pl.Int64}
)


@dataclass
class _Chain:
    """A watched chain and its cycles of the last hour.

    Columns of ``cycles``, a row for each, in the order in which they began:
        start: when it began (CLOCK_MONOTONIC, ns).
        latency_ns: of its output; null: it has none.
        late: whether the output left behind the cycle it was due in.
        place_ns: where in the cycle it left, counted from the anchor.

    Columns of a frame of ``hops``, a row for each hop, with the instant of the look it is of:
        hop: its place in the chain.
        communication_ns, computation_ns, waiting_ns: sums over cycles.
        longest_communication_ns, longest_computation_ns, longest_waiting_ns: of one cycle.
        count: how many cycles.

    ``ages`` has the cycles and messages of the chain's loop (:func:`_ages`).
    """

    text: str
    output: str  # its topic, as far as that is known
    slots: tuple[tuple[int, int], ...]
    cycles: pl.DataFrame = field(default_factory=lambda: pl.DataFrame(schema=_CYCLE))
    hops: deque[tuple[int, pl.DataFrame]] = field(default_factory=deque)
    ages: deque[tuple[int, tuple[pl.DataFrame, pl.DataFrame]]] = field(default_factory=deque)
    names: list[tuple[str, str]] = field(default_factory=list)  # node and topic of each hop
    first: Callback | None = None  # where cycles began when the chain was seen last
    counted: Counter[str] = field(
        default_factory=lambda: Counter(complete=0, late=0, incomplete=0, unclear=0, not_used=0)
    )
    problem: str | None = None

    def take_over(self, traversals: pl.DataFrame, hops: pl.DataFrame, now_ns: int) -> None:
        """Add cycles that are over, with their hops."""
        recent = self.cycles.filter(pl.col("start") > now_ns - SPANS["hour"])
        new = traversals.select(_CYCLE.names()).cast(_CYCLE)
        # Else each look of the hour is a chunk, and the next looks take 100 times as long.
        self.cycles = pl.concat([recent, new], rechunk=True)
        complete = int(traversals["complete"].sum())
        self.counted["complete"] += complete
        self.counted["incomplete"] += traversals.height - complete
        self.counted["late"] += int(traversals["late"].sum() or 0)
        of_complete = hops.join(traversals.filter("complete"), on="traversal", how="semi")
        if of_complete.height:
            shares = pl.col([f"{part}_ns" for part in PARTS])
            most = shares.max().name.prefix("longest_")
            figures = of_complete.group_by("hop").agg(shares.sum(), most, count=pl.len())
            self.hops.append((now_ns, figures))

    def statistics(self, since_ns: int) -> LatencyStatistics:
        """Return statistics over the cycles that began since an instant."""
        begun = self.cycles.filter(pl.col("start") >= since_ns)
        whole = begun.drop_nulls("latency_ns")
        late = None if whole["late"].null_count() else int(whole["late"].sum())
        return latency_statistics(
            whole["latency_ns"].to_numpy(), incomplete=begun.height - whole.height, late=late
        )

    def age(self) -> AgeNow | None:
        """Return what the chain's loop worked with."""
        if not self.ages:
            return None
        cycles, messages = (
            pl.concat([of_look[place] for _, of_look in self.ages]) for place in (0, 1)
        )
        known = cycles.drop_nulls("traversal")["age_at_loop_ns"]
        uses, _ = count_uses(cycles, messages)
        return AgeNow(latency_statistics(known.to_numpy()), *use_shares(uses))

    def worst_ns(self, since_ns: int) -> tuple[int, ...]:
        """Return the start of the worst cycle since an instant: without output, or the longest."""
        rows = self.cycles.filter(pl.col("start") >= since_ns)
        worst = rows.sort("latency_ns", descending=True, nulls_last=False, maintain_order=True)
        return tuple(worst["start"].head(1))

    def shares(self) -> tuple[tuple[float, ...], float]:
        """Return the share of outputs within each slot, and that of those before the first one."""
        places = self.cycles.drop_nulls("latency_ns")["place_ns"].drop_nulls().to_numpy()
        if not self.slots or not places.size:
            return (), 0.0
        opens, closes = np.array(self.slots).T
        slots = np.searchsorted(opens, places + _AHEAD_NS, side="right") - 1
        inside = (slots >= 0) & (places < closes[slots])
        counted = np.bincount(slots[inside], minlength=opens.size)
        return tuple((counted / places.size).tolist()), float((slots < 0).mean())

    def beginning(self, graph: ApplicationGraph) -> Chain | None:
        """Return the first callback as a chain, where the whole chain is no longer there."""
        if self.first is None:
            return None
        topic = self.names[0][1]
        for callback in graph.callbacks:
            alike = (getattr(callback, name) == getattr(self.first, name) for name in _SAME)
            if all(alike) and topic in callback.publishes:
                return Chain(self.text, (callback.id,), (topic,))
        return None


def _is_running(pid: int) -> bool:
    return Path(f"/proc/{pid}").exists()


def _forget(timed: deque[tuple[int, Any]], before_ns: int) -> None:
    """Drop the entries from before an instant, with which each begins."""
    while timed and timed[0][0] < before_ns:
        timed.popleft()


class Watch:
    """Follows the chains of an application that runs, or will run, with the library in front.

    ``chains`` are written as for `--chain`. Processes of ``users`` are followed. A cycle that takes
    longer than ``longest_ns`` counts as incomplete. ``plan`` says when outputs are due. With
    ``callbacks`` the watch follows the times of all callbacks, too. ``loops`` are names of loops
    that are looked for; all that are seen are followed. ``through`` is what no event shows, and the
    user declares (:mod:`~chainshaper.values.handed_over`). Call :meth:`read` every tenth of a
    second or so between two looks, or events are overwritten before they are read.
    """

    def __init__(
        self,
        chains: Sequence[str],
        *,
        users: Collection[int],
        plan: Plan | None = None,
        longest_ns: int = 2 * SECOND,
        callbacks: bool = False,
        loops: Sequence[str] = (),
        through: Through = (),
    ) -> None:
        declared = () if plan is None else declared_in(plan)
        self.through = tuple(dict.fromkeys((*through, *declared)))
        self._named_loops = loops
        self.callbacks: deque[tuple[int, Any]] | None = deque() if callbacks else None
        self.loops = WatchedLoops()
        self.users, self.plan, self.longest_ns = users, plan, longest_ns
        self.due = [] if plan is None else [due for chain in plan.chains for due in due_of(chain)]
        ends = [(text, text.rpartition("..")[2]) for text in chains]
        self.chains = [_Chain(text, end, self._slots(end)) for text, end in ends]
        self.processes: dict[int, TracedProcess] = {}
        # By pid, a sentence that says why nothing is seen of it.
        self._left_out: dict[int, str] = {}
        self._created: dict[int, tuple[int, dict[str, pl.DataFrame], TracingLibrary]] = {}
        self._fresh: list[tuple[int, NDArray[Any]]] = []  # pid and records, not yet in a table
        self._recent: deque[tuple[int, dict[str, pl.DataFrame]]] = deque()  # last instant, events
        self._latest: dict[int, int] = {}  # by pid, the time of its last event
        self._tabled_ns = 0
        self._stepped_ns = 0  # when CLOCK_REALTIME was set: cycles from before are unclear
        self._basis: list[tuple[Any, ...]] = []  # of the objects below: see `_objects`
        self._resolved = resolve_objects({})
        self._clock_offset_ns = clock_offset()
        self._searched_ns = 0
        self._lost_with_ended = 0
        self._over_ns = time.monotonic_ns()  # cycles that began until then are counted
        self._looked_from_ns = self._over_ns  # the last look counted cycles from then on
        self._began_ns = self._over_ns

    def _due(self, output: str) -> Due | None:
        return next((due for due in self.due if due.output in (None, output)), None)

    def _plan_of(self, output: str) -> ChainPlan | None:
        """Return the plan whose promise is about a chain with this output."""
        plans = () if self.plan is None else self.plan.chains
        return next((plan for plan in plans if plan.chain.output in (None, output)), None)

    def _slots(self, output: str) -> tuple[tuple[int, int], ...]:
        due = self._due(output) or Due(0)
        delay = due.cycles * due.cycle_ns
        return tuple((start + delay, end + delay) for start, end in due.slots)

    def read(self) -> None:
        """Read what is new in all memories, and search for new processes now and then."""
        now = time.monotonic_ns()
        searches = now - self._searched_ns > (_SEARCH_NS if self.processes else _FIRST_SEARCH_NS)
        if searches:
            self._searched_ns = now
            self._left_out = {
                pid: reason for pid, reason in self._left_out.items() if _is_running(pid)
            }
            followed = {*self.processes, *self._left_out}
            for pid, memory in memories(self.users, followed, self._left_out.__setitem__):
                self.processes[pid], self._latest[pid] = memory, 0
                created, _ = memory.objects()
                if created.size and created["time"][0] < self._began_ns:
                    self._take(pid, memory, self._began_ns)
                    memory.lost = 0  # before the watch began
        for pid, process in self.processes.items():
            self._take(pid, process)
        self.loops.look_at_cores(now)
        if now - self._tabled_ns > SECOND:
            self._take_fresh(now)
        # Processes that have ended stay until their last events are too old to be asked for.
        for pid in self._ended() if searches else ():
            if self._latest[pid] < self._needed_ns(now):
                process = self.processes.pop(pid)
                self._lost_with_ended += process.lost + process.dropped
                self._created.pop(pid, None)
                del self._latest[pid]

    def _take(self, pid: int, process: TracedProcess, since_ns: int = 0) -> None:
        for part in process.new_records():
            new = part[part["time"] >= since_ns] if since_ns else part
            if new.size:
                self._fresh.append((pid, new))
                self._latest[pid] = max(self._latest[pid], int(new["time"][-1]))

    def _ended(self) -> list[int]:
        return [pid for pid in self.processes if not _is_running(pid)]

    def _needed_ns(self, now_ns: int) -> int:
        """From when on events are needed, by :meth:`save` or by a look that comes late."""
        return min(now_ns - RECORDER_NS, self._looked_from_ns) - self.longest_ns

    def look(self) -> Seen:
        """Look at all chains; cycles that began ``longest_ns`` ago or earlier are counted."""
        # Before it reads: it may be held up meanwhile, and has not read what came then.
        now = time.monotonic_ns()
        self.read()
        offset = clock_offset()
        if abs(offset - self._clock_offset_ns) > _STEP_NS:
            self._stepped_ns = time.monotonic_ns()
        self._clock_offset_ns = offset
        over = now - self.longest_ns
        since = now - 2 * self.longest_ns - (over - self._over_ns)
        tables = self._tables(since)
        objects, ended = self._objects(tables, since), self._ended()
        flow = data_flow(tables, self._clock_offset_ns, objects, ended=ended)
        flow = replace(flow, through=self.through)
        moved = dict[str, int]()
        if self.plan:  # a page of another user says nothing of the outputs that are watched
            watched = (output for output in find_outputs() if output.user in self.users)
            moved = {output.topic: output.moved_ns for output in watched}
        # Where publications carry no stamp, the clock's offset says which one was taken.
        stampless = has_stampless(flow.publications)
        clear_ns = self._stepped_ns if stampless else 0
        within = pl.col("start").is_between(self._over_ns, over, "right")
        doubts = list[str]()
        graph = graph_of(flow, doubts)
        for chain in self.chains:
            _forget(chain.hops, now - SPANS["minute"])
            _forget(chain.ages, now - SPANS["minute"])
            traversed = self._judged(chain, flow, graph, doubts)
            if traversed is None:
                continue
            judged, hops, traversals = traversed
            if chain.problem is None:
                ages = _ages(flow, traversals, graph, (self._over_ns + 1, over))
                chain.ages += [] if ages is None else [(now, ages)]
            begun = judged.filter(within)
            # A lifecycle node that is not active owes no output, nor does an older message.
            idle = pl.col("reason").is_in(OWES_NO_OUTPUT).fill_null(False)
            new = begun.filter(~idle)
            new = new.with_columns(pl.col("place_ns") - moved.get(chain.output, 0))
            clear = new.filter(pl.col("start") > clear_ns)
            chain.take_over(clear, hops, now)
            chain.counted["not_used"] += begun.filter(reason="not used").height
            chain.counted["unclear"] += new.height - clear.height
        if self.callbacks is not None:
            of_over = replace(flow, instances=flow.instances.filter(within))
            self.callbacks.append((now, longest_times(of_over)))
            _forget(self.callbacks, now - SPANS["minute"])
        running = [process.pid for pid, process in self.processes.items() if pid not in ended]
        missed = self.loops.take(flow, self._over_ns, over, offset, running)
        self._looked_from_ns, self._over_ns = self._over_ns, over
        return Seen(
            at_ns=now,
            processes=processes_of(tables, dict.fromkeys(self.processes, "")),
            lost=self.lost,
            chains=tuple(self._now(chain, over, moved) for chain in self.chains),
            callbacks=tuple(_callbacks([times for _, times in self.callbacks or ()])),
            left_out=tuple(self._left_out.values()),
            loops=self.loops.now(),
            missed=tuple(miss.text for miss in missed),
            in_step=tuple(self._in_step()),
        )

    def _in_step(self) -> Iterator[LoopState]:
        """Yield the loops that runs keep in step whose plans are in force."""
        for journal, state in find_runs():
            if state is not None and journal.owner is not None:
                yield from state.loops

    def _judged(
        self, watched: _Chain, flow: DataFlow, graph: ApplicationGraph, doubts: Sequence[str]
    ) -> tuple[pl.DataFrame, pl.DataFrame, Traversals] | None:
        """Return the judged traversals of a chain, their hops, and all of them; None: no chain.

        ``doubts`` say what was declared and cannot be, which may be why there is no chain.

        Where only its beginning is in the graph, each cycle that began is incomplete.
        """
        watched.problem, chain = None, None
        try:
            chain = find_chain(graph, watched.text)
        except InputError as error:
            if self.processes:
                watched.problem = "; ".join([str(error), *doubts])
            else:
                watched.problem = " ".join(self._left_out.values()) or NO_PROCESS
            # Every cycle that is over had its events here: none of them has arrived.
            if not isinstance(error, SeveralPathsError):
                chain = watched.beginning(graph)
        if chain is None:
            return None
        traversals = traverse(flow, chain, graph)
        judged, _ = with_punctuality(flow, traversals, self._due(chain.topics[-1]))
        if watched.problem is not None:
            judged = judged.with_columns(latency_ns=None, late=None, complete=False)
            return judged, traversals.hops, traversals
        path = graph.path(chain)
        watched.first, watched.output = path[0], chain.topics[-1]
        watched.slots = self._slots(watched.output)  # the text may end with a node
        watched.names = [
            (callback.node or "", topic) for callback, topic in zip(path, chain.topics, strict=True)
        ]
        return judged, traversals.hops, traversals

    def _objects(self, tables: EventTables, since_ns: int) -> Objects:
        """Return the objects of all processes: those of the last look, if none can have come since.

        To resolve them is half of the work of a look. Objects of Python nodes become known only
        when a callback runs or a subscription takes, so these are compared, too.
        """
        columns_of_runs = [("callback_start", "callback"), ("rmw_take", "rmw_subscription_handle")]
        basis = [tuple(sorted((pid, created[0]) for pid, created in self._created.items()))]
        for name, column in columns_of_runs:
            rows = events.table(tables, name).select("pid", column).unique()
            basis.append(tuple(sorted(rows.iter_rows())))
        times = (tables[name]["time"][-1] for name in events.CREATION & tables.keys())
        if basis != self._basis or max(times, default=0) >= since_ns:
            self._basis, self._resolved = basis, resolve_objects(tables)
        return self._resolved

    def _now(self, chain: _Chain, over_ns: int, moved: Mapping[str, int]) -> ChainNow:
        """Return the figures of a chain whose cycles until ``over_ns`` are counted."""
        moved_ns = moved.get(chain.output, 0)
        begun = chain.cycles["start"].filter(chain.cycles["start"] > over_ns - SPANS["minute"])
        shares, early = chain.shares()
        lasted = begun[-1] - begun[0] if len(begun) > 1 else 0
        spans = {name: chain.statistics(over_ns - span) for name, span in SPANS.items()}
        hour, plan = spans["hour"], self._plan_of(chain.output)
        outputs = OutputsDue.of(hour.count, hour.late, hour.incomplete, plan)
        return ChainNow(
            chain=chain.text,
            spans=spans,
            rate_hz=(len(begun) - 1) * SECOND / lasted if lasted else 0.0,
            hops=tuple(_hops(chain)),
            shares=shares,
            early=early,
            promised_ns=chain.slots[-1][1] + moved_ns if chain.slots else None,
            moved_ns=moved_ns,
            counted=dict(chain.counted),
            problem=chain.problem,
            outputs=outputs,
            kept=outputs.kept,
            age=chain.age(),
        )

    def unseen_loops(self) -> list[str]:
        """Say which of the named loops have not been seen, and why."""
        tables = self._tables(time.monotonic_ns() - RECORDER_NS)
        notes = list(named_loops.notes(self._named_loops, tables))
        remedy = f"If it was not started here, start it behind `{named_loops.STARTED_SO}`."
        return [f"{note} {remedy}" for note in notes]

    @property
    def lost(self) -> int:
        """Events that were overwritten before they were read, or found no room."""
        running = sum(process.lost + process.dropped for process in self.processes.values())
        return running + self._lost_with_ended

    def _tables(self, since_ns: int) -> EventTables:
        """Return events since an instant, and the creation of objects, without ended processes'."""
        self._take_fresh(time.monotonic_ns())
        silent = {pid for pid in self._ended() if self._latest[pid] < since_ns}
        created = (tables for pid, (_, tables, _) in self._created.items() if pid not in silent)
        recent = (tables for last_ns, tables in self._recent if last_ns >= since_ns)
        return joined_tables([*created, *recent])

    def _take_fresh(self, now_ns: int) -> None:
        """Make tables of the records that were read since the last time; drop tables too old."""
        by_library: dict[TracingLibrary, list[tuple[NDArray[Any], int]]] = {}
        for pid, process in self.processes.items():
            asked = int(process.header["objects"][0])
            if pid not in self._created or self._created[pid][0] != asked:
                self._created[pid] = (asked, *creation_tables(process))
        for pid, part in self._fresh:
            parts = by_library.setdefault(self._created[pid][2], [])
            parts.append((part, self.processes[pid].pid))
        for library, parts in by_library.items():
            records = np.concatenate([part for part, _ in parts])
            pids = np.repeat([pid for _, pid in parts], [part.size for part, _ in parts])
            tables = event_tables(records, pids.astype(np.int32), library)
            self._recent.append((int(records["time"].max()), tables))
        self._fresh, self._tabled_ns = [], now_ns
        _forget(self._recent, self._needed_ns(now_ns))

    def save(self, output: str | Path, *, reasons: Sequence[str] = ()) -> Recording:
        """Write the last ten seconds as a recording, or more if the last look had cycles before.

        ``reasons`` for it stand in its notes. `report` shows the worst cycle of each chain first.

        Raises InputError: the folder exists. OperationError: it cannot be written, or there is
        nothing to be written.
        """
        output = refuse_existing(output)
        self.read()
        # The last look's cycles are in it.
        since = self._needed_ns(time.monotonic_ns()) + self.longest_ns
        tables = events.happened(self._tables(since), since)
        if not tables:
            raise OperationError(f"{output} is not written: no event has been seen yet")
        versions = (library.version for _, _, library in self._created.values())
        facts: dict[str, Any] = {
            "clock_offset_ns": self._clock_offset_ns,
            "pid_namespace": own_pid_namespace(),
            "chain": self.chains[0].text if self.chains else None,
            "through": self.through,
            "notes": (
                "the last seconds before it was asked for; objects from before them are there",
                *reasons,
                *self._left_out.values(),
            ),
            "worst_ns": tuple(
                start_ns for chain in self.chains for start_ns in chain.worst_ns(since)
            ),
        }
        if self.plan is not None:
            facts["plan"] = plan_values(self.plan)
            facts["in_force"] = InForceInfo(since_ns=since)
        info = info_of("preload", tables, versions, {}, self.lost, **facts)
        return write_recording(output, tables, info)


def _hops(chain: _Chain) -> Iterator[Hop]:
    """Yield the hops of a chain with their shares over the last minute."""
    if not chain.hops:
        return
    figures = pl.concat([frame for _, frame in chain.hops]).group_by("hop")
    sums = figures.agg(pl.exclude("^longest_.*$").sum(), pl.col("^longest_.*$").max()).sort("hop")
    for row in sums.iter_rows(named=True):
        communication, computation, waiting = (row[f"{part}_ns"] / row["count"] for part in PARTS)
        longest = tuple(row[f"longest_{part}_ns"] for part in PARTS)
        node, topic = chain.names[row["hop"]]
        yield Hop(node, topic, communication, computation, waiting, longest)


def _ages(
    flow: DataFlow, traversals: Traversals, graph: ApplicationGraph, between: tuple[int, int]
) -> tuple[pl.DataFrame, pl.DataFrame] | None:
    """Return what the chain's loop worked with in its cycles that began in a time; None: no loop.

    The first frame has its cycles (``start``, ``traversal``, ``age_at_loop_ns``), the second the
    messages that came (``traversal``, ``stored``). In both ``traversal`` is when it began, which
    names it in each look alike.
    """
    age = data_age(flow, traversals, graph, between)
    if age is None:
        return None
    begun = traversals.frame.select("traversal", begun="start")
    cycles = age.cycles.join(begun, on="traversal", how="left", maintain_order="left")
    messages = age.messages.join(begun, on="traversal", how="left", maintain_order="left")
    return (
        cycles.select("start", "age_at_loop_ns", traversal="begun"),
        messages.select("stored", traversal="begun"),
    )


def _callbacks(looks: Sequence[Mapping[tuple[str, str], Longest]]) -> Iterator[CallbackNow]:
    """Yield the longest times of each callback over some looks, by node and what starts it."""
    for node, starts in dict.fromkeys(name for times in looks for name in times):
        longest = [times[node, starts] for times in looks if (node, starts) in times]
        response, execution = (
            max((time_ns for time_ns in times if time_ns is not None), default=None)
            for times in zip(*(of_look.times for of_look in longest), strict=True)
        )
        yield CallbackNow(node, starts, Longest(response, execution, longest[-1].shown))


@contextlib.contextmanager
def exporting(
    port: int | None = None, endpoint: str | None = None
) -> Iterator[Callable[[Seen], list[str]]]:
    """Export metrics of the last look: OpenMetrics on a local port, OTLP to an HTTP endpoint.

    Yields a function that takes each look and returns the sentences about the collector since the
    last one. Times are in seconds, as both conventions have it; cycles count from the beginning of
    the watch.

    Raises PlatformError: the OpenTelemetry SDK is not installed. OperationError: no such port.
    InputError: no such endpoint.
    """
    if port is None and endpoint is None:
        yield lambda _: []
        return
    library = partial(extra_library, purpose="exporting metrics", extra="metrics")
    metrics, export = (library(f"opentelemetry.sdk.metrics{sub}") for sub in ("", ".export"))
    observation = library("opentelemetry.metrics").Observation
    readers, news = [], list[Callable[[], list[str]]]()
    with contextlib.ExitStack() as until:
        if endpoint is not None:
            check_endpoint(endpoint)
        if port is not None:
            until.enter_context(serving(port, library("prometheus_client").MetricsHandler))
            readers.append(library("opentelemetry.exporter.prometheus").PrometheusMetricReader())
        if endpoint is not None:
            otlp = library("opentelemetry.exporter.otlp.proto.http.metric_exporter")
            exporter = otlp.OTLPMetricExporter(endpoint=endpoint)
            news.append(delivery_news(exporter, endpoint))
            readers.append(export.PeriodicExportingMetricReader(exporter, EVERY_MS))
        provider = metrics.MeterProvider(metric_readers=readers)
        until.callback(provider.shutdown, timeout_millis=LONGEST_END_MS)
        meter, last = provider.get_meter("chainshaper"), list[Seen]()

        def observed(metric: str, _options: object) -> Iterator[Any]:
            for seen in last:
                for name, value, about in _values(seen):
                    if name == metric:
                        yield observation(value, about)

        for name, (kind, unit, about) in _METRICS.items():
            create = getattr(meter, f"create_observable_{kind}")
            values = [partial(observed, name)]
            create(f"chainshaper.{name}", values, unit=unit, description=about)

        def take(seen: Seen) -> list[str]:
            last[:] = [seen]
            return [sentence for take_news in news for sentence in take_news()]

        yield take


_METRICS = {
    "chain.latency": ("gauge", "s", "End-to-end latency of a chain over a span"),
    "hop.time": ("gauge", "s", "Mean share of a hop over the last minute"),
    "chain.cycles": ("counter", "1", "Cycles of a chain by outcome"),
    "loop.period": ("gauge", "s", "Period of a loop over the last minute"),
    "loop.start_jitter": ("gauge", "s", "Jitter of a loop's starts over the last minute"),
    "loop.overruns": ("gauge", "1", "Share of a loop's instances that overran in the last minute"),
    "loop.misses": ("gauge", "1", "Instances of a loop that missed its rate in the last minute"),
    "loop.step_lead": ("gauge", "s", "Lead of an output before a loop in step"),
    "loop.step_error": ("gauge", "s", "How much later than the lead a loop in step starts"),
    "loop.step_moved": ("gauge", "s", "How far an output or a loop is moved to be in step"),
    "loop.step_drift": ("gauge", "1", "Drift of a loop's clock against its chain's, as a share"),
    "loop.step_starts": ("gauge", "1", "Starts of a loop in step in the last minute"),
    "loop.step_misses": ("gauge", "1", "Starts off their place in step in the last minute"),
    "loop.in_step": ("gauge", "1", "Whether output and loop are in step: 1, or 0"),
    "events.lost": ("counter", "1", "Events that were overwritten before they were read"),
}


def _values(seen: Seen) -> Iterator[tuple[str, float, dict[str, str]]]:
    """Yield each value of :data:`_METRICS`, with its name and attributes."""
    yield "events.lost", float(seen.lost), {}
    for loop in seen.loops:
        of_loop = {"loop": loop.loop}
        times = {"period": loop.rate.period_ns, "start_jitter": loop.rate.start_jitter_ns}
        for figure, time_ns in times.items():
            if time_ns is not None:
                yield f"loop.{figure}", time_ns / SECOND, of_loop
        if loop.rate.overrun_share is not None:
            yield "loop.overruns", loop.rate.overrun_share, of_loop
        yield "loop.misses", float(loop.misses), of_loop
    for step in seen.in_step:
        yield from _values_in_step(step)
    for chain in seen.chains:
        yield from _values_of(chain)


def _values_of(chain: ChainNow) -> Iterator[tuple[str, float, dict[str, str]]]:
    """Yield the values of a chain."""
    named = {"chain": chain.chain}
    for span, figures in chain.spans.items():
        statistics: dict[str, int | None] = {"min": figures.min_ns, "max": figures.max_ns}
        for percentile, reached_ns in figures.percentiles_ns.items():
            statistics[f"p{percentile}"] = reached_ns
        for statistic, figure_ns in statistics.items():
            if figure_ns is not None:
                about = {**named, "span": span, "statistic": statistic}
                yield "chain.latency", figure_ns / SECOND, about
    for hop in chain.hops:
        about = {**named, "node": hop.node, "topic": hop.topic}
        for part in PARTS:
            yield "hop.time", getattr(hop, f"{part}_ns") / SECOND, {**about, "part": part}
    for outcome, count in chain.counted.items():
        yield "chain.cycles", count, {**named, "outcome": outcome}


def _values_in_step(step: LoopState) -> Iterator[tuple[str, float, dict[str, str]]]:
    """Yield the values of a loop in step."""
    both = {"chain": step.chain, "loop": step.loop, "moves": step.moves}
    yield "loop.in_step", float(step.in_step), both
    yield "loop.step_lead", step.lead_ns / SECOND, both
    for figure, step_ns in (("error", step.error_ns), ("moved", step.moved_ns)):
        if step_ns is not None:
            yield f"loop.step_{figure}", step_ns / SECOND, both
    if step.drift_ppm is not None:
        yield "loop.step_drift", step.drift_ppm * 1e-6, both
    yield "loop.step_starts", float(step.starts), both
    yield "loop.step_misses", float(step.misses), both
