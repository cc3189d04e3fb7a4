"""A real trace as other distributions would have recorded it: the figures must stay the same.

The traces with ground truth for chains are of Jazzy, whose events say exactly which message is
which. Without what older distributions lack, the same latencies have to come out.
"""

from typing import Any

import polars as pl
import pytest
from reference_traces import CHAINS, ReferenceTrace, reference_trace

from chainshaper.analysis import analyse_latency, data_flow
from chainshaper.values.events import EventTables

LATER = 10**12  # ns


def spans(trace: ReferenceTrace, tables: EventTables, chain: str) -> list[Any]:
    """Start and end of every complete traversal, in ns of the trace clock as in the truth."""
    found = analyse_latency(tables, chain, trace.clock_offset_ns).traversals.filter("complete")
    return [
        list(row) for row in found.select(pl.col("start", "end") + trace.clock_offset_ns).rows()
    ]


@pytest.mark.parametrize("earlier_ns", [50, -1000])
@pytest.mark.parametrize(("name", "chain"), CHAINS)
def test_as_humble_without_handles_and_timestamps(name: str, chain: str, earlier_ns: int) -> None:
    """Humble's `rmw_publish` comes just before the message gets its timestamp, by clocks whose
    distance is known to a microsecond or so.
    """
    trace = reference_trace(name)
    published = trace.tables["rmw_publish"]
    before = published["timestamp"] - trace.clock_offset_ns - earlier_ns
    humble = published.drop("timestamp", "rmw_publisher_handle").with_columns(time=before)
    found = spans(trace, {**trace.tables, "rmw_publish": humble.sort("time")}, chain)
    truth = trace.truth["chain"]["start_and_end_ns"]
    assert [start for start, _ in found] == [start for start, _ in truth]
    moved = dict(zip(published["time"] + trace.clock_offset_ns, published["time"] - before,
                     strict=True))  # fmt: skip
    assert [end for _, end in found] == [end - moved[end] for _, end in truth]


@pytest.mark.parametrize(("name", "chain"), CHAINS)
def test_as_caret_with_writes_stamps_and_dispatches(name: str, chain: str) -> None:
    trace = reference_trace(name)
    flow = data_flow(trace.tables, trace.clock_offset_ns)
    published = trace.tables["rmw_publish"]
    started = trace.tables["callback_start"].select("pid", "tid", "callback", start="time")
    dispatched = (
        flow.takes.drop_nulls("instance")
        .join(flow.instances.select("instance", "start"), on="instance")
        .join(started, on=["pid", "tid", "start"])
        .select(pl.col("start").alias("time") - 1, "pid", "tid", "callback",
                message=pl.lit(1, pl.UInt64), source_stamp="source_timestamp")
        .sort("time")
    )  # fmt: skip
    thread = ["pid", "tid", "cpu"]
    tables = {
        event: table
        for event, table in trace.tables.items()
        if event not in {"rmw_publish", "rmw_take", "rcl_take", "rclcpp_take"}
    } | {
        "dds_write": published.select("time", *thread, "message"),
        "dds_bind_addr_to_stamp": published.select(
            pl.col("time") + 1, *thread, addr="message", source_stamp="timestamp"
        ),
        "dispatch_subscription_callback": dispatched,
    }
    assert spans(trace, tables, chain) == trace.truth["chain"]["start_and_end_ns"]


@pytest.mark.parametrize(("name", "chain"), CHAINS)
def test_started_again_under_the_same_numbers(name: str, chain: str) -> None:
    """The application runs a second time, with all its process numbers and addresses."""
    trace = reference_trace(name)
    times = ("time", "timestamp", "source_timestamp")
    tables = {
        event: pl.concat([
            table,
            table.with_columns(pl.col(c) + LATER for c in times if c in table.columns),
        ])
        for event, table in trace.tables.items()
    }  # fmt: skip
    truth = trace.truth["chain"]["start_and_end_ns"]
    again = [[start + LATER, end + LATER] for start, end in truth]
    assert spans(trace, tables, chain) == [*truth, *again]
