"""`apply` with the back end scx: the node `sensor` in [0, END) of every CYCLE.

    apply_process.py CYCLE END FOLLOWS

Says `in force`, and after SIGTERM what was done. Unless it FOLLOWS (0 or 1), it never looks where
the timer is.
"""

import os
import signal
import sys
import threading

sys.path.insert(0, "/src")
from chainshaper.enforcement.undoing import RunState
from chainshaper.flow.apply import apply_plan
from chainshaper.flow.phase import DriftWatch
from chainshaper.planning import plan as of

cycle, end, follows = map(int, sys.argv[1:])
sensor = of.Server(
    name="sensor", core=0, priority=1, slots=((0, end),), threads=(of.Thread(node="/sensor"),)
)
plan = of.Plan(
    chain=of.ChainOfPlan(spec="sensor", period_ns=cycle),
    evidence=of.Evidence(samples=1, min_latency_ns=1, mean_latency_ns=1, max_latency_ns=end),
    margin=of.Margin(epsilon_ns=0),
    policy="server-per-chain",  # whose server is closed outside its slots
    cycle_ns=cycle,
    servers=(sensor,),
    predicted=of.Prediction(mean_ns=1, max_ns=1, jitter_ns=0),
)
stop, anchors = threading.Event(), set[int | None]()
signal.signal(signal.SIGTERM, lambda *_: stop.set())
if not follows:
    DriftWatch.EVERY_S = 1e6


def watch(state: RunState) -> None:
    if not anchors:
        os.write(1, b"in force\n")
    anchors.add(state.anchor_ns)


state = apply_plan(plan, back_end="scx", stop=stop, watch=watch).state
moved = f"{len(anchors) - 1} moves, {state.drift_ns or 0} ns in all"
os.write(1, f"{moved}, {state.servers[0].counters}\n".encode())
