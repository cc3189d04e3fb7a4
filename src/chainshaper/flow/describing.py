"""The description of an application as a recording shows it, for the simulator and live runs.

Execution times and deliveries are sequences, cycle by cycle as they were: what came together comes
together again. Cores, priorities, phases of timers, several threads and synchronisers are those of
the recording, or follow from who ran when (:mod:`chainshaper.analysis.occupation`). What a
recording cannot tell is said in notes, which stand at the top of the file. The parts of a
description are made in :mod:`.recorded_description`.
"""

from collections.abc import Mapping
from pathlib import Path
from textwrap import fill
from typing import Any

import numpy as np
import numpy.typing as npt
import yaml

from chainshaper.analysis import analyse_latency
from chainshaper.flow.recorded_description.costs import costs_of
from chainshaper.flow.recorded_description.evidence import Evidence, evidence_of
from chainshaper.flow.recorded_description.nodes import (
    DescribedNode,
    described_chain,
    described_nodes,
)
from chainshaper.flow.recorded_description.scheduling import described_scheduling
from chainshaper.flow.recorded_description.sequences import (
    in_whole_cycles,
    written_out,
    written_places,
)
from chainshaper.simulation import simulate, simulate_latencies
from chainshaper.values import events
from chainshaper.values.durations import format_duration, milliseconds
from chainshaper.values.errors import InputError
from chainshaper.values.files import scratch_folder
from chainshaper.values.recording import Recording
from chainshaper.values.yaml_file import AS_YAML, wrong_values_refused
from chainshaper.verify.measure import opened
from chainshaper.workload.description import Application

MOST_VALUES = 150_000  # durations in a description, which a file may have without being slow
_DEFAULT_DEPTH = 10  # of a topic's history, in a description
_NEAR_AVERAGE, _NEAR_MAXIMUM = 0.02, 0.05  # so near a simulated description comes, or says so
_MOST_CYCLES = 20_000  # that are simulated to see that


def application_file(
    recording: Recording | str | Path, chain: str | None = None
) -> tuple[str, tuple[str, ...]]:
    """Return the description of a recording's application (YAML), and what it cannot know.

    ``chain`` defaults to the recording's own, else the heaviest. Raises InputError: no chain is in
    it, or no description can be made of it.
    """
    recording = opened(recording)
    evidence = evidence_of(recording, chain)
    nodes = described_nodes(evidence)
    if not nodes:
        raise InputError(f"{recording.path}: no callback of it ran twice: record longer")
    scheduling = described_scheduling(evidence, nodes)
    values: dict[str, Any] = {
        "name": recording.path.name,
        "chain": described_chain(evidence, nodes),
        "scheduling": scheduling,
        "topics": _topics(evidence, nodes),
        "simulation": _simulation(evidence, nodes),
        "nodes": {
            name: {**node.values, "callbacks": [callback.values for callback in node.callbacks]}
            for name, node in nodes.items()
        },
    }
    values = {key: part for key, part in values.items() if part}
    values = in_whole_cycles(values, len(evidence.instances([evidence.origin])))
    places, share = written_places(values, MOST_VALUES)
    if places:
        evidence.notes.append(
            f"The recording is long: {100 * share:.0f} % of its cycles are written, evenly spread,"
            " and those with the longest and the shortest times."
        )
    values = written_out(values, places)
    with wrong_values_refused(Application, f"{recording.path}: "):
        application = Application.model_validate(values, context=AS_YAML, strict=False)
    compared = _simulated_back(evidence, application)
    notes = tuple(dict.fromkeys((*evidence.notes, compared)))
    body = yaml.safe_dump(values, sort_keys=False, default_flow_style=None, width=100)
    return "".join((*map(_comment, notes), body)), notes


def _comment(note: str) -> str:
    """Return a note as lines of comment."""
    return fill(note, 98, initial_indent="# ", subsequent_indent="#   ") + "\n"


