"""Verbs that look at recordings and traces, one or several, and write what they find elsewhere."""

from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

import chainshaper as cs
from chainshaper.cli import options as opt
from chainshaper.cli import output as out
from chainshaper.values.errors import InputError, OperationError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from chainshaper.monitor.budgets import Judged
    from chainshaper.reporting.tables import ResultTable
    from chainshaper.verify.slowdowns import Compared


def info(trace: list[Path] = opt.TRACE, json: bool = opt.JSON) -> None:
    """Show what is in a trace: events, losses, clock, distribution, RMW, hosts, processes.

    Notes say where its events contradict each other.
    """
    from chainshaper.analysis import recorded_flow
    from chainshaper.reporting import overviews

    with out.opened("info", trace) as (recording, report):
        report(0.9, "looking for contradictions")
        contradictions = recorded_flow(recording).contradictions
        contents = overviews.contents_json(recording, contradictions)
    if out.present(json, contents, *overviews.contents_table(recording)):
        out.show_line(out.lost_events(recording))
        out.notes((*contents["notes"], *(contradiction.note for contradiction in contradictions)))
        out.next_step("chainshaper", "chains", *trace)


def describe(
    trace: list[Path] = opt.TRACE,
    output: Path = opt.option("--output -o app.yaml", "File to write; must not exist.", ...),
    chain: str | None = opt.CHAIN,
    through: list[str] | None = opt.THROUGH,
    callback_groups: Path | None = opt.CALLBACK_GROUPS,
) -> None:
    """Write the description of an application from a recording, with its execution times.

    `chainshaper simulate` and `run` take it; edit it as you like.
    """
    from chainshaper.flow.describing import application_file
    from chainshaper.values.files import new_file, write_whole

    new_file(output, opt.DESCRIPTIONS)
    with out.opened("describe", trace, through) as (recording, _):
        known = out.with_callback_groups(recording, callback_groups)
        text, notes = application_file(known, chain)
        out.notes(notes)
    out.show_line(write_whole(output, [text.encode()]))
    out.next_step("chainshaper", "simulate", output, "-o", "simulated")


def graph(
    trace: list[Path] = opt.TRACE,
    output: Path | None = opt.option(
        "--output -o FILE", "File to write: .svg, .png, .dot or .json; must not exist."
    ),
    chain: str | None = opt.option(
        "--chain FIRST..LAST", "With --output: make this chain stand out in a picture."
    ),
    unfold: list[str] | None = opt.option(
        "--unfold NAMESPACE",
        "With --output: show the nodes of this namespace. A picture of more than 40 nodes is folded"
        " by namespace; / shows all nodes (may be repeated).",
    ),
    everything: bool = opt.option(
        "--all",
        "Also what every node has for itself: parameter services, /rosout, "
        "/parameter_events. In JSON they are always there, marked as internal.",
        False,
    ),
    through: list[str] | None = opt.THROUGH,
    json: bool = opt.JSON,
) -> None:
    """Show the application: nodes, callbacks with kind, period and function, topics, services."""
    from chainshaper.reporting import graph_drawing
    from chainshaper.values.files import new_file

    if output is not None:
        new_file(output, graph_drawing.ENDINGS)
    elif chain or unfold:
        raise InputError("--chain and --unfold are for a picture: add --output graph.svg")
    with out.opened("graph", trace, through) as (recording, report):
        application = cs.describe_application(recording)
        if output is not None:
            report(0.9, "drawing")
            cs.write_picture(
                application, output, everything=everything, chain=chain, unfolded=unfold or ()
            )
    if json:
        out.print_json(graph_drawing.application_json(application))
    elif output is None:
        chosen = application if everything else graph_drawing.without_internals(application)
        out.show(graph_drawing.application_table(chosen))
        out.show_line(out.lost_events(recording))
        out.notes(application.notes)
        out.next_step("chainshaper", "chains", *trace)
    else:
        out.show_line(output.absolute())
        out.notes((*application.notes, out.lost_events(recording)))


