"""A program with LTTng trace points of the provider `ros2`, for what needs a real LTTng.

`sources/chain_node.c` emits events as the nodes of ROS 2 Jazzy do (rclcpp 28.1.6); the provider
declares them with the fields of our event tables, whose names and types are `tracetools`'.
"""

import atexit
import functools
import re
import shutil
import subprocess
import tempfile
from collections.abc import Mapping
from pathlib import Path

import polars as pl
import pytest

from chainshaper.values import events

LTTNG = ("--source", "lttng")
"""The program emits its events to LTTng itself: no library in front of libtracetools sees them."""

_HEADER = """
#undef TRACEPOINT_PROVIDER
#define TRACEPOINT_PROVIDER ros2
#undef TRACEPOINT_INCLUDE
#define TRACEPOINT_INCLUDE "./ros2_provider.h"
#if !defined(ROS2_PROVIDER) || defined(TRACEPOINT_HEADER_MULTI_READ)
#define ROS2_PROVIDER
#include <stdint.h>
#include <lttng/tracepoint.h>
{events}
#endif
#include <lttng/tracepoint-event.h>
"""


def required_node() -> Path:
    """The program; skips the test where LTTng or a compiler is missing."""
    for tool, package in (
        ("lttng", "lttng-tools"),
        ("lttng-sessiond", "lttng-tools"),
        ("gcc", "gcc"),
    ):
        if shutil.which(tool) is None:
            pytest.skip(f"{tool} is not installed here (package {package})")
    program = _built()
    if isinstance(program, str):
        pytest.skip(f"the test's trace provider cannot be built (liblttng-ust-dev?): {program}")
    return program


@functools.cache
def _built() -> Path | str:
    """Build the program once; its path, or what the compiler said."""
    folder = Path(tempfile.mkdtemp(prefix="chain-node-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    source = Path(__file__).parents[1] / "sources" / "chain_node.c"
    emitted = sorted(set(re.findall(r"tracepoint\(ros2, (\w+)", source.read_text())))
    declared = "\n".join(_event(name, events.FIELDS[name]) for name in emitted)
    (folder / "ros2_provider.h").write_text(_HEADER.format(events=declared))
    libraries = ["-llttng-ust", "-ldl", "-lpthread"]
    command = ["gcc", "-O1", f"-I{folder}", "-o", f"{folder / 'chain_node'}", str(source)]
    built = subprocess.run([*command, *libraries], capture_output=True, text=True, check=False)
    return folder / "chain_node" if built.returncode == 0 else built.stderr.strip()


def _event(name: str, columns: Mapping[str, pl.DataType]) -> str:
    """An event as LTTng's macro wants it."""
    arguments, fields = [], []
    for field, kind in columns.items():
        if isinstance(kind, pl.List):
            arguments.append(f"const uint8_t *, {field}_")
            fields.append(f"ctf_array(uint8_t, {field}, {field}_, 24)")
        elif isinstance(kind, pl.String):
            arguments.append(f"const char *, {field}_")
            fields.append(f"ctf_string({field}, {field}_)")
        else:
            arguments.append(f"{str(kind).lower()}_t, {field}_")
            macro = "ctf_integer_hex" if kind == pl.UInt64() else "ctf_integer"
            fields.append(f"{macro}({str(kind).lower()}_t, {field}, {field}_)")
    given, declared = ", ".join(arguments), " ".join(fields)
    return f"TRACEPOINT_EVENT(ros2, {name}, TP_ARGS({given}), TP_FIELDS({declared}))"


def chain_command(program: Path, cycles: int = 40, period_us: int = 10_000) -> tuple[str, ...]:
    """Two nodes, /source → /x → /relay → /y, as one command; it ends after ``cycles``."""
    names = [f"{program} {{}} --ros-args -r __node:={name}" for name in ("source", "relay")]
    first = names[0].format(f"source {cycles} {period_us}")
    return ("sh", "-c", f"{first} | {names[1].format('relay')}")
