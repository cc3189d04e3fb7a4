"""The rows of a timeline: what happened when, thread by thread.

The report's page and the trace for Perfetto draw the same: the threads that ran callbacks, the
callbacks, the messages between them, the slots of the servers, the messages that the gate held
back, and stalls of the machine. Times are ns of the event clock. :func:`timeline_data` makes the
data of the page, with times since the first cycle's start. It has all cycles of a short recording.
Of a long one it has the longest and the shortest, the median, incomplete ones, those that the user
asked for by number, and a sample of the others.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt
import polars as pl

from chainshaper.analysis import DataFlow, LatencyAnalysis
from chainshaper.analysis.disturbance import lateness_in_cycle, overlapping
from chainshaper.planning import ChainPlan
from chainshaper.reporting.overviews import cores_text
from chainshaper.reporting.tables import ms, slots_ms
from chainshaper.values import events
from chainshaper.values.recording import Recording
from chainshaper.verify.measure import Measurement
from chainshaper.verify.predictions import due_of

CYCLES = 500
SLICES = 20_000
"""The most cycles, and callbacks in them, in the page's timeline of a recording."""

EXTREMES = 20
"""How many of the longest cycles, and of the shortest, are among them at any rate."""

KINDS = ("cycle", "callback", "unended", "gated", "slot", "stall")
CYCLE, CALLBACK, UNENDED, GATED, SLOT, STALL = range(len(KINDS))
"""The kinds of bars in the page's timeline, by number."""
BARS = ("row", "start", "length", "kind", "cycle", "text", "used")
"""The columns of bars, see :func:`timeline_data`."""

FAR = 10**15
"""An instant outside every recording: 11 days (ns)."""

Bar: TypeAlias = tuple[int, int, int, int, int, str, int | None]
Windows: TypeAlias = tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]

_GATED = {
    "traversal": pl.UInt32(),
    "hop": pl.UInt8(),
    **dict.fromkeys(("arrival", "origin", "release", "let_go"), pl.Int64()),
    "slot": pl.Int32(),
    "overrun": pl.String(),
}
_ORIGINS = {"traversal": pl.UInt32(), "origin": pl.Int64(), "assumed": pl.Boolean()}
_SLOTS = {"server": pl.String(), "slot": pl.Int32(), "opens": pl.Int64(), "closes": pl.Int64()}


@dataclass(frozen=True)
class Timeline:
    """The rows of a timeline, a frame for each kind. Times are ns of the event clock.

    ``threads``
        ``pid, tid``; ``nodes`` whose callbacks ran there; ``about``, its scheduling class and cores
        (null: unknown). The chain's nodes come first, in the chain's order.
    ``slices``
        ``instance, callback_id, pid, tid, start, end, ended, execution_ns``, sorted by start. Where
        the end was lost, ``ended`` is false and ``end`` the start of the thread's next instance,
        or the end of the recording.
    ``holds``
        The messages of the chain at gates: ``traversal, hop, arrival, origin, slot, overrun``;
        ``release``, when the gate was to let it go; ``let_go``, when it did.
    ``origins``
        Where the plan's slots count from, by cycle: ``traversal, origin``; ``assumed``, whether no
        event shows it. Empty without a plan.
    ``slots``
        The slots of each server in each such cycle: ``traversal, server, slot, start, end``.
    ``stalls``
        ``core, start, end``.
    """

    threads: pl.DataFrame
    slices: pl.DataFrame
    holds: pl.DataFrame
    origins: pl.DataFrame
    slots: pl.DataFrame
    stalls: pl.DataFrame


def timeline_of(
    recording: Recording,
    flow: DataFlow,
    analysis: LatencyAnalysis | None = None,
    plan: ChainPlan | None = None,
) -> Timeline:
    """Make the timeline of a recording, with cycles of ``analysis`` and slots of ``plan``."""
    times = flow.instances["start"], flow.instances["end"], flow.publications["time"]
    following = pl.col("start").shift(-1).over("pid", "tid")
    slices = flow.instances.sort("start", maintain_order=True).select(
        *("instance", "callback_id", "pid", "tid", "start"),
        pl.coalesce("end", following, pl.lit(pl.concat(times).max())).alias("end"),
        pl.col("end").is_not_null().alias("ended"),
        "execution_ns",
    )
    holds = pl.DataFrame(schema=_GATED) if analysis is None else analysis.releases.select(*_GATED)
    origins = _origins(analysis, plan)
    servers = () if plan is None else plan.servers
    slots = [
        (server.name, number, *slot)
        for server in servers
        for number, slot in enumerate(server.slots)
    ]
    # Two traversals may share a cycle of the gate: its slots are drawn once.
    cycles = origins.unique("origin", keep="first", maintain_order=True)
    opened = cycles.join(
        pl.DataFrame(slots, schema=_SLOTS, orient="row"), how="cross", maintain_order="left_right"
    )
    stalls = events.table(recording.events, "machine_stall", ["cpu"])
    at = pl.col("origin")
    return Timeline(
        threads=_threads(recording, flow, slices, analysis),
        slices=slices,
        holds=holds,
        origins=origins,
        slots=opened.select(
            "traversal", "server", "slot", start=at + pl.col("opens"), end=at + pl.col("closes")
        ),
        stalls=stalls.select(core="cpu", start="time", end=pl.col("time") + pl.col("duration")),
    )


