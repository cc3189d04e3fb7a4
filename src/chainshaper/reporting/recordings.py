"""What is in a recording and on the machine it was taken on: events, callbacks, chains, threads,
stalls, and the conditions under which it was recorded; as tables and as plain data."""

from collections import Counter
from collections.abc import Sequence
from datetime import datetime, timezone
from typing import Any

import polars as pl

from chainshaper.analysis import ChainEnumeration
from chainshaper.enforcement.threads import Allocation, NodeThread
from chainshaper.reporting.application_graph import short_symbol
from chainshaper.reporting.tables import (
    YES_NO,
    Column,
    ResultTable,
    core_ranges,
    figures,
    min_mean_max,
    ms,
    plain,
    scheduling_text,
    trigger,
    words,
)
from chainshaper.values.application import ApplicationGraph, Chain
from chainshaper.values.durations import format_duration, milliseconds
from chainshaper.values.recording import (
    INFO_FILE,
    MachineReport,
    Recording,
    StallMeterInfo,
    ThreadInfo,
    event_counts,
    lost_text,
)
from chainshaper.verify.measure import Measurement

__all__ = [
    "callback_rows",
    "callback_table",
    "chain_table",
    "chains_json",
    "condition_table",
    "contents_json",
    "contents_table",
    "count_text",
    "machine_json",
    "machine_tables",
    "recorded_thread_table",
    "stall_rows",
    "stall_table",
    "threads_json",
    "threads_table",
]

UNKNOWN = "unknown"
COLOURS = {"good": "green", "limited": "yellow", "absent": "red"}


def contents_json(recording: Recording) -> dict[str, Any]:
    """Counts per event, what was lost, the clock, and the system that was recorded."""
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
    }


def contents_table(recording: Recording) -> tuple[ResultTable, ResultTable]:
    """The system that was recorded, and how often each event happened."""
    contents = contents_json(recording)
    system = ResultTable(str(recording.path), words("", ""))
    system.add("source", contents["source"])
    system.add("distribution", contents["distribution"] or UNKNOWN)
    system.add("RMW", contents["rmw"] or UNKNOWN)
    system.add("hosts", ", ".join(contents["hosts"]) or UNKNOWN)
    system.add("clock offset", f"{contents['clock_offset_ns']} ns to CLOCK_REALTIME")
    for pid, name in contents["processes"].items():
        system.add(f"process {pid}", name)
    total = f"{sum(contents['events'].values()):,}"
    events = ResultTable(
        "Events", [Column("event", words=True, footer="together"), Column("count", footer=total)]
    )
    for name, number in contents["events"].items():
        events.add(name, f"{number:,}")
    return system, events


def callback_rows(statistics: pl.DataFrame) -> list[dict[str, Any]]:
    """Callback statistics as plain data: response and execution times in ns."""
    keys = ("node", "kind", "topic", "period_ns", "pid", "tids", "count")
    times = ("response_ns", "execution_ns")
    return [{key: row[key] for key in (*keys, *times)} for row in statistics.to_dicts()]


def callback_table(statistics: pl.DataFrame) -> ResultTable:
    """Every callback: its thread, how often it ran, and its execution and response times.

    Execution times have columns only where there are any. A function's name has a column in the
    report; on the terminal it stands behind callbacks that nothing else tells apart.
    """
    measured = [name for name in ("execution", "response") if statistics[f"{name}_ns"].count()]
    function = Column("function", words=True, detail=True)
    columns = [*words("node", "callback"), function, *figures("thread", "count")]
    for name in measured:
        columns += figures(*(f"{name}\n{figure}" for figure in ("min", "mean", "max")))
    table = ResultTable("Callbacks [ms]", columns)
    rows = statistics.to_dicts()
    triggers = Counter((row["pid"], row["node"], trigger(row)) for row in rows)
    for row in rows:
        what, symbol = trigger(row), short_symbol(row["symbol"])
        alike = triggers[row["pid"], row["node"], what] > 1
        table.add(
            row["node"] or "",
            f"{what} ({symbol})" if alike and symbol else what,
            symbol,
            ", ".join(map(str, row["tids"])),
            str(row["count"]),
            *(cell for name in measured for cell in min_mean_max(row[f"{name}_ns"])),
        )
    return table


