"""Overviews as tables and as plain data.

They show a recording (events, callbacks, chains, stalls), a machine (abilities, threads), a plan
(slots, bands, figure 7's curve), runs in force, a watch, budgets, and a sweep.
"""

from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from datetime import datetime, timezone
from typing import TYPE_CHECKING, Any

import polars as pl

from chainshaper.analysis import ChainEnumeration
from chainshaper.analysis.contradictions import Contradiction
from chainshaper.enforcement.configured_threads import configured, difference
from chainshaper.enforcement.journal import Journal
from chainshaper.enforcement.node_threads import Allocation, NodeThread
from chainshaper.enforcement.thread_scheduling import WantedScheduling
from chainshaper.enforcement.undoing import LoopState, RunState, ServerState
from chainshaper.linux.threads import POLICIES, RunningThread
from chainshaper.planning import BandChoice, ChainPlan, band_predictions, publish_slots
from chainshaper.planning.chain_plan import slot_text
from chainshaper.reporting.graph_drawing import short_symbol
from chainshaper.reporting.latency import expected_jitter_text
from chainshaper.reporting.tables import (
    ABSENT,
    YES_NO,
    Column,
    ResultTable,
    cost_text,
    counted,
    figures,
    interval_ms,
    listed,
    min_mean_max,
    ms,
    percent,
    plain,
    scheduling_text,
    slots_ms,
    words,
)
from chainshaper.values.application import ApplicationGraph, Chain, trigger_text
from chainshaper.values.callback_groups import (
    CallbackGroup,
    GroupConfiguration,
    ThreadConfiguration,
)
from chainshaper.values.durations import duration_text, format_duration, milliseconds
from chainshaper.values.hosts import process_text
from chainshaper.values.recording import (
    INFO_FILE,
    MachineReport,
    Recording,
    StallMeterInfo,
    ThreadInfo,
    event_counts,
    lost_text,
)
from chainshaper.verify.measure import PARTS, Measurement

if TYPE_CHECKING:  # only the verbs `watch` and `budget` need these modules
    from chainshaper.monitor.budgets import Judged
    from chainshaper.monitor.watch import AgeNow, Seen
    from chainshaper.monitor.watched_loops import LoopNow

UNKNOWN = "unknown"
COLOURS = {"good": "green", "limited": "yellow", "absent": "red"}
MARKS = {"good": "✓", "limited": "!", "absent": "✗"}
BACK_END = "back end "  # what the name of a back end's check begins with
WORTH_SAYING_NS = 1_000_000  # of a stall: as long as the shortest slot
OF_LOOPS = {  # column of `callback_statistics` that loops alone have → title
    "phase_ns": "phase",
    "start_jitter_ns": "jitter\nof start",
    "overruns": "overruns",
}
MOST_ROWS = 50  # points of a sweep that a table shows
MOST_SLOTS = 8  # slots of a server that a table shows
SWEEP_FIGURES = {  # column of a sweep's frame → title
    "mean_ns": "average",
    "max_ns": "maximum",
    "jitter_ns": "jitter",
    "band_jitter_ns": "jitter\nin a band",
    "late": "late",
    "incomplete": "no output",
    "kept": "promise",
}
PROMISE = {True: "met", False: "broken", None: ABSENT}


def contents_json(
    recording: Recording, contradictions: Sequence[Contradiction] = ()
) -> dict[str, Any]:
    """Describe a recording: counts per event, events lost, clock offset, system, contradictions."""
    info = recording.info
    notes = list(info.notes)
    # Older recordings have no checksums. A tracer's trace never has any, and needs no note.
    if info.checksums is None and (recording.path / INFO_FILE).is_file():
        notes.append(
            "this recording has no checksums, so that damage to its files may go unseen:"
            " `chainshaper convert` writes one that has"
        )
    clocks = {"clocks": [host.model_dump() for host in info.hosts]} if info.hosts else {}
    return {
        "source": info.source,
        **clocks,
        "events": dict(event_counts(recording).iter_rows()),
        "lost": info.lost,
        "clock_offset_ns": info.clock_offset_ns,
        "distribution": info.distribution,
        "rmw": info.rmw,
        "hosts": [host for host in info.host.split(", ") if host],
        "kernel": info.kernel,
        "processes": {str(pid): name for pid, name in info.processes.items()},
        "notes": notes,
        "contradictions": [{"note": each.note, "refused": each.refused} for each in contradictions],
    }


