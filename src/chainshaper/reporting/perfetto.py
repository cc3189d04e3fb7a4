"""A recording as a trace that ui.perfetto.dev opens.

What is in it: the threads of every process with their callbacks; each publication as an instant,
with an arrow to the callback that took the message; what asynchronous publishers' threads sent;
and, as rows of their own, the traversals of the chain with their hops, what the gate held back,
the slots of the servers, and stalls of the machine. Times are ns of the recording's event clock.
"""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import polars as pl

from chainshaper.analysis import DataFlow, LatencyAnalysis, data_flow, graph_of
from chainshaper.reporting.perfetto_format import Slice, Track, encode_trace
from chainshaper.reporting.timeline import Timeline, timeline_of
from chainshaper.values import events
from chainshaper.values.recording import Recording
from chainshaper.values.safe_text import shown
from chainshaper.values.whole_file import new_file, write_whole
from chainshaper.verify.measure import Measurement

__all__ = ["ENDINGS", "export_perfetto"]

ENDINGS = (".pftrace", ".perfetto-trace")

Thread = tuple[int, int]


def export_perfetto(source: Recording | Measurement, path: str | Path) -> Path:
    """Write a recording for Perfetto; a measurement adds its chain, and the plan in force.

    Raises:
        InputError: the path exists already, or ends in none of :data:`ENDINGS`.
        OperationError: it cannot be written; nothing is left behind.
    """
    path = new_file(path, ENDINGS)
    measured = source if isinstance(source, Measurement) else None
    recording = source.recording if isinstance(source, Measurement) else source
    analysis, plan = (measured.analysis, measured.plan) if measured else (None, None)
    flow = data_flow(recording.events, recording.info.clock_offset_ns)
    timeline = timeline_of(recording, flow, analysis, plan)
    tracks = _thread_tracks(recording, flow, timeline)
    if analysis is not None:
        tracks += [*_chain_track(analysis), *_gate_tracks(analysis, timeline)]
    tracks += [*_server_tracks(timeline), *_stall_tracks(timeline)]
    shown_tracks = [_shown(track) for track in tracks]
    return write_whole(path, encode_trace(shown_tracks, recording.info.clock_offset_ns))


def _shown(track: Track) -> Track:
    """A track with all its texts as they are shown."""
    families = [
        [
            replace(
                one,
                name=shown(one.name),
                arguments={
                    name: shown(value) if isinstance(value, str) else value
                    for name, value in one.arguments.items()
                },
            )
            for one in family
        ]
        for family in track.families
    ]
    return replace(track, owner=shown(track.owner), name=shown(track.name), families=families)


def _thread_tracks(recording: Recording, flow: DataFlow, timeline: Timeline) -> list[Track]:
    rows: dict[Thread, list[Slice]] = {}
    for found in (_callbacks(flow, timeline), _publications(flow), _unread(flow), _sends(flow)):
        for thread, one in found:
            rows.setdefault(thread, []).append(one)
    nodes = {
        (pid, tid): (names, about)
        for pid, tid, names, about in timeline.threads.select(
            "pid", "tid", "nodes", "about"
        ).iter_rows()
    }
    comms = {(thread.pid, thread.tid): thread.comm for thread in recording.info.threads}
    tracks = []
    for thread in [*(t for t in nodes if t in rows), *sorted(rows.keys() - nodes.keys())]:
        name, about = nodes.get(thread, (comms.get(thread, f"thread {thread[1]}"), None))
        owner = recording.info.processes.get(thread[0], name)
        title = f"{name} ({about})" if about else name
        tracks.append(Track(owner, title, [[one] for one in rows[thread]], thread))
    return tracks


def _callbacks(flow: DataFlow, timeline: Timeline) -> Iterator[tuple[Thread, Slice]]:
    callbacks = {callback.id: callback for callback in graph_of(flow).callbacks}
    ends = flow.takes.drop_nulls(["instance", "publication"]).group_by("instance").agg("take")
    arrows = {instance: [take + 1 for take in takes] for instance, takes in ends.iter_rows()}
    for row in timeline.slices.iter_rows(named=True):
        callback = callbacks[row["callback_id"]]
        arguments = {
            "function": callback.symbol,
            "instance": row["instance"],
            "execution_ns": row["execution_ns"],
            "end": None if row["ended"] else "not recorded",
        }
        ending = arrows.get(row["instance"], ())
        one = Slice(row["start"], row["end"], callback.label, arguments, ends_flows=ending)
        yield (row["pid"], row["tid"]), one


