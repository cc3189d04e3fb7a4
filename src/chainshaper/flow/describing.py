"""The description of an application as a recording shows it, for the simulator and live runs.

Execution times and deliveries are sequences, cycle by cycle as they were: what came together comes
together again. Cores, priorities, phases of timers, several threads and synchronisers are those of
the recording, or follow from who ran when (:mod:`chainshaper.analysis.occupation`); what a
recording cannot tell is said in notes, which stand at the top of the file.
"""

import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cmp_to_key, partial
from itertools import count
from pathlib import Path
from textwrap import fill
from typing import Any

import numpy as np
import numpy.typing as npt
import polars as pl
import yaml

from chainshaper.analysis import DataFlow, analyse_latency, graph_of, recorded_flow
from chainshaper.analysis.chains import find_chain, parse_chain
from chainshaper.analysis.graph import MESSAGE_FILTER
from chainshaper.analysis.occupation import (
    Occupation,
    ThreadKey,
    deliveries,
    occupation,
    publication_that_counts,
    taken_first,
)
from chainshaper.flow.exploration import list_chains
from chainshaper.linux.scheduling import available_cores
from chainshaper.simulation import simulate, simulate_latencies
from chainshaper.values import events
from chainshaper.values.application import INTERNAL_TOPICS, ApplicationGraph, Callback, Chain
from chainshaper.values.durations import duration_text, format_duration, milliseconds
from chainshaper.values.errors import InputError
from chainshaper.values.files import scratch_folder
from chainshaper.values.recording import Recording
from chainshaper.values.yaml_file import AS_YAML, wrong_values_refused
from chainshaper.verify.measure import opened
from chainshaper.workload.description import Application

Numbers = npt.NDArray[np.int64]

DEFAULT_PRIORITY, DDS_PRIORITY, MOST_URGENT = 80, 90, 97
DEFAULT_DEPTH = 10  # of a topic's history, in a description
REAL_TIME = ("SCHED_FIFO", "SCHED_RR")
MOST_VALUES = 150_000  # durations in a description, which a file may have without being slow
NEXT_NS = 100_000  # so close behind an end on its thread, a start was waiting for that
EVIDENCE = 10  # so many cases a figure is measured from
EXACT_PPM = 20  # a timer whose starts drift by more against its period has another one
UNEXPLAINED = 0.05  # the share of a synchroniser's sets that may be completed by chance elsewhere
NEAR_AVERAGE, NEAR_MAXIMUM = 0.02, 0.05  # so near a simulated description comes, or says so
MOST_CYCLES = 20_000  # that are simulated to see that
NEARLY = 0.9  # of the cycles, so that the others are missing at the recording's end
USUALLY, LEAST = 0.1, 0.05  # quantiles: of starts behind expiries, of free deliveries


@dataclass(frozen=True)
class _Evidence:
    """What a description is made from, and the notes that come up on the way.

    From ``start_ns`` on, the start of the first cycle, all sequences count. ``hops`` and ``first``
    are :func:`~chainshaper.analysis.occupation.deliveries` and :func:`~.occupation.taken_first`.
    """

    recording: Recording
    flow: DataFlow
    graph: ApplicationGraph
    chain: Chain
    callbacks: dict[int, Callback]
    found: Occupation
    hops: pl.DataFrame
    first: Mapping[tuple[int, int], int]
    origin: int
    start_ns: int
    notes: list[str] = field(default_factory=list)

    def instances(self, callbacks: Iterable[int]) -> pl.DataFrame:
        """Those of some callbacks, from the first cycle on."""
        chosen = pl.col("callback_id").is_in([*callbacks]) & (pl.col("start") >= self.start_ns)
        return self.found.instances.filter(chosen)


@dataclass
class _Described:
    """A callback in the description's words, and the ids of those that it stands for."""

    ids: tuple[int, ...]
    values: dict[str, Any]
    before: int | None = None  # the timer that goes first where both are due


@dataclass
class _Node:
    """A node as it will be described; ``deliveries`` are by topic."""

    callbacks: list[_Described] = field(default_factory=list)
    deliveries: dict[str, Numbers] = field(default_factory=dict)
    values: dict[str, Any] = field(default_factory=dict)

    @property
    def ids(self) -> list[int]:
        """Of all its callbacks."""
        return [number for one in self.callbacks for number in one.ids]