def contents_table(recording: Recording) -> tuple[ResultTable, ...]:
    """Make two tables of a recording: its system, and how often each event happened.

    Of a recording of several hosts there is a third, of their clocks.
    """
    contents = contents_json(recording)
    system = ResultTable(str(recording.path), words("", ""))
    for title, value in (
        ("source", contents["source"]),
        ("distribution", contents["distribution"] or UNKNOWN),
        ("RMW", contents["rmw"] or UNKNOWN),
        ("hosts", ", ".join(contents["hosts"]) or UNKNOWN),
        ("clock offset", f"{contents['clock_offset_ns']} ns to CLOCK_REALTIME"),
        *(
            (f"process {process_text(int(pid), recording.info.hosts)}", name)
            for pid, name in contents["processes"].items()
        ),
    ):
        system.add(title, value)
    total = f"{sum(contents['events'].values()):,}"
    columns = [Column("event", words=True, footer="together"), Column("count", footer=total)]
    events = ResultTable("Events", columns)
    for name, number in contents["events"].items():
        events.add(name, f"{number:,}")
    return (system, clocks_table(recording), events) if recording.info.hosts else (system, events)


def clocks_table(recording: Recording) -> ResultTable:
    """Make a table of how far each host's clock is ahead of the first one's."""
    reference, *others = recording.info.hosts
    columns = [*words("host"), *figures("ahead [ms]", "known to [ms]", "drift [ppm]", "jumps")]
    columns += [*figures("messages there", "back"), *words("wall clocks' claim")]
    table = ResultTable(f"Clocks against {reference.name}, by messages", columns)
    for host in others:
        low, high = host.drift_ppm
        drift = f"{low:+.2f}" if low == high else f"{low:+.2f} to {high:+.2f}"
        claim = "" if host.claimed_ns is None else f"{ms(host.claimed_ns)}: {host.claim_is}"
        counts_of = (f"{host.messages_there:,}", f"{host.messages_back:,}")
        table.add(
            host.name,
            interval_ms(host.offset_ns),
            f"± {ms(host.width_ns / 2)}",
            drift,
            len(host.steps),
            *counts_of,
            claim,
        )
    return table


def callback_rows(statistics: pl.DataFrame) -> list[dict[str, Any]]:
    """Callback statistics as plain data, with some of the columns of ``callback_statistics``.

    See :func:`~chainshaper.analysis.latency.callback_statistics`.
    """
    columns = ("node", "kind", "topic", "period_ns", "declared_ns", "pid", "pids", "tids", "count")
    times = ("response_ns", "execution_ns", *OF_LOOPS)
    return statistics.select(*columns, *times).to_dicts()


def callback_table(statistics: pl.DataFrame) -> ResultTable:
    """Make a table of callbacks: threads, number of instances, execution and response times.

    Execution and response times, and figures of loops, have columns only where there are any. The
    name of the function has a column in the report. On the terminal it stands behind callbacks that
    look alike without it.
    """
    measured = [name for name in ("execution", "response") if statistics[f"{name}_ns"].count()]
    columns = [*words("node", "callback"), Column("function", words=True, detail=True)]
    columns += figures("thread", "count")
    for name in measured:
        columns += figures(*(f"{name}\n{figure}" for figure in ("min", "mean", "max")))
    of_loops = [name for name in OF_LOOPS if statistics[name].count()]
    columns += figures(*(OF_LOOPS[name] for name in of_loops))
    table = ResultTable("Callbacks [ms]", columns)
    rows = []
    for row in statistics.to_dicts():
        starts = trigger_text(row["topic"], row["period_ns"], row["declared_ns"])
        trigger = f"{row['kind']} {starts}".rstrip()
        rows.append(((row["pid"], row["node"], trigger), row))
    alike = Counter(key for key, _ in rows)
    for key, row in rows:
        symbol, trigger = short_symbol(row["symbol"]), key[2]
        shown = f"{trigger} ({symbol})" if symbol and alike[key] > 1 else trigger
        times = (cell for name in measured for cell in min_mean_max(row[f"{name}_ns"]))
        loop = (
            ms(row[name]) if name != "overruns" or row[name] is None else row[name]
            for name in of_loops
        )
        table.add(
            row["node"] or "", shown, symbol, listed(row["tids"]), row["count"], *times, *loop
        )
    return table


def chains_json(graph: ApplicationGraph, enumeration: ChainEnumeration) -> dict[str, Any]:
    """The number of chains (unless ``exact``, a lower bound), those listed, and the heaviest."""
    heaviest = None
    if enumeration.heaviest is not None:
        heaviest = {**_chain(graph, enumeration.heaviest), "response_ns": enumeration.heaviest_ns}
    chains = [_chain(graph, chain) for chain in enumeration.chains]
    known = {name: getattr(enumeration, name) for name in ("count", "exact", "complete")}
    return {**known, "heaviest": heaviest, "chains": chains}


def _chain(graph: ApplicationGraph, chain: Chain) -> dict[str, Any]:
    """A chain as plain data."""
    path = graph.path(chain)
    return {
        "chain": chain.spec,
        "nodes": [callback.node for callback in path],
        "callbacks": [graph.label(callback) for callback in path],
        "topics": list(chain.topics),
    }


