"""Latency shaping: from measured latencies to the chain's server and its publish slots.

The chain runs in a server that is open from the start of a cycle until every execution seen so
far was complete, and its output is published in a server whose slot comes then: late for most
cycles, but at the same time in all of them (paper, sections 3.1 and 3.2).
"""

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from chainshaper.gate.decision import Anchor, Messages, Overrun
from chainshaper.planning.latency_file import check_latencies
from chainshaper.planning.margins import EPSILON_NS, OVERRUN_PROBABILITY, cycles_needed
from chainshaper.planning.plan import (
    ChainOfPlan,
    Evidence,
    Margin,
    Plan,
    Prediction,
    Server,
    ShapingNode,
    Thread,
    publish_slots,
    wrong_values_refused,
)
from chainshaper.planning.publication import publication_warnings
from chainshaper.values.durations import format_duration, milliseconds
from chainshaper.values.errors import InputError, OperationError
from chainshaper.values.plan_choices import Publication

__all__ = ["evidence_of", "plan_shaping", "plan_warnings", "predict_bands", "shaping_node_like"]

OUTPUT_PRIORITY = 1  # better than the chain's: a publish slot inside its slot has to pre-empt it
CHAIN_PRIORITY = 2
PAUSE_NS = 2_000_000  # a receiver on a slow machine takes a millisecond to get to its callback

NEARLY_FULL = 0.95  # of the cycle; also the kernel's default share for real-time threads