def _threads(
    recording: Recording, flow: DataFlow, slices: pl.DataFrame, analysis: LatencyAnalysis | None
) -> pl.DataFrame:
    """Make the frame ``threads`` of :class:`Timeline`."""
    chain = () if analysis is None else analysis.chain.callbacks
    place = pl.col("callback_id").replace_strict(
        list(chain), list(range(len(chain))), default=len(chain), return_dtype=pl.Int32
    )
    owners = flow.objects.callbacks.select("callback_id", "node").unique("callback_id")
    about = {
        (thread.pid, thread.tid): f"{thread.policy} {thread.priority}, {cores_text(thread.cores)}"
        for thread in recording.info.threads
    }
    nodes = pl.col("node").drop_nulls().unique().sort().str.join(", ")
    by_thread = slices.join(owners, on="callback_id", how="left").group_by("pid", "tid")
    rows = by_thread.agg(nodes=nodes, place=place.min()).sort("place", "nodes", "pid", "tid")
    texts = [about.get(key) for key in rows.select("pid", "tid").iter_rows()]
    return rows.drop("place").with_columns(pl.Series("about", texts, dtype=pl.String))


def _origins(analysis: LatencyAnalysis | None, plan: ChainPlan | None) -> pl.DataFrame:
    """Make the frame ``origins`` of :class:`Timeline`.

    A gate's decision has the origin. Without one it is the chain's start, or the start of its cycle
    (:func:`~chainshaper.analysis.disturbance.lateness_in_cycle`).
    """
    if analysis is None or plan is None:
        return pl.DataFrame(schema=_ORIGINS)
    decided = analysis.decided.select("traversal", decided="origin")
    rows = analysis.traversals.select("traversal", "start").join(
        decided.unique("traversal"), on="traversal", how="left", maintain_order="left"
    )
    from_cycle = plan.shaping_node is None or due_of(plan)[0].from_cycle
    late = lateness_in_cycle(rows["start"], plan.cycle_ns) if from_cycle else 0
    return rows.select(
        "traversal",
        origin=pl.coalesce("decided", pl.col("start") - pl.lit(late)),
        assumed=pl.col("decided").is_null(),
    )


