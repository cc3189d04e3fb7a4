"""Telling shaping nodes in ROS 2 where a cycle begins.

Outputs without a stamp (a `geometry_msgs/Twist`, say) are held to the cycle, whose beginning no
message tells. It is measured while a plan is in force, and told to the nodes as a parameter. That
takes ROS 2 a second or two, in a process of its own: who tells does not wait for it, but looks.
"""

import subprocess
import time
from dataclasses import dataclass

from chainshaper.durations import format_duration
from chainshaper.enforcement.threads.allocation import Allocation
from chainshaper.errors import OperationError
from chainshaper.planning import Plan
from chainshaper.planning.plan import shaping_nodes
from chainshaper.sources.ros import parameter as ros_parameter
from chainshaper.sources.ros.interpreter import environment_of, start_with_rclpy, why_it_failed

__all__ = ["NOBODY", "Telling", "moved_text", "tell_phase"]

_PATIENCE_S = 20
"""ROS 2 has started and found the nodes by then, however busy the machine is, or never will."""


@dataclass(frozen=True)
class Telling:
    """Nodes that are being told, by a process of ours.

    ``process`` is None where there is nobody to tell, or it was ``refused``; ``begun`` is s of
    CLOCK_MONOTONIC.
    """

    nodes: tuple[str, ...]
    process: "subprocess.Popen[str] | None"
    begun: float
    refused: str | None = None

    def is_over(self) -> bool:
        """Look whether the nodes know, or never will."""
        late = time.monotonic() - self.begun > _PATIENCE_S
        return self.process is None or self.process.poll() is not None or late

    def end(self) -> tuple[str, ...]:
        """What went wrong, in words. To be called when it is over, or nobody waits for it."""
        problem = self.refused
        if self.process is not None:
            late = self.process.poll() is None
            self.process.kill()
            _, said = self.process.communicate()
            unanswered = f"ROS 2 did not answer within {_PATIENCE_S} s"
            problem = unanswered if late else why_it_failed(self.process, said)
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
    environments = {}
    for node in (one.thread.node for one in shaping_nodes(plan)):
        pid = next((one.thread.pid for one in found.threads if node in one.nodes), None)
        environment = environment_of(pid) if pid is not None else {}
        if "AMENT_PREFIX_PATH" in environment:  # else it is the live workload's
            environments[node] = environment
    if not environments:
        return NOBODY
    nodes = tuple(environments)
    arguments = ("phase_ns", str(phase_ns % plan.cycle_ns), *nodes)
    try:
        process = start_with_rclpy(environments[nodes[0]], ros_parameter.__file__, *arguments)
    except OperationError as error:
        return Telling(nodes, None, 0.0, str(error))
    return Telling(nodes, process, time.monotonic())


def moved_text(drift_ns: int) -> str:
    """What to know when nodes are told again."""
    return (
        f"the chain's beginning has moved by {format_duration(drift_ns)} since the plan was put in "
        "force; shaping nodes are told, and outputs without a stamp follow from the next cycle"
    )
