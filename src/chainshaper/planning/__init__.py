"""From measured latencies to servers and slots: dimensioning, prediction, the plan file.

Everything starts with :func:`plan_shaping`; each further step takes a plan and returns a plan.
:func:`plan_chain` takes all of them that a :class:`PlanRequest` asks for.
"""

from chainshaper.planning.bands import BandChoice, choose_bands, with_bands, with_long_slot
from chainshaper.planning.margins import read_latencies
from chainshaper.planning.offsets import place_chains
from chainshaper.planning.overruns import plan_warnings
from chainshaper.planning.plan import (
    Margin,
    Modes,
    Plan,
    Prediction,
    Server,
    ShapingNode,
    Slot,
    Thread,
    band_predictions,
    dump_plan,
    load_plan,
    plan_json,
    publish_slots,
    save_plan,
    save_plans,
    server_of,
)
from chainshaper.planning.request import PlanRequest, Profile, band_choice, plan_chain, plan_chains
from chainshaper.planning.shaping import (
    CallbackTimes,
    let_per_callback,
    let_per_chain,
    over_cores,
    plan_shaping,
    server_per_callback,
    server_per_chain,
    with_first_node_apart,
    with_sink,
)

__all__ = [
    "BandChoice",
    "CallbackTimes",
    "Margin",
    "Modes",
    "Plan",
    "PlanRequest",
    "Prediction",
    "Profile",
    "Server",
    "ShapingNode",
    "Slot",
    "Thread",
    "band_choice",
    "band_predictions",
    "choose_bands",
    "dump_plan",
    "let_per_callback",
    "let_per_chain",
    "load_plan",
    "over_cores",
    "place_chains",
    "plan_chain",
    "plan_chains",
    "plan_json",
    "plan_shaping",
    "plan_warnings",
    "publish_slots",
    "read_latencies",
    "save_plan",
    "save_plans",
    "server_of",
    "server_per_callback",
    "server_per_chain",
    "with_bands",
    "with_first_node_apart",
    "with_long_slot",
    "with_sink",
]