def timeline_data(
    measurement: Measurement, timeline: Timeline, cycles: Sequence[int], zero: int
) -> dict[str, Any]:
    """Make the data of the page's timeline. Times are in ns since ``zero``.

    * ``rows``: the chain, threads, servers and cores, each with a remark.
    * ``row, start, length, kind, cycle, text, used``: the columns of bars (:data:`BARS`): number of
      the row; start and length; number in :data:`KINDS`; number of the cycle (-1: none); number in
      ``texts``; execution time.
    * ``texts``: of bars.
    * ``gaps``: stretches of which the page has no data.
    * ``cycles``, ``hops``: the cycles in the page, and the names of their hops.
    * ``of``: how many cycles there are.
    * ``chosen``: which cycles the page offers to open first.
    """
    analysis = measurement.analysis
    chosen = _chosen(analysis.traversals, measurement.recording.info.worst_ns)
    per_cycle = timeline.slices.height / max(1, analysis.traversals.height)
    in_page = _cycles_in_page(analysis.traversals, per_cycle, cycles, chosen.values())
    traversals = analysis.traversals.filter(pl.col("traversal").is_in(in_page))
    windows = _windows(traversals, timeline)
    stalls = _inside(timeline.stalls.sort("start"), windows)
    servers = () if measurement.plan is None else measurement.plan.servers
    rows = [("chain", ""), *timeline.threads.select("nodes", pl.col("about").fill_null("")).rows()]
    of_server = {server.name: number for number, server in enumerate(servers, start=len(rows))}
    rows += [
        (f"server {server.name}", f"core {server.core}, priority {server.priority}")
        for server in servers
    ]
    of_core = {core: number for number, core in enumerate(dict.fromkeys(stalls["core"]), len(rows))}
    rows += [("stalls" if core is None else f"stalls of core {core}", "") for core in of_core]

    threads = timeline.threads.select("pid", "tid").with_row_index("row", offset=1)
    ran = timeline.slices.select("instance", "pid", "tid").join(threads, on=["pid", "tid"])
    times = (pl.col(name) - pl.col("begun") for name in ("take", "start", "publish", "end"))
    hops = (
        analysis.hops.join(traversals.select("traversal", begun="start"), on="traversal")
        .join(ran, on="instance", how="left")
        .sort("traversal", "hop")
        .select("traversal", "hop", "row", *times)
    )
    labels = {callback.id: analysis.graph.label(callback) for callback in analysis.graph.callbacks}
    slices = (
        _inside(timeline.slices, windows)
        .join(threads, on=["pid", "tid"], maintain_order="left")
        .with_columns(label=pl.col("callback_id").replace_strict(labels, return_dtype=pl.String))
    )
    bars = [*_bars(timeline, traversals, slices, hops.drop_nulls("row"), of_server)]
    for core, start, end in stalls.iter_rows():
        bars.append((of_core[core], start, end - start, STALL, -1, "the machine stalled", None))
    texts = {text: number for number, text in enumerate(dict.fromkeys(bar[5] for bar in bars))}
    table = [(row, at - zero, *rest, texts[text], used) for row, at, *rest, text, used in bars]
    columns = zip(*table, strict=True) if table else [()] * len(BARS)
    edges = [-FAR, *(np.column_stack(windows) - zero).ravel().tolist(), FAR]
    passed = zip(analysis.chain.callbacks, analysis.chain.topics, strict=True)
    return {
        "rows": rows,
        **dict(zip(BARS, map(list, columns), strict=True)),
        "texts": list(texts),
        "gaps": list(zip(edges[::2], edges[1::2], strict=True)),
        "cycles": list(_cycles(traversals, hops, timeline.slots, zero)),
        "hops": [f"{labels[callback]} → {topic}" for callback, topic in passed],
        "of": analysis.traversals.height,
        "chosen": chosen,
    }


def _bars(
    timeline: Timeline,
    traversals: pl.DataFrame,
    slices: pl.DataFrame,
    hops: pl.DataFrame,
    of_server: dict[str, int],
) -> Iterator[Bar]:
    """Yield bars for cycles, callbacks, gates and slots; later ones are drawn over earlier ones."""
    columns = ["traversal", "start", "latency_ns", "disturbed"]
    for cycle, start, latency, hit in traversals.filter("complete").select(columns).iter_rows():
        text = f"cycle {cycle}{', disturbed by the machine' if hit else ''}"
        yield 0, start, latency, CYCLE, cycle, text, None
    columns = ["row", "label", "start", "end", "ended", "execution_ns"]
    for row, label, start, end, whole, used in slices.select(columns).iter_rows():
        text = label if whole else f"{label}\nits end was not recorded"
        yield row, start, end - start, CALLBACK if whole else UNENDED, -1, text, used
    columns = ["row", "traversal", "arrival", "let_go", "overrun"]
    gated = timeline.holds.join(hops, on=["traversal", "hop"], maintain_order="left")
    for row, cycle, arrival, let_go, overrun in gated.select(columns).iter_rows():
        text = f"cycle {cycle}: in the gate{f', overran: {overrun}' if overrun else ''}"
        yield row, arrival, let_go - arrival, GATED, cycle, text, None
    # If two traversals share a cycle, its slots are drawn once, with whichever is in the page.
    shown = timeline.origins.join(traversals.select("traversal"), on="traversal", how="semi")
    slots = timeline.slots.join(timeline.origins, on="traversal", maintain_order="left").join(
        shown, on="origin", how="semi", maintain_order="left"
    )
    columns = ["server", "traversal", "start", "end", "origin", "assumed"]
    for server, cycle, start, end, origin, assumed in slots.select(columns).iter_rows():
        text = f"server {server}, cycle {cycle}\n{slots_ms((start - origin, end - origin))} ms"
        if assumed:
            text += "\nthe cycle's start is not recorded but assumed"
        yield of_server[server], start, end - start, SLOT, cycle, text, None


