"""What of a trace's events becomes tables: providers, fields of other kinds, what is not kept."""

from pathlib import Path
from typing import Any

import pytest
from command_line import called, json_of
from ctf_writing import EventRecord, lttng_metadata, write_packet
from test_lttng_trace import START, chain_story, written

from chainshaper.sources import open_source


def one_event(folder: Path, name: str, kinds: dict[str, str], payload: dict[str, Any]) -> None:
    """A trace of a single event, of process 10."""
    text = lttng_metadata({name: kinds}, {"vpid": "s32", "vtid": "s32"})
    event = EventRecord(name, START, payload, {"vpid": 10, "vtid": 10})
    write_packet(folder, text, [event])


def test_another_providers_events_of_the_same_name_are_not_ours(tmp_path: Path) -> None:
    one_event(tmp_path / "trace", "mine:callback_start", {"callback": "x64"}, {"callback": 1})
    recording = open_source(tmp_path / "trace")
    assert len(recording.events) == 0
    assert json_of("info", tmp_path / "trace")["events"] == {"mine:callback_start": 1}


@pytest.mark.parametrize(
    ("field", "damaged"),
    [("topic_name", "x64"), ("publisher_handle", "string"), ("node_handle", "u32[]")],
)
def test_fields_of_another_kind_are_said_to_be_unknown(
    field: str, damaged: str, tmp_path: Path
) -> None:
    kinds = {"publisher_handle": "x64", "node_handle": "x64", "rmw_publisher_handle": "x64",
             "topic_name": "string", "queue_depth": "u64"} | {field: damaged}  # fmt: skip
    values: dict[str, Any] = {"x64": 7, "u64": 7, "string": "seven", "u32[]": [7]}
    payload = {name: values[kind] for name, kind in kinds.items()}
    payload[f"_{field}_length"] = 1
    one_event(tmp_path / "trace", "ros2:rcl_publisher_init", kinds, payload)
    said = called("graph", tmp_path / "trace")
    assert said.code == 0
    assert f"rcl_publisher_init has no usable field {field}" in said.err


def test_events_of_nobody_knows_which_thread_are_counted_and_left_out(tmp_path: Path) -> None:
    """LTTng without contexts; `ros2 trace` always asks for them."""
    text = lttng_metadata({"ros2:callback_start": {"callback": "x64"}}, {"procname": "char[17]"})
    event = EventRecord("ros2:callback_start", START, {"callback": 1}, {"procname": "node"})
    write_packet(tmp_path / "trace", text, [event, event])
    for verb in ("callbacks", "graph", "chains"):
        said = called(verb, tmp_path / "trace")
        assert said.code == 0
        assert "2 events say no process or thread and cannot be used" in said.err
        assert "--type=vpid --type=vtid" in said.err
    assert json_of("info", tmp_path / "trace")["events"] == {"ros2:callback_start": 2}


def test_what_a_conversion_leaves_behind_is_said(tmp_path: Path) -> None:
    """And `info` goes on to show the events that the trace had, under their full names."""
    trace = written(tmp_path / "trace", chain_story())
    one_event(trace / "dds", "dds:write", {"data": "x64"}, {"data": 1})
    shown = json_of("info", trace)
    assert shown["events"]["dds:write"] == 1
    said = called("convert", trace, "-o", tmp_path / "once").err
    assert "1 events of kinds that chainshaper makes no use of were not kept: dds:write" in said
    called("convert", tmp_path / "once", "-o", tmp_path / "twice")
    for name in ("once", "twice"):
        again = json_of("info", tmp_path / name)
        assert again["events"] == shown["events"]
        assert sum("not kept" in note for note in again["notes"]) == 1