def application_file(
    recording: Recording | str | Path, chain: str | None = None
) -> tuple[str, tuple[str, ...]]:
    """The description of a recording's application (YAML), and what it cannot know, in words.

    ``chain`` defaults to the recording's own, else the heaviest. Raises InputError: no chain is in
    it, or no description can be made of it.
    """
    recording = opened(recording)
    evidence = _evidence(recording, chain)
    nodes = _nodes(evidence)
    if not nodes:
        raise InputError(f"{recording.path}: no callback of it ran twice: record longer")
    scheduling = _scheduling(evidence, nodes)
    values: dict[str, Any] = {
        "name": recording.path.name,
        "chain": _described_chain(evidence, nodes),
        "scheduling": scheduling,
        "topics": _topics(evidence, nodes),
        "simulation": _costs(evidence, nodes),
        "nodes": {
            name: {**node.values, "callbacks": [one.values for one in node.callbacks]}
            for name, node in nodes.items()
        },
    }
    values = {key: part for key, part in values.items() if part}
    values = _in_whole_cycles(values, len(evidence.instances([evidence.origin])))
    values = _written_out(values, _chosen(evidence, values))
    with wrong_values_refused(Application, f"{recording.path}: "):
        application = Application.model_validate(values, context=AS_YAML, strict=False)
    compared = _simulated_back(evidence, application)
    notes = tuple(dict.fromkeys((*evidence.notes, compared)))
    body = yaml.safe_dump(values, sort_keys=False, default_flow_style=None, width=100)
    return "".join((*map(_comment, notes), body)), notes


def _simulated_back(evidence: _Evidence, application: Application) -> str:
    """How near the description comes to the recording: latencies simulated and recorded."""
    recorded = analyse_latency(evidence.flow, evidence.chain.spec)
    complete = recorded.traversals.drop_nulls("latency_ns").sort("latency_ns")
    if complete.is_empty():
        return "No cycle completes: the description cannot be compared with the recording."
    simulated = _latencies(application, min(MOST_CYCLES, 2 * len(complete)))
    if not simulated.size:
        return f"Simulated, no cycle of {application.chain} completes, as the recorded ones did."
    latencies = complete["latency_ns"].to_numpy()
    both = [(float(one.mean()), int(one.max())) for one in (simulated, latencies)]
    (mean, longest), (recorded_mean, recorded_longest) = both
    said = f"Simulated, {application.chain} takes {milliseconds(mean)} ms on average and"
    said += f" {milliseconds(longest)} ms at most; recorded were {milliseconds(recorded_mean)} and"
    said += f" {milliseconds(recorded_longest)} ms."
    if abs(longest - recorded_longest) > NEAR_MAXIMUM * recorded_longest:
        since = (complete["start"][-1] - complete["start"].min()) / 1e9
        said += f" The longest was recorded {since:.1f} s behind the first: what made it so long is"
        said += " not in the description."
    if abs(mean - recorded_mean) > NEAR_AVERAGE * recorded_mean:
        said += " The averages differ: what the notes say matters for this chain."
    return said


def _comment(note: str) -> str:
    return fill(note, 98, initial_indent="# ", subsequent_indent="#   ") + "\n"


def _evidence(recording: Recording, chain: str | None) -> _Evidence:
    """What a recording's description is made from."""
    flow = recorded_flow(recording)
    graph, heaviest = graph_of(flow), list_chains(flow).heaviest
    if heaviest is None:
        raise InputError(f"{recording.path}: no chain is in it, see `chainshaper graph`")
    path = find_chain(graph, chain or recording.info.chain or heaviest.spec)
    counting = publication_that_counts(flow, frozenset(path.topics))
    found = occupation(flow, recording.info, counting)
    timers = [one.id for one in graph.callbacks if one.kind == "timer"]
    origin = path.callbacks[0]
    wanted = [origin] if origin in timers or not timers else timers
    starts = found.instances.filter(pl.col("callback_id").is_in(wanted)).sort("start")
    begun = starts.filter(pl.col("start") >= found.settled_ns)
    origin = int(begun["callback_id"][0]) if len(begun) else origin
    start_ns = int(begun["start"][0]) if len(begun) else 0
    callbacks = {one.id: one for one in graph.callbacks}
    blocker = _blocker(callbacks, found, begun.filter(callback_id=origin))
    if blocker is not None and callbacks[blocker].period_ns == callbacks[origin].period_ns:
        earlier = found.instances.filter(pl.col("start") < start_ns, callback_id=blocker)["start"]
        if earlier.len():
            origin, start_ns = blocker, int(earlier[-1])
    evidence = _Evidence(
        recording=recording,
        flow=flow,
        graph=graph,
        chain=path,
        callbacks=callbacks,
        found=found,
        hops=deliveries(flow, found),
        first=taken_first(flow, found),
        origin=origin,
        start_ns=start_ns,
    )
    evidence.notes.append(
        "Execution times are response times, without those of callbacks that were seen to pre-empt"
        " them on their core: "
        + (
            "CPU times are not in the recording (no sched_switch, no CPU clock)."
            if found.others is None
            else f"in {100 * found.others:.1f} % of them interrupts, threads without callbacks or"
            " the machine had the core."
        )
    )
    if flow.instances["assumed"].any():
        evidence.notes.append(
            "Some callbacks have no events of their own (Python nodes, threads that publish): they"
            " last until they publish, as far as the description knows."
        )
    if len(begun) < len(starts):
        evidence.notes.append(
            "Cycles before all threads were on their cores are left out:"
            f" {len(starts) - len(begun)} of {len(starts)}."
        )
    gates = events.table(recording.events, "gate_release")
    if len(gates):
        evidence.notes.append(
            "The recording is of a shaped application: a shaping node is described as one that"
            " computes while it holds a message. Describe a recording without it."
        )
    return evidence


