"""The ROS parameters of the shaping node, the standby and the throttler.

ROS parameters do not nest: of a gate, each number or word is one parameter, and slots and modes are
lists. The node in C++ reads the same ones (`schema.hpp`).
"""

from collections.abc import Mapping
from dataclasses import MISSING, dataclass, field, fields
from typing import Any, Literal, get_origin

from chainshaper.robot.gate import DEPTH, VALUES, Gate, GateModes, values_of


def _parameters_of_gates() -> dict[str, tuple[Any, Any]]:
    """Return the type and the default of each parameter that describes a gate, by its name."""
    parameters: dict[str, tuple[Any, Any]] = {"slots_ns": (list[int], [])}  # start, end, start, …
    for declared in VALUES:
        type_ = str if get_origin(declared.type) is Literal else int
        default = 0 if declared.default is MISSING else declared.default
        parameters[declared.name] = type_, default
    return parameters | {
        "mode_names": (list[str], []),
        "mode_slots": (list[int], []),  # which slot each mode has, from 1
        "mode_default": (str, ""),
        "mode_late": (str, GateModes.late),
    }


_OF_GATES = _parameters_of_gates()


@dataclass
class NodeParameters:
    """The ROS parameters of shaping node, standby and throttler. Times are nanoseconds.

    Of the shaping node:

    * ``gate_values``: the parameters that describe the gate, by their names.
    * ``depth``: how many messages may wait; 0: as many as the history of the output's publisher
      has, :data:`.DEPTH` at least.
    * ``mode_topic``: where modes are announced; "": there are none.
    * ``spin_ns``: for so long before a release the thread watches the clock instead of sleeping.
    * ``pause_ns``: for so long behind a publication the thread rests.
    * ``core``: where the thread runs; -1: anywhere.
    * ``fifo_priority``: its SCHED_FIFO priority; 0: none.
    * ``output_depth``: the history of the original publisher where discovery does not tell it.
    * ``server_cores``: cores with servers, which receivers of the output do not run on.
    * ``log``: the file of the gate's log; "": none.
    * ``log_bytes``: the log and the one before it have no more together.
    * ``handover``: the name of the page shared with the standby; "": the node is alone.

    Of the standby:

    * ``shaping_node``: the name of the node that it stands beside.
    * ``fallback``: `bypass` or `silence`, while that node is not there.
    * ``patience_ns``: a node that is later than this is taken to hang.

    Of the throttler: ``inputs`` and ``outputs``, its topics; ``period_ns``; ``rule``.
    """

    gate_values: dict[str, Any] = field(
        default_factory=lambda: {name: default for name, (_, default) in _OF_GATES.items()}
    )
    depth: int = 0
    mode_topic: str = ""
    spin_ns: int = 0
    pause_ns: int = 0
    core: int = -1
    fifo_priority: int = 0
    output_depth: int = DEPTH
    server_cores: list[int] = field(default_factory=list)
    log: str = ""
    log_bytes: int = 100_000_000
    handover: str = ""
    shaping_node: str = "the shaping node"
    fallback: str = "bypass"
    patience_ns: int = 0
    inputs: list[str] = field(default_factory=list)
    outputs: list[str] = field(default_factory=list)
    period_ns: int = 0
    rule: str = "newest"

    @property
    def phase_ns(self) -> int:
        """Where cycles begin: the gate's, or the throttler's."""
        phase_ns: int = self.gate_values["phase_ns"]
        return phase_ns

    def gate(self, depth: int = DEPTH) -> Gate:
        """Return the gate that they describe. Raises ValueError: they describe none."""
        values = self.gate_values
        modes, bounds = None, values["slots_ns"]
        if self.mode_topic:
            places = [number - 1 for number in values["mode_slots"]]
            slots = dict(zip(values["mode_names"], places, strict=True))
            modes = GateModes(slots, values["mode_default"], values["mode_late"])
        return Gate(
            slots=tuple(zip(bounds[::2], bounds[1::2], strict=False)),
            modes=modes,
            depth=depth,
            **{declared.name: values[declared.name] for declared in VALUES},
        )


def _parameters() -> dict[str, tuple[Any, Any]]:
    usual = NodeParameters()
    of_nodes = {
        declared.name: (declared.type, getattr(usual, declared.name))
        for declared in fields(NodeParameters)
        if declared.name != "gate_values"
    }
    return _OF_GATES | of_nodes


PARAMETERS = _parameters()
"""The type and the default of each ROS parameter, by its name."""


def parameters_from(values: Mapping[str, Any]) -> NodeParameters:
    """Return parameters with these values, and the defaults of those that are not there."""
    of_gates = {name: values.get(name, default) for name, (_, default) in _OF_GATES.items()}
    of_nodes = {name: value for name, value in values.items() if name not in _OF_GATES}
    return NodeParameters(gate_values=of_gates, **of_nodes)


def gate_parameters(gate: Gate, mode_topic: str = "") -> dict[str, Any]:
    """Return the parameters that describe a gate, whose modes are announced on that topic."""
    parameters: dict[str, Any] = {"slots_ns": [bound for slot in gate.slots for bound in slot]}
    parameters |= values_of(gate)
    if (modes := gate.modes) is not None:
        parameters |= {
            "mode_topic": mode_topic,
            "mode_names": [*modes.slots],
            "mode_slots": [place + 1 for place in modes.slots.values()],
            "mode_default": modes.default,
            "mode_late": modes.late,
        }
    return parameters
