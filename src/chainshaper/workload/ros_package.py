"""A described application as a colcon package of C++ nodes, for the ROS 2 that a robot runs.

One program is every node: the launch file starts it once for each, with the node's name; the
description stands in it as a table (``src/application.hpp``). Messages are
``sensor_msgs/CompressedImage``, a header with the stamp that callbacks pass on, and bytes. An
execution time is drawn as :mod:`chainshaper.workload.execution` draws it, from another generator:
the distribution is the same, the sequence is not.
"""

import os
import re
from pathlib import Path
from typing import Any

from chainshaper.values.errors import InputError, OperationError, escape
from chainshaper.values.files import (
    folder_beside,
    free_place,
    open_to_all,
    rename_output,
    write_whole,
)
from chainshaper.workload.description import (
    Application,
    CallbackDescription,
    ExecutionTime,
    NodeDescription,
    node_name,
)

_TEMPLATES = Path(__file__).parent / "ros_nodes"
_NAME = re.compile(r"[a-z](_?[a-z0-9])+")  # REP 144
_TAKEN = ("launch_ros", "message_filters", "rclcpp", "sensor_msgs", "std_msgs", "test")
_LEAD_NS = 3_000_000_000
_PROFILES = """<dds xmlns="http://www.eprosima.com/XMLSchemas/fastRTPS_Profiles"><profiles>
{}</profiles></dds>
"""
_PROFILE = """  <data_writer profile_name="{}">
    <qos><publishMode><kind>ASYNCHRONOUS</kind></publishMode></qos>
    <historyMemoryPolicy>PREALLOCATED_WITH_REALLOC</historyMemoryPolicy>
  </data_writer>
"""
"""Of a topic's publisher; what it does not name stays as Fast DDS has it for this topic."""


def generate_package(application: Application, folder: str | Path) -> list[Path]:
    """Write a colcon package with the application's nodes; its files.

    The folder's name is the package's. ``colcon build`` builds it and ``ros2 launch NAME
    NAME.launch.py`` starts it (Humble and later).

    Raises InputError: the folder exists already, its name is no package's, or a callback does what
    only the live workload can. OperationError: it cannot be written; nothing is left behind.
    """
    folder = Path(folder).absolute()
    free_place(folder, os.path.lexists(folder))
    if not _NAME.fullmatch(folder.name) or folder.name in _TAKEN:
        remedy = "end the path in small letters, digits and single underscores, beginning with a"
        remedy += " letter, such as src/my_robot"
        raise InputError(f"{folder.name!r} cannot be the name of a package: {remedy}")
    files = _files(application, folder.name)  # what is refused is refused before writing
    try:
        with folder_beside(folder) as partial:
            for name, text in files.items():
                path = Path(partial, name)
                path.parent.mkdir(exist_ok=True)
                write_whole(path, [text.encode()])
            open_to_all(Path(partial))
            rename_output(Path(partial), folder)
    except OSError as error:
        raise OperationError(f"{folder}: cannot be written: {error.strerror}") from error
    return [folder / name for name in files]


def _files(application: Application, package: str) -> dict[str, str]:
    """Paths in the package, and their text."""
    for name, node in application.nodes.items():
        for number, callback in enumerate(node.callbacks):
            _refuse(application, f"{name}: callback {number}", callback)
    publishers = {
        (name, topic)
        for name, callback in application.callbacks()
        for topic in callback.publishes
        if application.topic(topic).publication == "asynchronous"
    }
    values = {
        "PACKAGE": package,
        "DESCRIPTION": escape(" ".join(application.name.split())),
        "APPLICATION": ",\n".join(_node(application, name) for name in application.nodes),
        "LEAD_NS": str(_LEAD_NS + max(cb.timer_ns or 0 for _, cb in application.callbacks())),
        "NODES": repr([node_name(name) for name in application.nodes]),
        "ASYNCHRONOUS": repr(sorted({node_name(name) for name, _ in publishers})),
        "SEED": str(application.seed),
    }
    files = {}
    for path in sorted(_TEMPLATES.rglob("*.*")):
        name = str(path.relative_to(_TEMPLATES)).removesuffix(".in")
        text = path.read_text(encoding="utf-8")
        if path.suffix == ".in":
            text = re.sub("@([A-Z_]+)@", lambda found: values[found[1]], text)
        files[f"launch/{package}.launch.py" if name == "launch.py" else name] = text
    if topics := sorted({topic for _, topic in publishers}):
        profiles = "".join(map(_PROFILE.format, topics))
        files["launch/asynchronous.xml"] = _PROFILES.format(profiles)
    return files