def count_text(enumeration: ChainEnumeration) -> str:
    """How many chains there are, and how many of them are listed."""
    number = counted(enumeration.count, "chain")
    if not enumeration.exact:
        number = f"at least {number}"
    return number if enumeration.complete else f"{number}, {len(enumeration.chains)} of them listed"


def chain_table(graph: ApplicationGraph, enumeration: ChainEnumeration) -> ResultTable:
    """Make a table of chains: where each starts, the topics it passes; the heaviest is marked."""
    columns = [*words("starts at", "topics"), *figures("heaviest [ms]")]
    table = ResultTable("Computation chains", columns)
    for chain in dict.fromkeys(filter(None, (*enumeration.chains, enumeration.heaviest))):
        row = _chain(graph, chain)
        heaviest = chain == enumeration.heaviest and enumeration.heaviest_ns is not None
        weight = milliseconds(enumeration.heaviest_ns or 0) if heaviest else ""
        table.add(row["callbacks"][0], " → ".join(row["topics"]), weight)
    return table


def threads_json(
    allocation: Allocation, configuration: GroupConfiguration | None = None
) -> dict[str, Any]:
    """The threads of a running application as plain data, and notes on what is not certain.

    With a configuration of callback_isolated_executor, what it gives to each of them, too.
    """
    given = {} if configuration is None else configured(allocation.threads, configuration)
    rows = [
        {
            "nodes": list(listed_thread.nodes),
            "nodes_known_by": listed_thread.nodes_known_by or None,
            **{
                name: getattr(listed_thread.thread, name) for name in ("pid", "tid", "comm", "role")
            },
            "callbacks": [
                {"node": node, "callback": name} for node, name in listed_thread.callbacks
            ],
            "dds_kind": listed_thread.thread.kind,
            "known_by": listed_thread.known_by or None,
            "policy": listed_thread.thread.policy,
            "priority": listed_thread.thread.priority,
            "cores": list(listed_thread.thread.cores),
            "reservation": listed_thread.thread.reservation
            and vars(listed_thread.thread.reservation),
            **(
                {}
                if configuration is None
                else _configured_json(listed_thread, given.get(listed_thread.thread.identity))
            ),
        }
        for listed_thread in allocation.threads
    ]
    return {"threads": rows, "notes": list(allocation.notes)}


def _configured_json(
    listed_thread: NodeThread, pair: tuple[CallbackGroup, ThreadConfiguration] | None
) -> dict[str, Any]:
    """What a configuration gives to a thread: its group, the scheduling, and how the two differ."""
    if pair is None:
        return {"callback_group": None, "configured": None, "differs": None}
    group, entry = pair
    return {
        "callback_group": group.id,
        "configured": {
            "policy": entry.policy,
            "priority": entry.real_time_priority,
            "cores": [*(entry.affinity or ())],
        },
        "differs": difference(entry, listed_thread.thread),
    }


def threads_table(
    allocation: Allocation, configuration: GroupConfiguration | None = None
) -> ResultTable:
    """Make a table of threads; node and process are left out where the row above has the same.

    With a configuration of callback_isolated_executor it has a further column.
    """
    names = ["node", "pid", "tid", "name", "role", "class", "cores", "known by"]
    given = {} if configuration is None else configured(allocation.threads, configuration)
    names += [] if configuration is None else ["configured"]
    table = ResultTable("Threads", words(*names))
    row_above: NodeThread | None = None
    for listed_thread in allocation.threads:
        thread = listed_thread.thread
        first = row_above is None or row_above.thread.pid != thread.pid
        same_nodes = not first and row_above is not None and row_above.nodes == listed_thread.nodes
        known_by, names = (
            [listed_thread.known_by or "-"],
            [name for _, name in listed_thread.callbacks],
        )
        if first and listed_thread.nodes:
            known_by.append(f"node: {listed_thread.nodes_known_by or None}")
        role = f"DDS {thread.kind}" if thread.role == "dds" else ", ".join((thread.role, *names))
        scheduling = scheduling_text(thread.policy, thread.priority), core_ranges(thread.cores)
        if thread.reservation is not None:
            scheduling = f"{scheduling[0]} {thread.reservation.text}", scheduling[1]
        nodes = "" if same_nodes else ", ".join(listed_thread.nodes) or UNKNOWN
        numbers = thread.pid if first else "", thread.tid, thread.comm
        cells = [nodes, *numbers, role, *scheduling, "; ".join(known_by)]
        if configuration is not None:
            cells.append(_configured_text(thread, given.get(thread.identity)))
        table.add(*cells)
        row_above = listed_thread
    return table


def _configured_text(
    thread: RunningThread, pair: tuple[CallbackGroup, ThreadConfiguration] | None
) -> str:
    """What a configuration gives to a thread, and whether the thread has it."""
    if pair is None:
        return ""
    group, entry = pair
    state = "as it has" if difference(entry, thread) is None else "in place of what it has"
    return f"{group.id}: {entry.text}, {state}"


