"""Telling shaping nodes in ROS 2 where a cycle begins.

Outputs without a stamp (a `geometry_msgs/Twist`, say) are held to the cycle, whose beginning no
message tells. It is measured when a plan is put in force, and told to the node as a parameter.
"""

from chainshaper.dry_run import shaping_nodes
from chainshaper.enforcement.threads.allocation import Allocation
from chainshaper.planning import Plan
from chainshaper.sources.ros import parameter as ros_parameter
from chainshaper.sources.ros.interpreter import environment_of, run_with_rclpy

__all__ = ["tell_phase"]

_PATIENCE_S = 20


def tell_phase(plan: Plan, found: Allocation, phase_ns: int) -> tuple[str, ...]:
    """Set ``phase_ns`` of a plan's shaping nodes as far as they are ROS 2's; what went wrong.

    ``phase_ns`` is where the chain begins in every cycle, on CLOCK_MONOTONIC.
    """
    notes = []
    for node in (one.thread.node for one in shaping_nodes(plan)):
        pid = next((one.thread.pid for one in found.threads if node in one.nodes), None)
        environment = environment_of(pid) if pid is not None else {}
        if "AMENT_PREFIX_PATH" not in environment:
            continue  # the live workload's
        value = str(phase_ns % plan.cycle_ns)
        arguments = (ros_parameter.__file__, node, "phase_ns", value)
        _, problem = run_with_rclpy(environment, *arguments, within_s=_PATIENCE_S)
        if problem is not None:
            notes.append(
                f"{node} could not be told where cycles begin ({problem}): outputs without a stamp "
                "of their chain's beginning will not be in time"
            )
    return tuple(notes)