def _latencies(application: Application, cycles: int) -> Numbers:
    """The latencies of a description's chain that are completed in simulation (ns)."""
    try:
        found = simulate_latencies(application, cycles=cycles)
    except InputError:  # stored messages lead through nodes of which events alone tell
        with scratch_folder() as folder:
            recording = simulate(application, folder / "simulated", cycles=cycles)
            traversals = analyse_latency(recording, application.chain).traversals
            found = traversals["latency_ns"].drop_nulls().to_numpy()
    return found[found >= 0]


# Nodes and their callbacks --------------------------------------------------------------------


def _nodes(evidence: _Evidence) -> dict[str, _Node]:
    """The nodes with the callbacks that ran, in the order of the graph."""
    seen: set[int] = set()
    chosen: list[tuple[int, ...]] = []
    for callback in evidence.callbacks.values():
        if callback.id in seen or not _describable(callback):
            continue
        members = _inputs(evidence, callback)
        seen |= {*members}
        if len(evidence.instances(members)) >= 2:
            chosen.append(members)
    ran = [evidence.callbacks[number] for members in chosen for number in members]
    published = {topic for one in ran for topic in _written(one)}
    names = _names(evidence, ran)
    nodes: dict[str, _Node] = {}
    for members in chosen:
        first = evidence.callbacks[members[0]]
        node = nodes.setdefault(names[first.node, first.pid], _Node())
        node.callbacks.append(_described(evidence, node, members, published))
    for node in nodes.values():
        _in_turn(evidence, node)
    calls = {
        str(one.topic)
        for one in evidence.callbacks.values()
        if one.kind in ("service", "client") and one.publishes
    }
    if calls:
        evidence.notes.append(
            f"Services and their clients ({', '.join(sorted(calls))}) are left out: a description"
            " has topics only."
        )
    return nodes


def _names(evidence: _Evidence, ran: Sequence[Callback]) -> dict[tuple[str, int], str]:
    """The name in the description of each node and process: as permitted there, and its own."""
    nodes = dict.fromkeys((callback.node, callback.pid) for callback in ran)
    processes = Counter(node for node, _ in nodes)
    found: dict[tuple[str, int], str] = {}
    for node, pid in nodes:
        name = re.sub(r"[^A-Za-z0-9_/]", "_", node).strip("/")
        if not re.match(r"[A-Za-z_]", name):
            name = f"node_{name}"
        if processes[node] > 1:
            name = f"{name}_{pid}"
            evidence.notes.append(
                f"{node} ran in {processes[node]} processes at once: that in process {pid} is"
                f" {name} in the description."
            )
        alike = name
        for number in count(2):
            if name not in found.values():
                break
            name = f"{alike}_{number}"
        if processes[node] == 1 and name != node.strip("/"):
            said = f"{node} is no name of a node in a description: it is {name} there."
            evidence.notes.append(said)
        found[node, pid] = name
    return found


def _described_chain(evidence: _Evidence, nodes: Mapping[str, _Node]) -> str:
    """A chain by the names that its nodes have in the description."""
    named = dict[str, str]()
    for name, node in nodes.items():
        first = evidence.callbacks[node.ids[0]]
        for known_by in (first.node, *(f"{first.node}@{pid}" for pid in first.processes)):
            named |= {known_by: f"/{name}", known_by.removeprefix("/"): f"/{name}"}
    topics = {topic for each in evidence.callbacks.values() for topic in each.publishes}
    points = parse_chain(evidence.chain.spec)
    return "..".join(
        point if {point, f"/{point}"} & topics else named.get(point, point) for point in points
    )


def _describable(callback: Callback) -> bool:
    driver = callback.kind == "unknown" and bool(_written(callback))
    ours = callback.kind in ("timer", "subscription") and callback.topic not in INTERNAL_TOPICS
    return driver or ours


def _written(callback: Callback) -> list[str]:
    """What it publishes itself."""
    left = INTERNAL_TOPICS | {*callback.passes_on}
    return [topic for topic in callback.publishes if topic not in left]