def core_ranges(cores: Sequence[int]) -> str:
    """Cores as the kernel writes them: ``0-3,7``."""
    runs: list[list[int]] = []
    for core in cores:
        if runs and core == runs[-1][-1] + 1:
            runs[-1][1:] = [core]
        else:
            runs.append([core])
    return ",".join("-".join(map(str, run)) for run in runs)


def machine_json(report: MachineReport) -> dict[str, Any]:
    """All checks of a machine and its stalls as plain data."""
    return {
        "checks": [vars(check) for check in report.checks],
        "stalls": stall_rows(report.stall_meter, report.stalls),
        "watched_ns": report.watched_ns,
        "threshold_ns": report.stall_meter.threshold_ns,
        "realtime": report.stall_meter.realtime,
    }


def machine_tables(report: MachineReport) -> tuple[ResultTable, ResultTable]:
    """Make two tables of a machine: what it can do, and its stalls."""
    abilities = ResultTable("This machine", words("", "found", "for", "remedy"))
    for check in report.checks:
        finding = plain(check.found, COLOURS[check.state])
        name = f"{MARKS[check.state]} {check.name}"
        abilities.add(name, finding, check.needed_for, check.remedy)
    threshold = duration_text(report.stall_meter.threshold_ns)
    stalls = stall_table(report.stall_meter, report.stalls)
    stalls.title = f"Stalls longer than {threshold} in {duration_text(report.watched_ns)}"
    if not report.stall_meter.realtime:
        stalls.caption = "taken without SCHED_FIFO: ordinary scheduling is among these stalls"
    return abilities, stalls


def machine_line(report: MachineReport) -> str:
    """Say in a line whether this machine can shape, by which back end, and what to look at."""
    usable = [
        check.name.removeprefix(BACK_END)
        for check in report.checks
        if check.name.startswith(BACK_END) and check.state == "good"
    ]
    if not usable:
        (fifo,) = (check for check in report.checks if check.name == f"{BACK_END}fifo")
        return f"✗ this machine cannot shape: {fifo.found}; {fifo.remedy}"
    doubts = [check.name for check in report.checks if check.state == "limited"]
    longest = max(row["longest_ns"] for row in stall_rows(report.stall_meter, report.stalls))
    if longest >= WORTH_SAYING_NS:
        doubts.append(f"stalls of up to {duration_text(round(longest, -5))}")
    mark, about = ("!", f"; see {', '.join(doubts)}") if doubts else ("✓", "")
    return f"{mark} this machine can shape, by {usable[0]}: `chainshaper demo` shows it{about}"


def stall_rows(meter: StallMeterInfo, stalls: pl.DataFrame) -> list[dict[str, Any]]:
    """Count the stalls of each core; sum their durations and find the longest (ns).

    ``stalls`` has the columns ``cpu, duration`` (ns).
    """
    rows = []
    for core, usual in zip(meter.cores, meter.median_lateness_ns, strict=True):
        durations = stalls.filter(cpu=core)["duration"].to_list()
        row = {"core": core, "count": len(durations), "longest_ns": max(durations, default=0)}
        rows.append({**row, "total_ns": sum(durations), "median_wakeup_ns": usual})
    return rows


def stall_table(meter: StallMeterInfo, stalls: pl.DataFrame) -> ResultTable:
    """Make a table of the stalls of each core."""
    titles = ("stalls", "in all [ms]", "longest [ms]", "usual wake-up [µs]")
    table = ResultTable("", [*words(""), *figures(*titles)])
    for row in stall_rows(meter, stalls):
        times = ms(row["total_ns"]), ms(row["longest_ns"] or None)
        table.add(
            f"core {row['core']}", row["count"], *times, f"{row['median_wakeup_ns'] / 1e3:.0f}"
        )
    return table


def condition_table(
    names: Sequence[str], recordings: Sequence[Sequence[Measurement]]
) -> ResultTable:
    """Make a table of how each recording was taken, a column for each.

    A recording has a measurement for each of its chains.
    """
    columns = []
    for first, *further in recordings:
        info, plans = (
            first.recording.info,
            [measurement.plan for measurement in (first, *further) if measurement.plan is not None],
        )
        in_force = "\n".join(map(_in_force, plans))
        columns.append(
            {
                "folder": str(first.recording.path),
                "first cycle": _begun(first),
                "source": info.source,
                "host": info.host,
                "kernel": info.kernel,
                "ROS 2 distribution": info.distribution,
                "RMW": info.rmw,
                "command": " ".join(info.command),
                "real-time scheduling": YES_NO.get(info.realtime),
                "scheduling in force": _scheduling(info.threads),
                "machine watched for stalls": _watched(info.stall_meter),
                "events": f"{event_counts(first.recording)['count'].sum():,}",
                "events lost": lost_text(info.lost).partition(": ")[2],
                "plan in force": in_force or "none",
            }
        )
    table = ResultTable("", words("", *names))
    for title in columns[0]:
        table.add(title, *(column[title] or UNKNOWN for column in columns))
    return table


