"""`apply` at work with the back end scx: the node `sensor` in [0, END) of every cycle.

    apply_process.py CYCLE END FOLLOWS

Says `in force`, and on SIGTERM how often slots were moved and what the server has counted. Unless
it FOLLOWS (0 or 1), it never looks where the timer is.
"""

import os
import signal
import sys
import threading

sys.path.insert(0, "/src")
from chainshaper.enforcement.undoing import RunState
from chainshaper.flow.apply import apply_plan
from chainshaper.flow.phase import DriftWatch
from chainshaper.planning.plan import (
    ChainOfPlan,
    Evidence,
    Margin,
    Plan,
    Prediction,
    Server,
    Thread,
)

cycle, end, follows = map(int, sys.argv[1:])
plan = Plan(
    chain=ChainOfPlan(spec="sensor", period_ns=cycle),
    evidence=Evidence(samples=1, min_latency_ns=1, mean_latency_ns=1, max_latency_ns=end),
    margin=Margin(epsilon_ns=0),
    policy="server-per-callback",
    cycle_ns=cycle,
    servers=(
        Server(
            name="sensor", core=0, priority=1, slots=((0, end),), threads=(Thread(node="/sensor"),)
        ),
    ),
    predicted=Prediction(mean_ns=1, max_ns=1, jitter_ns=0),
)
stop, anchors = threading.Event(), dict[int, None]()
signal.signal(signal.SIGTERM, lambda *_: stop.set())
if not follows:
    DriftWatch.EVERY_S = 1e6


def watch(state: RunState) -> None:
    if not anchors:
        os.write(1, b"in force\n")
    anchors[state.anchor_ns or 0] = None


state = apply_plan(plan, back_end="scx", stop=stop, watch=watch).state
moved = f"{len(anchors) - 1} moves, {state.drift_ns or 0} ns in all"
os.write(1, f"{moved}, {state.servers[0].counters}\n".encode())