def _inputs(evidence: _Evidence, callback: Callback) -> tuple[int, ...]:
    """The callback, with the other inputs of the synchroniser that it is one of."""
    of_node = (callback.pid, callback.node, "subscription")
    siblings = [
        one
        for one in evidence.callbacks.values()
        if (one.pid, one.node, one.kind) == of_node and one.topic not in INTERNAL_TOPICS
    ]
    filtered = callback.symbol is None or MESSAGE_FILTER in callback.symbol
    through = {*callback.in_turns, *(callback.publishes if filtered else ())} - INTERNAL_TOPICS
    together = [one for one in siblings if through.intersection(one.publishes)]
    distinct = len({one.topic for one in together}) == len(together) > 1
    if callback.kind != "subscription" or not distinct:
        return (callback.id,)
    return tuple(sorted((one.id for one in together), key=cmp_to_key(partial(_turn, evidence))))


def _turn(evidence: _Evidence, one: int, other: int) -> int:
    """Which of two callbacks an executor looks at first, as far as it was seen: as sorting asks."""
    return evidence.first.get((other, one), 0) - evidence.first.get((one, other), 0)


def _described(
    evidence: _Evidence, node: _Node, members: tuple[int, ...], published: set[str]
) -> _Described:
    """A callback, or a synchroniser with several inputs, in the description's words."""
    callbacks = [evidence.callbacks[number] for number in members]
    topics = list(dict.fromkeys(topic for one in callbacks for topic in _written(one)))
    read = [str(one.topic) for one in callbacks]
    own = evidence.instances(members)
    described = _Described(members, {})
    rows: Numbers = own["instance"].to_numpy().astype(np.int64)
    if callbacks[0].kind == "subscription" and published.issuperset(read):
        orders = [_by_message(evidence, node, one) for one in callbacks]
        rows = orders[0]
        described.values = {"subscription": read[0]}
        if len(read) > 1:
            described.values = {"synchronises": read}
            if (trigger := _trigger(own, members)) is not None:
                described.values["triggered_by"] = evidence.callbacks[trigger].topic
            rows = own.drop_nulls("published")["instance"].to_numpy().astype(np.int64)
    else:
        described.values = _timer(evidence, described, callbacks[0], own)
    before, after = _spent(evidence, callbacks[0], rows)
    described.values["execution"] = before
    if topics:
        described.values["publishes"] = topics
        if after.any():
            described.values["afterwards"] = after
        if len(members) == 1 and (silent := int(own["published"].null_count())):
            evidence.notes.append(
                f"{callbacks[0].label} published nothing in {silent} of {len(own)} executions: in"
                " the description it publishes in all."
            )
    return described


def _trigger(own: pl.DataFrame, members: Sequence[int]) -> int | None:
    """The input whose messages complete all sets, where a wait for one of each does not explain it.

    That is tried: who would have completed the sets by the order in which messages came?
    """
    wrote = own.drop_nulls("published")["callback_id"].unique().to_list()
    if len(wrote) != 1:
        return None
    waiting, surprises = Counter[int](), 0
    for number, left in own.select("callback_id", "published").iter_rows():
        waiting[number] += 1
        complete = all(waiting[one] for one in members)
        if complete:
            waiting.subtract(members)
        surprises += complete != (left is not None)
    return int(wrote[0]) if surprises > UNEXPLAINED * len(own) else None


def _by_message(evidence: _Evidence, node: _Node, callback: Callback) -> Numbers:
    """The instances of a subscription by message of its topic; adds the topic's deliveries.

    A message that did not arrive has none (-1).
    """
    topic = str(callback.topic)
    writers = [one.id for one in evidence.callbacks.values() if topic in _written(one)]
    first = evidence.instances(writers).select("instance")
    sent = evidence.flow.publications.filter(pl.col("topic").cast(pl.String) == topic)
    sent = sent.join(first, on="instance", how="semi").sort("sent", nulls_last=True)
    hops = evidence.hops.filter(pl.col("callback_id") == callback.id).unique("publication")
    rows = sent.select("publication").join(
        hops, on="publication", how="left", maintain_order="left"
    )
    arrived = rows["instance"].is_not_null().to_numpy()
    if not arrived.any():
        return evidence.instances([callback.id])["instance"].to_numpy().astype(np.int64)
    rows = rows[: int(np.flatnonzero(arrived)[-1]) + 1]
    if missing := rows["instance"].null_count():
        evidence.notes.append(
            f"{missing} of {len(rows)} messages on {topic} did not reach {callback.node}: in the"
            " description all do."
        )
    node.deliveries[topic] = _delays(evidence, rows)
    instances: Numbers = rows["instance"].cast(pl.Int64).fill_null(-1).to_numpy()
    return instances