def chains_json(graph: ApplicationGraph, found: ChainEnumeration) -> dict[str, Any]:
    """``count`` chains (a lower bound unless ``exact``), those listed, and the heaviest."""
    heaviest = None
    if found.heaviest is not None:
        heaviest = {**_chain(graph, found.heaviest), "response_ns": found.heaviest_ns}
    return {
        "count": found.count,
        "exact": found.exact,
        "complete": found.complete,
        "heaviest": heaviest,
        "chains": [_chain(graph, chain) for chain in found.chains],
    }


def _chain(graph: ApplicationGraph, chain: Chain) -> dict[str, Any]:
    callbacks = {callback.id: callback for callback in graph.callbacks}
    path = [callbacks[number] for number in chain.callbacks]
    return {
        "chain": chain.spec,
        "nodes": [callback.node for callback in path],
        "callbacks": [callback.label for callback in path],
        "topics": list(chain.topics),
    }


def count_text(found: ChainEnumeration) -> str:
    """How many chains there are, and how many of them are listed."""
    number = f"{found.count:,} chains" if found.exact else f"at least {found.count:,} chains"
    return number if found.complete else f"{number}, {len(found.chains)} of them listed"


def chain_table(graph: ApplicationGraph, found: ChainEnumeration) -> ResultTable:
    """One row per chain: where it starts, which topics it passes; the heaviest is marked."""
    columns = [*words("starts at", "topics"), *figures("heaviest [ms]")]
    table = ResultTable("Computation chains", columns)
    listed = list(found.chains)
    if found.heaviest is not None and found.heaviest not in listed:
        listed.append(found.heaviest)
    for chain in listed:
        weight = found.heaviest_ns if chain == found.heaviest else None
        row = _chain(graph, chain)
        topics = " → ".join(row["topics"])
        table.add(row["callbacks"][0], topics, "" if weight is None else milliseconds(weight))
    return table


def threads_json(allocation: Allocation) -> dict[str, Any]:
    """The threads of a running application, and what is not certain about them."""
    return {
        "threads": [_thread(found) for found in allocation.threads],
        "notes": list(allocation.notes),
    }


def threads_table(allocation: Allocation) -> ResultTable:
    """A row per thread; what is as in the row above is left out."""
    names = ("node", "pid", "tid", "name", "role", "class", "cores", "known by")
    table = ResultTable("Threads", words(*names))
    above: NodeThread | None = None
    for found in allocation.threads:
        row = _thread(found)
        first = above is None or above.thread.pid != found.thread.pid
        same_nodes = not first and above is not None and above.nodes == found.nodes
        known_by = [row["known_by"] or "-"]
        if first and found.nodes:
            known_by.append(f"node: {row['nodes_known_by']}")
        table.add(
            "" if same_nodes else ", ".join(found.nodes) or UNKNOWN,
            str(row["pid"]) if first else "",
            str(row["tid"]),
            row["comm"],
            f"DDS {row['dds_kind']}" if row["role"] == "dds" else row["role"],
            scheduling_text(row["policy"], row["priority"]),
            core_ranges(row["cores"]),
            "; ".join(known_by),
        )
        above = found
    return table


def _thread(found: NodeThread) -> dict[str, Any]:
    thread = found.thread
    return {
        "nodes": list(found.nodes),
        "nodes_known_by": found.nodes_known_by or None,
        "pid": thread.pid,
        "tid": thread.tid,
        "comm": thread.comm,
        "role": thread.role,
        "dds_kind": thread.kind,
        "known_by": found.known_by or None,
        "policy": thread.policy,
        "priority": thread.priority,
        "cores": list(thread.cores),
    }


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
    watched = format_duration(report.watched_ns)
    threshold = format_duration(report.stall_meter.threshold_ns)
    stalls = stall_table(report.stall_meter, report.stalls)
    stalls.title = f"Stalls longer than {threshold} in {watched}"
    if not report.stall_meter.realtime:
        stalls.caption = "taken without SCHED_FIFO: ordinary scheduling is among these stalls"
    return abilities, stalls


def stall_rows(meter: StallMeterInfo, stalls: pl.DataFrame) -> list[dict[str, Any]]:
    """Per core: stalls seen, of the columns ``cpu, duration``; their total and longest (ns)."""
    rows = []
    for core, usual in zip(meter.cores, meter.median_lateness_ns, strict=True):
        own = stalls.filter(cpu=core)["duration"].to_list()
        longest = max(own, default=0)
        row = {"core": core, "count": len(own), "longest_ns": longest, "total_ns": sum(own)}
        rows.append({**row, "median_wakeup_ns": usual})
    return rows


