"""Verbs that look at recordings and traces, one or several, and write what they find elsewhere."""

from pathlib import Path

from chainshaper.cli.options import (
    CHAIN,
    JSON,
    PLAN_IN_FORCE,
    RECORDING_OUTPUT,
    TRACE,
    argument,
    option,
    plan_in_force,
)
from chainshaper.cli.output import late_progress, notes, print_json, show, show_line
from chainshaper.values.errors import InputError


def info(trace: list[Path] = TRACE, json: bool = JSON) -> None:
    """Show what is in a trace: events, losses, clock, distribution, RMW, hosts, processes."""
    from chainshaper.flow.exploration import lost_events
    from chainshaper.reporting.recordings import contents_json, contents_table
    from chainshaper.sources import open_source

    with late_progress("info") as progress:
        opened = open_source(*trace, progress=progress, overview=True)
        result = contents_json(opened)
    if json:
        print_json(result)
        return
    show(*contents_table(opened))
    show_line(lost_events(opened.info))
    notes(result["notes"])


def graph(
    trace: list[Path] = TRACE,
    output: Path | None = option(
        None, "--output -o FILE", "File to write: .svg, .dot or .json; must not exist."
    ),
    everything: bool = option(
        False,
        "--all",
        "Also what every node has for itself: parameter services, /rosout, "
        "/parameter_events. In JSON they are always there, marked as internal.",
    ),
    json: bool = JSON,
) -> None:
    """Show the application: nodes, callbacks with kind, period and function, topics, services."""
    from chainshaper.flow.exploration import describe_application, lost_events
    from chainshaper.reporting.application_graph import (
        application_json,
        application_table,
        without_internals,
    )
    from chainshaper.reporting.graph_drawing import ENDINGS, write_picture
    from chainshaper.sources import open_source
    from chainshaper.values.files import new_file

    if output is not None:
        new_file(output, ENDINGS)
    with late_progress("graph") as progress:
        opened = open_source(*trace, progress=progress)
        application = describe_application(opened)
        if output is not None:
            progress(0.9, "drawing")
            write_picture(application, output, everything=everything)
    if json:
        print_json(application_json(application))
    elif output is None:
        show(application_table(application if everything else without_internals(application)))
        show_line(lost_events(opened.info))
        notes(application.notes)
    else:
        show_line(str(output.absolute()))
        notes((*application.notes, lost_events(opened.info)))


def callbacks(trace: list[Path] = TRACE, json: bool = JSON) -> None:
    """Show every callback of a recording or trace: kind, count, execution and response time."""
    from chainshaper.analysis import callback_statistics, data_flow
    from chainshaper.flow.exploration import lost_events
    from chainshaper.reporting.recordings import callback_rows, callback_table
    from chainshaper.sources import open_source

    with late_progress("callbacks") as progress:
        opened = open_source(*trace, progress=progress)
        flow = data_flow(opened.events, opened.info.clock_offset_ns)
        statistics = callback_statistics(flow)
    if json:
        print_json(callback_rows(statistics))
        if any(opened.info.lost.values()):  # the array has no place for it
            notes([lost_events(opened.info)])
        return
    show(callback_table(statistics))
    show_line(lost_events(opened.info))
    notes((*opened.info.notes, *flow.notes))


def chains(
    trace: list[Path] = TRACE,
    start: str | None = option(
        None,
        "--from X",
        "Topic or node where they begin. Default: callbacks that nothing triggers.",
    ),
    end: str | None = option(
        None, "--to Y", "Topic or node where they end. Default: topics from which nothing goes on."
    ),
    limit: int = option(100, "--limit", "How many to list.", min=1),
    json: bool = JSON,
) -> None:
    """List the computation chains, count them, and show the heaviest.

    The heaviest chain has the largest sum of its callbacks' mean response times.
    """
    from chainshaper.analysis import data_flow, graph_of
    from chainshaper.flow.exploration import list_chains, lost_events
    from chainshaper.reporting.recordings import chain_table, chains_json, count_text
    from chainshaper.sources import open_source

    with late_progress("chains") as progress:
        opened = open_source(*trace, progress=progress)
        flow = data_flow(opened.events, opened.info.clock_offset_ns)
        progress(0.9, "searching chains")
        application = graph_of(flow)
        found = list_chains(flow, start, end, limit)
    if json:
        lost = {"lost": opened.info.lost, "notes": [*opened.info.notes, *flow.notes]}
        print_json({**chains_json(application, found), **lost})
        return
    show(chain_table(application, found))
    show_line(f"{count_text(found)}; {lost_events(opened.info)}")
    notes((*opened.info.notes, *flow.notes))


def latency(
    trace: list[Path] = TRACE,
    chain: str | None = CHAIN,
    chains: Path | None = option(
        None,
        "--chains FILE",
        "A CARET architecture file: --chain then names one of its named_paths.",
    ),
    json: bool = JSON,
    instances: bool = option(False, "--instances", "With --json: every traversal, one by one."),
) -> None:
    """Show the end-to-end latency of a chain: average, maximum, jitter, percentiles.

    Each traversal is followed from the start of the first callback to the publication of the last
    topic, message by message. A second table shows in which hop the time went.
    """
    from chainshaper.flow.exploration import lost_events, named_chain
    from chainshaper.reporting.latency import (
        breakdown_json,
        breakdown_table,
        latency_json,
        latency_table,
    )
    from chainshaper.sources import open_source
    from chainshaper.verify.measure import measure_latency
    from chainshaper.verify.overruns import dropped_text, overruns_text

    if instances and not json:
        raise InputError("--instances goes with --json: add it")
    if chains is not None:
        chain = named_chain(chains, chain)
    with late_progress("latency") as progress:
        opened = open_source(*trace, progress=progress)
        measurement = measure_latency(opened, chain)
    analysis = measurement.analysis
    if json:
        found = latency_json(measurement, instances=instances)
        print_json({**found, **breakdown_json(analysis)})
        return
    show(latency_table(measurement), breakdown_table(analysis))
    counts = f"{analysis.statistics.disturbed} cycles disturbed by the machine"
    if measurement.longest_stall_ns is None:
        counts = "stalls of the machine not watched"
    if analysis.incomplete:
        reasons = ", ".join(f"{count} {reason}" for reason, count in analysis.incomplete.items())
        counts += f"; incomplete: {reasons}"
    if measurement.overruns:
        counts += f"; {overruns_text(measurement.overruns)}"
    if measurement.dropped:
        counts += f"; {dropped_text(measurement.dropped)}"
    show_line(f"{counts}; {lost_events(opened.info)}")
    notes(analysis.notes)


