"""The thread of an asynchronous publisher held back until its slot, beside threads that run on."""

from pathlib import Path

import polars as pl
from applied_plans import leftovers, needs_fifo
from calm_runs import calm_run
from gated import needs_cgroups
from small_chain import PERIOD_NS, small_chain, small_chain_plan

from chainshaper import measure_latency, shape_application
from chainshaper.planning import Plan
from chainshaper.planning.plan import publisher_servers
from chainshaper.workload.description import Application, CallbackDescription

MS = 1_000_000
SLOT_NS = 10 * MS


def _plan() -> Plan:
    return small_chain_plan(5 * MS, 19 * MS, publication="asynchronous", publish_slot_ns=SLOT_NS)


def _burning_meanwhile(application: Application) -> Application:
    """The chain's last node has a timer of its own, whose callback needs the executor's thread."""
    third = application.nodes["third"]
    timer = CallbackDescription.model_validate({"timer": "5ms", "execution": {"constant": "500us"}})
    busy = third.model_copy(update={"callbacks": (*third.callbacks, timer)})
    return application.model_copy(update={"nodes": {**application.nodes, "third": busy}})


@needs_fifo
@needs_cgroups
def test_the_publisher_waits_for_its_slot_and_its_executor_does_not(tmp_path: Path) -> None:
    application = _burning_meanwhile(small_chain(tmp_path, publication="asynchronous"))
    plan = _plan()
    ((_, server, _),) = publisher_servers(plan)
    recording = calm_run(
        lambda place: shape_application(application, plan, place / "rec", cycles=26), tmp_path
    )

    measured = measure_latency(recording)
    assert measured.analysis.incomplete == {}, "nothing is lost"
    undisturbed = measured.analysis.traversals.filter(~pl.col("disturbed"))
    # Latency counts from the first callback, which starts a little after its cycle does.
    start, end = server.slots[0]
    in_slot = undisturbed.filter(pl.col("latency_ns").is_between(start - MS, end))
    assert undisturbed.height > 10
    assert in_slot.height > 0.9 * undisturbed.height

    # The executor of the same process ran while its publisher was held back.
    starts = recording.events["callback_start"]
    phase = (starts["time"] - measured.analysis.traversals["start"][0]) % PERIOD_NS
    assert (~phase.is_between(start, end)).sum() > starts.height / 2
    assert not leftovers()