def _refuse(application: Application, place: str, callback: CallbackDescription) -> None:
    """InputError: the callback does what a generated node does not."""
    announced = application.announced()
    refusals = {
        "gate": callback.gate is not None
        and "a gate of its own; remove it, and let `chainshaper shape` or `splice` put a shaping "
        "node behind the output",
        "computes": callback.computes is not None
        and "a function in Python, which no node in C++ calls; describe its `execution` instead, "
        "such as the `samples` of a recording",
        "kind": callback.kind != "subscription"
        and f"a {callback.kind}'s messages on a topic, which ROS 2 has not; remove `kind`",
        "subscription": not announced.isdisjoint(callback.inputs)
        and "names of modes, which carry no stamp to pass on; subscribe to another topic",
        "publishes": not callback.announces
        and not announced.isdisjoint(callback.publishes)
        and "data on a topic on which modes are announced; publish on another topic",
    }
    for field, reason in refusals.items():
        if reason:
            raise InputError(f"{place}: `{field}` cannot be generated for ROS 2: it is {reason}")


# The table in C++


def _node(application: Application, name: str) -> str:
    node, own = application.nodes[name], application.scheduling_of(name)
    both = [_list([one.core, one.priority]) for one in (own, application.dds_scheduling_of(name))]
    about = ", ".join([_text(node_name(name)), *both, _list(application.cores_of(name))])
    callbacks = ",\n    ".join(_callback(application, node, one) for one in node.callbacks)
    return f"  {{{about}, {{\n    {callbacks}}}}}"


def _callback(
    application: Application, node: NodeDescription, callback: CallbackDescription
) -> str:
    inputs, outputs = (
        _list(_topic(application, topic) for topic in topics)
        for topics in (callback.inputs, callback.publishes)
    )
    trigger = -1
    if callback.triggered_by is not None:
        trigger = callback.synchronises.index(callback.triggered_by)
    starts = (callback.timer_ns or 0, callback.phase_ns, inputs, trigger)
    times = (_execution(callback.execution), _execution(callback.afterwards))
    alone = "true" if callback.group and not node.exclusive_group(callback) else "false"
    group = _text(callback.group or "")
    announces = _list(map(_text, callback.announces))
    return _list([*starts, *times, outputs, announces, group, alone])


def _topic(application: Application, name: str) -> str:
    own = application.topic(name)
    reliable = "true" if own.reliability == "reliable" else "false"
    return _list([_text(name), own.depth, reliable, own.lifespan_ns or 0, own.payload])


def _execution(own: ExecutionTime | None) -> str:
    if own is None:
        return "{Distribution::constant, {}, 1}"
    distributions = {
        "constant": None if own.constant_ns is None else (own.constant_ns,),
        "uniform": own.uniform_ns,
        "normal": own.normal_ns and (*own.normal_ns, *(own.within_ns or ())),
        "samples": own.samples_ns,
        "sequence": own.sequence_ns,
    }
    kind, values = next((kind, many) for kind, many in distributions.items() if many is not None)
    return _list([f"Distribution::{kind}", _list(values), own.block])


def _list(values: Any) -> str:
    return f"{{{', '.join(map(str, values))}}}"


def _text(text: str) -> str:
    """A string literal; what could end it, or mean something in it, is written in octal."""
    plain = re.compile(rb"[^A-Za-z0-9/_ -]").sub(
        lambda found: b"\\%03o" % ord(found[0]), text.encode()
    )
    return f'"{plain.decode()}"'