def callbacks(trace: list[Path] = opt.TRACE, json: bool = opt.JSON) -> None:
    """Show every callback of a recording or trace: kind, count, execution and response time."""
    from chainshaper.analysis import recorded_flow
    from chainshaper.reporting import overviews

    with out.opened("callbacks", trace) as (recording, _):
        flow = recorded_flow(recording)
        statistics = cs.callback_statistics(flow)
    rows, table = overviews.callback_rows(statistics), overviews.callback_table(statistics)
    if out.present(json, rows, table):
        out.show_line(out.lost_events(recording))
        out.notes((*recording.info.notes, *flow.notes))
        out.next_step("chainshaper", "chains", *trace)
    else:  # the JSON is an array, which has no place for notes
        out.notes(contradiction.note for contradiction in flow.contradictions)
        if any(recording.info.lost.values()):
            out.notes([out.lost_events(recording)])


def chains(
    trace: list[Path] = opt.TRACE,
    start: str | None = opt.option(
        "--from X", "Topic or node where they begin. Default: callbacks that nothing triggers."
    ),
    end: str | None = opt.option(
        "--to Y", "Topic or node where they end. Default: topics from which nothing goes on."
    ),
    limit: int = opt.option("--limit", "How many to list.", 100, min=1),
    through: list[str] | None = opt.THROUGH,
    json: bool = opt.JSON,
) -> None:
    """List the computation chains, count them, and show the heaviest.

    The heaviest chain has the largest sum of its callbacks' mean response times.
    """
    from chainshaper.analysis import graph_of, recorded_flow
    from chainshaper.reporting import overviews

    with out.opened("chains", trace, through) as (recording, report):
        flow = recorded_flow(recording)
        report(0.9, "searching chains")
        application, listed = graph_of(flow), cs.list_chains(flow, start, end, limit)
    remarks = [*recording.info.notes, *flow.notes]
    values = overviews.chains_json(application, listed)
    values |= {"lost": recording.info.lost, "notes": remarks}
    if out.present(json, values, overviews.chain_table(application, listed)):
        out.show_line(f"{overviews.count_text(listed)}; {out.lost_events(recording)}")
        out.notes(remarks)
        if listed.chains:
            out.next_step("chainshaper", "latency", *trace, "--chain", listed.chains[0].spec)


def latency(
    trace: list[Path] = opt.TRACE,
    chain: str | None = opt.CHAIN,
    through: list[str] | None = opt.THROUGH,
    chains: Path | None = opt.option(
        "--chains FILE", "A CARET architecture file: --chain then names one of its named_paths."
    ),
    figures: Path | None = opt.option(
        "--figures DIR",
        "Draw latency.png, hops.png (every cycle, stacked by hop), distribution.png and graph.png"
        " (the nodes, with times) into this folder.",
    ),
    json: bool = opt.JSON,
    instances: bool = opt.option("--instances", "With --json: every traversal, one by one.", False),
) -> None:
    """Show the end-to-end latency of a chain: average, maximum, jitter, percentiles.

    Each traversal is followed from the start of the first callback to the publication of the last
    topic, message by message. A second table shows in which hop the time went.
    """
    from chainshaper.flow.exploration import named_chain
    from chainshaper.reporting import latency as of_chain

    if instances and not json:
        raise InputError("--instances goes with --json: add it")
    chain = chain if chains is None else named_chain(chains, chain)
    named = () if chain is None else ("--chain", chain)
    with out.opened("latency", trace, through) as (recording, report):
        measurement = cs.measure_latency(recording, chain)
        drawn: tuple[Path, ...] = ()
        if figures is not None:
            from chainshaper.reporting.figures import draw_measurement

            report(0.8, "drawing")
            drawn = draw_measurement(measurement, figures)
    analysis = measurement.analysis
    values = of_chain.latency_json(measurement, instances=instances)
    values |= of_chain.breakdown_json(analysis)
    tables = [of_chain.latency_table(measurement), of_chain.breakdown_table(analysis)]
    if analysis.data_age is not None:
        tables.append(of_chain.data_age_table(analysis.data_age))
    if out.present(json, values, *tables):
        out.show_line(f"{of_chain.doubts_text(measurement)}; {out.lost_events(recording)}")
        if values["promise"] is not None:
            out.show_line(values["promise"]["text"])
        for path in drawn:
            out.show_line(path)
        out.notes(analysis.notes)
        out.next_step("chainshaper", "plan", *trace[:1], *named, "-o", "plan.yaml")