def _in_force(plan: ChainPlan) -> str:
    """A plan in one line: its policy, whether servers close behind their slots, its chain."""
    closing = "servers closed behind their slots" if plan.slot_ends == "closed" else ""
    parts = [part for part in (plan.policy, closing) if part]
    return f"{', '.join(parts)}, for {plan.chain.spec or 'a chain'}"


def _begun(measurement: Measurement) -> str:
    """Text: when the first cycle began, how many there are, and the time from first to last."""
    starts = measurement.analysis.traversals["start"]
    if not len(starts):
        return "none"
    offset = measurement.recording.info.clock_offset_ns
    first = datetime.fromtimestamp((starts[0] + offset) / 1e9, tz=timezone.utc)
    lasted = (starts[-1] - starts[0]) / 1e9
    return f"{first:%Y-%m-%d %H:%M:%S} UTC, {len(starts)} cycles in {lasted:.1f} s"


def _scheduling(threads: Iterable[ThreadInfo]) -> str:
    """How many threads of each role have which scheduling and cores, a line each."""
    kinds = Counter(
        (thread.role, thread.policy, thread.priority, thread.cores) for thread in threads
    )
    return "\n".join(
        f"{role}: {policy} {priority}, {cores_text(cores)} ({number})"
        for (role, policy, priority, cores), number in sorted(kinds.items())
    )


def cores_text(cores: Sequence[int]) -> str:
    """``cores 0, 1``."""
    return f"core{'' if len(cores) == 1 else 's'} {listed(cores)}"


def _watched(meter: StallMeterInfo | None) -> str:
    """How the machine was watched for stalls."""
    if meter is None:
        return "no: disturbed cycles are not known"
    open = "" if meter.realtime else ", itself open to pre-emption"
    return (
        f"every {meter.period_ns / 1e6:g} ms on {cores_text(meter.cores)}{open}; stalls from "
        f"{meter.threshold_ns / 1e6:g} ms"
    )


def recorded_thread_table(threads: Sequence[ThreadInfo]) -> ResultTable:
    """Make a table of a recorded application's threads, as the kernel reported them."""
    columns = [*words("node", "thread", "role"), *figures("pid", "tid")]
    table = ResultTable("", [*columns, *words("scheduling"), *figures("cores")])
    for recorded in sorted(threads, key=lambda thread: (thread.node, thread.tid)):
        scheduling = f"{recorded.policy} {recorded.priority}", listed(recorded.cores)
        table.add(
            recorded.node, recorded.comm, recorded.role, recorded.pid, recorded.tid, *scheduling
        )
    return table


def plan_table(plan: ChainPlan) -> ResultTable:
    """Make a table of a plan's servers, their slots and threads."""
    columns = [*words("server"), *figures("core", "priority"), *words("slots", "threads")]
    table = ResultTable(f"Plan for {plan.chain.spec or 'a chain'} [ms]", columns)
    for server in plan.servers:
        threads = []
        for thread in server.threads:
            publishes = thread.role == "publisher"
            role = "publisher" if publishes else ", ".join(thread.callbacks)
            threads.append(f"{thread.node} ({role})" if role else thread.node)
        table.add(
            server.name, server.core, server.priority, slots_ms(*server.slots), ", ".join(threads)
        )
    offset = f", offset {milliseconds(plan.offset_ns)}" if plan.offset_ns else ""
    table.caption = f"cycle {milliseconds(plan.cycle_ns)}{offset}; {expected_jitter_text(plan)}"
    if (received := receivers_text(plan)) is not None:
        table.caption += f"\n{received}"
    if (read := loop_text(plan)) is not None:
        table.caption += f"\n{read}"
    return table


def loop_text(plan: ChainPlan) -> str | None:
    """Text: how old the data of the loop are that reads a plan's output, when it reads them."""
    loop = plan.loop
    if loop is None:
        return None
    how_often = "irregular" if loop.period_ns is None else f"every {duration_text(loop.period_ns)}"
    text = f"loop of {loop.node}, {how_often}, reads {loop.topic}: age at the first use"
    low, high = loop.age.first_ns
    text += f" {milliseconds(low)} to {milliseconds(high)}"
    text += ", constant" if loop.age.constant else ""
    if loop.age.every_ns != loop.age.first_ns:
        text += f"; in all of its cycles up to {milliseconds(loop.age.every_ns[1])}"
    fewest, most = loop.age.uses
    times = f"{fewest} to {most} times" if fewest != most else f"{most} times"
    times = {(1, 1): "once", (0, 1): "once or never"}.get(loop.age.uses, times)
    text += f"; a message is used {times}"
    if loop.in_step == "output":
        text += (
            f"\nin step: the slot starts {milliseconds(loop.lead_ns)} before the loop, or sooner"
        )
    if loop.in_step == "loop":
        text += f"\nin step: the loop starts {milliseconds(loop.lead_ns)} behind the slot's start"
    return text


