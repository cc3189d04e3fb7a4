"""The reference traces as event tables, read through babeltrace2's own Python bindings."""

import json
import subprocess
import tempfile
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import polars as pl
import pytest

from chainshaper import events

__all__ = ["DATA", "TRACES", "ReferenceTrace", "reference_trace"]

DATA = Path(__file__).resolve().parents[3] / "shared" / "data"
TRACES = (
    "jazzy_chain_cyclonedds",
    "jazzy_chain_fastrtps_async",
    "jazzy_avp_cyclonedds",
    "humble_sync",
    "galactic_caret_end_to_end",
)
SYSTEM_PYTHON = "/usr/bin/python3"  # python3-bt2 is a Debian package, not on PyPI

_DUMP = """
import json, sys
import bt2

def plain(value):
    if isinstance(value, bt2._ArrayFieldConst):
        return [int(x) for x in value]
    return str(value) if isinstance(value, bt2._StringFieldConst) else int(value)

tables, offset = {}, None
for message in bt2.TraceCollectionMessageIterator(sys.argv[1]):
    if type(message) is not bt2._EventMessageConst:
        continue
    event, clock = message.event, message.default_clock_snapshot
    offset = clock.clock_class.offset
    offset = offset.seconds * 10**9 + offset.cycles * 10**9 // clock.clock_class.frequency
    context = event.common_context_field
    row = {
        "time": clock.ns_from_origin - offset,
        "pid": int(context["vpid"]),
        "tid": int(context["vtid"]),
        "cpu": int(event.packet.context_field["cpu_id"]),
    }
    row.update((name, plain(value)) for name, value in event.payload_field.items())
    columns = tables.setdefault(event.name, {name: [] for name in row})
    for name, value in row.items():
        columns[name].append(value)
json.dump({"offset": offset, "tables": tables}, sys.stdout)
"""


@dataclass(frozen=True)
class ReferenceTrace:
    tables: events.EventTables
    clock_offset_ns: int
    truth: dict[str, Any]
    others: dict[str, list[dict[str, Any]]]  # events that are not ROS 2's, row by row


@cache
def reference_trace(name: str) -> ReferenceTrace:
    """A trace and its ground truth; skips the test where either cannot be had."""
    folder = DATA / name
    if not folder.is_dir():
        pytest.skip(f"the reference traces are not here ({folder})")
    if (
        not Path(SYSTEM_PYTHON).exists()
        or subprocess.run(
            [SYSTEM_PYTHON, "-c", "import bt2"], capture_output=True, check=False
        ).returncode
    ):
        pytest.skip("babeltrace2's Python bindings (Debian package python3-bt2) are missing")
    newest = max(file.stat().st_mtime_ns for file in (folder / "trace").rglob("*"))
    cache_file = Path(tempfile.gettempdir()) / f"chainshaper-{name}-{newest}.json"
    if not cache_file.exists():
        dump = subprocess.run(
            [SYSTEM_PYTHON, "-c", _DUMP, str(folder / "trace")], capture_output=True, check=True
        )
        partial = cache_file.with_suffix(".partial")
        partial.write_bytes(dump.stdout)
        partial.rename(cache_file)
    dumped = json.loads(cache_file.read_text())
    tables: dict[str, pl.DataFrame] = {}
    others: dict[str, list[dict[str, Any]]] = {}
    for full_name, columns in dumped["tables"].items():
        provider, event = full_name.split(":")
        if provider.startswith("ros2") and event in events.FIELDS:
            types = {**events.COMMON_COLUMNS, **events.FIELDS[event]}
            frame = pl.DataFrame(
                columns,
                strict=False,
                schema_overrides={column: types[column] for column in columns if column in types},
            )
            tables[event] = frame.sort("time", maintain_order=True)
        elif not provider.startswith("ros2"):
            rows = zip(*columns.values(), strict=True)
            others[full_name] = [dict(zip(columns, row, strict=True)) for row in rows]
    truth = json.loads((folder / "truth.json").read_text())
    return ReferenceTrace(tables, dumped["offset"], truth, others)