def convert(trace: list[Path] = opt.TRACE, output: Path = opt.RECORDING_OUTPUT) -> None:
    """Write a trace as a recording: one Parquet file per event table."""
    from chainshaper.values.recording import refuse_existing

    refuse_existing(output)
    with out.opened("convert", trace) as (recording, _):
        written = cs.convert_recording(recording, output)
    out.show_line(written.path.absolute())
    out.notes((*written.info.notes, out.lost_events(written)))
    out.next_step("chainshaper", "chains", output)


FEW = 3  # more recordings than these get an overview


def budget(
    trace: list[Path] = opt.TRACE,
    output: Path = opt.option("--output -o FILE", "The budget file.", ...),
    chain: list[str] | None = opt.CHAINS,
    through: list[str] | None = opt.THROUGH,
    room: float = opt.option("--room SHARE", "How far limits lie beyond what was measured.", 0.1),
) -> None:
    """Propose a budget: limits for chains, their hops and callbacks, as a recording has them.

    It is a YAML file that you edit; `chainshaper check` says which recordings keep to it. What
    --through declares stands in it, too.
    """
    from chainshaper.monitor.budgets import propose_budget, save_budget
    from chainshaper.values.files import new_file
    from chainshaper.verify.measure import taken_chain

    new_file(output)
    with out.opened("budget", trace, through) as (recording, _):
        proposed = propose_budget(recording, chain or [], room)
    out.show_line(save_budget(proposed, output))
    if not chain:
        out.notes(taken_chain(recording, None, proposed.chains[0].chain))
    out.next_step("chainshaper", "check", *trace[:1], "--budget", output)


def _matching(recordings: list[Path]) -> list[Path]:
    """Return the folders that are named, also by patterns in quotes, which the shell left to us."""
    from glob import glob, has_magic

    folders: list[Path] = []
    for recording in recordings:
        if recording.exists() or not has_magic(str(recording)):
            folders.append(recording)
            continue
        matches = glob(str(recording), recursive=True)  # noqa: PTH207 - no hidden ones, as a shell
        if not matches:
            reason = "no folder has such a name; see that the pattern is right"
            raise InputError(f"{recording}: {reason}")
        folders += map(Path, sorted(matches))
    return folders


