"""A shaped run of three nodes that is written, not recorded: every figure is known by hand.

/first runs every 100 ms from 1 ms on and publishes /t1 after 4 ms; /second starts 1 ms later and
publishes after 10 ms more; what it publishes arrives at the shaping node 1 ms later, 16 ms after
the cycle's start, and is let go 20 µs after the publish slot [30 ms, 31 ms) opens. So every latency
is 30.02 ms, and the actuator starts 1 ms after that. Core 1 stalls for 2 ms in cycle 1, while
/second computes, which the margin of 3 ms absorbs.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from story import OFFSET, Story

from chainshaper.planning import ChainPlan, plan_shaping
from chainshaper.values.recording import (
    Recording,
    RecordingInfo,
    StallMeterInfo,
    ThreadInfo,
    write_recording,
)

MS = 1_000_000
PERIOD_NS = 100 * MS
LATENCY_NS = 30 * MS + 20_000


def known_plan(**changes: Any) -> ChainPlan:
    """Single-band shaping for latencies up to 27 ms: publish slot [30 ms, 31 ms)."""
    return plan_shaping(
        np.array([15, 27]) * MS,
        PERIOD_NS,
        epsilon_ns=3 * MS,
        spec="/t1../t2",
        output="/t2",
        publisher="/second",
        nodes=("/first", "/second"),
        core=1,
        **changes,
    )


def known_run(
    folder: Path,
    cycles: int = 3,
    *,
    first: str = "/first",
    untaken: tuple[int, ...] = (),
    overran: tuple[int, ...] = (),
    beside: Sequence[str] = (),
    **facts: Any,
) -> Recording:
    """The recording; messages on /t1 of the cycles ``untaken`` are not taken.

    Outputs of ``overran`` arrive at the shaping node 1 ms behind the slot, and leave at once.
    Nodes ``beside`` the chain do nothing. ``facts`` are further fields of `recording.json`.
    """
    plan = known_plan()
    assert plan.shaping_node is not None
    story = Story()
    gate = f"/{plan.shaping_node.name}"
    nodes = [story.node(name, pid) for pid, name in ((1, first), (2, "/second"), (3, gate))]
    actuator = story.subscription(story.node("/actuator", 4), "/t2")
    for number, name in enumerate(beside):
        story.node(name, 100 + number)
    timer = story.timer(nodes[0], period=PERIOD_NS, symbol="First<1>::tick()")
    second = story.subscription(nodes[1], "/t1")
    shaping = story.subscription(nodes[2], plan.shaping_node.input)
    to_second = story.publisher(nodes[0], "/t1")
    to_shaping = story.publisher(nodes[1], plan.shaping_node.input)
    output = story.publisher(nodes[2], "/t2")
    for cycle in range(cycles):
        start = cycle * PERIOD_NS + MS
        sent = start + 4 * MS
        story.runs(timer, start, sent + 1000, writes=((to_second, sent),))
        if cycle in untaken:
            continue
        passed = sent + (26 if cycle in overran else 11) * MS
        arrival = passed + MS
        story.runs(second, sent + MS, passed + 1000, reads=sent, writes=((to_shaping, passed),))
        out = arrival if cycle in overran else start + LATENCY_NS
        story.runs(shaping, arrival, out + 1000, reads=passed, writes=((output, out),))
        story.event(
            "gate_release",
            out,
            3,
            callback=shaping.handle,
            source_timestamp=passed + OFFSET,
            arrival=arrival,
            origin=start,
            release=arrival if cycle in overran else start + 30 * MS,
            slot=None if cycle in overran else 0,
            cycles_waited=0,
            anchor="stamp",
            overrun="publish" if cycle in overran else None,
        )
        story.runs(actuator, out + MS, out + 2 * MS, reads=out)
    story.event("machine_stall", PERIOD_NS + 7 * MS, 9, cpu=1, duration=2 * MS)
    thread = {"tid": 2, "pid": 2, "comm": "second", "node": "/second", "role": "executor"}
    scheduling = {"policy": "SCHED_FIFO", "priority": 80, "cores": (1,)}
    stall_meter = StallMeterInfo(
        cores=(0, 1), period_ns=MS, threshold_ns=100_000, wakeups=600,
        median_lateness_ns=(20_000, 30_000), realtime=True,
    )  # fmt: skip
    known = {
        "source": "live",
        "host": "robot",
        "clock_offset_ns": OFFSET,
        "chain": "/t1../t2",
        "plan": plan.model_dump(mode="json"),
        "threads": (ThreadInfo.model_validate(thread | scheduling),),
        "stall_meter": stall_meter,
    }
    info = RecordingInfo.model_validate(known | facts)
    return write_recording(folder, story.tables(), info)
