"""What a machine takes besides computing, for a simulation: measured in a recording made on it."""

from collections.abc import Collection
from pathlib import Path

import polars as pl

from chainshaper import open_source
from chainshaper.analysis import DataFlow, data_flow
from chainshaper.analysis.disturbance import stalled_after
from chainshaper.simulation.simulating import samples
from chainshaper.values import events
from chainshaper.values.errors import InputError
from chainshaper.values.recording import Recording
from chainshaper.workload.description import ExecutionTime, SimulationDescription

DELIVERY_NS = 30_000
"""A message is taken to be under way for so long where no message shows it."""

COMPUTES_NS = 1_000_000
"""A callback that computes for less is over before an interrupt says much."""

FAR = 10
"""What took so many times the median waited for something else."""


def measured_costs(
    recording: Recording | str | Path, but_for: Collection[str] = ()
) -> SimulationDescription:
    """What a machine takes besides computing, from a recording of a live run on it.

    Only executors that nothing of the application out-ranks on their core count, ``but_for`` these
    nodes, such as shaping nodes, which rest while the chain runs: others wait for more, such as the
    DDS threads that receive a large message there. Publishing lasts from a
    callback's last publication to its end; taking from the executor's choice to the callback's
    start. A message that came while the core was busy was there by the time that it was free, and
    from then to the choice the executor woke up; one that found it idle was on its way before that.
    What executors were kept from while they computed, interrupts took.

    Raises InputError: no message of the recording was taken by such an executor that waited for it.
    """
    recording = recording if isinstance(recording, Recording) else open_source(recording)
    flow = data_flow(recording.events, recording.info.clock_offset_ns)
    core = pl.col("tid").replace_strict(_first_executors(recording, but_for), default=None)
    instances = flow.instances.with_columns(core=core).drop_nulls(["core", "end"])
    read = _read(recording, flow, instances)
    waited = read.filter(pl.col("before").fill_null(0) <= pl.col("sent"))
    if not waited.height:
        raise InputError(
            f"{recording.path}: no executor waited for a message in it, so nothing says what "
            "waking up costs: record an application whose callbacks are connected by topics"
        )
    was_busy = waited["freed"].fill_null(0) > waited["sent"]
    woken = _ordinary((waited["chosen"] - waited["freed"]).filter(was_busy))
    came = (waited["chosen"] - waited["sent"]).filter(~was_busy)
    if not woken.len():  # nothing tells waking up and delivery apart
        woken, came = _ordinary(came - DELIVERY_NS), came.clear()
    delivery = _ordinary(came) - round(float(woken.median()))  # type: ignore[arg-type]
    last = flow.publications.group_by("instance").agg(pl.col("sent").max(), pl.len())
    published = _calm(flow, instances.join(last.drop_nulls(), on="instance"), "sent", "end")
    return SimulationDescription(
        wake_up=samples(woken),
        take=samples(_ordinary(read["start"] - read["chosen"])),
        publish=samples(_ordinary((published["end"] - published["sent"]) // published["len"])),
        delivery=samples(delivery) if came.len() else ExecutionTime(constant_ns=DELIVERY_NS),
        interrupts=_share_taken(instances),
    )


def _first_executors(recording: Recording, but_for: Collection[str]) -> dict[int, int]:
    """The core of each executor that no thread of the application out-ranks there."""
    threads = [
        thread
        for thread in recording.info.threads
        if thread.role != "stall-meter" and thread.node not in but_for
    ]
    return {
        one.tid: one.cores[0]
        for one in threads
        if one.role == "executor" and len(one.cores) == 1
        if not any(
            one.cores[0] in other.cores and other.priority > one.priority for other in threads
        )
    }


def _read(recording: Recording, flow: DataFlow, instances: pl.DataFrame) -> pl.DataFrame:
    """The messages that these instances got, but for those that a stall of the machine hit.

    When each was ``sent``, when the executor had ended its instance ``before`` and its core was
    ``freed`` by whichever executor, when the message was ``chosen`` and its callback's ``start``.
    """
    chosen = events.table(recording.events, "rclcpp_executor_get_next_ready")
    read = (
        flow.takes.select("publication", "instance")
        .drop_nulls()
        .join(flow.publications.select("publication", "sent"), on="publication")
        .join(instances.select("instance", "tid", "core", "start"), on="instance")
    )
    for by, name, earlier, later in (
        ("tid", "chosen", chosen.rename({"time": "chosen"}), "start"),
        ("tid", "before", instances.rename({"end": "before"}), "chosen"),
        ("core", "freed", instances.rename({"end": "freed"}), "chosen"),
    ):
        read = read.sort(later).join_asof(
            earlier.select(by, name).sort(name),
            left_on=later,
            right_on=name,
            by=by,
            check_sortedness=False,
        )
    return _calm(flow, read, "sent", "start")


def _calm(flow: DataFlow, frame: pl.DataFrame, start: str, end: str) -> pl.DataFrame:
    """The rows in whose window no stall of the machine was: the others do not show its costs."""
    hit = stalled_after(flow, frame[start].to_numpy(), frame[end].to_numpy())
    return frame.filter(~pl.Series(hit))


def _share_taken(instances: pl.DataFrame) -> float:
    """For which share of their response times instances did not run: median, or the default."""
    computed = instances.filter(pl.col("execution_ns") > COMPUTES_NS)
    median = (1 - computed["execution_ns"] / (computed["end"] - computed["start"])).median()
    if not isinstance(median, float):
        return SimulationDescription().interrupts
    return min(0.5, max(0.0, median))


def _ordinary(costs: pl.Series) -> pl.Series:
    """What costs took, but for those that took so long that they waited for something else.

    In ascending order: rows of joins come in any, and simulations are to draw the same again.
    """
    costs, median = costs.sort(), costs.median()
    return costs.filter(costs <= FAR * median) if isinstance(median, float) else costs