def receivers_text(plan: ChainPlan) -> str | None:
    """Text: where the receivers of a plan's output run, and what the plan promises them."""
    node, promised = plan.shaping_node, plan.predicted.receivers
    if node is None or node.receivers_at is None or promised is None:
        return None
    text = f"{', '.join(node.receivers)} on core {node.receivers_at.core}: callbacks start by"
    text += f" {milliseconds(promised.max_ns)}, jitter"
    return f"{text} {milliseconds(promised.jitter_ns)} at most"


def bands_table(plan: ChainPlan) -> ResultTable:
    """Make a table of a plan's latency bands as predicted, or of its modes and their slots."""
    if plan.modes is not None and plan.evidence.modes is not None:
        columns = [*words("mode"), *figures("cycles", "min", "mean", "max", "slot")]
        table = ResultTable("Modes, as measured, and their slots [ms]", columns)
        for mode, evidence in plan.evidence.modes.items():
            times = map(
                ms, (evidence.min_latency_ns, evidence.mean_latency_ns, evidence.max_latency_ns)
            )
            slot = publish_slots(plan)[plan.modes.bands[mode] - 1]
            table.add(mode, f"{evidence.samples:,}", *times, slots_ms(slot))
        return table
    columns = figures("slot", "share of cycles", "jitter at most")
    table = ResultTable("Predicted latency bands [ms]", columns)
    for start, end, share, jitter in band_predictions(plan):
        table.add(slots_ms((start, end)), percent(share), ms(jitter))
    return table


def choice_table(choice: BandChoice) -> ResultTable:
    """Make a table of figure 7: the average over the number of bands, and where `auto` stops."""
    columns = [*figures("bands", "average", "gain"), *words("slots end at")]
    table = ResultTable("Average over the number of bands [ms]", columns, choice.reason)
    for before, placement in zip((None, *choice.curve), choice.curve, strict=False):
        ends = placement.slot_ends_ns
        table.add(
            f"{'→ ' if placement is choice.chosen else ''}{len(ends)}",
            milliseconds(placement.mean_ns),
            ABSENT if before is None else f"{1 - placement.mean_ns / before.mean_ns:.2%}",
            " ".join(map(milliseconds, ends)),
        )
    return table


def choice_json(choice: BandChoice) -> dict[str, Any]:
    """Figure 7 as plain data, as in :func:`choice_table`."""
    curve = [
        {
            "bands": len(placement.slot_ends_ns),
            "mean_ns": round(placement.mean_ns),
            "bands_ns": list(placement.slot_ends_ns),
        }
        for placement in choice.curve
    ]
    chosen = len(choice.chosen.slot_ends_ns)
    return {"curve": curve, "chosen": chosen, "reason": choice.reason}


def servers_table(state: RunState) -> ResultTable:
    """Make a table of a run's servers, with their counters since they were armed."""
    columns = words("server", "core", "priority", "slots", "threads", "enforced by")
    columns += figures("slots opened", "late", "worst", "overruns")
    table = ResultTable(f"{state.plan or 'plan'} in force with {state.back_end}", columns)
    if state.anchor_ns is not None:
        table.caption = f"cycles of {duration_text(state.cycle_ns)}"
        if state.drift_ns is not None:
            table.caption += f"; the chain's start has drifted by {state.drift_ns / 1e6:+.3f} ms"
        for move in {latest.chain: latest for latest in state.moves}.values():
            table.caption += f"; {move.text}"
        for step in {(latest.chain, latest.loop): latest for latest in state.steps}.values():
            table.caption += f"; {step.text}"
        for loop in state.loops:
            table.caption += f"; {loop.text}"
    for server in state.servers:
        slots = " ".join(map(slot_text, server.slots[:MOST_SLOTS]))
        # A server of several chains has slots over the whole hyper-period.
        if (more := len(server.slots) - MOST_SLOTS) > 0:
            slots += f" and {more} more"
        table.add(
            server.name,
            server.core,
            server.priority,
            slots,
            listed(server.threads) or "none",
            server.kept_by,
            *_counters(server).values(),
        )
    return table


def run_line(state: RunState) -> str:
    """The state of a run in one line, for where there is no terminal."""
    parts = []
    for server in state.servers:
        known = [f"{key} {value}" for key, value in _counters(server).items() if value != "-"]
        if known:
            parts.append(f"{server.name}: {', '.join(known)}")
    return "; ".join(parts) or f"in force with {state.back_end}"