def check(
    recordings: list[Path] = opt.argument("REC...", "Recordings' or traces' folders.", ...),
    budget: Path | None = opt.option("--budget FILE", "What they have to keep to."),
    baseline: list[Path] | None = opt.option(
        "--baseline REC", "Recordings of before (may be repeated): is a callback slower now?"
    ),
    chain: list[str] | None = opt.CHAINS,
    through: list[str] | None = opt.THROUGH,
    junit: Path | None = opt.option("--junit FILE", "Also write JUnit XML, for a CI system."),
    markdown: Path | None = opt.option("--markdown FILE", "Also write Markdown, for a review."),
    scheduler: str | None = opt.SCHEDULER,
    json: bool = opt.JSON,
) -> None:
    """Check recordings against a budget, or those of before; exit code 1 if they are worse.

    Limits apply to all cycles, disturbed ones included. Where only these break one, that is said.
    With --baseline all recordings together are compared with those of before, callback by callback.
    """
    from chainshaper.monitor import budgets
    from chainshaper.reporting.latency import JSON_FORMAT
    from chainshaper.values.files import new_file, write_whole

    if budget is None and not baseline:
        raise InputError("say what to check against: --budget FILE, or --baseline REC")
    limits = budgets.Budget() if budget is None else budgets.load_budget(budget)
    limits = limits.declaring(through or ())
    for file in filter(None, (junit, markdown)):
        new_file(file)
    judged_of: list[list[Judged]] = []  # for each recording
    compared: list[Compared] = []
    paths, before = _matching(recordings), _matching(baseline or [])
    with out.late_progress("check") as report:
        if budget is not None:
            judged_of = budgets.check_budgets(paths, limits, report, scheduler)
        judged = [limit for of_recording in judged_of for limit in of_recording]
        unread = {limit.recording for limit in judged if limit.figure == budgets.EVENTS}
        paths = [path for path in paths if str(path) not in unread]
        if before and paths:
            from chainshaper.verify.slowdowns import slowdowns_in

            chains = chain or [of_chain.chain for of_chain in limits.chains]
            compared, notes = slowdowns_in(
                paths, before, chains, report, scheduler, through=limits.through
            )
            out.notes(notes)
    every: list[Judged | Compared] = [*judged, *compared]
    if junit is not None:
        write_whole(junit, [budgets.junit_report(every).encode()])
    if markdown is not None:
        write_whole(markdown, [_markdown(judged, compared).encode()])
    if json:
        out.print_json({"format": JSON_FORMAT, "limits": [_json_of(checked) for checked in every]})
    else:
        _show_checked(judged_of, compared, budget)
    verdicts = []
    if broken := sum(not limit.met for limit in judged):
        verdicts.append(f"{broken} of {len(judged)} limits of {budget} are broken")
    if slower := sum(not callback.met for callback in compared):
        verdicts.append(f"{slower} of {len(compared)} callbacks are slower than before")
    if verdicts:
        raise OperationError("; ".join(verdicts))


def _json_of(checked: "Judged | Compared") -> dict[str, object]:
    """Return a limit or a callback with the names that its values have in JSON."""
    names = {"figure": "what", "measured": "found"}
    values = {names.get(name, name): value for name, value in asdict(checked).items()}
    return values | {
        "where": checked.where,
        "what": checked.figure,
        "met": checked.met,
        "text": checked.text,
    }


def _markdown(judged: "Sequence[Judged]", compared: "Sequence[Compared]") -> str:
    """Return a report of limits and of callbacks compared with before, where there are any."""
    from chainshaper.monitor.budgets import markdown_report

    parts = []
    if judged:
        parts.append(markdown_report(judged))
    if compared:
        words = ("callbacks", "slower than before", "no slower than before")
        parts.append(markdown_report(compared, words))
    return "\n".join(parts)


def _show_checked(
    judged_of: "list[list[Judged]]", compared: "list[Compared]", budget: Path | None
) -> None:
    """Show the limits that are broken and the callbacks that are slower, or say that none is.

    ``judged_of`` has the limits of each recording.
    """
    from chainshaper.reporting.overviews import broken_table, fleet_table

    judged = [limit for of_recording in judged_of for limit in of_recording]
    broken = [limit for limit in judged if not limit.met]
    if broken and len(judged_of) > FEW:
        out.show(fleet_table(judged_of), broken_table(broken))
    elif broken:
        out.show(broken_table(broken))
    elif budget is not None:
        out.show_line(f"all {len(judged)} limits of {budget} are met")
    slower = [callback.text for callback in compared if not callback.met]
    if slower:
        out.show_line("\n".join(slower))
    elif compared:
        out.show_line(f"none of {len(compared)} callbacks is slower than before")


def comparison_tables(*comparisons: "cs.Comparison") -> "list[ResultTable]":
    """Return tables of comparisons: an overview of several chains, and those of each chain.

    These have recordings beside each other, then each prediction beside its measurement.
    """
    from chainshaper.reporting import latency

    tables = [latency.overview_table(comparisons)] if len(comparisons) > 1 else []
    for comparison in comparisons:
        tables.append(latency.comparison_table(comparison))
        for measurement in comparison.measurements:
            if measurement.prediction is not None:
                name = measurement.recording.path.name
                tables.append(latency.prediction_table(measurement.prediction, name))
    return tables


