"""From measured latencies to servers and slots: dimensioning, prediction, the plan file."""

from chainshaper.planning.latency_file import check_latencies, read_latencies
from chainshaper.planning.plan import (
    ChainOfPlan,
    Evidence,
    Margin,
    Plan,
    Prediction,
    Server,
    ShapingNode,
    Slot,
    Thread,
    publish_slots,
    server_of,
)
from chainshaper.planning.plan_file import dump_plan, load_plan, plan_json, save_plan
from chainshaper.planning.shaping import plan_shaping, plan_warnings, predict_bands

__all__ = [
    "ChainOfPlan",
    "Evidence",
    "Margin",
    "Plan",
    "Prediction",
    "Server",
    "ShapingNode",
    "Slot",
    "Thread",
    "check_latencies",
    "dump_plan",
    "load_plan",
    "plan_json",
    "plan_shaping",
    "plan_warnings",
    "predict_bands",
    "publish_slots",
    "read_latencies",
    "save_plan",
    "server_of",
]
