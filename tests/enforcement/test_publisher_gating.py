"""The thread of an asynchronous publisher held back until its slot, beside threads that run on."""

from pathlib import Path

import numpy as np
import polars as pl
import pytest
from applied_plans import leftovers, needs_fifo
from gated import needs_cgroups
from small_chain import PERIOD_NS, small_chain

from chainshaper import measure_latency, shape_application
from chainshaper.errors import OperationError
from chainshaper.planning import Plan, plan_shaping
from chainshaper.planning.publisher_threads import publisher_servers
from chainshaper.workload.description import Application, CallbackDescription

MS = 1_000_000
SLOT_NS = 10 * MS


def _plan(publisher: str = "/third") -> Plan:
    return plan_shaping(
        np.array([5, 19]) * MS,
        PERIOD_NS,
        spec="/t1../t3",
        output="/t3",
        publisher=publisher,
        nodes=("/first", "/second", publisher),
        publication="asynchronous",
        publish_slot_ns=SLOT_NS,
    )


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
    recording = shape_application(application, plan, tmp_path / "rec", cycles=60)

    measured = measure_latency(recording)
    undisturbed = measured.analysis.traversals.filter(~pl.col("disturbed"))
    in_slot = undisturbed["latency_ns"].is_between(*server.slots[0])
    assert undisturbed.height > 20
    assert in_slot.mean() > 0.9  # type: ignore[operator]  # one of the first may be early

    # The executor of the same process ran while its publisher was held back.
    starts = recording.events["callback_start"]
    origin = measured.analysis.traversals["start"].to_numpy()
    outside = 0
    for at in starts["time"].to_numpy():
        phase = (at - origin[0]) % PERIOD_NS
        outside += not server.slots[0][0] <= phase < server.slots[0][1]
    assert outside > starts.height / 2
    assert not leftovers()


@needs_fifo
@needs_cgroups
def test_a_publisher_that_publishes_in_its_executors_thread_is_named(tmp_path: Path) -> None:
    with pytest.raises(OperationError, match="/first has no thread that publishes for it"):
        shape_application(
            small_chain(tmp_path, publication="asynchronous"), _plan("/first"), tmp_path / "rec"
        )
    assert not leftovers()