def taken_chains(comparisons: "Sequence[cs.Comparison]", chain: str | None) -> list[str]:
    """Return notes about recordings whose only chain was taken, since none was named."""
    from chainshaper.verify.measure import taken_chain

    notes: dict[str, None] = {}
    for comparison in comparisons:
        for measurement in comparison.measurements:
            if not measurement.plan:
                taken = taken_chain(measurement.recording, chain, comparison.chain)
                notes |= dict.fromkeys(taken)
    return list(notes)


def judge(comparisons: "Sequence[cs.Comparison]", *, strict: bool, json: bool) -> None:
    """Say whether promises of plans were met.

    Raises OperationError, InputError: not all were, or there was none, and ``strict`` asks for it.
    """
    from chainshaper.reporting.latency import verdict

    all_met = list[bool | None]()
    for comparison in comparisons:
        about = f"{comparison.chain}: " if len(comparisons) > 1 else ""
        for measured in comparison.measurements:
            if measured.plan is not None:
                met, text = verdict(measured)
                all_met.append(met)
                if not json:
                    out.show_line(about + text)
    if strict and not all_met:
        raise InputError("--strict judges a plan's promise: name the plan in force with --plan")
    if strict and not all(all_met):
        raise OperationError("the plan's promise is not met (--strict)")


def compare(
    recordings: list[Path] = opt.argument("REC REC...", "Recordings' folders.", ...),
    chain: str | None = opt.CHAIN,
    through: list[str] | None = opt.THROUGH,
    figures: Path | None = opt.option(
        "--figures DIR", "Draw latency.png, hops.png and distribution.png into this folder."
    ),
    plan: Path | None = opt.PLAN_IN_FORCE,
    strict: bool = opt.STRICT,
    json: bool = opt.JSON,
) -> None:
    """Show the same chain in several recordings side by side, usually before and after shaping.

    Where a plan was in force, its prediction stands beside the measurement, band by band, and the
    last line says whether its promise was met. Without --chain, all chains of
    the plan in force in the last recording are shown.
    """
    from chainshaper.reporting.latency import comparisons_json

    in_force = opt.plan_in_force(plan)
    with out.late_progress("compare") as progress:
        opened = [cs.open_source(path, through=through or ()) for path in recordings]
        comparisons = cs.compare_chains(opened, chain, in_force, progress=progress)
        if figures is not None:
            from chainshaper.reporting.figures import draw_comparison

            if len(comparisons) > 1:
                raise InputError("--figures draws one chain: name it with --chain")
            progress(0.9, "drawing")
            draw_comparison(comparisons[0].measurements, figures)
    out.present(json, comparisons_json(comparisons), *comparison_tables(*comparisons))
    out.notes(taken_chains(comparisons, chain))
    judge(comparisons, strict=strict, json=json)
    if not json:
        out.next_step("chainshaper", "report", *recordings, "-o", "report.html")


def report(
    recordings: list[Path] = opt.argument("REC...", "Recordings' or LTTng traces' folders.", ...),
    output: Path = opt.option("--output -o FILE.html", "File to write; must not exist.", ...),
    chain: str | None = opt.CHAIN,
    through: list[str] | None = opt.THROUGH,
    plan: Path | None = opt.PLAN_IN_FORCE,
    cycles: list[int] | None = opt.option(
        "--cycle N",
        "A cycle that the timeline has to show, where there are too many to show all. "
        "May be given several times.",
        min=0,
    ),
    json: bool = opt.JSON,
) -> None:
    """Write one self-contained HTML page about a chain, usually before and after shaping.

    It has the figures, latency over time, histogram and distribution, the hops, the callbacks, a
    timeline of single cycles, overruns, stalls, the plan, and how all of it was recorded. The page
    needs no network. Without --chain, it has all chains of the plan in force in the last recording.
    """
    from chainshaper.reporting.latency import comparisons_json
    from chainshaper.reporting.page import ENDINGS
    from chainshaper.values.files import new_file

    new_file(output, ENDINGS)
    in_force = opt.plan_in_force(plan)
    with out.late_progress("report") as progress:
        opened = [cs.open_source(path, through=through or ()) for path in recordings]
        comparisons = cs.compare_chains(
            opened, chain, in_force, least=1, progress=progress, with_flow=True
        )
        progress(0.9, "drawing")
        written = cs.write_report(comparisons, output, cycles or ()).absolute()
    if out.present(json, {"report": str(written), **comparisons_json(comparisons)}):
        out.show_line(written)
    out.notes(taken_chains(comparisons, chain))