def _spent(evidence: _Evidence, callback: Callback, rows: Numbers) -> tuple[Numbers, Numbers]:
    """CPU time of instances to their publication (or end), and behind it."""
    known = rows >= 0
    frame = evidence.found.instances[rows[known]].select("before_ns", "after_ns")
    if frame["before_ns"].null_count() == len(frame):
        evidence.notes.append(f"How long {callback.label} computes is not in the recording: 0.")
    filled = frame.select(pl.all().fill_null(pl.all().median()).fill_null(0))
    both = []
    for key in filled.columns:
        spent = np.full(len(rows), int(np.median(filled[key].to_numpy())), np.int64)
        spent[known] = filled[key].to_numpy()
        both.append(spent)
    return both[0], both[1]


# Timers ---------------------------------------------------------------------------------------


def _timer(
    evidence: _Evidence, described: _Described, callback: Callback, own: pl.DataFrame
) -> dict[str, Any]:
    """A timer's period and phase; of what no described callback triggers, those of its starts."""
    period, expiry = _expiry(evidence, callback, own)
    if callback.kind != "timer":
        evidence.notes.append(
            f"{callback.label} is started by nothing that is described: in the description a timer"
            f" starts it, every {duration_text(period)}."
        )
    blocker = _blocker(evidence.callbacks, evidence.found, own)
    if blocker is not None:
        described.before = blocker
        first = evidence.instances([blocker])
        expiry = _expiry(evidence, evidence.callbacks[blocker], first)[1]
    if callback.id == evidence.origin:
        return {"timer": format_duration(period)}
    origin = evidence.callbacks[evidence.origin]
    _, begins = _expiry(evidence, origin, evidence.instances([origin.id]))
    phase = 0 if described.before == origin.id else (expiry - begins) % period
    values: dict[str, Any] = {"timer": format_duration(period)}
    return values | ({"phase": format_duration(phase)} if phase else {})


def _expiry(evidence: _Evidence, callback: Callback, own: pl.DataFrame) -> tuple[int, int]:
    """A timer's period, and an instant at which it expired (ns)."""
    starts = own["start"].sort().to_numpy().astype(np.int64)
    apart = int(np.median(np.diff(starts))) if len(starts) > 1 else 0
    period = callback.period_ns or max(1_000, round(apart, -3))
    if callback.declared_ns not in (None, callback.period_ns):
        evidence.notes.append(
            f"{callback.node} has a timer that was declared with a period of"
            f" {duration_text(callback.declared_ns or 0)} and started every"
            f" {duration_text(period)}: that is its period in the description."
        )
    number = np.rint((starts - starts[0]) / period).astype(np.int64)
    behind = starts - number * period
    third = len(starts) // 3
    if third >= EVIDENCE and number[-1] > number[0]:
        drift = np.median(behind[-third:]) - np.median(behind[:third])
        drift /= max(1.0, float(np.mean(number[-third:]) - np.mean(number[:third])))
        if abs(drift) > EXACT_PPM * 1e-6 * period:
            period += round(drift)
            behind = starts - number * period
    # Starts come later than expiries, by a little as a rule.
    return period, int(np.quantile(behind, USUALLY))


def _blocker(callbacks: Mapping[int, Callback], found: Occupation, own: pl.DataFrame) -> int | None:
    """The timer behind which a timer's callback starts as a rule, on the same thread."""
    every = found.instances.drop_nulls("end").sort("end")
    last = (
        own.select("pid", "tid", "start")
        .sort("start")
        .join_asof(
            every.select("pid", "tid", "callback_id", end="end"),
            left_on="start",
            right_on="end",
            by=["pid", "tid"],
            strategy="backward",
            check_sortedness=False,
        )
    )
    close = last.filter(pl.col("start") - pl.col("end") < NEXT_NS)["callback_id"]
    if not len(close) or 2 * len(close) <= len(own):
        return None
    blocker = int(close.mode()[0])
    return blocker if callbacks[blocker].kind == "timer" else None


def _in_turn(evidence: _Evidence, node: _Node) -> None:
    """Put callbacks behind those that go first: executors look at them in this order."""

    def turn(one: _Described, other: _Described) -> int:
        return _turn(evidence, one.ids[0], other.ids[0])

    node.callbacks.sort(key=cmp_to_key(turn))
    for described in [*node.callbacks]:
        ids = [one.ids for one in node.callbacks]
        places = [number for number, own in enumerate(ids) if described.before in own]
        if places and node.callbacks.index(described) < places[0]:
            node.callbacks.remove(described)
            node.callbacks.insert(places[0], described)


# Cores, priorities, threads -------------------------------------------------------------------


