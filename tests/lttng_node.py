"""A program with LTTng trace points of the provider `ros2`, for what needs a real LTTng.

The provider is generated from the events that a real ROS 2 Jazzy emits (rclcpp 28.1.6), with their
real fields; `sources/chain_node.c` emits them as its nodes would.
"""

import atexit
import functools
import re
import shutil
import subprocess
import tempfile
from pathlib import Path

import pytest

LTTNG = ("--source", "lttng")
"""The program emits its events to LTTng itself: no library in front of libtracetools sees them."""

EVENTS = """
callback_end: callback: uint64
callback_start: callback: uint64; is_intra_process: int32
rcl_init: context_handle: uint64; version: string
rcl_node_init: node_handle: uint64; rmw_handle: uint64; node_name: string; namespace: string
rcl_publish: publisher_handle: uint64; message: uint64
rcl_publisher_init: publisher_handle: uint64; node_handle: uint64; rmw_publisher_handle: uint64; \
topic_name: string; queue_depth: uint64
rcl_subscription_init: subscription_handle: uint64; node_handle: uint64; \
rmw_subscription_handle: uint64; topic_name: string; queue_depth: uint64
rcl_take: message: uint64
rcl_timer_init: timer_handle: uint64; period: int64
rclcpp_callback_register: callback: uint64; symbol: string
rclcpp_publish: message: uint64
rclcpp_subscription_callback_added: subscription: uint64; callback: uint64
rclcpp_subscription_init: subscription_handle: uint64; subscription: uint64
rclcpp_take: message: uint64
rclcpp_timer_callback_added: timer_handle: uint64; callback: uint64
rclcpp_timer_link_node: timer_handle: uint64; node_handle: uint64
rmw_publish: rmw_publisher_handle: uint64; message: uint64; timestamp: int64
rmw_publisher_init: rmw_publisher_handle: uint64; gid: uint8[24]
rmw_subscription_init: rmw_subscription_handle: uint64; gid: uint8[24]
rmw_take: rmw_subscription_handle: uint64; message: uint64; source_timestamp: int64; taken: int32
"""

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
    events = "\n".join(_event(line) for line in EVENTS.split("\n") if line)
    (folder / "ros2_provider.h").write_text(_HEADER.format(events=events))
    source = Path(__file__).parent / "sources" / "chain_node.c"
    libraries = ["-llttng-ust", "-ldl", "-lpthread"]
    command = ["gcc", "-O1", f"-I{folder}", "-o", f"{folder / 'chain_node'}", str(source)]
    built = subprocess.run([*command, *libraries], capture_output=True, text=True, check=False)
    return folder / "chain_node" if built.returncode == 0 else built.stderr.strip()


def _event(line: str) -> str:
    """``name: field: type; …`` as LTTng's macro wants it."""
    name, _, rest = line.partition(": ")
    arguments, fields = [], []
    for field, kind in (re.split(": ", one) for one in rest.split("; ")):
        array = re.fullmatch(r"(\w+)\[(\d+)\]", kind)
        if array:
            arguments.append(f"const {array[1]}_t *, {field}_")
            fields.append(f"ctf_array({array[1]}_t, {field}, {field}_, {array[2]})")
        elif kind == "string":
            arguments.append(f"const char *, {field}_")
            fields.append(f"ctf_string({field}, {field}_)")
        else:
            arguments.append(f"{kind}_t, {field}_")
            macro = "ctf_integer_hex" if kind == "uint64" else "ctf_integer"
            fields.append(f"{macro}({kind}_t, {field}, {field}_)")
    given, declared = ", ".join(arguments), " ".join(fields)
    return f"TRACEPOINT_EVENT(ros2, {name}, TP_ARGS({given}), TP_FIELDS({declared}))"


def chain_command(program: Path, cycles: int = 40, period_us: int = 10_000) -> tuple[str, ...]:
    """Two nodes, /source → /x → /relay → /y, as one command; it ends after ``cycles``."""
    names = [f"{program} {{}} --ros-args -r __node:={name}" for name in ("source", "relay")]
    first = names[0].format(f"source {cycles} {period_us}")
    return ("sh", "-c", f"{first} | {names[1].format('relay')}")
