"""Write a described application as a colcon package of C++ nodes, for the ROS 2 of a robot.

All nodes are the same program, which has the description as a table (``src/application.hpp``). The
launch file starts it once for each node, with the node's name. Messages are
``sensor_msgs/CompressedImage``: a header with the stamp that callbacks pass on, and bytes.
Execution times have the distribution of :mod:`chainshaper.workload.execution`, but another random
generator draws them, so their sequence is another.
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
from chainshaper.values.licence import package_values, with_licence
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
"""The profile of a topic's publisher. What it does not name is as Fast DDS has it by default."""


def generate_package(application: Application, folder: str | Path) -> list[Path]:
    """Write a colcon package with the application's nodes; return its files.

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
    """Return the files of the package: their texts, by their paths."""
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
        **package_values(),
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
            text = re.sub("@([A-Z_]+)@", lambda placeholder: values[placeholder[1]], text)
        files[f"launch/{package}.launch.py" if name == "launch.py" else name] = text
    if topics := sorted({topic for _, topic in publishers}):
        profiles = "".join(map(_PROFILE.format, topics))
        files["launch/asynchronous.xml"] = _PROFILES.format(profiles)
    return with_licence(files)


def _refuse(application: Application, place: str, callback: CallbackDescription) -> None:
    """Raise InputError if the callback does what a generated node cannot."""
    announced = application.announced()
    refusals = {
        "gate": callback.gate is not None
        and "a gate of its own; remove it, and let `chainshaper shape` or `splice` put a shaping "
        "node behind the output",
        "computes": callback.computes is not None
        and "a function in Python, which no node in C++ calls; describe its `execution` instead, "
        "such as the `samples` of a recording",
        "control": callback.control is not None
        and "a part in a control loop, which live runs have only; remove it",
        "loop": callback.loop_ns is not None
        and "a thread of its own, which generated nodes have not; describe a `timer` instead",
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
    node = application.nodes[name]
    executor, dds = application.scheduling_of(name), application.dds_scheduling_of(name)
    fields = [
        _text(node_name(name)),
        _list([executor.core, executor.priority]),
        _list([dds.core, dds.priority]),
        _list(application.cores_of(name)),
    ]
    callbacks = [_callback(application, node, callback) for callback in node.callbacks]
    listed = ",\n    ".join(callbacks)
    return f"  {{{', '.join(fields)}, {{\n    {listed}}}}}"


def _callback(
    application: Application, node: NodeDescription, callback: CallbackDescription
) -> str:
    trigger = -1
    if callback.triggered_by is not None:
        trigger = callback.synchronises.index(callback.triggered_by)
    is_reentrant = bool(callback.group) and not node.exclusive_group(callback)
    return _list(
        [
            callback.timer_ns or 0,
            callback.phase_ns,
            _list(_topic(application, topic) for topic in callback.inputs),
            trigger,
            _execution(callback.execution),
            _execution(callback.afterwards),
            _list(_topic(application, topic) for topic in callback.publishes),
            _list(map(_text, callback.announces)),
            _text(callback.group or ""),
            "true" if is_reentrant else "false",
        ]
    )


def _topic(application: Application, name: str) -> str:
    described = application.topic(name)
    is_reliable = "true" if described.reliability == "reliable" else "false"
    lifespan_ns = described.lifespan_ns or 0
    return _list([_text(name), described.depth, is_reliable, lifespan_ns, described.payload])


def _execution(time: ExecutionTime | None) -> str:
    if time is None:
        return "{Distribution::constant, {}, 1}"
    distributions = {
        "constant": None if time.constant_ns is None else (time.constant_ns,),
        "uniform": time.uniform_ns,
        "normal": time.normal_ns and (*time.normal_ns, *(time.within_ns or ())),
        "samples": time.samples_ns,
        "sequence": time.sequence_ns,
    }
    kind, values = next(
        (kind, values) for kind, values in distributions.items() if values is not None
    )
    return _list([f"Distribution::{kind}", _list(values), time.block])


def _list(values: Any) -> str:
    """Return values as a braced list of C++."""
    return f"{{{', '.join(map(str, values))}}}"


def _text(text: str) -> str:
    """Return a text as a string literal of C++; what could have a meaning there is octal."""
    plain = re.compile(rb"[^A-Za-z0-9/_ -]").sub(
        lambda character: b"\\%03o" % ord(character[0]), text.encode()
    )
    return f'"{plain.decode()}"'
