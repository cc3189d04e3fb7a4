"""Event tables as an LTTng trace: what the tracers would have written.

For tests, examples and benchmarks: with it every situation that a trace can show can be told as
tables and read back through the whole path, by babeltrace2 too. User space and kernel have a
folder each, as they do below the folder of a session.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import polars as pl

from chainshaper.sources.ctf.lttng_text import lttng_metadata
from chainshaper.sources.ctf.tsdl import parse_tsdl
from chainshaper.sources.ctf.writer import EventRecord, encode_packet, write_trace
from chainshaper.values import events

__all__ = ["write_lttng_trace"]

_KERNEL = ("sched_switch",)
_CARET = ("dds_write", "dds_bind_addr_to_stamp", "rmw_implementation")
_PACKET_EVENTS = 1000
_CHARACTERS = 16  # of a thread's name


def write_lttng_trace(
    folder: str | Path,
    tables: events.EventTables,
    *,
    clock_offset_ns: int = 1_700_000_000_000_000_000,
    host: str = "example",
    process_names: Mapping[int, str] | None = None,
    gid_length: int = 24,
    discarded_events: int = 0,
) -> Path:
    """Write event tables as a trace into ``folder`` (``ust`` and, if needed, ``kernel`` in it).

    Every event is declared with the columns that its table has, nulls are not possible. ``cpu``
    decides about the stream (null: 0), ``discarded_events`` is what the tracer claims to have
    dropped on the first. Returns ``folder``.
    """
    folder = Path(folder)
    names = process_names or {}
    kernel = {name: frame for name, frame in tables.items() if name in _KERNEL}
    user = {name: frame for name, frame in tables.items() if name not in _KERNEL}
    for part, chosen in (("ust/uid/1000/64-bit", user), ("kernel", kernel)):
        if not chosen:
            continue
        in_kernel = part == "kernel"
        declared = {
            _full_name(name): {
                column: _kind(kind, gid_length)
                for column, kind in frame.schema.items()
                if column not in events.COMMON_COLUMNS
            }
            for name, frame in chosen.items()
        }
        context = {"vpid": "s32", "vtid": "s32", "procname": f"char[{_CHARACTERS + 1}]"}
        if in_kernel:
            context = {"pid": "s32", "tid": "s32"}
        text = lttng_metadata(
            declared, context, kernel=in_kernel, offset=clock_offset_ns, host=host
        )
        records = _records(chosen, names, in_kernel)
        _write(folder / part, text, records, 0 if in_kernel else discarded_events)
    return folder


def _full_name(name: str) -> str:
    if name in _KERNEL:
        return name
    return f"ros2_caret:{name}" if name in _CARET else f"ros2:{name}"


def _kind(kind: pl.DataType, gid_length: int) -> str:
    if isinstance(kind, pl.List):
        return f"u8[{gid_length}]"
    return {pl.UInt64(): "x64", pl.Int64(): "s64", pl.Int32(): "s32", pl.String(): "string"}[kind]


def _records(
    tables: events.EventTables, names: Mapping[int, str], in_kernel: bool
) -> dict[int, list[EventRecord]]:
    """The events of each core, in order of time."""
    records: dict[int, list[EventRecord]] = {}
    for name, frame in tables.items():
        for row in frame.iter_rows(named=True):
            time, pid, tid, cpu = (row.pop(column, None) for column in events.COMMON_COLUMNS)
            context: dict[str, Any] = {"vpid": pid, "vtid": tid}
            context["procname"] = names.get(pid, f"process_{pid}")[:_CHARACTERS]
            if in_kernel:
                context = {"pid": pid, "tid": tid}
            records.setdefault(cpu or 0, []).append(
                EventRecord(_full_name(name), time, row, context)
            )
    for found in records.values():
        found.sort(key=lambda record: record.time)
    return records


def _write(
    folder: Path, text: str, records: dict[int, list[EventRecord]], discarded_events: int
) -> None:
    declared = parse_tsdl(text)
    streams = {}
    for cpu, found in sorted(records.items()):
        packets = []
        for number, start in enumerate(range(0, len(found), _PACKET_EVENTS)):
            about = {
                "cpu_id": cpu,
                "packet_seq_num": number,
                "events_discarded": discarded_events if cpu == min(records) else 0,
            }
            part = found[start : start + _PACKET_EVENTS]
            packets.append(encode_packet(declared, part, about, instance=cpu))
        streams[f"channel_{cpu}"] = packets
    write_trace(folder, text, streams)
