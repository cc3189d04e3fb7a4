"""Measured times instead of described ones: what a recording says about an application.

Execution times are the CPU times of each callback's instances in the order in which they happened,
so that stretches of them keep their correlation in time; callbacks that all ran once a cycle have
as many, so that their stretches are of the same cycles. What publishing costs is not in them: a
callback computes before it publishes.
"""

from collections.abc import Mapping
from pathlib import Path

import polars as pl

from chainshaper.analysis import data_flow
from chainshaper.analysis.flow import DataFlow
from chainshaper.sources import open_source
from chainshaper.values.errors import InputError
from chainshaper.values.recording import Recording
from chainshaper.workload.description import Application, ExecutionTime
from chainshaper.workload.live import node_name

MOST = 100_000
"""Enough samples for any distribution."""


def with_recorded_times(
    application: Application, recording: Recording | str | Path, *, block: int = 1
) -> Application:
    """The application with execution times drawn from a recording of it, in stretches of ``block``.

    Gates keep what they have: they compute nothing.

    Raises InputError: a callback of the application is not in the recording, or its CPU time is
    not.
    """
    recording = recording if isinstance(recording, Recording) else open_source(recording)
    times = _computing_times(data_flow(recording.events, recording.info.clock_offset_ns))
    nodes = {}
    for name, node in application.nodes.items():
        callbacks = []
        for callback in node.callbacks:
            if callback.gate is not None:
                callbacks.append(callback)
                continue
            trigger = callback.timer_ns or callback.subscription or callback.synchronises[-1]
            if (node_name(name), trigger) not in times:
                raise InputError(
                    f"{recording.path} has no CPU times of {node_name(name)}'s callback"
                    f" {callback.subscription or callback.synchronises or 'of its timer'}: record"
                    " the application that is described, with its threads' CPU times or"
                    " sched_switch"
                )
            drawn = samples(times[node_name(name), trigger]).model_copy(update={"block": block})
            callbacks.append(callback.model_copy(update={"execution": drawn, "computes": None}))
        nodes[name] = node.model_copy(update={"callbacks": tuple(callbacks)})
    return application.model_copy(update={"nodes": nodes})


def _computing_times(flow: DataFlow) -> Mapping[tuple[str, str | int], pl.Series]:
    """CPU times up to the first publication, by node and topic or period, in order of start."""
    published = flow.publications.group_by("instance").agg(first=pl.col("time").min())
    frame = (
        flow.instances.join(published, on="instance", how="left", maintain_order="left")
        .join(
            flow.objects.callbacks.select("callback_id", "node", "topic", "period_ns").unique(
                "callback_id"
            ),
            on="callback_id",
        )
        .with_columns(used=pl.col("execution_ns") - (pl.col("end") - pl.col("first")).fill_null(0))
        .drop_nulls("used")
        .sort("start")
    )
    found: dict[tuple[str, str | int], pl.Series] = {}
    for (node, topic, period), group in frame.group_by("node", "topic", "period_ns"):
        found[str(node), int(period) if period is not None else str(topic)] = group["used"]
    return found


def samples(values: pl.Series) -> ExecutionTime:
    """Times that are drawn as they were measured (ns)."""
    return ExecutionTime(samples_ns=tuple(values.drop_nulls().clip(0).head(MOST).to_list()))
