"""Telling shaping nodes in ROS 2 where a cycle begins.

Outputs without a stamp (a `geometry_msgs/Twist`, say) are held to the cycle, whose beginning no
message tells. It is measured while a plan is in force, and told to the nodes as a parameter. That
takes ROS 2 a second or two, in a process of its own: who tells does not wait for it, but looks.

That process runs as the user of the nodes' processes, in one's environment. As whom we may not run,
our own environment is used, where ROS 2 is sourced in it. Which participant of the domain answers
under a node's name, DDS does not prove without its security plug-ins; two that do are noticed.
"""

import time
from dataclasses import dataclass

from chainshaper.enforcement.threads.allocation import Allocation
from chainshaper.planning import Plan
from chainshaper.planning.plan import shaping_nodes
from chainshaper.sources.ros import script as ros_script
from chainshaper.sources.ros.interpreter import (
    Environment,
    Script,
    environment_of,
    own_environment,
    start_with_rclpy,
)
from chainshaper.values.durations import format_duration
from chainshaper.values.errors import OperationError

__all__ = ["NOBODY", "Telling", "moved_text", "tell_phase"]

_PATIENCE_S = 20
"""ROS 2 has started and found the nodes by then, however busy the machine is, or never will."""


@dataclass(frozen=True)
class Telling:
    """Nodes that are being told, by a process of ours.

    ``script`` is None where there is nobody to tell, or it was ``refused``; ``begun`` is s of
    CLOCK_MONOTONIC.
    """

    nodes: tuple[str, ...]
    script: Script | None
    begun: float
    refused: str | None = None

    def is_over(self) -> bool:
        """Look whether the nodes know, or never will."""
        late = time.monotonic() - self.begun > _PATIENCE_S
        return self.script is None or self.script.is_over() or late

    def end(self) -> tuple[str, ...]:
        """What went wrong, in words. To be called when it is over, or nobody waits for it."""
        problem = self.refused
        if self.script is not None:
            late = not self.script.is_over()
            _, problem = self.script.end()
            problem = f"ROS 2 did not answer within {_PATIENCE_S} s" if late else problem
        if problem is None:
            return ()
        return (
            f"{', '.join(self.nodes)} could not be told where cycles begin ({problem}): outputs "
            "without a stamp of their chain's beginning will not be in time",
        )


NOBODY = Telling((), None, 0.0)
"""Nobody is being told."""


def tell_phase(plan: Plan, found: Allocation, phase_ns: int) -> Telling:
    """Begin to set ``phase_ns`` of a plan's shaping nodes, as far as they are ROS 2's.

    ``phase_ns`` is where the chain begins in every cycle, on CLOCK_MONOTONIC. The nodes of a chain
    are in one domain: any of them has the environment in which all are found.
    """
    pids = {
        node: one.thread.pid
        for node in (one.thread.node for one in shaping_nodes(plan))
        for one in found.threads
        if node in one.nodes
    }
    try:
        environments = {node: _environment_for(pid) for node, pid in pids.items()}
        nodes = tuple(node for node, one in environments.items() if _is_ros(one))
        if not nodes:  # they are the live workload's
            return NOBODY
        arguments = ("parameter", "phase_ns", str(phase_ns % plan.cycle_ns), *nodes)
        script = start_with_rclpy(environments[nodes[0]], ros_script.__file__, *arguments)
    except OperationError as error:
        return Telling(tuple(pids), None, 0.0, str(error))
    return Telling(nodes, script, time.monotonic())


def _environment_for(pid: int) -> Environment:
    """The environment of a node, or ours where nothing of the node's may be run."""
    try:
        return environment_of(pid)
    except OperationError:
        ours = own_environment()
        if _is_ros(ours):
            return ours
        raise


def _is_ros(environment: Environment) -> bool:
    return "AMENT_PREFIX_PATH" in environment.variables


def moved_text(drift_ns: int) -> str:
    """What to know when nodes are told again."""
    return (
        f"the chain's beginning has moved by {format_duration(drift_ns)} since the plan was put in "
        "force; shaping nodes are told, and outputs without a stamp follow from the next cycle"
    )