def convert(trace: list[Path] = TRACE, output: Path = RECORDING_OUTPUT) -> None:
    """Write a trace as a recording: one Parquet file per event table."""
    from chainshaper.flow.exploration import convert_recording, lost_events
    from chainshaper.sources import open_source
    from chainshaper.values.recording import refuse_existing

    refuse_existing(output)
    with late_progress("convert") as progress:
        opened = open_source(*trace, progress=progress)
        written = convert_recording(opened, output)
    show_line(str(written.path.absolute()))
    notes((*written.info.notes, lost_events(written.info)))


def compare(
    recordings: list[Path] = argument(..., "REC REC...", "Recordings' folders."),
    chain: str | None = CHAIN,
    figures: Path | None = option(
        None, "--figures DIR", "Draw latency.png and distribution.png into this folder."
    ),
    plan: Path | None = PLAN_IN_FORCE,
    json: bool = JSON,
) -> None:
    """Show the same chain in several recordings side by side, usually before and after shaping.

    Where a plan was in force, its prediction stands beside the measurement, band by band.
    """
    from chainshaper.reporting.latency import comparison_json, comparison_table, prediction_table
    from chainshaper.verify.measure import compare_recordings

    comparison = compare_recordings(recordings, chain, plan_in_force(plan))
    if figures is not None:
        from chainshaper.reporting.figures import draw_comparison

        draw_comparison(comparison.measurements, figures)
    if json:
        print_json(comparison_json(comparison))
        return
    predictions = [one.held for one in comparison.measurements if one.held is not None]
    show(comparison_table(comparison), *map(prediction_table, predictions))


def report(
    recordings: list[Path] = argument(..., "REC...", "Recordings' or LTTng traces' folders."),
    output: Path = option(..., "--output -o FILE.html", "File to write; must not exist."),
    chain: str | None = CHAIN,
    plan: Path | None = PLAN_IN_FORCE,
    cycles: list[int] | None = option(
        None,
        "--cycle N",
        "A cycle that the timeline has to show, where there are too many to show all. "
        "May be given several times.",
        min=0,
    ),
    json: bool = JSON,
) -> None:
    """Write one self-contained HTML page about a chain, usually before and after shaping.

    It has the figures, latency over time, histogram and distribution, the hops, the callbacks, a
    timeline of single cycles, overruns, stalls, the plan, and how all of it was recorded. The page
    needs no network.
    """
    from chainshaper.reporting.latency import comparison_json
    from chainshaper.reporting.page import ENDINGS, write_report
    from chainshaper.sources import open_source
    from chainshaper.values.files import new_file
    from chainshaper.verify.measure import Comparison, measure_latency

    new_file(output, ENDINGS)
    in_force = plan_in_force(plan)
    measurements = []
    with late_progress("report") as progress:
        for number, path in enumerate(recordings, start=1):
            progress((number - 1) / (len(recordings) + 1), f"analysing {path}")
            used = in_force if number == len(recordings) else None
            measurements.append(measure_latency(open_source(path), chain, used))
        progress(len(recordings) / (len(recordings) + 1), "drawing")
        written = write_report(measurements, output, cycles or ())
    if json:
        compared = Comparison(measurements[0].analysis.chain.spec, tuple(measurements))
        print_json({"report": str(written.absolute()), **comparison_json(compared)})
        return
    show_line(str(written.absolute()))


def export(
    trace: list[Path] = TRACE,
    output: Path = option(
        ..., "--output -o FILE", "File to write, such as trace.pftrace; must not exist."
    ),
    perfetto: bool = option(False, "--perfetto", "A trace that ui.perfetto.dev opens."),
    chain: str | None = CHAIN,
    plan: Path | None = PLAN_IN_FORCE,
) -> None:
    """Write a recording for another tool: threads, callbacks, messages, slots, stalls.

    The chain's traversals are a track of their own where a chain is named or recorded.
    """
    if not perfetto:
        raise InputError("the format is missing: add --perfetto")
    from chainshaper.flow.exploration import lost_events
    from chainshaper.reporting.perfetto import ENDINGS, export_perfetto
    from chainshaper.sources import open_source
    from chainshaper.values.files import new_file
    from chainshaper.verify.measure import measure_latency

    new_file(output, ENDINGS)
    in_force = plan_in_force(plan)
    with late_progress("export") as progress:
        opened = open_source(*trace, progress=progress)
        progress(0.5, "analysing")
        named = chain or opened.info.chain
        source = opened if named is None else measure_latency(opened, named, in_force)
        progress(0.7, "writing")
        written = export_perfetto(source, output)
    show_line(str(written.absolute()))
    notes((*opened.info.notes, lost_events(opened.info)))
