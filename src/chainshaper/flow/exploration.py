"""Looking into a recording or a trace, for `chainshaper info`, `graph`, `chains` and `convert`."""

from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import yaml

from chainshaper.analysis import (
    ChainEnumeration,
    DataFlow,
    callback_statistics,
    enumerate_chains,
    graph_of,
    load_named_paths,
    recorded_flow,
)
from chainshaper.analysis.chains import close_names
from chainshaper.analysis.contradictions import shown_periods
from chainshaper.analysis.graph import ApplicationDescription, services
from chainshaper.flow.plan import inputs_of
from chainshaper.linux.scheduling import available_cores
from chainshaper.sources.lttng.sessions import table_name
from chainshaper.values.application import INTERNAL_TOPICS
from chainshaper.values.durations import format_duration
from chainshaper.values.errors import InputError
from chainshaper.values.recording import Recording, RecordingInfo, event_counts, write_recording
from chainshaper.values.yaml_file import AS_YAML, wrong_values_refused
from chainshaper.verify.measure import opened
from chainshaper.workload.description import Application


def list_chains(
    source: Recording | DataFlow, start: str | None = None, end: str | None = None, limit: int = 100
) -> ChainEnumeration:
    """The chains of a recording, and the heaviest of them by mean response times."""
    if isinstance(source, Recording):
        source = recorded_flow(source)
    statistics = callback_statistics(source).drop_nulls("response_ns")
    mean = statistics["response_ns"].struct.field("mean")
    weights = dict(zip(statistics["callback_id"], mean, strict=True))
    return enumerate_chains(graph_of(source), start, end, limit, weights)


def named_chain(file: str | Path, name: str | None = None) -> str:
    """The chain that a CARET architecture file calls ``name``, which only one path needs not."""
    paths = load_named_paths(file)
    known = ", ".join(paths)
    if not paths:
        remedy = "name a path in it (CARET's documentation says how), or leave out --chains"
        raise InputError(f"{file}: no path is named in it: {remedy}")
    if name is None and len(paths) != 1:
        raise InputError(f"{file}: choose one of its named_paths with --chain: {known}")
    name = next(iter(paths)) if name is None else name
    if name in paths:
        return paths[name]
    close = close_names(name, paths)
    hint = f"did you mean {' or '.join(close)}?" if close else f"its named_paths: {known}"
    raise InputError(f"{file}: no path is named {name!r}; {hint}")


def convert_recording(recording: Recording | str | Path, output: str | Path) -> Recording:
    """Write a trace as a recording of ours: every figure stays the same to the nanosecond. A note
    names the events that the analysis does not know.

    Raises InputError: ``output`` exists already, or no event is known.
    """
    recording = opened(recording)
    if not len(recording.events):
        raise InputError(f"{recording.path}: no event in it is one that chainshaper knows")
    return write_recording(output, recording.events, with_trace_events(recording))


def with_trace_events(recording: Recording) -> RecordingInfo:
    """A trace's description with the events it had, and a note about those that are left out."""
    info = recording.info
    if info.source != "lttng" or info.trace_events:
        return info
    counts = dict(event_counts(recording).iter_rows())
    left = [name for name in counts if table_name(name) not in recording.events]
    notes = info.notes
    if left:
        what = "events of kinds that chainshaper makes no use of were left out"
        notes += (f"{sum(counts[name] for name in left)} {what}: {', '.join(left)}.",)
    return info.model_copy(update={"trace_events": counts, "notes": notes})


QUANTILES = 20  # of a callback's times: so many stand for all in a description


def application_file(recording: Recording | str | Path, chain: str | None = None) -> str:
    """The description of an application (YAML) as a recording shows it, to simulate and to run.

    Callbacks execute as long as they did, by quantiles; what no node of it publishes comes from a
    timer. ``chain`` defaults to the heaviest. Raises InputError: no chain is in it, or no
    description can be made of it.
    """
    recording = opened(recording)
    flow = recorded_flow(recording)
    graph, heaviest = graph_of(flow), list_chains(flow).heaviest
    if heaviest is None:
        raise InputError(f"{recording.path}: no chain is in it, see `chainshaper graph`")
    published = {topic for one in graph.callbacks for topic in one.publishes}
    nodes: dict[str, Any] = {}
    periods = shown_periods(flow.contradictions)
    seen: set[int] = set()
    for one in graph.callbacks:
        ours = one.kind in ("timer", "subscription") and one.topic not in INTERNAL_TOPICS
        if one.id in seen or not ours:
            continue
        topics = [topic for topic in one.publishes if topic not in INTERNAL_TOPICS]
        members = inputs_of(graph, one, topics[0]) if topics else (one.id,)
        seen |= {*members}
        own = flow.instances.filter(pl.col("callback_id").is_in(members) & ~pl.col("assumed"))
        began = own.filter(callback_id=one.id)["start"].sort()
        times = own.select(pl.coalesce("execution_ns", pl.col("end") - pl.col("start")))
        taken = times.to_series().drop_nulls().to_numpy()
        if not taken.size or len(began) < 2:  # it hardly ran
            continue
        read = [graph.callbacks[number].topic for number in members]
        period = periods.get(one.id) or one.period_ns or int(began.diff().median() or 0)
        trigger: dict[str, Any] = {"timer": format_duration(round(period, -3))}
        if set(read) <= published:
            trigger = {"synchronises": read} if len(read) > 1 else {"subscription": read[0]}
        steps = np.quantile(taken, (np.arange(QUANTILES) + 0.5) / QUANTILES)  # of equal shares
        samples = [format_duration(max(1_000, int(step) // 1000 * 1000)) for step in steps]
        callback = {**trigger, "execution": {"samples": samples}, "publishes": topics}
        nodes.setdefault(one.node.strip("/"), {"callbacks": []})["callbacks"].append(callback)
    cores = available_cores()
    values = {
        "name": recording.path.name,
        "chain": chain or recording.info.chain or heaviest.spec,
        "scheduling": {
            "executors": {"core": cores[-1], "priority": 80},
            "dds": {"core": cores[0], "priority": 90},
        },
        "nodes": nodes,
    }
    with wrong_values_refused(Application, f"{recording.path}: "):
        Application.model_validate(values, context=AS_YAML, strict=False)
    return yaml.safe_dump(values, sort_keys=False, default_flow_style=None, width=100)


def describe_application(recording: Recording | str | Path) -> ApplicationDescription:
    """The application that a recording or trace shows: its graph and its services."""
    recording = opened(recording)
    flow = recorded_flow(recording)
    return ApplicationDescription(
        graph=graph_of(flow),
        services=services(recording.events),
        lost=recording.info.lost,
        notes=(*recording.info.notes, *flow.notes),
    )