def export(
    trace: list[Path] = opt.TRACE,
    output: Path = opt.option(
        "--output -o FILE", "File to write, such as trace.pftrace; must not exist.", ...
    ),
    perfetto: bool = opt.option("--perfetto", "A trace that ui.perfetto.dev opens.", False),
    mcap: bool = opt.option("--mcap", "Times of callbacks and cycles, for Foxglove.", False),
    layout: Path | None = opt.option(
        "--layout FILE", "With --mcap: also write the layout of Foxglove's panels (.json)."
    ),
    chain: str | None = opt.CHAIN,
    through: list[str] | None = opt.THROUGH,
    plan: Path | None = opt.PLAN_IN_FORCE,
    callback_groups: bool = opt.option(
        "--callback-groups",
        "The priorities and cores of --plan, by callback group: a configuration (.yaml) of"
        " callback_isolated_executor, on which the recording was made.",
        False,
    ),
    template: Path | None = opt.option(
        "--template FILE.yaml",
        "With --callback-groups: the file of `thread_configurator_node --prerun`, or yours. Its ids"
        " are used, and what the plan does not concern stays.",
    ),
) -> None:
    """Write a recording for another tool: threads, callbacks, messages, slots, stalls.

    Or, with --callback-groups, the priorities of a plan for callback_isolated_executor.

    The chain's traversals are a track of their own where a chain is named or recorded, or the only
    one.
    """
    if [perfetto, mcap, callback_groups].count(True) != 1:
        reason = "the format is missing, or there are two"
        raise InputError(f"{reason}: add --perfetto or --mcap, or --callback-groups")
    if template is not None and not callback_groups:
        raise InputError("--template is for a plan's priorities: add --callback-groups")
    if callback_groups:
        _export_callback_groups(trace, output, plan, template, through)
        return
    from chainshaper.reporting.perfetto import ENDINGS
    from chainshaper.values.files import new_file
    from chainshaper.verify.measure import SeveralChainsError

    new_file(output, (".mcap",) if mcap else ENDINGS)
    if layout is not None and not mcap:
        raise InputError("--layout is for Foxglove: add --mcap")
    in_force = opt.plan_in_force(plan)
    with out.opened("export", trace, through) as (recording, report):
        report(0.5, "analysing")
        measured = None
        with suppress(SeveralChainsError):
            measured = cs.measure_latency(recording, chain, in_force)
        report(0.7, "writing")
        if mcap:
            written = cs.export_mcap(measured or recording, output, layout)
        else:
            written = cs.export_perfetto(measured or recording, output)
    out.show_line(written.absolute())
    out.notes((*recording.info.notes, out.lost_events(recording)))


def _export_callback_groups(
    trace: list[Path],
    output: Path,
    plan: Path | None,
    template: Path | None,
    through: list[str] | None,
) -> None:
    """Write the priorities and cores of a plan as a configuration of callback_isolated_executor."""
    from chainshaper.values.callback_groups import read_group_configuration
    from chainshaper.values.files import new_file, write_whole

    new_file(output, opt.DESCRIPTIONS)
    if plan is None:
        raise InputError("the priorities are those of a plan: add --plan plan.yaml")
    planned = cs.load_plan(plan)
    theirs = None if template is None else read_group_configuration(template)
    with out.opened("export", trace, through) as (recording, report):
        report(0.5, "finding callback groups")
        exported = cs.export_callback_groups(planned, recording, theirs)
    out.show_line(write_whole(output, [exported.text.encode()]))
    out.notes(exported.notes)
