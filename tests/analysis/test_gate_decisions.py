"""Decisions of gates, with and without the handle of the gate's callback."""

import polars as pl

from chainshaper import analyse_latency
from chainshaper.analysis import data_flow
from chainshaper.analysis.messages import gate_decisions
from chainshaper.values.recording import Recording


def test_a_shaping_node_that_knows_no_handles_is_told_by_its_process(shaped: Recording) -> None:
    """What a node in ROS 2 notes of itself: the same rows, but for the handle."""
    releases = shaped.events["gate_release"]
    nameless = releases.with_columns(callback=pl.lit(None, dtype=releases.schema["callback"]))
    without = {**shaped.events, "gate_release": nameless}

    flow = data_flow(shaped.events, shaped.info.clock_offset_ns)
    one, other = (gate_decisions(tables, flow.objects) for tables in (shaped.events, without))
    assert one.height == releases.height > 0
    assert one.drop("callback").equals(other.drop("callback"))

    known = analyse_latency(shaped.events, "/t1../t3", clock_offset_ns=shaped.info.clock_offset_ns)
    found = analyse_latency(without, "/t1../t3", clock_offset_ns=shaped.info.clock_offset_ns)
    assert known.traversals.equals(found.traversals)
