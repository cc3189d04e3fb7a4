"""Every event of real ROS 2 traces, and every field that has a column, against babeltrace2."""

import json

import pytest
from reference import assert_equal_to_babeltrace
from reference_traces import TRACES, reference_folder

from chainshaper.sources.ctf import count_events, open_trace, read_events


@pytest.mark.parametrize("name", TRACES)
def test_every_event_and_field_equals_babeltrace_and_counts_the_truth(name: str) -> None:
    trace, frames = assert_equal_to_babeltrace(reference_folder(name) / "trace")
    assert trace.warnings == ()
    counts, _ = count_events(trace)
    assert {n: len(f) for n, f in frames.items()} == counts
    truth = json.loads((reference_folder(name) / "truth.json").read_text())
    assert {n: c for n, c in counts.items() if c} == truth["events"]


def test_only_what_is_asked_for_is_read() -> None:
    trace = open_trace(reference_folder("humble_sync") / "trace")
    frames = read_events(trace, {"ros2:callback_start", "no:such_event"})
    assert list(frames) == ["ros2:callback_start"]
    assert frames["ros2:callback_start"].equals(read_events(trace)["ros2:callback_start"])


def test_several_folders_are_merged_by_time() -> None:
    names = ("jazzy_chain_cyclonedds", "jazzy_avp_cyclonedds")
    folders = [reference_folder(name) / "trace" for name in names]
    merged = read_events(open_trace(*folders))["ros2:rmw_take"]
    parts = [read_events(open_trace(folder))["ros2:rmw_take"] for folder in folders]
    assert len(merged) == sum(map(len, parts))
    assert merged["time"].is_sorted()
    assert merged["message"].sum() == sum(part["message"].sum() for part in parts)