def _cycles(
    traversals: pl.DataFrame, hops: pl.DataFrame, slots: pl.DataFrame, zero: int
) -> Iterator[dict[str, Any]]:
    """Yield each cycle in the page. Times are in ns.

    Its ``hops`` are ``[row, take, start, publish, end]``, counted from its start. Its ``length`` is
    the time that it takes on the timeline, with its servers' slots.
    """
    closes = dict(slots.group_by("traversal").agg(pl.col("end").max()).iter_rows())
    hops_of: dict[int, list[list[int | None]]] = {}
    for traversal, _, *hop in hops.iter_rows():
        hops_of.setdefault(traversal, []).append(hop)
    for row in traversals.iter_rows(named=True):
        number, start = row["traversal"], row["start"]
        hops_of_cycle = hops_of.get(number, [])
        state = f"incomplete: {row['reason']} ({row['broken_at']})"
        about = f"{ms(row['latency_ns'])} ms" if row["complete"] else state
        if row["disturbed"]:
            about += ", disturbed by the machine"
        received = 0
        if row["received"] is not None:
            received = row["received"] - start
            about += f"; {ms(received)} ms at the subscriber"
        about += f"; began {(start - zero) / 1e9:.3f} s after the first"
        cycle = {"n": number, "start": start - zero, "hops": hops_of_cycle, "about": about}
        if row["complete"]:
            cycle["latency"] = row["latency_ns"]
        ends = [time for hop in hops_of_cycle for time in hop[2:] if time is not None]
        ends += [row["latency_ns"] or 0, received, closes.get(number, start) - start]
        yield {**cycle, "length": max(1000, *ends)}


def _chosen(traversals: pl.DataFrame, worst_ns: Sequence[int]) -> dict[str, int]:
    """Choose the longest, median and shortest cycle, and the first one that the page shows.

    They are undisturbed, unless all complete ones are disturbed. The first is the cycle for which
    a watch wrote the recording, if there is one.
    """
    worst = traversals.filter(pl.col("start").is_in(worst_ns))["traversal"]
    first = {"first": int(worst[0])} if len(worst) else {}
    complete = traversals.filter("complete")
    calm = complete.filter(~pl.col("disturbed"))
    ordered = (calm if calm.height else complete).sort("latency_ns", maintain_order=True)
    numbers = ordered["traversal"].to_list()
    if not numbers:
        return first
    middle = numbers[(len(numbers) - 1) // 2]
    return {"longest": numbers[-1], "median": middle, "shortest": numbers[0], **first}


def _cycles_in_page(
    traversals: pl.DataFrame, slices: float, asked: Sequence[int], chosen: Iterable[int]
) -> list[int]:
    """Choose the cycles in the page: all if they are few, else a selection.

    These are the ones asked for, the chosen, extremes, incomplete ones, and a sample of all.
    """
    room = max(2 * EXTREMES + 1, min(CYCLES, int(SLICES / max(1.0, slices))))
    all_cycles = traversals["traversal"].to_list()
    if len(all_cycles) <= room:
        return all_cycles
    known = set(all_cycles)
    ordered = traversals.filter("complete").sort("latency_ns", maintain_order=True)["traversal"]
    candidates = [
        *(cycle for cycle in asked if cycle in known),
        *chosen,
        *ordered.tail(EXTREMES),
        *ordered.head(EXTREMES),
        *traversals.filter(~pl.col("complete"))["traversal"].head(EXTREMES),
        *all_cycles[:: max(1, len(all_cycles) // room)],
    ]
    return sorted(list(dict.fromkeys(candidates))[: room + len(asked)])


def _windows(traversals: pl.DataFrame, timeline: Timeline) -> Windows:
    """Windows from a little before each cycle to a little after its output's reception, merged."""
    slots = timeline.slots.group_by("traversal").agg(closes=pl.col("end").max())
    rows = traversals.join(slots, on="traversal", how="left", maintain_order="left")
    usual = rows["latency_ns"].median()
    length = int(usual) if isinstance(usual, float) else 100_000_000
    ends = pl.max_horizontal("end", "received", "closes", pl.col("start") + length)
    began = rows["start"].to_numpy() - length // 20
    ended = rows.select(ends.cum_max() + length // 20).to_series().to_numpy()
    fresh = np.ones(len(began), dtype=bool)
    fresh[1:] = began[1:] > ended[:-1]
    return began[fresh], ended[np.append(fresh[1:], True)[: len(fresh)]]


def _inside(slices: pl.DataFrame, windows: Windows) -> pl.DataFrame:
    """Select the rows whose time from ``start`` to ``end`` meets a window."""
    start, end = slices["start"].to_numpy(), slices["end"].to_numpy()
    return slices.filter(pl.Series(overlapping(start, end, *windows), dtype=pl.Boolean))