def _scheduling(evidence: _Evidence, nodes: Mapping[str, _Node]) -> dict[str, Any]:
    """The scheduling of most nodes and of DDS threads; what differs is added to the nodes."""
    threads = {name: _threads(evidence, node) for name, node in nodes.items()}
    bound = {name: _core_of(evidence, own) for name, own in threads.items()}
    priorities = _priorities(evidence, threads)
    dds = _dds_scheduling(evidence)
    free = (core for core in count() if core not in {*bound.values(), dds["core"]})
    together = dict[ThreadKey, int]()  # of an executor that runs several nodes, or none is bound
    roaming = []
    for name, node in nodes.items():
        _add_executor(evidence, node, threads[name])
        core = bound[name]
        if core is None:
            core = next((together[one] for one in threads[name] if one in together), None)
            core = next(free) if core is None else core
            roaming.append(name)
            node.values |= {"bound": False}
        if node.values.get("executor") == "multi_threaded":
            node.values["cores"] = _cores_of_threads(evidence, node, threads[name], core, free)
        else:
            node.values["core"] = core
            together |= dict.fromkeys(threads[name], core)
        node.values["priority"] = priorities[name]
    if roaming:
        evidence.notes.append(
            f"The threads of {', '.join(roaming)} are bound to no core that the recording shows:"
            " simulated, each has a core of its own; live, they run on any."
        )
    _note_shared(evidence, threads)
    common = Counter(node.values["core"] for node in nodes.values() if "core" in node.values)
    usual = Counter(priorities.values()).most_common(1)[0][0]
    core = common.most_common(1)[0][0] if common else dds["core"]
    for node in nodes.values():
        if node.values.get("core") == core:
            del node.values["core"]
        if node.values["priority"] == usual:
            del node.values["priority"]
    return {"executors": {"core": core, "priority": usual}, "dds": dds}


def _threads(evidence: _Evidence, node: _Node) -> list[ThreadKey]:
    """The threads that ran a node's callbacks."""
    own = evidence.instances(node.ids).select("pid", "tid").unique(maintain_order=True)
    return [(int(pid), int(tid)) for pid, tid in own.iter_rows()]


def _core_of(evidence: _Evidence, threads: Sequence[ThreadKey]) -> int | None:
    """The core to which the first of some threads is bound, as long as all are bound to one."""
    cores = [evidence.found.cores.get(one) for one in threads]
    return None if None in cores else cores[0]


def _priorities(evidence: _Evidence, threads: Mapping[str, Sequence[ThreadKey]]) -> dict[str, int]:
    """Each node's priority: as recorded, as the scheduler had it, or by who pre-empted whom."""
    known = {
        (one.pid, one.tid): one.priority if one.policy in REAL_TIME else 0
        for one in evidence.recording.info.threads
    }
    if not known:
        switches = events.table(evidence.flow.events, "sched_switch").drop_nulls("next_prio")
        seen = switches.group_by("next_tid").agg(pl.col("next_prio").mode().first())
        kernel = dict(seen.iter_rows())
        known = {
            one: max(0, 99 - kernel[one[1]])
            for own in threads.values()
            for one in own
            if one[1] in kernel
        }
    ordinary, unknown, found = [], [], dict[str, int]()
    for name, own in threads.items():
        recorded = [known[one] for one in own if one in known]
        if not recorded:
            unknown.append(name)
            ranks = [evidence.found.urgency.get(one, 0) for one in own]
            found[name] = min(MOST_URGENT, DEFAULT_PRIORITY + max(ranks, default=0))
        else:
            found[name] = min(MOST_URGENT, max(1, *recorded))
            if max(recorded) == 0:
                ordinary.append(name)
    if unknown:
        evidence.notes.append(
            f"Priorities of {', '.join(unknown)} are not in the recording: {DEFAULT_PRIORITY}, and"
            " more for those that were seen to pre-empt others on their core."
        )
    if ordinary:
        evidence.notes.append(
            f"{', '.join(ordinary)} had no SCHED_FIFO priority: described with the lowest."
        )
    return found


def _dds_scheduling(evidence: _Evidence) -> dict[str, int]:
    """Core and priority of most DDS threads, as recorded; else those of the machine at hand."""
    recorded = [
        (one.cores[0], one.priority)
        for one in evidence.recording.info.threads
        if one.role == "dds" and len(one.cores) == 1 and one.policy in REAL_TIME
    ]
    if recorded:
        core, priority = Counter(recorded).most_common(1)[0][0]
        return {"core": core, "priority": min(MOST_URGENT, priority)}
    evidence.notes.append(
        "Cores and priorities of DDS threads are not in the recording: the first core, above all"
        " executors."
    )
    return {"core": available_cores()[0], "priority": DDS_PRIORITY}


