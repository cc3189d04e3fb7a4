"""/source → /t1 → /managed, a lifecycle node that is made active → /t2 → /sink.

`ROLE` names the program, `DOES` what the nodes print into.
"""

import os

from launch import LaunchDescription
from launch.actions import EmitEvent, RegisterEventHandler
from launch.events import matches_action
from launch_ros.actions import LifecycleNode, Node
from launch_ros.event_handlers import OnStateTransition
from launch_ros.events.lifecycle import ChangeState
from lifecycle_msgs.msg import Transition


def generate_launch_description() -> LaunchDescription:
    role = os.environ["ROLE"]
    managed = LifecycleNode(
        executable=role, arguments=["managed"], name="managed", namespace="", output="screen"
    )

    def change(transition: int) -> EmitEvent:
        event = ChangeState(
            lifecycle_node_matcher=matches_action(managed), transition_id=transition
        )
        return EmitEvent(event=event)

    activate = OnStateTransition(
        target_lifecycle_node=managed,
        goal_state="inactive",
        start_state="configuring",
        entities=[change(Transition.TRANSITION_ACTIVATE)],
    )
    period = os.environ.get("PERIOD", "50")
    return LaunchDescription(
        [
            Node(executable=role, arguments=["source", period], name="source", output="screen"),
            Node(executable=role, arguments=["sink"], name="sink", output="screen"),
            managed,
            RegisterEventHandler(activate),
            change(Transition.TRANSITION_CONFIGURE),
        ]
    )
