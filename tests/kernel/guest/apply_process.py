"""`apply` with the back end scx: the node `sensor` in [0, END) of every CYCLE, alone or not.

    apply_process.py CYCLE END FOLLOWS [SLOT_ENDS]

Says `in force`, and after SIGTERM what was done. Unless it FOLLOWS (0 or 1), it never looks where
the timer is. With SLOT_ENDS (`closed` or `open-until-done`) cycles begin :data:`.LEAD_NS` behind
multiples of CYCLE, and a second node, `worker`, has the server [END, 2 * END).
"""

import os
import signal
import sys
import threading
from typing import Any

sys.path.insert(0, "/src")
from chainshaper.enforcement.undoing import RunState
from chainshaper.flow.apply import apply_plan
from chainshaper.flow.phase import DriftWatch
from chainshaper.planning import Plan
from chainshaper.planning import chain_plan as of

cycle, end, follows = map(int, sys.argv[1:4])
nodes = ["sensor"]
how: dict[str, Any] = {"policy": "server-per-chain"}  # closed outside its slots
if slot_ends := sys.argv[4:]:
    nodes = ["sensor", "worker"]
    how = {"policy": "server-per-callback", "slot_ends": slot_ends[0]}
servers = [
    of.Server(
        name=node,
        core=0,
        priority=1,
        slots=((place * end, (place + 1) * end),),
        threads=(of.Thread(node=f"/{node}"),),
    )
    for place, node in enumerate(nodes)
]
plan = of.ChainPlan(
    chain=of.ChainOfPlan(spec="sensor", period_ns=cycle),
    evidence=of.Evidence(samples=1, min_latency_ns=1, mean_latency_ns=1, max_latency_ns=end),
    margin=of.Margin(epsilon_ns=0),
    cycle_ns=cycle,
    servers=tuple(servers),
    predicted=of.Prediction(mean_ns=1, max_ns=1, jitter_ns=0),
    **how,
)
stop, anchors = threading.Event(), set[int | None]()
signal.signal(signal.SIGTERM, lambda *_: stop.set())
if not follows:
    DriftWatch.EVERY_S = 1e6


def watch(state: RunState) -> None:
    if not anchors:
        os.write(1, b"in force\n")
    anchors.add(state.anchor_ns)


phase_ns = 0 if slot_ends else None
state = apply_plan(Plan.of(plan), back_end="scx", phase_ns=phase_ns, stop=stop, watch=watch).state
moved = f"{len(anchors) - 1} moves, {state.drift_ns or 0} ns in all"
os.write(1, f"{moved}, {state.servers[0].counters}\n".encode())
