"""Small applications whose schedules are worked out by hand, and what the simulator makes of them.

Nothing costs anything unless a test says so, and times are milliseconds after the first recorded
expiry of the chain's timer.
"""

from itertools import pairwise
from pathlib import Path
from typing import Any

import polars as pl
import yaml

from chainshaper.analysis import data_flow
from chainshaper.planning import ChainPlan, Plan
from chainshaper.simulation import simulate
from chainshaper.simulation.simulating import START_NS
from chainshaper.values.durations import parse_duration
from chainshaper.values.recording import Recording
from chainshaper.values.yaml_file import AS_YAML
from chainshaper.workload.description import Application
from chainshaper.workload.timing import WARM_UP_CYCLES

FREE: dict[str, Any] = {
    **{name: {"constant": "0ms"} for name in ("wake_up", "take", "publish", "delivery")},
    "interrupts": 0.0,
}
MS = 1_000_000


def application(text: str, **simulation: Any) -> Application:
    """An application from YAML, on cores 1 (executors, priority 80) and 0 (DDS, 90)."""
    described = {
        "name": "by hand",
        "scheduling": {
            "executors": {"core": 1, "priority": 80},
            "dds": {"core": 0, "priority": 90},
        },
        "simulation": {**FREE, **simulation},
        **yaml.safe_load(text),
    }
    return Application.model_validate(_tuples(described), context=AS_YAML)


def _tuples(value: Any) -> Any:
    """YAML's lists as the models want them."""
    if isinstance(value, dict):
        return {key: _tuples(item) for key, item in value.items()}
    return tuple(_tuples(item) for item in value) if isinstance(value, list) else value


def simulated(
    folder: Path, described: Application, plan: ChainPlan | None = None, cycles: int = 1
) -> Recording:
    """A recording of a few cycles, with what ran where."""
    return simulate(
        described,
        folder / "recording",
        Plan.of(plan) if plan else None,
        cycles=cycles,
        switches=True,
    )


def begin_of(recording: Recording) -> int:
    """The first recorded expiry of the chain's timer (its phase is 0 in these tests)."""
    application_written = recording.info.application or {}
    period = min(
        callback["timer"]
        for node in application_written["nodes"].values()
        for callback in node["callbacks"]
        if "timer" in callback and not callback.get("phase")
    )
    return START_NS + WARM_UP_CYCLES * parse_duration(period)


def callbacks(recording: Recording) -> list[tuple[str, float, float]]:
    """Callback instances as (node, start, end), in order of start."""
    flow = data_flow(recording.events)
    named = flow.instances.join(
        flow.objects.callbacks.select("callback_id", "node").unique(), on="callback_id"
    ).sort("start", "instance")
    begin = begin_of(recording)
    return [
        (node.strip("/"), (start - begin) / MS, (end - begin) / MS)
        for node, start, end in named.select("node", "start", "end").iter_rows()
    ]


def ran(recording: Recording, core: int = 1) -> list[tuple[str, float, float]]:
    """What ran on a core, as (thread, from, to); idle time is left out."""
    begin = begin_of(recording)
    table = recording.events["sched_switch"].filter(pl.col("cpu") == core)
    rows = table.select("time", "next_comm").rows()
    return [
        (name, (start - begin) / MS, (end - begin) / MS)
        for (start, name), (end, _) in pairwise(rows)
        if end > start and name != "swapper"
    ]
