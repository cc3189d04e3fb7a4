"""The gate of a plan's shaping node, as ROS parameters and as the settings of the gate libraries.

A shaping node reads ROS parameters (:class:`.NodeParameters`). The gates inside the processes that
publish and subscribe (`LD_PRELOAD`) read the same names and values from one text file.
"""

import hashlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from chainshaper.linux.threads import gate_thread_name
from chainshaper.planning.chain_plan import ChainPlan, ShapingNode, server_of
from chainshaper.planning.overruns import cycles_until_output
from chainshaper.robot.gate import DEPTH, Gate, GateModes
from chainshaper.robot.node_parameters import gate_parameters
from chainshaper.sources.preload import native_library

GATES = "CHAINSHAPER_GATES"
"""The variable that names the file with all gates of an application (`in_front_of_rmw.hpp`)."""


def gate_of(plan: ChainPlan, node: ShapingNode, depth: int = DEPTH) -> Gate:
    """Return the gate of a plan's shaping node, with room for ``depth`` messages."""
    server = server_of(plan, node.thread)  # there is one, or the plan was refused
    modes = plan.modes if node == plan.shaping_node else None
    # Plans number bands from 1, as people do; a gate numbers its slots from 0.
    slots = {} if modes is None else {mode: band - 1 for mode, band in modes.bands.items()}
    return Gate(
        slots=() if server is None else server.slots,
        cycle_ns=plan.cycle_ns,
        anchor=plan.anchor,
        phase_ns=plan.offset_ns,
        overrun=plan.overrun,
        due_cycles=cycles_until_output(plan, node),
        modes=None if modes is None else GateModes(slots, modes.default, modes.late),
        messages=plan.messages,
        into_open_slot=plan.into_open_slot,
        depth=depth,
    )


def shaping_parameters(plan: ChainPlan, node: ShapingNode, log: Path | None) -> dict[str, Any]:
    """Return the ROS parameters of a shaping node (:class:`.NodeParameters`)."""
    mode_topic = "" if plan.modes is None else plan.modes.topic
    parameters = gate_parameters(gate_of(plan, node), mode_topic) | {
        "depth": node.depth or 0,
        "spin_ns": node.spin_ns,
        "pause_ns": node.pause_ns,
        "core": node.core,
        "fifo_priority": node.fifo_priority,
        "output_depth": plan.chain.output_depth or DEPTH,
        "log": "" if log is None else str(log.absolute()),
    }
    if node.receivers:
        parameters["server_cores"] = sorted({server.core for server in plan.servers})
    return parameters


def page_name(node: ShapingNode, place: Path) -> str:
    """Return the name of an output's page (:mod:`chainshaper.robot.handover`).

    ``place`` tells it from the pages of other launches: a file that is not moved before its use,
    such as the log.
    """
    return f"{node.name}.{hashlib.sha256(str(place.absolute()).encode()).hexdigest()[:8]}"


def gate_settings(plan: ChainPlan, node: ShapingNode, publisher: str, log: Path) -> str:
    """Return the lines of an output in the file that :data:`GATES` names."""
    values = {
        "output": node.output,
        "input": node.input,
        "node": node.name,
        "publisher": publisher,
        "thread": gate_thread_name(node.name),
        "handover": page_name(node, log),
    }
    return settings_text(values | shaping_parameters(plan, node, log))


def delivery_settings(node: ShapingNode) -> str:
    """Return the lines of an output that receivers get at a constant time; "": it is not one."""
    if node.delivery_ns is None:
        return ""
    values = {"output": node.output, "delivery_ns": node.delivery_ns}
    return settings_text({**values, "receiver": list(node.receivers)})


def settings_text(values: Mapping[str, Any]) -> str:
    """Return lines ``NAME VALUE``, one for each value of a list; ``output`` comes first."""
    lines = []
    for name, value in values.items():
        listed = value if isinstance(value, list) else [value]
        lines += [f"{name} {entry}\n" for entry in listed]
    return "".join(lines)


def gate_library() -> Path:
    """Return the library with both gates, which was built with the package."""
    return native_library("libchainshaper_gate.so")
