"""What a launch file starts, asked of ROS 2 itself; run by the Python of a ROS 2 environment.

Standard input holds a JSON array of jobs: a launch `file`, its `arguments`, names of `topics`. The
file is carried out by `launch`, except that no process is started: the command line that each node
would get is noted instead. A node is then made of it by `rclpy`, and asked what the topics are
called. Nodes that nobody named are called like their executables. For each job a JSON array is
printed, with pairs of a node's full name and its names of the topics; or the text of an error.
"""

import asyncio
import json
import sys
from typing import Any

import rclpy
from launch import LaunchContext
from launch.actions import IncludeLaunchDescription, RegisterEventHandler, TimerAction
from launch.actions.execute_local import ExecuteLocal
from launch.descriptions import Executable
from launch.launch_description_sources import AnyLaunchDescriptionSource
from launch_ros.actions import LifecycleNode, LoadComposableNodes, Node
from launch_ros.actions import load_composable_nodes as loading
from launch_ros.substitutions import ExecutableInPackage

UNTOUCHED = Executable.prepare, loading.get_composable_node_load_request
started: list[tuple[str, list[str]]] = []


def note_process(action: ExecuteLocal, context: LaunchContext) -> None:
    """In place of starting a process."""
    action.prepare(context)
    words = action.process_details["cmd"]
    if any("chainshaper_" in word for word in words) and not action._ExecuteLocal__respawn:
        raise RuntimeError(f"{words} is not started again when it ends")
    if "--ros-args" in words:
        started.append((words[0].rpartition("/")[2], words))


def note_components(action: LoadComposableNodes, context: LaunchContext) -> None:
    """In place of asking a container, which hands on rules, name and namespace in this order."""
    for description in action._LoadComposableNodes__composable_node_descriptions:
        request = loading.get_composable_node_load_request(description, context)
        if request is not None:
            rules = list(request.remap_rules)
            rules += [f"__node:={request.node_name}"] if request.node_name else []
            rules += [f"__ns:={request.node_namespace}"] if request.node_namespace else []
            words = [word for rule in rules for word in ("-r", rule)]
            started.append((request.plugin_name.rpartition(":")[2], ["--ros-args", *words]))


def carry_out(entity: Any, context: LaunchContext) -> None:
    """Visit entities in order, as the launch service does, without waiting for events."""
    for inner in entity.visit(context) or ():
        carry_out(inner, context)


def nodes_of(file: str, arguments: dict[str, str], topics: list[str]) -> list[Any]:
    """The nodes that a launch file starts, and what they call the topics."""
    Executable.prepare, loading.get_composable_node_load_request = UNTOUCHED
    started.clear()
    context = LaunchContext()
    context.extend_globals({"chainshaper_dry_run": True})  # nothing is looked after
    context._set_asyncio_loop(asyncio.new_event_loop())
    source = AnyLaunchDescriptionSource(file)
    carry_out(IncludeLaunchDescription(source, launch_arguments=arguments.items()), context)
    found = []
    for name, words in started:
        node = rclpy.create_node(name, cli_args=words, use_global_arguments=False)
        names = {topic: node.resolve_topic_name(topic) for topic in topics}
        found.append((node.get_fully_qualified_name(), names))
        node.destroy_node()
    return found


def main() -> None:
    ExecuteLocal.execute = note_process
    ExecutableInPackage.perform = lambda one, context: context.perform_substitution(
        one.executable[0]
    )
    LifecycleNode.execute = Node.execute
    LoadComposableNodes.execute = note_components
    TimerAction.execute = lambda action, _: action.actions
    RegisterEventHandler.execute = lambda action, _: action.event_handler.describe()[1]
    rclpy.init()
    results: list[Any] = []
    for job in json.load(sys.stdin):
        try:
            results.append(nodes_of(**job))
        except Exception as error:
            results.append(str(error))
    rclpy.shutdown()
    json.dump(results, sys.stdout)


if __name__ == "__main__":
    main()
