"""Looking into a recording or a trace, for `chainshaper info`, `graph`, `chains` and `convert`."""

from pathlib import Path

from chainshaper.analysis import (
    ChainEnumeration,
    DataFlow,
    callback_statistics,
    enumerate_chains,
    graph_of,
    load_named_paths,
    recorded_flow,
)
from chainshaper.analysis.graph import ApplicationDescription, services
from chainshaper.sources.lttng.sessions import table_name
from chainshaper.values.close_names import close_names
from chainshaper.values.errors import InputError
from chainshaper.values.recording import Recording, RecordingInfo, event_counts, write_recording
from chainshaper.verify.measure import opened


def list_chains(
    source: Recording | DataFlow, start: str | None = None, end: str | None = None, limit: int = 100
) -> ChainEnumeration:
    """Return the chains of a recording, and the heaviest of them by mean response times."""
    if isinstance(source, Recording):
        source = recorded_flow(source)
    statistics = callback_statistics(source).drop_nulls("response_ns")
    mean = statistics["response_ns"].struct.field("mean")
    weights = dict(zip(statistics["callback_id"], mean, strict=True))
    return enumerate_chains(graph_of(source), start, end, limit, weights)


def named_chain(file: str | Path, name: str | None = None) -> str:
    """Return the chain that a CARET architecture file calls ``name``.

    A file with a single path needs no name. Raises InputError: there is no such path.
    """
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
    """Write a trace as a recording of ours: every figure stays the same to the nanosecond.

    A note names the events that the analysis does not know.

    Raises InputError: ``output`` exists already, or no event is known.
    """
    recording = opened(recording)
    if not len(recording.events):
        raise InputError(f"{recording.path}: no event in it is one that chainshaper knows")
    return write_recording(output, recording.events, with_trace_events(recording))


def with_trace_events(recording: Recording) -> RecordingInfo:
    """Return a trace's description with the events it had, and a note about those left out."""
    info = recording.info
    if info.source != "lttng" or info.trace_events:
        return info
    counts = dict(event_counts(recording).iter_rows())
    left_out = [name for name in counts if table_name(name) not in recording.events]
    notes = info.notes
    if left_out:
        number = sum(counts[name] for name in left_out)
        notes += (
            f"{number} events of kinds that chainshaper makes no use of were left out:"
            f" {', '.join(left_out)}.",
        )
    return info.model_copy(update={"trace_events": counts, "notes": notes})


def describe_application(recording: Recording | str | Path) -> ApplicationDescription:
    """Return the application that a recording or trace shows: its graph and its services."""
    recording = opened(recording)
    flow = recorded_flow(recording)
    return ApplicationDescription(
        graph=graph_of(flow),
        services=services(recording.events),
        lost=recording.info.lost,
        notes=(*recording.info.notes, *flow.notes),
    )