def _topics(evidence: Evidence, nodes: Mapping[str, DescribedNode]) -> dict[str, Any]:
    """Return how topics are published, where that is not as by default."""
    written = {
        topic
        for node in nodes.values()
        for described in node.callbacks
        for topic in described.values.get("publishes", ())
    }
    settings: dict[str, dict[str, Any]] = {topic: {} for topic in sorted(written)}
    created = events.table(evidence.flow.events, "rcl_publisher_init", ["asynchronous"])
    publishers = created.select("topic_name", "queue_depth", "asynchronous")
    for topic, depth, asynchronous in publishers.iter_rows():
        if topic in settings and asynchronous:
            settings[topic]["publication"] = "asynchronous"
        if topic in settings and depth and depth != _DEFAULT_DEPTH:
            settings[topic]["depth"] = int(depth)
    for endpoint in evidence.recording.info.endpoints:
        if endpoint.topic in settings and endpoint.kind == "publisher":
            of_topic = settings[endpoint.topic]
            if endpoint.reliability == "best_effort":
                of_topic["reliability"] = "best_effort"
            if endpoint.lifespan_ns:
                of_topic["lifespan"] = format_duration(endpoint.lifespan_ns)
    return {topic: of_topic for topic, of_topic in settings.items() if of_topic}


def _simulation(evidence: Evidence, nodes: Mapping[str, DescribedNode]) -> dict[str, Any]:
    """Return what the simulator needs: deliveries as they were, and no cost that is in others."""
    costs = costs_of(evidence)
    times_ns = {"wake_up": costs.wake_up_ns, "take": costs.take_ns, "publish": 0, "delivery": 0}
    values: dict[str, Any] = {
        name: {"constant": format_duration(time_ns)} for name, time_ns in times_ns.items()
    }
    values["interrupts"] = 0.0
    values["deliveries"] = {
        name: node.deliveries for name, node in nodes.items() if node.deliveries
    }
    return values


def _simulated_back(evidence: Evidence, application: Application) -> str:
    """Say how near the description comes to the recording: simulated and recorded latencies."""
    recorded = analyse_latency(evidence.flow, evidence.chain.spec)
    complete = recorded.traversals.drop_nulls("latency_ns").sort("latency_ns")
    if complete.is_empty():
        return "No cycle completes: the description cannot be compared with the recording."
    simulated = _simulated_latencies(application, min(_MOST_CYCLES, 2 * len(complete)))
    if not simulated.size:
        return f"Simulated, no cycle of {application.chain} completes, as the recorded ones did."
    latencies = complete["latency_ns"].to_numpy()
    mean, recorded_mean = float(simulated.mean()), float(latencies.mean())
    longest, recorded_longest = int(simulated.max()), int(latencies.max())
    text = (
        f"Simulated, {application.chain} takes {milliseconds(mean)} ms on average and"
        f" {milliseconds(longest)} ms at most; recorded were {milliseconds(recorded_mean)} and"
        f" {milliseconds(recorded_longest)} ms."
    )
    if abs(longest - recorded_longest) > _NEAR_MAXIMUM * recorded_longest:
        since = (complete["start"][-1] - complete["start"].min()) / 1e9
        text += (
            f" The longest was recorded {since:.1f} s behind the first: what made it so long is"
            " not in the description."
        )
    if abs(mean - recorded_mean) > _NEAR_AVERAGE * recorded_mean:
        text += " The averages differ: what the notes say matters for this chain."
    return text


def _simulated_latencies(application: Application, cycles: int) -> npt.NDArray[np.int64]:
    """Return the latencies of a description's chain that are completed in simulation (ns)."""
    try:
        latencies = simulate_latencies(application, cycles=cycles)
    except InputError:  # stored messages lead through nodes of which events alone tell
        with scratch_folder() as folder:
            recording = simulate(application, folder / "simulated", cycles=cycles)
            traversals = analyse_latency(recording, application.chain).traversals
            latencies = traversals["latency_ns"].drop_nulls().to_numpy()
    return latencies[latencies >= 0]