def stall_table(meter: StallMeterInfo, stalls: pl.DataFrame) -> ResultTable:
    """Stalls per core, and the longest."""
    titles = ("stalls", "in all [ms]", "longest [ms]", "usual wake-up [µs]")
    table = ResultTable("", [*words(""), *figures(*titles)])
    for row in stall_rows(meter, stalls):
        table.add(
            f"core {row['core']}",
            str(row["count"]),
            ms(row["total_ns"]),
            ms(row["longest_ns"] or None),
            f"{row['median_wakeup_ns'] / 1e3:.0f}",
        )
    return table


def condition_table(names: Sequence[str], measurements: Sequence[Measurement]) -> ResultTable:
    """How each recording was taken, a column for each: what makes its figures believable."""
    infos = [measurement.recording.info for measurement in measurements]
    totals = [event_counts(m.recording)["count"].sum() for m in measurements]
    rows: dict[str, list[str | None]] = {
        "folder": [str(measurement.recording.path) for measurement in measurements],
        "first cycle": [_begun(measurement) for measurement in measurements],
        "source": [info.source for info in infos],
        "host": [info.host for info in infos],
        "kernel": [info.kernel for info in infos],
        "ROS 2 distribution": [info.distribution for info in infos],
        "RMW": [info.rmw for info in infos],
        "command": [" ".join(info.command) for info in infos],
        "real-time scheduling": [YES_NO.get(info.realtime) for info in infos],
        "scheduling in force": [_scheduling(info.threads) for info in infos],
        "machine watched for stalls": [_watched(info.stall_meter) for info in infos],
        "events": [f"{total:,}" for total in totals],
        "events lost": [lost_text(info.lost).partition(": ")[2] for info in infos],
        "plan in force": [
            "none" if m.plan is None else f"{m.plan.policy}, for {m.plan.chain.spec or 'a chain'}"
            for m in measurements
        ],
    }
    table = ResultTable("", words("", *names))
    for title, cells in rows.items():
        table.add(title, *(cell or UNKNOWN for cell in cells))
    return table


def _begun(measurement: Measurement) -> str:
    """When the first cycle began, and for how long cycles went on beginning."""
    starts = measurement.analysis.traversals["start"]
    if not len(starts):
        return "none"
    offset = measurement.recording.info.clock_offset_ns
    first = datetime.fromtimestamp((starts[0] + offset) / 1e9, tz=timezone.utc)
    lasted = (starts[-1] - starts[0]) / 1e9
    return f"{first:%Y-%m-%d %H:%M:%S} UTC, {len(starts)} cycles in {lasted:.1f} s"


def _scheduling(threads: Sequence[ThreadInfo]) -> str:
    kinds = Counter((one.role, one.policy, one.priority, one.cores) for one in threads)
    return "\n".join(
        f"{role}: {policy} {priority}, {_cores(cores)} ({number})"
        for (role, policy, priority, cores), number in sorted(kinds.items())
    )


def _cores(cores: Sequence[int]) -> str:
    return f"core{'' if len(cores) == 1 else 's'} {', '.join(map(str, cores))}"


def _watched(meter: StallMeterInfo | None) -> str:
    if meter is None:
        return "no: disturbed cycles are not known"
    own = "" if meter.realtime else ", itself open to pre-emption"
    return (
        f"every {meter.period_ns / 1e6:g} ms on {_cores(meter.cores)}{own}; stalls from "
        f"{meter.threshold_ns / 1e6:g} ms"
    )


def recorded_thread_table(threads: Sequence[ThreadInfo]) -> ResultTable:
    """The threads of a recorded application, as the kernel reported them."""
    columns = [*words("node", "thread", "role"), *figures("pid", "tid")]
    table = ResultTable("", [*columns, *words("scheduling"), *figures("cores")])
    for one in sorted(threads, key=lambda thread: (thread.node, thread.tid)):
        where = str(one.pid), str(one.tid), f"{one.policy} {one.priority}"
        table.add(one.node, one.comm, one.role, *where, ", ".join(map(str, one.cores)))
    return table
