"""The ROS parameters of shaping node, standby and throttler, and the gate that they describe.

The nodes in Python read them as they are here, those in C++ from the struct that `schema.hpp` has
(:mod:`chainshaper.splicing.generated_package`). Like the gate, this is a part of the nodes' files.
"""

from dataclasses import dataclass, field
from typing import Any

from chainshaper.gate.decision import DEPTH, Gate, Modes


@dataclass
class NodeParameters:
    """The ROS parameters of shaping node, standby and throttler; times are ns, 0-based places."""

    slots_ns: list[int] = field(default_factory=list)  # start and end of each, one after the other
    cycle_ns: int = 0
    anchor: str = "stamp"
    phase_ns: int = 0
    overrun: str = "wait"
    due_cycles: int = 0
    messages: str = "all-in-order"
    depth: int = 0  # 0: the publisher's history, DEPTH at least
    mode_topic: str = ""  # no modes
    mode_names: list[str] = field(default_factory=list)
    mode_slots: list[int] = field(default_factory=list)
    mode_default: str = ""
    mode_late: str = "wait"
    spin_ns: int = 0
    pause_ns: int = 0
    core: int = -1
    fifo_priority: int = 0
    output_depth: int = DEPTH  # where the history of the original publisher is not known
    server_cores: list[int] = field(default_factory=list)
    log: str = ""
    log_bytes: int = 100_000_000  # the log and the one before it have no more
    handover: str = ""  # the node is alone
    # Of the standby,
    shaping_node: str = "the shaping node"
    fallback: str = "bypass"
    patience_ns: int = 0
    # and of the throttler.
    inputs: list[str] = field(default_factory=list)
    outputs: list[str] = field(default_factory=list)
    period_ns: int = 0

    def gate(self, depth: int = DEPTH) -> Gate:
        """The gate that they describe, with room for so many messages.

        Raises:
            ValueError: they describe none.
        """
        bands = dict(zip(self.mode_names, self.mode_slots, strict=True))
        return Gate(
            slots=tuple(zip(self.slots_ns[::2], self.slots_ns[1::2], strict=False)),
            cycle_ns=self.cycle_ns,
            anchor=self.anchor,
            phase_ns=self.phase_ns,
            overrun=self.overrun,
            due_cycles=self.due_cycles,
            modes=Modes(bands, self.mode_default, self.mode_late) if self.mode_topic else None,
            messages=self.messages,
            depth=depth,
        )


def gate_parameters(gate: Gate, mode_topic: str = "") -> dict[str, Any]:
    """The parameters that describe a gate, whose modes are announced on that topic."""
    same = ("cycle_ns", "anchor", "phase_ns", "overrun", "due_cycles", "messages")
    known: dict[str, Any] = {"slots_ns": [bound for slot in gate.slots for bound in slot]}
    known |= {name: getattr(gate, name) for name in same}
    if gate.modes is not None:
        known |= {
            "mode_topic": mode_topic,
            "mode_names": list(gate.modes.bands),
            "mode_slots": list(gate.modes.bands.values()),
            "mode_default": gate.modes.default,
            "mode_late": gate.modes.late,
        }
    return known
