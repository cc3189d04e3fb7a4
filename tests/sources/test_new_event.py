"""An event that is added as CONTRIBUTING says is known to the tables and to every tracer."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from chainshaper.sources.preload import events_header
from chainshaper.values.event_declarations import events_of_library

# Runs in a process of its own, since tables are derived from the declarations at import.
PROGRAM = """
import ctypes, os, subprocess, sys
from pathlib import Path
from chainshaper.values import event_declarations as declarations
from chainshaper.values.event_declarations import Event, EventField

DECLARATION

declarations.EVENTS[added.name] = added

import numpy as np
from chainshaper.sources import tracing_library
from chainshaper.sources.ebpf.trace_points import bpftrace_script, trace_points
from chainshaper.sources.lttng import trace as lttng
from chainshaper.sources.preload import (
    TracedProcess, creation_tables, event_tables, events_header
)
from chainshaper.values import events

folder, source, compiler = map(Path, sys.argv[1:])
header = events_header.events_header(declarations.events_of_library())
text = f"{header}#define FORMAT {events_header.format_of(header)}u\\n"
(folder / "events.h").write_text(text)
(folder / "rclpy_hook.h").write_text(events_header.hook_header())
library = folder / "libtrace.so"
subprocess.run(
    [compiler, "-std=gnu11", "-shared", "-fPIC", f"-I{folder}", source, "-o", library, "-ldl"],
    check=True,
)
loaded = ctypes.CDLL(str(library))
number = ctypes.c_uint64
loaded.ros_trace_rclcpp_wake_up(number(0xABC), number(0), number(1 << 40))
(memory,) = (
    int(fd.name)
    for fd in Path("/proc/self/fd").iterdir()
    if fd.is_symlink() and "chainshaper-trace" in os.readlink(fd)
)
process = TracedProcess(memory)
(records,) = process.new_records()
_, tracetools = creation_tables(process)
pids = np.full(records.size, process.pid, np.int32)
table = event_tables(records, pids, tracetools)["rclcpp_wake_up"]
assert table.select("callback", "reason").rows() == [(0xABC, 1 << 40)]
assert events.empty("rclcpp_wake_up").columns[-2:] == ["callback", "reason"]
assert any("rclcpp_wake_up" in group for group in lttng._GROUPS)
exports = tracing_library.TracingLibrary(
    Path("/lib.so"), frozenset({"ros_trace_rclcpp_wake_up"}), "8.2.0"
)
script = bpftrace_script(trace_points([exports]))
assert "ros_trace_rclcpp_wake_up" in script and "arg0, 0, arg2" in script
"""


def declaration_of_contributing() -> str:
    """The declaration that CONTRIBUTING shows."""
    text = Path(__file__).parents[2].joinpath("CONTRIBUTING.md").read_text("utf-8")
    shown = text.partition("### How to add an event")[2].partition("       Event(")[2]
    lines = ["added = Event(", *shown.partition("\n       )")[0].splitlines()[1:], ")"]
    return "\n".join(line.strip() for line in lines)


@pytest.mark.skipif(shutil.which("gcc") is None, reason="gcc is not installed")
def test_an_event_that_is_added_as_contributing_says_is_traced(tmp_path: Path) -> None:
    program = PROGRAM.replace("DECLARATION", declaration_of_contributing())
    source = Path(events_header.__file__).with_name("preload.c")
    subprocess.run(
        [sys.executable, "-c", program, str(tmp_path), str(source), str(shutil.which("gcc"))],
        check=True,
        timeout=120,
        env={name: value for name, value in os.environ.items() if name != "LD_PRELOAD"},
    )


def test_another_list_of_events_is_another_format() -> None:
    events = events_of_library()
    fewer = events_header.format_of(events_header.events_header(events[:-1]))
    assert fewer != events_header.FORMAT
    assert events_header.event_line(events[1]) == "CREATION(rcl_node_init, 12, 0)"
