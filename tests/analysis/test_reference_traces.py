"""Real traces of ROS 2 applications, against ground truth computed independently."""

import polars as pl
import pytest
from reference_traces import TRACES, reference_trace

from chainshaper.analysis import analyse_latency, application_graph, data_flow
from chainshaper.analysis.matching import first_after


@pytest.mark.parametrize("name", TRACES)
def test_publications_and_their_takes(name: str) -> None:
    trace = reference_trace(name)
    flow = data_flow(trace.tables, trace.clock_offset_ns)
    read = flow.takes.drop_nulls("publication").select("publication").unique()
    counted = {
        topic: [published.height, published.join(read, on="publication", how="semi").height]
        for topic in trace.truth["published_and_taken"]
        for published in [flow.publications.filter(topic=topic).drop_nulls("source_timestamp")]
    }
    assert counted == trace.truth["published_and_taken"]


def test_a_synchroniser_that_holds_messages_back_is_noticed() -> None:
    trace = reference_trace("jazzy_avp_cyclonedds")
    found = analyse_latency(trace.tables, "/lidar_rear/points_raw../localization/ndt_pose")
    assert any("lower bounds" in note for note in found.notes)


def test_humble_takes_are_linked_to_what_dds_says_it_wrote() -> None:
    # This trace also has DDS's own write events, which carry the source timestamp: the first on
    # a publication's thread is its own. They are not used by the analysis. 40 messages of /topic_b
    # were taken whose publication is not in the trace: its process's events end 200 ms early.
    trace = reference_trace("humble_sync")
    flow = data_flow(trace.tables, trace.clock_offset_ns)
    writes = pl.DataFrame(trace.others["dds:write"]).select(
        pl.col("tid").cast(pl.Int32), "timestamp", written="time"
    )
    stamped = first_after(flow.publications, writes, ["tid"], "time", "written")
    stamped = stamped.select("publication", "timestamp")
    linked = flow.takes.drop_nulls("publication").join(stamped, on="publication", how="left")
    assert linked.height == 3994
    assert (linked["timestamp"] == linked["source_timestamp"]).all()
    unknown = flow.takes.filter(pl.col("publication").is_null())
    assert unknown["topic"].cast(pl.String).to_list() == ["/topic_b"] * 40
    found = analyse_latency(trace.tables, "/topic_a../topic_b", trace.clock_offset_ns)
    assert found.statistics.count == 1986
    assert found.incomplete == {"lost": 5, "not taken": 40}


def test_caret_traces_have_chains_through_stored_messages() -> None:
    trace = reference_trace("galactic_caret_end_to_end")
    graph = application_graph(trace.tables)
    timer_driven = next(c for c in graph.callbacks if c.topic == "/topic3")
    assert timer_driven.passes_on == ("/topic4",)
    found = analyse_latency(trace.tables, "/topic1../actuator_dummy_node")
    assert found.chain.topics == ("/topic1", "/topic2", "/topic3", "/topic4")
    assert found.statistics.count + found.statistics.incomplete == 75
