"""What there is, in rows and as plain data: in a recording (events, callbacks, chains, stalls), on
a machine (abilities, threads), in a plan (slots, bands, figure 7's curve), in force, in a sweep."""

from collections import Counter
from collections.abc import Iterable, Sequence
from datetime import datetime, timezone
from typing import TYPE_CHECKING, Any

import polars as pl

from chainshaper.analysis import ChainEnumeration
from chainshaper.analysis.contradictions import Contradiction
from chainshaper.enforcement.journal import Journal
from chainshaper.enforcement.node_threads import Allocation, NodeThread
from chainshaper.enforcement.thread_scheduling import WantedScheduling
from chainshaper.enforcement.undoing import RunState, ServerState
from chainshaper.linux.threads import POLICIES
from chainshaper.planning import BandChoice, ChainPlan, band_predictions, publish_slots
from chainshaper.planning.chain_plan import slot_text
from chainshaper.reporting.graph_drawing import short_symbol
from chainshaper.reporting.latency import expected_jitter_text
from chainshaper.reporting.tables import (
    ABSENT,
    YES_NO,
    Column,
    ResultTable,
    counted,
    figures,
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
from chainshaper.values.durations import duration_text, format_duration, milliseconds
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

if TYPE_CHECKING:  # only their verbs import them
    from chainshaper.monitor.budgets import Judged
    from chainshaper.monitor.watch import Seen

UNKNOWN = "unknown"
COLOURS = {"good": "green", "limited": "yellow", "absent": "red"}
MOST_ROWS = 50
MOST_SLOTS = 8
SWEEP_FIGURES = {
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
    """Counts per event, what was lost, the clock, the system that was recorded, and the
    ``contradictions`` among its events."""
    info = recording.info
    notes = list(info.notes)
    # A recording from before there were checksums; a tracer's trace never has any.
    if info.checksums is None and (recording.path / INFO_FILE).is_file():
        notes.append(
            "this recording has no checksums, so that damage to its files may go unseen:"
            " `chainshaper convert` writes one that has"
        )
    return {
        "source": info.source,
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


def contents_table(recording: Recording) -> tuple[ResultTable, ResultTable]:
    """The system that was recorded, and how often each event happened."""
    contents = contents_json(recording)
    system = ResultTable(str(recording.path), words("", ""))
    for title, value in (
        ("source", contents["source"]),
        ("distribution", contents["distribution"] or UNKNOWN),
        ("RMW", contents["rmw"] or UNKNOWN),
        ("hosts", ", ".join(contents["hosts"]) or UNKNOWN),
        ("clock offset", f"{contents['clock_offset_ns']} ns to CLOCK_REALTIME"),
        *((f"process {pid}", name) for pid, name in contents["processes"].items()),
    ):
        system.add(title, value)
    total = f"{sum(contents['events'].values()):,}"
    columns = [Column("event", words=True, footer="together"), Column("count", footer=total)]
    events = ResultTable("Events", columns)
    for name, number in contents["events"].items():
        events.add(name, f"{number:,}")
    return system, events


def callback_rows(statistics: pl.DataFrame) -> list[dict[str, Any]]:
    """Callback statistics as plain data: response and execution times in ns; ``pid`` is the last
    of ``pids``, the processes of a node that was started again; ``declared_ns`` is a timer's
    declared period, ``period_ns`` that of its starts."""
    columns = ("node", "kind", "topic", "period_ns", "declared_ns", "pid", "pids", "tids", "count")
    return statistics.select(*columns, "response_ns", "execution_ns").to_dicts()


def callback_table(statistics: pl.DataFrame) -> ResultTable:
    """Every callback: its thread, how often it ran, and its execution and response times.

    Execution times have columns only where there are any. A function's name has a column in the
    report; on the terminal it stands behind callbacks that nothing else tells apart.
    """
    measured = [name for name in ("execution", "response") if statistics[f"{name}_ns"].count()]
    columns = [*words("node", "callback"), Column("function", words=True, detail=True)]
    columns += figures("thread", "count")
    for name in measured:
        columns += figures(*(f"{name}\n{figure}" for figure in ("min", "mean", "max")))
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
        table.add(row["node"] or "", shown, symbol, listed(row["tids"]), row["count"], *times)
    return table


def chains_json(graph: ApplicationGraph, found: ChainEnumeration) -> dict[str, Any]:
    """``count`` chains (a lower bound unless ``exact``), those listed, and the heaviest."""
    heaviest = None
    if found.heaviest is not None:
        heaviest = {**_chain(graph, found.heaviest), "response_ns": found.heaviest_ns}
    chains = [_chain(graph, chain) for chain in found.chains]
    known = {name: getattr(found, name) for name in ("count", "exact", "complete")}
    return {**known, "heaviest": heaviest, "chains": chains}


def _chain(graph: ApplicationGraph, chain: Chain) -> dict[str, Any]:
    path = graph.path(chain)
    return {
        "chain": chain.spec,
        "nodes": [callback.node for callback in path],
        "callbacks": [graph.label(callback) for callback in path],
        "topics": list(chain.topics),
    }


def count_text(found: ChainEnumeration) -> str:
    """How many chains there are, and how many of them are listed."""
    number = f"{'' if found.exact else 'at least '}{counted(found.count, 'chain')}"
    return number if found.complete else f"{number}, {len(found.chains)} of them listed"


def chain_table(graph: ApplicationGraph, found: ChainEnumeration) -> ResultTable:
    """One row per chain: where it starts, which topics it passes; the heaviest is marked."""
    columns = [*words("starts at", "topics"), *figures("heaviest [ms]")]
    table = ResultTable("Computation chains", columns)
    for chain in dict.fromkeys(filter(None, (*found.chains, found.heaviest))):
        row = _chain(graph, chain)
        heaviest = chain == found.heaviest and found.heaviest_ns is not None
        weight = milliseconds(found.heaviest_ns or 0) if heaviest else ""
        table.add(row["callbacks"][0], " → ".join(row["topics"]), weight)
    return table


def threads_json(allocation: Allocation) -> dict[str, Any]:
    """The threads of a running application, and what is not certain about them."""
    rows = [
        {
            "nodes": list(found.nodes),
            "nodes_known_by": found.nodes_known_by or None,
            **{name: getattr(found.thread, name) for name in ("pid", "tid", "comm", "role")},
            "callbacks": [{"node": node, "callback": name} for node, name in found.callbacks],
            "dds_kind": found.thread.kind,
            "known_by": found.known_by or None,
            "policy": found.thread.policy,
            "priority": found.thread.priority,
            "cores": list(found.thread.cores),
        }
        for found in allocation.threads
    ]
    return {"threads": rows, "notes": list(allocation.notes)}


def threads_table(allocation: Allocation) -> ResultTable:
    """A row per thread; what is as in the row above is left out."""
    columns = words("node", "pid", "tid", "name", "role", "class", "cores", "known by")
    table = ResultTable("Threads", columns)
    above: NodeThread | None = None
    for found in allocation.threads:
        thread = found.thread
        first = above is None or above.thread.pid != thread.pid
        same_nodes = not first and above is not None and above.nodes == found.nodes
        known_by, names = [found.known_by or "-"], [name for _, name in found.callbacks]
        if first and found.nodes:
            known_by.append(f"node: {found.nodes_known_by or None}")
        role = f"DDS {thread.kind}" if thread.role == "dds" else ", ".join((thread.role, *names))
        scheduling = scheduling_text(thread.policy, thread.priority), core_ranges(thread.cores)
        nodes = "" if same_nodes else ", ".join(found.nodes) or UNKNOWN
        who = thread.pid if first else "", thread.tid, thread.comm
        table.add(nodes, *who, role, *scheduling, "; ".join(known_by))
        above = found
    return table


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
    """What the machine can do, and how it stalls."""
    abilities = ResultTable("This machine", words("", "found", "for", "remedy"))
    for check in report.checks:
        found = plain(check.found, COLOURS[check.state])
        abilities.add(check.name, found, check.needed_for, check.remedy)
    threshold = duration_text(report.stall_meter.threshold_ns)
    stalls = stall_table(report.stall_meter, report.stalls)
    stalls.title = f"Stalls longer than {threshold} in {duration_text(report.watched_ns)}"
    if not report.stall_meter.realtime:
        stalls.caption = "taken without SCHED_FIFO: ordinary scheduling is among these stalls"
    return abilities, stalls


def stall_rows(meter: StallMeterInfo, stalls: pl.DataFrame) -> list[dict[str, Any]]:
    """Per core: stalls seen, of the columns ``cpu, duration``; their total and longest (ns)."""
    rows = []
    for core, usual in zip(meter.cores, meter.median_lateness_ns, strict=True):
        own = stalls.filter(cpu=core)["duration"].to_list()
        row = {"core": core, "count": len(own), "longest_ns": max(own, default=0)}
        rows.append({**row, "total_ns": sum(own), "median_wakeup_ns": usual})
    return rows


def stall_table(meter: StallMeterInfo, stalls: pl.DataFrame) -> ResultTable:
    """Stalls per core, and the longest."""
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
    """How each recording was taken, a column for each: what makes its figures believable.

    A recording has a measurement for each of its chains.
    """
    columns = []
    for one, *others in recordings:
        info, plans = one.recording.info, [m.plan for m in (one, *others) if m.plan is not None]
        in_force = "\n".join(map(_in_force, plans))
        columns.append(
            {
                "folder": str(one.recording.path),
                "first cycle": _begun(one),
                "source": info.source,
                "host": info.host,
                "kernel": info.kernel,
                "ROS 2 distribution": info.distribution,
                "RMW": info.rmw,
                "command": " ".join(info.command),
                "real-time scheduling": YES_NO.get(info.realtime),
                "scheduling in force": _scheduling(info.threads),
                "machine watched for stalls": _watched(info.stall_meter),
                "events": f"{event_counts(one.recording)['count'].sum():,}",
                "events lost": lost_text(info.lost).partition(": ")[2],
                "plan in force": in_force or "none",
            }
        )
    table = ResultTable("", words("", *names))
    for title in columns[0]:
        table.add(title, *(own[title] or UNKNOWN for own in columns))
    return table


def _in_force(plan: ChainPlan) -> str:
    """A plan in one line, with what its servers do at their slots' ends."""
    closing = "servers closed behind their slots" if plan.slot_ends == "closed" else ""
    parts = [part for part in (plan.policy, closing) if part]
    return f"{', '.join(parts)}, for {plan.chain.spec or 'a chain'}"


def _begun(measurement: Measurement) -> str:
    """When the first cycle began, and for how long cycles went on beginning."""
    starts = measurement.analysis.traversals["start"]
    if not len(starts):
        return "none"
    offset = measurement.recording.info.clock_offset_ns
    first = datetime.fromtimestamp((starts[0] + offset) / 1e9, tz=timezone.utc)
    lasted = (starts[-1] - starts[0]) / 1e9
    return f"{first:%Y-%m-%d %H:%M:%S} UTC, {len(starts)} cycles in {lasted:.1f} s"


def _scheduling(threads: Iterable[ThreadInfo]) -> str:
    kinds = Counter((one.role, one.policy, one.priority, one.cores) for one in threads)
    return "\n".join(
        f"{role}: {policy} {priority}, {cores_text(cores)} ({number})"
        for (role, policy, priority, cores), number in sorted(kinds.items())
    )


def cores_text(cores: Sequence[int]) -> str:
    """``cores 0, 1``."""
    return f"core{'' if len(cores) == 1 else 's'} {listed(cores)}"


def _watched(meter: StallMeterInfo | None) -> str:
    if meter is None:
        return "no: disturbed cycles are not known"
    own = "" if meter.realtime else ", itself open to pre-emption"
    return (
        f"every {meter.period_ns / 1e6:g} ms on {cores_text(meter.cores)}{own}; stalls from "
        f"{meter.threshold_ns / 1e6:g} ms"
    )


def recorded_thread_table(threads: Sequence[ThreadInfo]) -> ResultTable:
    """The threads of a recorded application, as the kernel reported them."""
    columns = [*words("node", "thread", "role"), *figures("pid", "tid")]
    table = ResultTable("", [*columns, *words("scheduling"), *figures("cores")])
    for one in sorted(threads, key=lambda thread: (thread.node, thread.tid)):
        scheduling = f"{one.policy} {one.priority}", listed(one.cores)
        table.add(one.node, one.comm, one.role, one.pid, one.tid, *scheduling)
    return table


def plan_table(plan: ChainPlan) -> ResultTable:
    """Servers and slots of a plan."""
    columns = [*words("server"), *figures("core", "priority"), *words("slots", "threads")]
    table = ResultTable(f"Plan for {plan.chain.spec or 'a chain'} [ms]", columns)
    for one in plan.servers:
        threads = []
        for thread in one.threads:
            publishes = thread.role == "publisher"
            what = "publisher" if publishes else ", ".join(thread.callbacks)
            threads.append(f"{thread.node} ({what})" if what else thread.node)
        table.add(one.name, one.core, one.priority, slots_ms(*one.slots), ", ".join(threads))
    offset = f", offset {milliseconds(plan.offset_ns)}" if plan.offset_ns else ""
    table.caption = f"cycle {milliseconds(plan.cycle_ns)}{offset}; {expected_jitter_text(plan)}"
    if (received := receivers_text(plan)) is not None:
        table.caption += f"\n{received}"
    return table


def receivers_text(plan: ChainPlan) -> str | None:
    """What a plan promises for those that receive its output, and where they run."""
    node, promised = plan.shaping_node, plan.predicted.receivers
    if node is None or node.receivers_at is None or promised is None:
        return None
    said = f"{', '.join(node.receivers)} on core {node.receivers_at.core}: callbacks start by"
    said += f" {milliseconds(promised.max_ns)}, jitter"
    return f"{said} {milliseconds(promised.jitter_ns)} at most"


def bands_table(plan: ChainPlan) -> ResultTable:
    """What a plan predicts of each latency band, or of each mode by what was measured in it."""
    if plan.modes is not None and plan.evidence.modes is not None:
        columns = [*words("mode"), *figures("cycles", "min", "mean", "max", "slot")]
        table = ResultTable("Modes, as measured, and their slots [ms]", columns)
        for mode, own in plan.evidence.modes.items():
            times = map(ms, (own.min_latency_ns, own.mean_latency_ns, own.max_latency_ns))
            slot = publish_slots(plan)[plan.modes.bands[mode] - 1]
            table.add(mode, f"{own.samples:,}", *times, slots_ms(slot))
        return table
    columns = figures("slot", "share of cycles", "jitter at most")
    table = ResultTable("Predicted latency bands [ms]", columns)
    for start, end, share, jitter in band_predictions(plan):
        table.add(slots_ms((start, end)), percent(share), ms(jitter))
    return table


def choice_table(choice: BandChoice) -> ResultTable:
    """Figure 7 in rows: the average over the number of bands, and where `auto` stops."""
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
    """The same as plain data."""
    curve = [
        {
            "bands": len(one.slot_ends_ns),
            "mean_ns": round(one.mean_ns),
            "bands_ns": list(one.slot_ends_ns),
        }
        for one in choice.curve
    ]
    chosen = len(choice.chosen.slot_ends_ns)
    return {"curve": curve, "chosen": chosen, "reason": choice.reason}


def servers_table(state: RunState) -> ResultTable:
    """The servers of a run, a row each, with what they have done since they were armed."""
    columns = words("server", "core", "priority", "slots", "threads", "enforced by")
    columns += figures("slots opened", "late", "worst", "overruns")
    table = ResultTable(f"{state.plan or 'plan'} in force with {state.back_end}", columns)
    if state.anchor_ns is not None:
        table.caption = f"cycles of {duration_text(state.cycle_ns)}"
        if state.drift_ns is not None:
            table.caption += f"; the chain's start has drifted by {state.drift_ns / 1e6:+.3f} ms"
        for move in {one.chain: one for one in state.moves}.values():
            table.caption += f"; {move.text}"
    for one in state.servers:
        more = len(one.slots) - MOST_SLOTS  # of several chains, over the hyper-period
        slots = " ".join(map(slot_text, one.slots[:MOST_SLOTS]))
        slots += f" and {more} more" if more > 0 else ""
        threads = listed(one.threads) or "none"
        about = one.name, one.core, one.priority, slots, threads, one.kept_by
        table.add(*about, *_counted(one).values())
    return table


def run_line(state: RunState) -> str:
    """The state of a run in one line, for where there is no terminal."""
    parts = []
    for server in state.servers:
        known = [f"{key} {value}" for key, value in _counted(server).items() if value != "-"]
        parts += [f"{server.name}: {', '.join(known)}"] if known else []
    return "; ".join(parts) or f"in force with {state.back_end}"


def _counted(server: ServerState) -> dict[str, str]:
    counters = server.counters
    lateness = counters.longest_lateness_ns
    worst = None if lateness is None else f"{milliseconds(lateness)} ms"
    values = {"slots": counters.slots, "late": counters.late_entries, "worst": worst}
    values["overruns"] = counters.overruns
    return {name: "-" if value is None else str(value) for name, value in values.items()}


def runs_table(runs: Iterable[tuple[Journal, RunState | None]]) -> ResultTable:
    """Every run on this machine: its plan, back end and owner, and how it is doing."""
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
    """What is to be seen of each chain now: its spans, then its hops."""
    nodes = ", ".join(sorted(filter(None, seen.processes.values()))) or "no node"
    tables = []
    for one in seen.chains:
        title = f"{one.chain}: {one.rate_hz:.2f} cycles a second"
        if one.promised_ns is not None:
            shares = ", ".join(map(percent, one.shares)) or "no output yet"
            moved = f", moved by {one.moved_ns / 1e6:+.3f} ms" if one.moved_ns else ""
            title += f"; the plan's last slot ends at {ms(one.promised_ns)} ms{moved}"
            title += f", in slots: {shares}"
            if one.shares:
                others = max(1.0 - one.early - sum(one.shares), 0.0)
                title += f", before the first: {percent(one.early)}, outside: {percent(others)}"
        if one.kept is not None:
            met = "met" if one.kept else "broken"
            title += f"; promise {met} over the hour: {one.outputs.text},"
            title += f" {one.outputs.most_missed} at most"
        names = ("cycles", "min", "p50", "p99", "max", "jitter", "late", "incomplete")
        table = ResultTable(title, [*words("last [ms]"), *figures(*names)], one.problem)
        for span, own in one.spans.items():
            middle = (own.percentiles_ns.get(which) for which in ("50", "99"))
            times = map(ms, (own.min_ns, *middle, own.max_ns, own.jitter_ns))
            table.add(span, own.count, *times, own.late, own.incomplete)
        tables.append(table)
        if one.hops:
            hops = ResultTable("", [*words("node", "topic"), *figures(*PARTS)])
            for hop in one.hops:
                hops.add(hop.node, hop.topic, *(ms(getattr(hop, f"{part}_ns")) for part in PARTS))
            tables.append(hops)
    lost = f"; {seen.lost} events lost" if seen.lost else ""
    if unclear := sum(one.counted["unclear"] for one in seen.chains):
        lost += f"; {unclear} cycles unclear: the clock was set"
    if unused := sum(one.counted["not_used"] for one in seen.chains):
        lost += f"; {unused} messages not used: newer ones were stored"
    lost += "".join(f"; {one.rstrip('.')}" for one in seen.left_out)
    problem = tables[-1].caption
    tables[-1].caption = f"{problem}; {nodes}{lost}" if problem else f"{nodes}{lost}"
    return tables


def fleet_table(judged: "Sequence[Sequence[Judged]]") -> ResultTable:
    """How many limits each recording breaks, the worst first, and which comes first."""
    columns = [*words("recording"), *figures("limits", "broken"), *words("first of them")]
    table = ResultTable("Recordings against the budget", columns)
    rows = [(own, [one for one in own if not one.met]) for own in judged if own]
    for own, broken in sorted(rows, key=lambda row: -len(row[1])):
        first = broken[0].text if broken else ""
        table.add(own[0].recording, len(own), len(broken), first)
    return table


def broken_table(broken: "Sequence[Judged]") -> ResultTable:
    """Limits of a budget that are broken, and why."""
    columns = [*words("recording", "where", "limit"), *figures("budget", "found")]
    table = ResultTable("Limits that are broken", [*columns, *words("because")])
    for one in broken:
        shown = percent if one.what == "missing" else ms
        values = shown(one.limit), shown(one.found)
        table.add(one.recording, one.where, one.what, *values, one.because or "")
    return table


def changes_table(changes: Iterable[WantedScheduling]) -> ResultTable:
    """What a plan would give to each thread, a row each."""
    names = ("node", "pid", "tid", "name", "role", "server", "class", "core", "why")
    table = ResultTable("What threads would get", words(*names))
    for one in changes:
        thread, wanted = one.node_thread.thread, one.scheduling
        scheduling = "as it is"
        if wanted.priority is not None:
            scheduling = scheduling_text(POLICIES[wanted.policy], wanted.priority)
        cores = listed(wanted.cores) if wanted.cores else "as they are"
        about = ", ".join(one.node_thread.nodes), thread.pid, thread.tid, thread.comm, thread.role
        table.add(*about, one.server or "", scheduling, cores, one.reason)
    return table


def sweep_table(frame: pl.DataFrame) -> ResultTable:
    """The axes and the most important figures of each point, those of many only for the first."""
    axes = sweep_axes(frame)
    names = [name.removesuffix("_ns") for name in (*axes, *SWEEP_FIGURES.values())]
    table = ResultTable("Simulated end-to-end latency [ms]", figures(*names))
    for row in frame.head(MOST_ROWS).to_dicts():
        row["kept"] = PROMISE[row["kept"]]
        found = [ms(row[n]) if n.endswith("_ns") else row[n] for n in SWEEP_FIGURES]
        if row["error"] is not None:
            found = ["failed", *([""] * (len(found) - 1))]
        table.add(*(sweep_value(name, row[name]) for name in axes), *found)
    if frame.height > MOST_ROWS:
        table.caption = f"the first {MOST_ROWS} of {frame.height} points"
    return table


def sweep_axes(frame: pl.DataFrame) -> list[str]:
    """Axes stand before what all sweeps have; a seed that is varied is one of them."""
    return frame.columns[: frame.columns.index("cycles")]


def sweep_value(name: str, value: Any) -> str:
    """A point's place on an axis."""
    if value is None:
        return ABSENT
    return format_duration(value) if name.endswith("_ns") else str(value)
