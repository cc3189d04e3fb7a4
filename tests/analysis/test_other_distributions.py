"""A real trace as other distributions would have recorded it: the figures must stay the same.

The traces with ground truth for chains are of Jazzy, whose events say exactly which message is
which. Without what older distributions lack, the same latencies have to come out.
"""

from typing import Any

import polars as pl
import pytest
from reference_traces import CHAINS, ReferenceTrace, reference_trace

from chainshaper.analysis import analyse_latency
from chainshaper.values.events import EventTables

LATER = 10**12  # ns


def spans(trace: ReferenceTrace, tables: EventTables, chain: str) -> list[Any]:
    """Start and end of every complete traversal, in ns of the trace clock as in the truth."""
    found = analyse_latency(tables, chain, trace.clock_offset_ns).traversals.filter("complete")
    times = found.select(pl.col("start", "end") + trace.clock_offset_ns)
    return [list(row) for row in times.rows()]


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
