"""The ROS parameters of the shaping node, the standby and the throttler."""

from dataclasses import dataclass, field
from typing import Any

from chainshaper.robot.gate import DEPTH, Gate, Modes


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
    into_open_slot: str = "at-once"
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
    rule: str = "newest"

    def gate(self, depth: int = DEPTH) -> Gate:
        """The gate that they describe. Raises ValueError: they describe none."""
        bands = dict(zip(self.mode_names, self.mode_slots, strict=True))
        return Gate(
            slots=tuple(zip(self.slots_ns[::2], self.slots_ns[1::2], strict=False)),
            modes=Modes(bands, self.mode_default, self.mode_late) if self.mode_topic else None,
            depth=depth,
            **{name: getattr(self, name) for name in SAME},
        )


SAME = ("cycle_ns", "anchor", "phase_ns", "overrun", "due_cycles", "messages", "into_open_slot")
"""What a gate, its parameters and its description have alike, under these names."""


def gate_parameters(gate: Gate, mode_topic: str = "") -> dict[str, Any]:
    """The parameters that describe a gate, whose modes are announced on that topic."""
    known: dict[str, Any] = {"slots_ns": [bound for slot in gate.slots for bound in slot]}
    known |= {name: getattr(gate, name) for name in SAME}
    if (modes := gate.modes) is not None:
        bands = {"mode_names": [*modes.bands], "mode_slots": [*modes.bands.values()]}
        late = {"mode_default": modes.default, "mode_late": modes.late}
        known |= {"mode_topic": mode_topic, **bands, **late}
    return known