def _publications(flow: DataFlow) -> Iterator[tuple[Thread, Slice]]:
    taken = flow.takes.drop_nulls("publication").group_by("publication").agg("take")
    arrows = {publication: [take + 1 for take in takes] for publication, takes in taken.iter_rows()}
    for row in flow.publications.iter_rows(named=True):
        arguments = {
            "publication": row["publication"],
            "source_timestamp": row["source_timestamp"],
            "taken_by": len(arrows.get(row["publication"], ())),
        }
        flows = arrows.get(row["publication"], ())
        one = Slice(row["time"], None, f"publish {row['topic']}", arguments, flows=flows)
        yield (row["pid"], row["tid"]), one


def _unread(flow: DataFlow) -> Iterator[tuple[Thread, Slice]]:
    """Messages that were taken, but that no callback got: their arrow ends at the take."""
    taken = flow.takes.filter(pl.col("publication").is_not_null() & pl.col("instance").is_null())
    for row in taken.iter_rows(named=True):
        one = Slice(row["time"], None, f"take {row['topic']}", ends_flows=[row["take"] + 1])
        yield (row["pid"], row["tid"]), one


def _sends(flow: DataFlow) -> Iterator[tuple[Thread, Slice]]:
    for row in events.table(flow.events, "asynchronous_send").iter_rows(named=True):
        arguments = {"source_timestamp": row["timestamp"]}
        end = row["time"] + (row["duration"] or 0)
        yield (row["pid"], row["tid"]), Slice(row["time"], end, row["outcome"], arguments)


def _chain_track(analysis: LatencyAnalysis) -> Iterator[Track]:
    """Traversals, each with the computation of its hops inside; incomplete ones as instants."""
    nodes = {callback.id: callback.node for callback in analysis.graph.callbacks}
    hops: dict[int, list[Slice]] = {}
    for row in analysis.hops.drop_nulls("publish").sort("traversal", "hop").iter_rows(named=True):
        name = f"{nodes[row['callback_id']]} → {row['topic']}"
        arguments = {"communication_ns": row["communication_ns"], "via": row["via"]}
        hop = Slice(row["start"], row["publish"], name, arguments)
        hops.setdefault(row["traversal"], []).append(hop)
    families = []
    for row in analysis.traversals.iter_rows(named=True):
        number = row["traversal"]
        if row["complete"]:
            arguments = {
                "latency_ns": row["latency_ns"],
                "disturbed": row["disturbed"],
                "reception_ns": row["reception_ns"],
            }
            whole = Slice(row["start"], row["end"], f"cycle {number}", arguments)
            families.append([whole, *hops.get(number, ())])
        else:
            what = f"cycle {number} incomplete: {row['reason']}"
            families.append([Slice(row["start"], None, what, {"topic": row["broken_at"]})])
    yield Track("Chain", analysis.chain.spec, families)


def _gate_tracks(analysis: LatencyAnalysis, timeline: Timeline) -> Iterator[Track]:
    """What the shaping nodes held, from arrival until they let it go (or gave it up)."""
    node_of = {callback.id: callback.node for callback in analysis.graph.callbacks}
    for (hop,), rows in timeline.holds.group_by("hop", maintain_order=True):
        families = []
        for row in rows.iter_rows(named=True):
            late = None if row["release"] is None else row["let_go"] - row["release"]
            arguments = {
                "cycle": row["traversal"],
                "slot": row["slot"],
                "planned": row["release"],
                "behind_plan_ns": late,
                "overrun": row["overrun"],
            }
            name = "held" if row["overrun"] is None else f"overran: {row['overrun']}"
            families.append([Slice(row["arrival"], row["let_go"], name, arguments)])
        yield Track("Gate", node_of[analysis.chain.callbacks[hop]], families)


def _server_tracks(timeline: Timeline) -> Iterator[Track]:
    for (server,), rows in timeline.slots.group_by("server", maintain_order=True):
        slots = [
            [Slice(start, end, f"slot {slot + 1}", {"cycle": traversal})]
            for traversal, slot, start, end in rows.select(
                "traversal", "slot", "start", "end"
            ).iter_rows()
        ]
        yield Track("Servers", str(server), slots)


def _stall_tracks(timeline: Timeline) -> Iterator[Track]:
    for (core,), rows in timeline.stalls.group_by("core", maintain_order=True):
        where = "all cores" if core is None else f"core {core}"
        stalls = [
            [Slice(start, end, "stall")] for start, end in rows.select("start", "end").iter_rows()
        ]
        yield Track("Stalls of the machine", where, stalls)