def _add_executor(evidence: _Evidence, node: _Node, threads: Sequence[ThreadKey]) -> None:
    """Say that a node has several threads, where its callbacks ran at the same time."""
    own = evidence.instances(node.ids).drop_nulls("end").sort("start")
    if len(threads) < 2 or own.is_empty():
        return
    overlaps = _overlaps(own)
    if not overlaps:
        return
    starts, ends = own["start"].to_numpy(), np.sort(own["end"].to_numpy())
    running = np.arange(1, len(starts) + 1) - np.searchsorted(ends, starts, "right")
    node.values |= {"executor": "multi_threaded", "threads": int(max(2, running.max()))}
    groups, kinds = list[set[int]](), dict[str, str]()
    for described in node.callbacks:
        ids = {*described.ids}
        if any((one, other) in overlaps for one in ids for other in ids):
            kinds["beside_itself"] = "reentrant"
            described.values["group"] = "beside_itself"
            continue
        fitting = (
            number
            for number, members in enumerate(groups)
            if not any((one, other) in overlaps for one in ids for other in members)
        )
        number = next(fitting, len(groups))
        groups[number : number + 1] = [ids.union(*groups[number : number + 1])]
        if number:
            kinds[f"group_{number}"] = "mutually_exclusive"
            described.values["group"] = f"group_{number}"
    if kinds:
        node.values["callback_groups"] = kinds
    name = evidence.callbacks[node.ids[0]].node
    evidence.notes.append(
        f"Callback groups of {name} follow from which of its callbacks ran at the same time."
    )


def _overlaps(own: pl.DataFrame) -> set[tuple[int, int]]:
    """Pairs of callbacks of which instances ran at the same time, both ways."""
    found, running = set[tuple[int, int]](), list[tuple[int, int]]()
    for number, start, end in own.select("callback_id", "start", "end").iter_rows():
        running = [one for one in running if one[0] > start]
        found |= {pair for _, other in running for pair in ((number, other), (other, number))}
        running.append((end, number))
    return found


def _cores_of_threads(
    evidence: _Evidence,
    node: _Node,
    threads: Sequence[ThreadKey],
    core: int,
    free: Iterator[int],
) -> list[int]:
    """The core of each thread of an executor: bound to none, each has one of its own."""
    if node.values.get("bound") is False:
        return [core, *(next(free) for _ in range(1, node.values["threads"]))]
    known = [evidence.found.cores.get(one) for one in threads]
    cores = [one for one in known if one is not None]
    return cores[: node.values["threads"]]


def _note_shared(evidence: _Evidence, threads: Mapping[str, Sequence[ThreadKey]]) -> None:
    """Say which nodes share threads: described nodes have processes of their own."""
    groups: list[tuple[set[ThreadKey], list[str]]] = []
    for name, own in threads.items():
        together = [one for one in groups if not one[0].isdisjoint(own)]
        groups = [one for one in groups if one not in together]
        names = [member for _, members in together for member in members]
        groups.append(({*own}.union(*(keys for keys, _ in together)), [*names, name]))
    for _, names in groups:
        if len(names) > 1:
            evidence.notes.append(
                f"{', '.join(names)} share an executor: in the description each has one of its own."
            )


# Topics and costs -----------------------------------------------------------------------------


def _topics(evidence: _Evidence, nodes: Mapping[str, _Node]) -> dict[str, Any]:
    """How topics are published, where that is not as by default."""
    written = {
        topic
        for node in nodes.values()
        for described in node.callbacks
        for topic in described.values.get("publishes", ())
    }
    found: dict[str, dict[str, Any]] = {topic: {} for topic in sorted(written)}
    created = events.table(evidence.flow.events, "rcl_publisher_init", ["asynchronous"])
    for topic, depth, asynchronous in created.select(
        "topic_name", "queue_depth", "asynchronous"
    ).iter_rows():
        if topic in found and asynchronous:
            found[topic]["publication"] = "asynchronous"
        if topic in found and depth and depth != DEFAULT_DEPTH:
            found[topic]["depth"] = int(depth)
    for endpoint in evidence.recording.info.endpoints:
        if endpoint.topic in found and endpoint.kind == "publisher":
            own = found[endpoint.topic]
            if endpoint.reliability == "best_effort":
                own["reliability"] = "best_effort"
            if endpoint.lifespan_ns:
                own["lifespan"] = format_duration(endpoint.lifespan_ns)
    return {topic: own for topic, own in found.items() if own}


