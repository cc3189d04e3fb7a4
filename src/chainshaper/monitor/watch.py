"""Watching the chains of an application that runs: `chainshaper watch`.

    memories of the nodes ─► events of the last seconds ─► traversals ─► figures over three spans

The library of :mod:`chainshaper.sources.preload` is in front of ROS 2 in each process; whoever may
read the process's memory can follow it and go away without a trace. Every look runs the analysis of
`chainshaper latency` over the last few seconds and takes over the cycles that are surely over:
those that began longer ago than a cycle may take. So figures are those of a recording of the same
time, and memory does not grow: events are there for seconds, cycles for an hour as four numbers.
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
from chainshaper.analysis.disturbance import Due, with_punctuality
from chainshaper.analysis.latency import (
    LatencyStatistics,
    Longest,
    latency_statistics,
    longest_times,
)
from chainshaper.analysis.messages import has_stampless
from chainshaper.analysis.objects import Objects, resolve_objects
from chainshaper.analysis.traversals import OWES_NO_OUTPUT
from chainshaper.monitor.metrics import (
    EVERY_MS,
    LONGEST_END_MS,
    check_endpoint,
    serving,
    tell_delivery,
)
from chainshaper.planning import ChainPlan, Plan
from chainshaper.planning.plan_file import plan_values
from chainshaper.robot.clocks import clock_offset
from chainshaper.sources.preload import (
    NO_PROCESS,
    TracedProcess,
    creation_tables,
    event_tables,
    joined_tables,
    memories,
)
from chainshaper.sources.system import info_of, own_pid_namespace, processes_of
from chainshaper.sources.tracing_library import TracingLibrary
from chainshaper.splicing.shaped_outputs import find_outputs
from chainshaper.values import events
from chainshaper.values.application import ApplicationGraph, Callback, Chain
from chainshaper.values.errors import InputError, OperationError, extra_library
from chainshaper.values.events import EventTables
from chainshaper.values.recording import InForceInfo, Recording, refuse_existing, write_recording
from chainshaper.verify.measure import PARTS
from chainshaper.verify.predictions import due_of
from chainshaper.verify.promises import OutputsDue

SECOND = 1_000_000_000
SPANS = {"second": SECOND, "minute": 60 * SECOND, "hour": 3600 * SECOND}
RECORDER_NS = 10 * SECOND
"""So much of the past the flight recorder has."""

_SEARCH_NS, _FIRST_SEARCH_NS = 5 * SECOND, SECOND  # between two looks for new processes
_STEP_NS = 1_000_000  # of CLOCK_REALTIME: more than reading its offset can be off
_AHEAD_NS = 100_000  # a stamp, or a phase, is not exact: outputs seem to leave before their slot


@dataclass(frozen=True)
class Hop:
    """A callback of the chain: its mean shares of the latency over the last minute (ns), and in
    ``longest_ns`` the longest of each, in the order of :data:`~.measure.PARTS`.
    """

    node: str
    topic: str
    communication_ns: float
    computation_ns: float
    waiting_ns: float
    longest_ns: tuple[int | None, ...]


@dataclass(frozen=True)
class CallbackNow:
    """A callback, what starts it, and its longest response and execution time over the last minute
    (ns; None: not known).
    """

    node: str
    starts: str
    longest_ns: Longest


@dataclass(frozen=True)
class ChainNow:
    """One chain: statistics by span (:data:`SPANS`), over all cycles that began in it.

    ``rate_hz`` is of cycles that began, over the last minute; ``shares`` of all outputs those that
    left within each of the plan's slots, over the hour (empty: without a plan), ``early`` those
    before the first slot; ``promised_ns`` is the end of the last slot, which is ``moved_ns`` behind
    the plan's; ``counted`` are cycles since the watch began: ``complete``, of these ``late``,
    ``incomplete``, ``unclear``, whose messages no event before Iron tells apart while
    CLOCK_REALTIME is set, and ``not_used``: older than the message that the chain's timer or
    synchroniser used, so no output is missing. ``kept`` says whether the plan's promise was kept
    over the hour, as ``outputs`` has it (None: no plan, or no cycle). ``problem`` says why nothing
    goes through the chain.
    """

    chain: str
    spans: Mapping[str, LatencyStatistics]
    rate_hz: float
    hops: tuple[Hop, ...]
    shares: tuple[float, ...]
    early: float
    promised_ns: int | None
    moved_ns: int
    counted: Mapping[str, int]
    problem: str | None
    outputs: OutputsDue
    kept: bool | None


@dataclass(frozen=True)
class Seen:
    """One look: its instant (CLOCK_MONOTONIC, ns), the nodes by process, and the chains.

    ``lost`` counts events that were overwritten before we read them, or found no room.
    ``callbacks`` are there where they are asked for. ``left_out`` are sentences: which processes
    have the library in front, and are not seen all the same, and why.
    """

    at_ns: int
    processes: Mapping[int, str]
    lost: int
    chains: tuple[ChainNow, ...]
    callbacks: tuple[CallbackNow, ...] = ()
    left_out: tuple[str, ...] = ()

    def as_json(self) -> dict[str, Any]:
        return asdict(self)

    def as_diagnostics(self) -> list[dict[str, Any]]:
        """A status for each chain, for :func:`~chainshaper.sources.ros.publishing_diagnostics`.

        ERROR: nothing was to be seen in the last minute. WARN: an output was late or never came.
        """
        statuses = []
        for one in self.chains:
            minute = one.spans["minute"]
            missing = OutputsDue.of(minute.count, minute.late, minute.incomplete).missed
            level, text = 2, one.problem or "no output in the last minute"
            if minute.count:
                level = int(missing > 0)
                text = f"{minute.count} outputs in the last minute, {missing} late or missing"
            values = {"cycles per second": f"{one.rate_hz:.3f}"}
            for span, own in one.spans.items():
                for which, ns in (("p50", own.percentiles_ns.get("50")), ("max", own.max_ns)):
                    if ns is not None:
                        values[f"{which} of the last {span} [ms]"] = f"{ns / 1e6:.3f}"
            about = {"name": f"chainshaper: {one.chain}", "level": level, "message": text}
            statuses.append({**about, "values": values})
        return statuses


# A callback, also of a node that was started again, or whose timer is seen at another period.
_SAME = ("node", "kind", "topic", "declared_ns")
_CYCLE = pl.Schema(
    {"start": pl.Int64, "latency_ns": pl.Int64, "late": pl.Boolean, "place_ns": pl.Int64}
)


@dataclass
class _Chain:
    """What is known of a chain: a row for each cycle, in the order of beginning, for an hour."""

    text: str
    output: str  # its topic, as far as that is known
    slots: tuple[tuple[int, int], ...]
    cycles: pl.DataFrame = field(default_factory=lambda: pl.DataFrame(schema=_CYCLE))
    hops: deque[tuple[int, pl.DataFrame]] = field(default_factory=deque)
    names: list[tuple[str, str]] = field(default_factory=list)  # node and topic of each hop
    first: Callback | None = None  # where cycles began when the chain was seen last
    counted: Counter[str] = field(
        default_factory=lambda: Counter(complete=0, late=0, incomplete=0, unclear=0, not_used=0)
    )
    problem: str | None = None

    def take_over(self, traversals: pl.DataFrame, hops: pl.DataFrame, now_ns: int) -> None:
        """Cycles that are over."""
        recent = self.cycles.filter(pl.col("start") > now_ns - SPANS["hour"])
        new = traversals.select(_CYCLE.names()).cast(_CYCLE)
        # Else each look of the hour is a chunk, and the next looks take 100 times as long.
        self.cycles = pl.concat([recent, new], rechunk=True)
        whole = int(traversals["complete"].sum())
        self.counted["complete"] += whole
        self.counted["incomplete"] += traversals.height - whole
        self.counted["late"] += int(traversals["late"].sum() or 0)
        own = hops.join(traversals.filter("complete"), on="traversal", how="semi")
        if own.height:
            shares = pl.col([f"{part}_ns" for part in PARTS])
            most = shares.max().name.prefix("longest_")
            figures = own.group_by("hop").agg(shares.sum(), most, count=pl.len())
            self.hops.append((now_ns, figures))

    def statistics(self, since_ns: int) -> LatencyStatistics:
        begun = self.cycles.filter(pl.col("start") >= since_ns)
        whole = begun.drop_nulls("latency_ns")
        late = None if whole["late"].null_count() else int(whole["late"].sum())
        gone = begun.height - whole.height
        return latency_statistics(whole["latency_ns"].to_numpy(), incomplete=gone, late=late)

    def worst_ns(self, since_ns: int) -> tuple[int, ...]:
        """The start of the cycle, since an instant, that has no output, or took longest."""
        rows = self.cycles.filter(pl.col("start") >= since_ns)
        worst = rows.sort("latency_ns", descending=True, nulls_last=False, maintain_order=True)
        return tuple(worst["start"].head(1))

    def shares(self) -> tuple[tuple[float, ...], float]:
        """Of all outputs those within each slot, and those before the first one."""
        places = self.cycles.drop_nulls("latency_ns")["place_ns"].drop_nulls().to_numpy()
        if not self.slots or not places.size:
            return (), 0.0
        opens, closes = np.array(self.slots).T
        slots = np.searchsorted(opens, places + _AHEAD_NS, side="right") - 1
        inside = (slots >= 0) & (places < closes[slots])
        counted = np.bincount(slots[inside], minlength=opens.size)
        return tuple((counted / places.size).tolist()), float((slots < 0).mean())

    def beginning(self, graph: ApplicationGraph) -> Chain | None:
        """The part of the chain that begins cycles, where it is not found any more but was."""
        for one in graph.callbacks if self.first else ():
            alike = (getattr(one, n) == getattr(self.first, n) for n in _SAME)
            if all(alike) and self.names[0][1] in one.publishes:
                return Chain(self.text, (one.id,), (self.names[0][1],))
        return None


def _is_running(pid: int) -> bool:
    return Path(f"/proc/{pid}").exists()


def _forget(seen: deque[tuple[int, Any]], before_ns: int) -> None:
    while seen and seen[0][0] < before_ns:
        seen.popleft()


class Watch:
    """The chains of what runs, or will run, with the library in front.

    ``chains`` as `--chain` has them; ``users`` are whose processes are followed; a cycle that takes
    longer than ``longest_ns`` counts as incomplete. ``plan`` says when outputs are due. With
    ``callbacks`` their times are looked at, too. Between two looks :meth:`read` wants to be called
    every tenth of a second or so.
    """

    def __init__(
        self,
        chains: Sequence[str],
        *,
        users: Collection[int],
        plan: Plan | None = None,
        longest_ns: int = 2 * SECOND,
        callbacks: bool = False,
    ) -> None:
        self.callbacks: deque[tuple[int, Any]] | None = deque() if callbacks else None
        self.users, self.plan, self.longest_ns = users, plan, longest_ns
        self.due = [] if plan is None else [due for one in plan.chains for due in due_of(one)]
        ends = [(text, text.rpartition("..")[2]) for text in chains]
        self.chains = [_Chain(text, end, self._slots(end)) for text, end in ends]
        self.processes: dict[int, TracedProcess] = {}
        self._left_out: dict[int, str] = {}  # why nothing is seen of these, in sentences
        self._created: dict[int, tuple[int, dict[str, pl.DataFrame], TracingLibrary]] = {}
        self._fresh: list[tuple[int, NDArray[Any]]] = []  # of a process, not yet in a table
        self._recent: deque[tuple[int, dict[str, pl.DataFrame]]] = deque()  # and their last instant
        self._latest: dict[int, int] = {}  # a process's last event
        self._tabled_ns = 0
        self._stepped_ns = 0  # until then it is not clear which message a cycle had
        self._known: list[tuple[Any, ...]] = []
        self._resolved = resolve_objects({})
        self._clock_offset_ns = clock_offset()
        self._searched_ns = 0
        self._lost_with_ended = 0
        self._over_ns = time.monotonic_ns()  # cycles that began until then have been taken over
        self._began_ns = self._looked_from_ns = self._over_ns  # the last look's cycles from then on

    def _due(self, output: str) -> Due | None:
        return next((due for due in self.due if due.output in (None, output)), None)

    def _plan_of(self, output: str) -> ChainPlan | None:
        """The plan whose promise is about a chain with this output."""
        plans = () if self.plan is None else self.plan.chains
        return next((one for one in plans if one.chain.output in (None, output)), None)

    def _slots(self, output: str) -> tuple[tuple[int, int], ...]:
        due = self._due(output) or Due(0)
        delay = due.cycles * due.cycle_ns
        return tuple((start + delay, end + delay) for start, end in due.slots)

    def read(self) -> None:
        """Take what is new in all memories, and look for new processes now and then."""
        now = time.monotonic_ns()
        searches = now - self._searched_ns > (_SEARCH_NS if self.processes else _FIRST_SEARCH_NS)
        if searches:
            self._searched_ns = now
            self._left_out = {p: why for p, why in self._left_out.items() if _is_running(p)}
            known = {*self.processes, *self._left_out}
            for pid, memory in memories(self.users, known, self._left_out.__setitem__):
                self.processes[pid], self._latest[pid] = memory, 0
                created, _ = memory.objects()
                if created.size and created["time"][0] < self._began_ns:
                    self._take(pid, memory, self._began_ns)
                    memory.lost = 0  # before the watch began
        for pid, process in self.processes.items():
            self._take(pid, process)
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
        return [one for one in self.processes if not _is_running(one)]

    def _needed_ns(self, now_ns: int) -> int:
        """From when on events may be asked for: by the flight recorder, or by a late look."""
        return min(now_ns - RECORDER_NS, self._looked_from_ns) - self.longest_ns

    def look(self) -> Seen:
        """What is to be seen now; cycles that began ``longest_ns`` ago or earlier are counted."""
        self.read()
        now, offset = time.monotonic_ns(), clock_offset()
        if abs(offset - self._clock_offset_ns) > _STEP_NS:
            self._stepped_ns = now
        self._clock_offset_ns = offset
        over = now - self.longest_ns
        since = now - 2 * self.longest_ns - (over - self._over_ns)
        tables = self._tables(since)
        objects, ended = self._objects(tables, since), self._ended()
        flow = data_flow(tables, self._clock_offset_ns, objects, ended=ended)
        moved = dict[str, int]()
        if self.plan:  # a page of another user says nothing of the outputs that are watched
            watched = (output for output in find_outputs() if output.user in self.users)
            moved = {output.topic: output.moved_ns for output in watched}
        # Where publications carry no stamp, the clock's offset says which one was taken.
        stampless = has_stampless(flow.publications)
        clear_ns = self._stepped_ns if stampless else 0
        within = pl.col("start").is_between(self._over_ns, over, "right")
        graph = graph_of(flow)
        for one in self.chains:
            _forget(one.hops, now - SPANS["minute"])
            if (found := self._judged(one, flow, graph)) is not None:
                judged, hops = found
                begun = judged.filter(within)
                # A lifecycle node that is not active owes no output, nor does an older message.
                idle = pl.col("reason").is_in(OWES_NO_OUTPUT).fill_null(False)
                new = begun.filter(~idle)
                one.counted["not_used"] += begun.filter(reason="not used").height
                new = new.with_columns(pl.col("place_ns") - moved.get(one.output, 0))
                one.take_over(clear := new.filter(pl.col("start") > clear_ns), hops, now)
                one.counted["unclear"] += new.height - clear.height
        if self.callbacks is not None:
            own = replace(flow, instances=flow.instances.filter(within))
            self.callbacks.append((now, longest_times(own)))
            _forget(self.callbacks, now - SPANS["minute"])
        self._looked_from_ns, self._over_ns = self._over_ns, over
        return Seen(
            at_ns=now,
            processes=processes_of(tables, dict.fromkeys(self.processes, "")),
            lost=self.lost,
            chains=tuple(self._now(one, over, moved) for one in self.chains),
            callbacks=tuple(_callbacks([own for _, own in self.callbacks or ()])),
            left_out=tuple(self._left_out.values()),
        )

    def _judged(
        self, one: _Chain, flow: DataFlow, graph: ApplicationGraph
    ) -> tuple[pl.DataFrame, pl.DataFrame] | None:
        """The traversals of a chain, judged, and their hops; None where it is not to be found."""
        one.problem, chain = None, None
        try:
            chain = find_chain(graph, one.text)
        except InputError as error:
            nobody = " ".join(self._left_out.values()) or NO_PROCESS
            one.problem = str(error) if self.processes else nobody
            # Every cycle that is over had its events here: none of them has arrived.
            if not isinstance(error, SeveralPathsError):
                chain = one.beginning(graph)
        if chain is None:
            return None
        found = traverse(flow, chain, graph)
        judged, _ = with_punctuality(flow, found, self._due(chain.topics[-1]))
        if one.problem is not None:
            return judged.with_columns(latency_ns=None, late=None, complete=False), found.hops
        path = graph.path(chain)
        one.first, one.output = path[0], chain.topics[-1]
        one.slots = self._slots(one.output)  # the text may end with a node
        one.names = [(c.node or "", t) for c, t in zip(path, chain.topics, strict=True)]
        return judged, found.hops

    def _objects(self, tables: EventTables, since_ns: int) -> Objects:
        """Who exists: as at the last look where nothing was created, and the same ran, since then.

        That is half of a look, and what is created stays; which callbacks ran, and which
        subscriptions took, makes known those that say so only thereby (Python's).
        """
        what_ran = [("callback_start", "callback"), ("rmw_take", "rmw_subscription_handle")]
        known = [tuple(sorted((pid, one[0]) for pid, one in self._created.items()))]
        for name, column in what_ran:
            rows = events.table(tables, name).select("pid", column).unique()
            known.append(tuple(sorted(rows.iter_rows())))
        created = (tables[one]["time"][-1] for one in events.CREATION & tables.keys())
        if known != self._known or max(created, default=0) >= since_ns:
            self._known, self._resolved = known, resolve_objects(tables)
        return self._resolved

    def _now(self, one: _Chain, over_ns: int, moved: Mapping[str, int]) -> ChainNow:
        moved_ns = moved.get(one.output, 0)
        begun = one.cycles["start"].filter(one.cycles["start"] > over_ns - SPANS["minute"])
        shares, early = one.shares()
        lasted = begun[-1] - begun[0] if len(begun) > 1 else 0
        spans = {name: one.statistics(over_ns - span) for name, span in SPANS.items()}
        hour, plan = spans["hour"], self._plan_of(one.output)
        outputs = OutputsDue.of(hour.count, hour.late, hour.incomplete, plan)
        return ChainNow(
            chain=one.text,
            spans=spans,
            rate_hz=(len(begun) - 1) * SECOND / lasted if lasted else 0.0,
            hops=tuple(_hops(one)),
            shares=shares,
            early=early,
            promised_ns=one.slots[-1][1] + moved_ns if one.slots else None,
            moved_ns=moved_ns,
            counted=dict(one.counted),
            problem=one.problem,
            outputs=outputs,
            kept=outputs.kept,
        )

    @property
    def lost(self) -> int:
        """Events that were overwritten before they were read, or found no room."""
        there = sum(one.lost + one.dropped for one in self.processes.values())
        return there + self._lost_with_ended

    def _tables(self, since_ns: int) -> EventTables:
        """All that was created, but for what ended before an instant, and what happened since."""
        self._take_fresh(time.monotonic_ns())
        gone = {pid for pid in self._ended() if self._latest[pid] < since_ns}
        created = (tables for pid, (_, tables, _) in self._created.items() if pid not in gone)
        return joined_tables([*created, *(own for last, own in self._recent if last >= since_ns)])

    def _take_fresh(self, now_ns: int) -> None:
        """Make tables of what was read since the last time, and drop those that are too old."""
        by_library: dict[TracingLibrary, list[tuple[NDArray[Any], int]]] = {}
        for pid, process in self.processes.items():
            asked = int(process.header["objects"][0])
            if pid not in self._created or self._created[pid][0] != asked:
                self._created[pid] = (asked, *creation_tables(process))
        for pid, part in self._fresh:
            own = by_library.setdefault(self._created[pid][2], [])
            own.append((part, self.processes[pid].pid))
        for library, own in by_library.items():
            records = np.concatenate([part for part, _ in own])
            pids = np.repeat([pid for _, pid in own], [part.size for part, _ in own])
            tables = event_tables(records, pids.astype(np.int32), library)
            self._recent.append((int(records["time"].max()), tables))
        self._fresh, self._tabled_ns = [], now_ns
        _forget(self._recent, self._needed_ns(now_ns))

    def save(self, output: str | Path, *, reasons: Sequence[str] = ()) -> Recording:
        """Write the last ten seconds as a recording, or more if the last look had cycles before.

        ``reasons`` why stand in its notes. `report` shows the worst cycle of each chain first.

        Raises InputError: the folder exists. OperationError: it cannot be written, or there is
        nothing to be written.
        """
        output = refuse_existing(output)
        self.read()
        since = (
            self._needed_ns(time.monotonic_ns()) + self.longest_ns
        )  # with the last look's cycles
        tables = events.happened(self._tables(since), since)
        if not tables:
            raise OperationError(f"{output} is not written: no event has been seen yet")
        versions = (library.version for _, _, library in self._created.values())
        facts: dict[str, Any] = {
            "clock_offset_ns": self._clock_offset_ns,
            "pid_namespace": own_pid_namespace(),
            "chain": self.chains[0].text if self.chains else None,
            "notes": (
                "the last seconds before it was asked for; objects from before them are there",
                *reasons,
                *self._left_out.values(),
            ),
            "worst_ns": tuple(at for one in self.chains for at in one.worst_ns(since)),
        }
        if self.plan is not None:
            facts["plan"] = plan_values(self.plan)
            facts["in_force"] = InForceInfo(since_ns=since)
        info = info_of("preload", tables, versions, {}, self.lost, **facts)
        return write_recording(output, tables, info)


def _hops(one: _Chain) -> Iterator[Hop]:
    if not one.hops:
        return
    figures = pl.concat([frame for _, frame in one.hops]).group_by("hop")
    sums = figures.agg(pl.exclude("^longest_.*$").sum(), pl.col("^longest_.*$").max()).sort("hop")
    for row in sums.iter_rows(named=True):
        communication, computation, waiting = (row[f"{part}_ns"] / row["count"] for part in PARTS)
        longest = tuple(row[f"longest_{part}_ns"] for part in PARTS)
        node, topic = one.names[row["hop"]]
        yield Hop(node, topic, communication, computation, waiting, longest)


def _callbacks(looks: Sequence[Mapping[tuple[str, str], Longest]]) -> Iterator[CallbackNow]:
    for node, starts in dict.fromkeys(name for own in looks for name in own):
        found = [own[node, starts] for own in looks if (node, starts) in own]
        response, execution = (
            max((one for one in times if one is not None), default=None)
            for times in zip(*(one.times for one in found), strict=True)
        )
        yield CallbackNow(node, starts, Longest(response, execution, found[-1].shown))


@contextlib.contextmanager
def exporting(
    port: int | None = None, endpoint: str | None = None
) -> Iterator[Callable[[Seen], list[str]]]:
    """Metrics of what was seen last: OpenMetrics on a local port, OTLP to an HTTP endpoint.

    What it gives wants every look, and answers with what there is to say about the collector. Times
    are in seconds, as both conventions have it; cycles count from the beginning of the watch.

    Raises PlatformError: the OpenTelemetry SDK is not installed. OperationError: no such port.
    InputError: no such endpoint.
    """
    if port is None and endpoint is None:
        yield lambda _: []
        return
    library = partial(extra_library, purpose="exporting metrics", extra="metrics")
    metrics, export = (library(f"opentelemetry.sdk.metrics{sub}") for sub in ("", ".export"))
    observation = library("opentelemetry.metrics").Observation
    readers, told = [], list[Callable[[], list[str]]]()
    with contextlib.ExitStack() as until:
        if endpoint is not None:
            check_endpoint(endpoint)
        if port is not None:
            until.enter_context(serving(port, library("prometheus_client").MetricsHandler))
            readers.append(library("opentelemetry.exporter.prometheus").PrometheusMetricReader())
        if endpoint is not None:
            otlp = library("opentelemetry.exporter.otlp.proto.http.metric_exporter")
            exporter = otlp.OTLPMetricExporter(endpoint=endpoint)
            told.append(tell_delivery(exporter, endpoint))
            readers.append(export.PeriodicExportingMetricReader(exporter, EVERY_MS))
        provider = metrics.MeterProvider(metric_readers=readers)
        until.callback(provider.shutdown, timeout_millis=LONGEST_END_MS)
        meter, last = provider.get_meter("chainshaper"), list[Seen]()

        def observed(wanted: str, _options: object) -> Iterator[Any]:
            for seen in last:
                for name, value, about in _values(seen):
                    if name == wanted:
                        yield observation(value, about)

        for name, (kind, unit, about) in _METRICS.items():
            create = getattr(meter, f"create_observable_{kind}")
            values = [partial(observed, name)]
            create(f"chainshaper.{name}", values, unit=unit, description=about)

        def take(seen: Seen) -> list[str]:
            last[:] = [seen]
            return [text for one in told for text in one()]

        yield take


_METRICS = {
    "chain.latency": ("gauge", "s", "End-to-end latency of a chain over a span"),
    "hop.time": ("gauge", "s", "Mean share of a hop over the last minute"),
    "chain.cycles": ("counter", "1", "Cycles of a chain by outcome"),
    "events.lost": ("counter", "1", "Events that were overwritten before they were read"),
}


def _values(seen: Seen) -> Iterator[tuple[str, float, dict[str, str]]]:
    """Each value of :data:`_METRICS`, and its attributes."""
    yield "events.lost", float(seen.lost), {}
    for one in seen.chains:
        chain = {"chain": one.chain}
        for span, own in one.spans.items():
            percentiles = {f"p{which}": ns for which, ns in own.percentiles_ns.items()}
            for which, ns in {"min": own.min_ns, "max": own.max_ns, **percentiles}.items():
                if ns is not None:
                    yield "chain.latency", ns / SECOND, {**chain, "span": span, "statistic": which}
        for hop in one.hops:
            about = {**chain, "node": hop.node, "topic": hop.topic}
            for part in PARTS:
                yield "hop.time", getattr(hop, f"{part}_ns") / SECOND, {**about, "part": part}
        for outcome, count in one.counted.items():
            yield "chain.cycles", count, {**chain, "outcome": outcome}