def _counters(server: ServerState) -> dict[str, str]:
    """Texts of a server's counters, by their names; ``-`` where there is none."""
    counters = server.counters
    lateness = counters.longest_lateness_ns
    worst = None if lateness is None else f"{milliseconds(lateness)} ms"
    values = {"slots": counters.slots, "late": counters.late_entries, "worst": worst}
    values["overruns"] = counters.overruns
    return {name: "-" if value is None else str(value) for name, value in values.items()}


def runs_table(runs: Iterable[tuple[Journal, RunState | None]]) -> ResultTable:
    """Make a table of the runs on this machine: plan, back end, owner and state."""
    table = ResultTable("Plans in force", words("run", "plan", "back end", "owner", "state"))
    for journal, state in runs:
        plan, back_end = (state.plan, state.back_end) if state else ("not known yet", "")
        if journal.owner is None:
            condition = "crashed: `chainshaper release` undoes it"
        elif state is None:
            condition = "being set up"
        else:
            condition = f"failed: {state.failure}" if state.failure else run_line(state)
        owner = "gone" if journal.owner is None else str(journal.owner)
        table.add(journal.path.parent.name, plan, back_end, owner, condition)
    return table


def watch_tables(seen: "Seen") -> list[ResultTable]:
    """Make tables of each watched chain, its spans, hops and data's age; and one of all loops."""
    nodes = ", ".join(sorted(filter(None, seen.processes.values()))) or "no node"
    tables = []
    for chain in seen.chains:
        title = f"{chain.chain}: {chain.rate_hz:.2f} cycles a second"
        if chain.promised_ns is not None:
            shares = ", ".join(map(percent, chain.shares)) or "no output yet"
            moved = f", moved by {chain.moved_ns / 1e6:+.3f} ms" if chain.moved_ns else ""
            title += f"; the plan's last slot ends at {ms(chain.promised_ns)} ms{moved}"
            title += f", in slots: {shares}"
            if chain.shares:
                outside = max(1.0 - chain.early - sum(chain.shares), 0.0)
                title += f", before the first: {percent(chain.early)}, outside: {percent(outside)}"
        if chain.kept is not None:
            met = "met" if chain.kept else "broken"
            title += f"; promise {met} over the hour: {chain.outputs.text},"
            title += f" {chain.outputs.most_missed} at most"
        names = ("cycles", "min", "p50", "p99", "max", "jitter", "late", "incomplete")
        table = ResultTable(title, [*words("last [ms]"), *figures(*names)], chain.problem)
        for span, latencies in chain.spans.items():
            table.add(
                span,
                latencies.count,
                ms(latencies.min_ns),
                ms(latencies.percentiles_ns.get("50")),
                ms(latencies.percentiles_ns.get("99")),
                ms(latencies.max_ns),
                ms(latencies.jitter_ns),
                latencies.late,
                latencies.incomplete,
            )
        tables.append(table)
        if chain.hops:
            hops = ResultTable("", [*words("node", "topic"), *figures(*PARTS)])
            for hop in chain.hops:
                hops.add(hop.node, hop.topic, *(ms(getattr(hop, f"{part}_ns")) for part in PARTS))
            tables.append(hops)
        if chain.age is not None:
            tables.append(_age_now_table(chain.age))
    if seen.loops or not tables:
        tables.append(_loops_now_table(seen.loops))
    if seen.in_step:
        tables.append(_in_step_table(seen.in_step))
    lost = f"; {seen.lost} events lost" if seen.lost else ""
    if unclear := sum(chain.counted["unclear"] for chain in seen.chains):
        lost += f"; {unclear} cycles unclear: the clock was set"
    if unused := sum(chain.counted["not_used"] for chain in seen.chains):
        lost += f"; {unused} messages not used: newer ones were stored"
    lost += "".join(f"; {reason.rstrip('.')}" for reason in seen.left_out)
    problem = tables[-1].caption
    tables[-1].caption = f"{problem}; {nodes}{lost}" if problem else f"{nodes}{lost}"
    return tables


def _in_step_table(loops: Sequence[LoopState]) -> ResultTable:
    """Make a table of loops that are kept in step with outputs."""
    names = ("lead", "off by", "moved by", "age", "drift [ppm]", "starts", "missed")
    columns = [*words("in step [ms]", "loop", "moves"), *figures(*names)]
    reasons = "; ".join(loop.text for loop in loops if not loop.in_step)
    table = ResultTable("", columns, reasons or None)
    for loop in loops:
        times = (loop.lead_ns, loop.error_ns, loop.moved_ns, loop.age_ns)
        drift = ABSENT if loop.drift_ppm is None else f"{loop.drift_ppm:+.1f}"
        counted = (loop.starts, loop.misses)
        table.add(loop.chain, loop.loop, loop.moves, *map(ms, times), drift, *counted)
    return table


