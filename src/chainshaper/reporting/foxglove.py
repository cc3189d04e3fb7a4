"""A recording as MCAP, which Foxglove plots, and the layout of panels that plots it.

A topic for each node, ``/chainshaper/<node>``, has a message for each callback instance, at its
end; the topic ``/chainshaper/latency`` has one for each cycle of the chain. Times are in ms, log
times are CLOCK_REALTIME, as in a bag of the same run. Messages are JSON, with a schema.

The layout names the topics and fields that the file has; Foxglove opens it by "Import from file".
"""

import io
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

from chainshaper.analysis import graph_of, recorded_flow
from chainshaper.values.application import trigger_text
from chainshaper.values.errors import extra_library
from chainshaper.values.files import new_file, write_whole
from chainshaper.values.recording import Recording
from chainshaper.verify.measure import Measurement

_LATENCY = "/chainshaper/latency"
_JSON_TYPES = {
    **dict.fromkeys(("latency_ms", "response_ms", "execution_ms"), "number"),
    **dict.fromkeys(("callback", "incomplete"), "string"),
    "late": "boolean",
}
_PLOT = {
    "showXAxisLabels": True,
    "showYAxisLabels": True,
    "showLegend": True,
    "legendDisplay": "floating",
    "isSynced": True,
    "xAxisVal": "timestamp",
}

_Values: TypeAlias = dict[str, str | float | bool]


@dataclass(frozen=True)
class _Message:
    topic: str
    log_time: int  # ns of the event clock: the end of an instance, or of a cycle
    publish_time: int  # ns: its start
    values: _Values


def export_mcap(
    source: Recording | Measurement, path: str | Path, layout: str | Path | None = None
) -> Path:
    """Write times of callbacks, and of a measurement's chain, as messages for Foxglove.

    ``layout`` is a file for the panels that plot them. Raises InputError: a path exists already, or
    does not end in `.mcap`, or the layout's in `.json`. PlatformError: the package mcap is not
    installed. OperationError: a file cannot be written; nothing is left of it.
    """
    path = new_file(path, (".mcap",))
    layout = None if layout is None else new_file(layout, (".json",))
    writing = extra_library("mcap.writer", "writing MCAP", "mcap")
    recording = source.recording if isinstance(source, Measurement) else source
    messages = _messages_of(source, recording)
    file, offset = io.BytesIO(), recording.info.clock_offset_ns
    writer, channels = writing.Writer(file), dict[str, int]()
    writer.start()
    kinds = {name: {"type": kind} for name, kind in _JSON_TYPES.items()}
    schema = json.dumps({"type": "object", "properties": kinds}).encode()
    number = writer.register_schema("chainshaper", "jsonschema", schema)
    for message in sorted(messages, key=lambda message: message.log_time):
        if message.topic not in channels:
            channels[message.topic] = writer.register_channel(message.topic, "json", number)
        writer.add_message(
            channels[message.topic],
            message.log_time + offset,
            json.dumps(message.values).encode(),
            message.publish_time + offset,
        )
    writer.finish()
    write_whole(path, [file.getvalue()])
    if layout is not None:
        write_whole(layout, [json.dumps(_layout_of(messages), indent=2).encode()])
    return path


def _messages_of(source: Recording | Measurement, recording: Recording) -> list[_Message]:
    """Return a message for each callback instance, and for each cycle of a measured chain."""
    flow = recorded_flow(recording)
    callbacks = {callback.id: callback for callback in graph_of(flow).callbacks}
    messages = list[_Message]()
    took = flow.instances.drop_nulls("end").select("callback_id", "start", "end", "execution_ns")
    for number, start, end, used in took.iter_rows():
        callback = callbacks[number]
        values: _Values = {
            "callback": trigger_text(callback.topic, callback.period_ns, callback.declared_ns),
            "response_ms": (end - start) / 1e6,
        }
        if used is not None:
            values["execution_ms"] = used / 1e6
        messages.append(_Message(f"/chainshaper{callback.node or '/unknown'}", end, start, values))
    if isinstance(source, Measurement):
        cycles = source.analysis.traversals.select("start", "end", "latency_ns", "late", "reason")
        for start, end, latency, late, reason in cycles.iter_rows():
            possible = {"latency_ms": latency and latency / 1e6, "late": late, "incomplete": reason}
            values = {name: value for name, value in possible.items() if value is not None}
            messages.append(_Message(_LATENCY, end or start, start, values))
    return messages


def _layout_of(messages: Sequence[_Message]) -> dict[str, Any]:
    """Return a layout: the chain's latency, whether it was late, and the times of each node."""
    fields = dict[str, set[str]]()  # by topic: those that some message has
    for message in messages:
        fields.setdefault(message.topic, set()).update(message.values)
    nodes = sorted(topic for topic in fields if topic != _LATENCY)
    panels = dict[str, dict[str, Any]]()
    if "latency_ms" in fields.get(_LATENCY, ()):
        panels["Plot!latency"] = _plot("Latency of the chain (ms)", {_LATENCY: "latency_ms"})
    if "late" in fields.get(_LATENCY, ()):
        panels["StateTransitions!late"] = {
            "isSynced": True,
            "paths": [_path(_LATENCY, "late", "late")],
        }
    for field, title in (
        ("response_ms", "Response times of callbacks (ms)"),
        ("execution_ms", "CPU times of callbacks (ms)"),
    ):
        topics = [topic for topic in nodes if field in fields[topic]]
        if topics:
            panels[f"Plot!{field}"] = _plot(title, dict.fromkeys(topics, field))
    return {
        "configById": panels,
        "globalVariables": {},
        "userNodes": {},
        "playbackConfig": {"speed": 1},
        "layout": _column([*panels]),
    }


def _plot(title: str, fields: Mapping[str, str]) -> dict[str, Any]:
    """Return a panel with a line for each topic's field."""
    paths = [
        _path(topic, field, topic.removeprefix("/chainshaper")) for topic, field in fields.items()
    ]
    return {"title": title, "paths": paths, **_PLOT}


def _path(topic: str, field: str, label: str) -> dict[str, Any]:
    return {
        "value": f"{topic}.{field}",
        "label": label,
        "enabled": True,
        "timestampMethod": "receiveTime",
    }


def _column(panels: Sequence[str]) -> Any:
    """Return panels one below the other, of equal heights; Foxglove nests pairs."""
    if len(panels) < 2:
        return panels[0] if panels else None
    return {
        "direction": "column",
        "first": panels[0],
        "second": _column(panels[1:]),
        "splitPercentage": round(100 / len(panels)),
    }