def plan_shaping(
    latencies_ns: NDArray[np.int64],
    period_ns: int,
    *,
    spec: str | None = None,
    output: str | None = None,
    publisher: str | None = None,
    nodes: Sequence[str] = (),
    epsilon_ns: int = EPSILON_NS,
    margin: Margin | None = None,
    publish_slot_ns: int = 1_000_000,
    publication: Publication = "synchronous",
    output_depth: int | None = None,
    core: int = 1,
    output_core: int | None = None,
    anchor: Anchor = "stamp",
    overrun: Overrun = "publish",
    messages: Messages = "all-in-order",
    depth: int | None = None,
    fifo_priority: int = 84,
    spin_ns: int = 1_000_000,
    pause_ns: int | None = None,
    receivers: Sequence[str] = (),
    **conditions: Any,
) -> Plan:
    """Plan single-band shaping: one publish slot right behind the longest latency measured.

    With L̄ the longest latency, ε the margin, Δ the length of the publish slot and CT the
    period, the chain's server R_m gets the slot [0, L̄ + ε) (eq. 1) and the output's server R_m°
    gets [L̄ + ε, L̄ + ε + Δ) (eq. 4 with a shaping node, eq. 2 with an asynchronous publisher
    thread), in the same cycle (eq. 3). R_m° gets the better priority and, unless ``output_core``
    says otherwise, the same core.

    Args:
        latencies_ns: every end-to-end latency to be covered; L̄ is the longest of them, so leave
            out beforehand what the chain is not to be planned for.
        period_ns: the chain's period.
        spec, output, publisher, nodes: the chain as written, its last topic, the node that
            publishes it, and the nodes whose executors run the chain's callbacks. Without
            ``output`` the plan names no publishing thread: it can be studied, not carried out.
        epsilon_ns, publish_slot_ns: ε and Δ.
        margin: a margin that was derived from the latencies, in place of ``epsilon_ns``.
        publication: ``synchronous`` splices a shaping node behind the output; ``asynchronous``
            puts the publisher's own thread into R_m°.
        output_depth: history of the output's writer (keep last).
        core, output_core: cores of the two servers.
        anchor, fifo_priority, spin_ns, pause_ns, receivers: for the shaping node; it pauses for
            2 ms, a twentieth of the period at most, if nothing else is asked for.
        overrun: what becomes of an output that missed its slot.
        messages, depth: which of several outputs in one cycle leave, and how many may wait.
        conditions: how the latencies were taken: the other fields of
            :class:`~chainshaper.planning.plan_parts.Evidence`.

    Raises:
        InputError: latencies or values that no plan may have.
        OperationError: L̄ + ε + Δ does not fit into the period.
    """
    latencies = check_latencies(latencies_ns)
    if margin is not None:
        epsilon_ns = margin.epsilon_ns
    if epsilon_ns < 0 or publish_slot_ns <= 0 or period_ns <= 0:
        raise InputError(
            "epsilon must be 0ms or more, the publish slot and the period longer than 0ms;"
            f" found {format_duration(epsilon_ns)}, {format_duration(publish_slot_ns)} and"
            f" {format_duration(period_ns)}"
        )
    if publication == "asynchronous" and output is not None and publisher is None:
        raise InputError(
            "asynchronous publication gates the publisher's own thread: name the node that"
            " publishes the chain's output"
        )
    chain_end = int(latencies.max()) + epsilon_ns
    slot_end = chain_end + publish_slot_ns
    _refuse_too_long(int(latencies.max()), epsilon_ns, publish_slot_ns, period_ns)
    output_core = core if output_core is None else output_core
    with wrong_values_refused():
        node = None
        if publication == "synchronous" and output is not None:
            node = ShapingNode(
                **_names(output),
                depth=depth,
                core=output_core,
                fifo_priority=fifo_priority,
                spin_ns=spin_ns,
                pause_ns=min(PAUSE_NS, period_ns // 20) if pause_ns is None else pause_ns,
                receivers=tuple(receivers),
            )
        publishing = [node.thread] if node is not None else []
        if publication == "asynchronous" and publisher is not None:
            publishing = [Thread(node=publisher, role="publisher")]
        return Plan(
            chain=ChainOfPlan(
                spec=spec,
                output=output,
                publisher=publisher,
                output_depth=output_depth,
                period_ns=period_ns,
            ),
            evidence=evidence_of(latencies, **conditions),
            margin=margin or Margin(epsilon_ns=epsilon_ns),
            policy="shaped",
            cycle_ns=period_ns,
            anchor=anchor,
            overrun=overrun,
            messages=messages,
            servers=(
                Server(
                    name="chain",
                    core=core,
                    priority=CHAIN_PRIORITY,
                    slots=((0, chain_end),),
                    threads=tuple(Thread(node=name) for name in nodes),
                ),
                Server(
                    name="output",
                    core=output_core,
                    priority=OUTPUT_PRIORITY,
                    slots=((chain_end, slot_end),),
                    threads=tuple(publishing),
                ),
            ),
            shaping_node=node,
            predicted=predict_bands(latencies, [slot_end], publish_slot_ns),
        )


def shaping_node_like(
    node: ShapingNode, output: str, publisher: str | None, receivers: Sequence[str] = ()
) -> ShapingNode:
    """A shaping node for another topic, with the core, priority and waiting of a given one."""
    others = {**_names(output), "publisher": publisher, "receivers": tuple(receivers)}
    return ShapingNode.model_validate({**node.model_dump(), **others})


def evidence_of(latencies_ns: NDArray[np.int64], **conditions: Any) -> Evidence:
    """The latencies' statistics, with the conditions they were taken under: Evidence's fields."""
    return Evidence(
        samples=int(latencies_ns.size),
        min_latency_ns=int(latencies_ns.min()),
        mean_latency_ns=round(int(latencies_ns.sum()) / latencies_ns.size),
        max_latency_ns=int(latencies_ns.max()),
        **conditions,
    )


def predict_bands(
    latencies_ns: NDArray[np.int64], slot_ends_ns: Sequence[int], publish_slot_ns: int
) -> Prediction:
    """What publication in given slots makes of measured latencies.

    Each band is represented by the end of its slot, x_α. An execution whose own latency is in
    (x_{α−1}, x_α] publishes in slot α, so with φ the measured distribution the average is
    Σ (φ(x_α) − φ(x_{α−1}))·x_α (eq. 5). The latest output is at x_ν, the earliest at the start
    of the first slot, x_1 − Δ, so the jitter is x_ν − (x_1 − Δ): 25 ms for the paper's slots
    [62, 63], [77, 78], [86, 87] ms.

    ``slot_ends_ns`` ascend and the last is not before the longest latency; Δ is
    ``publish_slot_ns``. All in nanoseconds.

    Raises:
        InputError: slot ends that break these rules.
    """
    ends = [int(end) for end in slot_ends_ns]
    if not ends or any(after <= before for before, after in pairwise(ends)):
        raise InputError(f"slot ends must ascend, at least one: found {ends}")
    longest = int(latencies_ns.max())
    if ends[-1] < longest:
        raise InputError(
            f"the last slot ends at {format_duration(ends[-1])}, before the longest latency,"
            f" {format_duration(longest)}: move it behind"
        )
    reached = np.searchsorted(np.sort(latencies_ns), ends, side="right")
    counts = [int(count) for count in np.diff(reached, prepend=0)]
    total = sum(counts)
    return Prediction(
        mean_ns=round(sum(count * end for count, end in zip(counts, ends, strict=True)) / total),
        max_ns=ends[-1],
        jitter_ns=ends[-1] - (ends[0] - publish_slot_ns),
        shares=tuple(count / total for count in counts),
    )


def plan_warnings(plan: Plan) -> list[str]:
    """What a person must know before relying on a plan; one sentence each, none if all is well."""
    evidence, cycle = plan.evidence, plan.cycle_ns
    warnings = _about_late_outputs(plan)
    if evidence.realtime is False:
        warnings.append(
            "the latencies were taken without real-time scheduling: other programs are in them,"
            " and the chain's slot is longer than it needs to be. Record again with the privilege"
            " to use SCHED_FIFO."
        )
    if evidence.lost_events:
        warnings.append(
            f"{evidence.lost_events} events were lost while recording: cycles are missing, and the"
            " longest latency may be among them. Record again, see the recording's notes."
        )
    if evidence.incomplete:
        warnings.append(
            f"{evidence.incomplete} executions of the chain have no end in the recording; their"
            " latencies, which may be the longest, are not in the plan."
        )
    if plan.margin.confidence_interval_ns is not None:
        low, high = map(format_duration, plan.margin.confidence_interval_ns)
        warnings.append(
            f"the margin {format_duration(plan.margin.epsilon_ns)} is an estimate; with 95 %"
            f" confidence it lies between {low} and {high}."
        )
    last = max((end for _, end in publish_slots(plan)), default=evidence.max_latency_ns)
    if NEARLY_FULL * cycle < last <= cycle:
        warnings.append(
            f"the plan fills {last / cycle:.1%} of the cycle {format_duration(cycle)}: an"
            " execution a little longer than any measured delays the next one."
        )
    if evidence.max_latency_ns >= cycle:
        warnings.append(
            f"the longest latency {format_duration(evidence.max_latency_ns)} is not shorter than"
            f" the cycle {format_duration(cycle)}: executions of the chain overlapped while they"
            " were measured, and response times have each other's interference in them."
        )
    elif evidence.max_latency_ns > NEARLY_FULL * cycle:
        warnings.append(
            "a cycle as long as the longest measured keeps its core busy for more than"
            f" {NEARLY_FULL:.0%}, where the kernel throttles real-time threads"
            " (/proc/sys/kernel/sched_rt_runtime_us)."
        )
    if evidence.utilisation is not None and evidence.utilisation > NEARLY_FULL:
        warnings.append(
            f"the chain's execution takes {evidence.utilisation:.1%} of its core: latencies"
            " will pile up from cycle to cycle, whatever the slots."
        )
    return [*warnings, *publication_warnings(plan)]


def _about_late_outputs(plan: Plan) -> list[str]:
    """How many outputs will be late, if the sample tells, and what the machine's stalls cost."""
    evidence, margin = plan.evidence, plan.margin
    cycles, needed = evidence.samples + evidence.disturbed, cycles_needed(OVERRUN_PROBABILITY)
    found = []
    if cycles < needed:
        found.append(
            f"the sample is small: {cycles} cycles are too few to say how late one output in a"
            f" hundred will be. Record {needed} cycles or more."
        )
    if evidence.disturbed:
        stall = evidence.longest_stall_ns
        what = "" if stall is None else f", longest stall {milliseconds(stall)} ms"
        found.append(f"the machine disturbed {evidence.disturbed} of {cycles} cycles{what}.")
    if margin.stalls_ns:
        end = evidence.max_latency_ns + margin.epsilon_ns
        found.append(
            f"covering the disturbed cycles costs {milliseconds(margin.stalls_ns)} ms: outputs"
            f" leave at {milliseconds(end)} ms; on a machine that does not stall it would be"
            f" {milliseconds(end - margin.stalls_ns)} ms (--ideal-machine)."
        )
    late = margin.overrun_probability or 0.0
    if cycles >= needed and late > OVERRUN_PROBABILITY and margin.source != "derived":
        found.append(
            f"by the latencies of all cycles, up to {late:.1%} of the outputs will miss their slot"
            f" ({plan.overrun}): a larger margin (--epsilon) or a calmer machine helps."
        )
    return found


def _names(output: str) -> dict[str, str]:
    # The chain publishes on a topic of its own, and the shaping node takes over the output's.
    return {
        "name": "chainshaper" + output.replace("/", "_"),
        "input": f"{output}_tmp",
        "output": output,
    }


def _refuse_too_long(longest: int, epsilon: int, publish_slot: int, period: int) -> None:
    missing = longest + epsilon + publish_slot - period
    if missing <= 0:
        return
    remedies = ["a longer period", "a shorter chain"]
    if longest + epsilon < period:
        remedies.insert(0, f"a publish slot of {format_duration(period - longest - epsilon)}")
    if longest + publish_slot <= period:
        remedies.insert(0, f"a margin of {format_duration(period - longest - publish_slot)}")
    if longest >= period:
        remedies.append("a pipeline over several cores (section 3.1 of the paper)")
    raise OperationError(
        f"the longest latency {format_duration(longest)}, the margin {format_duration(epsilon)} and"
        f" the publish slot {format_duration(publish_slot)} do not fit into the cycle of"
        f" {format_duration(period)}: {format_duration(missing)} too long. What helps:"
        f" {', or '.join(remedies)}."
    )