def _age_now_table(age: "AgeNow") -> ResultTable:
    """Make a table of the age of a loop's data over the last minute."""
    names = ("cycles", "min", "p50", "p99", "max", "jitter", "never used", "used again")
    table = ResultTable("", [*words("age at the loop [ms]"), *figures(*names)])
    ages = age.at_loop
    middle = (ages.percentiles_ns.get(name) for name in ("50", "99"))
    times = (ages.min_ns, *middle, ages.max_ns, ages.jitter_ns)
    shares = ("" if share is None else percent(share) for share in (age.never, age.again))
    table.add("last minute", ages.count, *map(ms, times), *shares)
    return table


def _loops_now_table(loops: "Sequence[LoopNow]") -> ResultTable:
    """Make a table of how loops kept their rate over the last minute."""
    names = ("instances", "period", "jitter of start", "overruns", "missed its rate")
    problems = "; ".join(f"{loop.loop}: {loop.problem}" for loop in loops if loop.problem)
    nothing = "no loop has been seen" if not loops else None
    table = ResultTable(
        "Loops, over the last minute [ms]", [*words("loop"), *figures(*names)], problems or nothing
    )
    for loop in loops:
        rate = loop.rate
        overruns = "" if rate.overruns is None else rate.overruns
        table.add(
            loop.loop,
            rate.count,
            ms(rate.period_ns),
            ms(rate.start_jitter_ns),
            overruns,
            loop.misses,
        )
    return table


def fleet_table(judged: "Sequence[Sequence[Judged]]") -> ResultTable:
    """Make a table of how many limits each recording breaks, the worst first."""
    columns = [*words("recording"), *figures("limits", "broken"), *words("first of them")]
    table = ResultTable("Recordings against the budget", columns)
    rows = [(limits, [limit for limit in limits if not limit.met]) for limits in judged if limits]
    for limits, broken in sorted(rows, key=lambda row: -len(row[1])):
        first = broken[0].text if broken else ""
        table.add(limits[0].recording, len(limits), len(broken), first)
    return table


def broken_table(broken: "Sequence[Judged]") -> ResultTable:
    """Make a table of the limits of a budget that are broken, and why."""
    columns = [*words("recording", "where", "limit"), *figures("budget", "found")]
    table = ResultTable("Limits that are broken", [*columns, *words("because")])
    for judged in broken:
        shown: Callable[[float | None], str] = percent if judged.is_share else ms
        if judged.is_cost:
            shown = cost_text
        values = shown(judged.limit), shown(judged.measured)
        table.add(judged.recording, judged.where, judged.figure, *values, judged.because or "")
    return table


def changes_table(changes: Iterable[WantedScheduling]) -> ResultTable:
    """Make a table of the scheduling that a plan would give to each thread."""
    names = ("node", "pid", "tid", "name", "role", "server", "class", "core", "why")
    table = ResultTable("What threads would get", words(*names))
    for change in changes:
        thread, wanted = change.node_thread.thread, change.scheduling
        scheduling = "as it is"
        if wanted.priority is not None:
            scheduling = scheduling_text(POLICIES[wanted.policy], wanted.priority)
        cores = listed(wanted.cores) if wanted.cores else "as they are"
        table.add(
            ", ".join(change.node_thread.nodes),
            thread.pid,
            thread.tid,
            thread.comm,
            thread.role,
            change.server or "",
            scheduling,
            cores,
            change.reason,
        )
    return table


def sweep_table(frame: pl.DataFrame) -> ResultTable:
    """Make a table of a sweep: the axes and most important figures of the first points."""
    axes = sweep_axes(frame)
    names = [name.removesuffix("_ns") for name in (*axes, *SWEEP_FIGURES.values())]
    has_cost = frame["control_cost"].count() > 0
    names += ["control cost"] if has_cost else []
    table = ResultTable("Simulated end-to-end latency [ms]", figures(*names))
    for row in frame.head(MOST_ROWS).to_dicts():
        row["kept"] = PROMISE[row["kept"]]
        cells = [
            ms(row[figure]) if figure.endswith("_ns") else row[figure] for figure in SWEEP_FIGURES
        ]
        if has_cost:
            cost = row["control_cost"]
            cells.append("unstable" if cost is None else f"{cost:.4g}")
        if row["error"] is not None:
            cells = ["failed", *([""] * (len(cells) - 1))]
        table.add(*(sweep_value(name, row[name]) for name in axes), *cells)
    if frame.height > MOST_ROWS:
        table.caption = f"the first {MOST_ROWS} of {frame.height} points"
    return table


def sweep_axes(frame: pl.DataFrame) -> list[str]:
    """Names of a sweep's axes: the columns before those that all sweeps have.

    A seed that is varied is an axis.
    """
    return frame.columns[: frame.columns.index("cycles")]


def sweep_value(name: str, value: Any) -> str:
    """Text of a point's place on an axis."""
    if value is None:
        return ABSENT
    return format_duration(value) if name.endswith("_ns") else str(value)