def _own_costs(evidence: _Evidence) -> tuple[int, int]:
    """CPU time from being woken to being at work, and from there to a callback (medians, ns).

    They are what passed between the end of a callback that kept a message waiting, and the start of
    the message's own: one of the same thread needs no waking.
    """
    waited = evidence.hops.drop_nulls("kept_ns").with_columns(
        cost=pl.col("delay_ns") - pl.col("kept_ns")
    )
    free = evidence.hops.filter(pl.col("kept_ns").is_null())["delay_ns"]
    most = int(free.quantile(LEAST) or 0) if len(free) else 1 << 40
    same, others = (waited.filter(by_thread=own)["cost"] for own in (True, False))
    take = int(same.median() or 0) if len(same) >= EVIDENCE else 0  # type: ignore[arg-type]
    both = int(others.median() or 0) if len(others) >= EVIDENCE else take  # type: ignore[arg-type]
    take = min(take, most)
    return max(0, min(both, most) - take), take


def _delays(evidence: _Evidence, rows: pl.DataFrame) -> Numbers:
    """How long each message was under way: what came before its thread began to take it.

    Of a message that waited for another callback that is not known: as long as others, though not
    longer than it was kept waiting.
    """
    costs = sum(_own_costs(evidence))
    alone = (rows["delay_ns"] - costs).clip(0).set(rows["kept_ns"].is_not_null(), None)
    usual = alone.median()
    shorter = rows["kept_ns"].clip(0, int(usual or 0))
    unseen = rows["before_ns"]  # when its thread began that callback, else it had begun with it
    waited = pl.select(pl.max_horizontal(shorter, unseen)).to_series()
    known = waited.zip_with(rows["kept_ns"].is_not_null(), alone)
    filled: Numbers = known.fill_null(int(known.median() or 0)).to_numpy().astype(np.int64)
    return filled


def _costs(evidence: _Evidence, nodes: Mapping[str, _Node]) -> dict[str, Any]:
    """What the simulator needs: deliveries as they were, and no cost that is in other times."""
    wake_up, take = _own_costs(evidence)
    own = {"wake_up": wake_up, "take": take, "publish": 0, "delivery": 0}
    costs: dict[str, Any] = {
        key: {"constant": format_duration(value)} for key, value in own.items()
    }
    deliveries_of = {name: node.deliveries for name, node in nodes.items() if node.deliveries}
    return costs | {"interrupts": 0.0, "deliveries": deliveries_of}


# Writing --------------------------------------------------------------------------------------


def _sequences(values: Any) -> Iterator[Numbers]:
    """All sequences of a description, at whatever depth."""
    if isinstance(values, np.ndarray):
        yield values
    elif isinstance(values, dict | list):
        for part in values.values() if isinstance(values, dict) else values:
            yield from _sequences(part)


def _in_whole_cycles(values: Any, cycles: int) -> Any:
    """The description with sequences as long as so many cycles, where they nearly are.

    Those that are shorter by little, since the recording ended, get usual values at their ends:
    they all begin again together.
    """
    if isinstance(values, dict):
        return {key: _in_whole_cycles(part, cycles) for key, part in values.items()}
    if isinstance(values, list):
        return [_in_whole_cycles(part, cycles) for part in values]
    if not isinstance(values, np.ndarray) or not cycles:
        return values
    whole = max(1, round(len(values) / cycles)) * cycles
    if not NEARLY * whole <= len(values) < whole:
        return values
    usual = int(np.median(values))
    return np.concatenate([values, np.full(whole - len(values), usual, np.int64)])


def _chosen(evidence: _Evidence, values: Any) -> dict[int, Numbers]:
    """Which places of sequences are written, by their length: all, unless these are too many."""
    lengths = Counter(len(own) for own in _sequences(values) if own.min() < own.max())
    total = sum(length * number for length, number in lengths.items())
    if total <= MOST_VALUES:
        return {}
    found = {}
    for length in lengths:
        share = np.linspace(0, length - 1, max(2, length * MOST_VALUES // total))
        places = {*np.rint(share).astype(int).tolist()}
        for own in _sequences(values):
            if len(own) == length:
                places |= {int(own.argmax()), int(own.argmin())}
        found[length] = np.array(sorted(places), np.int64)
    kept = 100 * MOST_VALUES / total
    evidence.notes.append(
        f"The recording is long: {kept:.0f} % of its cycles are written, evenly spread, and those"
        " with the longest and the shortest times."
    )
    return found


def _written_out(values: Any, chosen: Mapping[int, Numbers]) -> Any:
    """The description with its sequences as durations."""
    if isinstance(values, np.ndarray):
        if values.min() == values.max():
            return {"constant": format_duration(int(values[0]))}
        places = chosen.get(len(values))
        written = values if places is None else values[places]
        return {"sequence": [format_duration(int(value)) for value in written]}
    if isinstance(values, dict):
        return {key: _written_out(part, chosen) for key, part in values.items()}
    if isinstance(values, list):
        return [_written_out(part, chosen) for part in values]
    return values
