"""Write what starts a described application as `rclpy` nodes, each in a process of its own.

All nodes are the same program (:mod:`.described_node`), which reads its own part of the description
from a file. Messages are ``sensor_msgs/CompressedImage``, as those of generated nodes in C++.
Execution times are those of the live workload and of the simulator, one by one.
"""

import json
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from chainshaper.values.errors import InputError, OperationError
from chainshaper.values.files import write_whole
from chainshaper.workload.description import (
    Application,
    CallbackDescription,
    ExecutionTime,
    node_name,
)
from chainshaper.workload.execution import FIRST_AFTER, blocks

_PROGRAM = Path(__file__).with_name("described_node.py")
_START = """\
#!/bin/bash
# Starts the nodes, each in a process of its own, and ends all of them when one ends.
exec > {said} 2>&1
{exports}
# Not by SIGINT, which a script's jobs ignore until rclpy listens to signals; and rclpy misses some.
end_all() {{ trap '' INT TERM; while kill -TERM $(jobs -pr) 2> /dev/null; do sleep 0.5; done; }}
trap 'end_all; exit 0' INT TERM
{nodes}
wait -n
code=$?
end_all
exit $((code ? code : 1))
"""


@dataclass(frozen=True)
class WrittenNodes:
    """What starts an application.

    * ``command``: ends all nodes when one ends, or by SIGINT.
    * ``ready``: the file of each node that appears when it is ready.
    * ``said``: the file of what they print.
    """

    command: tuple[str, ...]
    ready: tuple[Path, ...]
    said: Path


def write_rclpy_nodes(
    application: Application,
    folder: Path,
    *,
    realtime: bool,
    remaps: Mapping[str, Mapping[str, str]] | None = None,
    beside: Sequence[Sequence[str]] = (),
    environment: Mapping[str, str] | None = None,
) -> WrittenNodes:
    """Write an application's nodes, and a script that starts them, into an existing folder.

    With ``realtime`` threads get the described cores and SCHED_FIFO priorities. ``remaps`` are
    topics that a node, by its full name, finds elsewhere. ``beside`` are commands of further
    processes; all get the ``environment``, whose libraries are loaded before others.

    Raises InputError: the application does what these nodes do not. OperationError: a file cannot
    be written.
    """
    for name in application.nodes:
        _refuse(application, name)
    commands, ready = [], list[Path]()
    try:
        for number, name in enumerate(application.nodes):
            ready.append(folder / f"{number}.ready")
            file = folder / f"{number}.json"
            described = _described(application, name, realtime) | {"ready": str(ready[-1])}
            write_whole(file, [json.dumps(described).encode()])
            renamed = {} if remaps is None else remaps.get(node_name(name), {})
            commands.append(_node_command(file, node_name(name), renamed))
        script, said = folder / "start", folder / "said"
        text = _script([*commands, *beside], environment or {}, said)
        write_whole(script, [text.encode()])
    except OSError as error:
        raise OperationError(f"{error.filename}: cannot be written: {error.strerror}") from error
    return WrittenNodes(("bash", str(script)), tuple(ready), said)


def _node_command(file: Path, name: str, renamed: Mapping[str, str]) -> list[str]:
    """Return the command of a node, by its full name, with the topics that it finds elsewhere."""
    namespace, _, base = name.rpartition("/")
    rules = {"__node": base, "__ns": namespace or "/", **renamed}
    remaps = [word for match, target in rules.items() for word in ("-r", f"{match}:={target}")]
    return ["python3", str(_PROGRAM), str(file), "--ros-args", *remaps]


def _script(commands: Sequence[Sequence[str]], environment: Mapping[str, str], said: Path) -> str:
    exports = []
    for variable, value in environment.items():
        text = shlex.quote(value)
        if variable == "LD_PRELOAD":  # in front of a tracer's
            text += '"${LD_PRELOAD:+:$LD_PRELOAD}"'
        exports.append(f"export {variable}={text}")
    started = [f"{shlex.join(command)} &" for command in commands]
    return _START.format(
        said=shlex.quote(str(said)), exports="\n".join(exports), nodes="\n".join(started)
    )


def _described(application: Application, name: str, realtime: bool) -> dict[str, Any]:
    """Return what the program reads of a node."""
    node = application.nodes[name]
    topics = {topic for callback in node.callbacks for topic in callback.publishes}
    topics.update(topic for callback in node.callbacks for topic in callback.subscriptions)
    scheduling = None
    if realtime:
        threads = {
            "executor": application.scheduling_of(name),
            "dds": application.dds_scheduling_of(name),
            "loop": application.loop_scheduling_of(name),
        }
        scheduling = {
            which: wanted.model_dump() for which, wanted in threads.items() if wanted is not None
        }
    return {
        "callbacks": [
            _callback(application, name, number) for number in range(len(node.callbacks))
        ],
        "topics": {topic: _topic(application, topic) for topic in sorted(topics)},
        "scheduling": scheduling,
    }


def _callback(application: Application, name: str, number: int) -> dict[str, Any]:
    callback = application.nodes[name].callbacks[number]

    def drawn(times: ExecutionTime | None, index: int) -> list[int]:
        """Return execution times, which are gone through again and again."""
        if times is None:
            return [0]
        if times.constant_ns is not None:
            return [times.constant_ns]
        if times.sequence_ns is not None:
            return [*times.sequence_ns]
        first = next(blocks(times, application.seed, node_name(name), index))
        return [*map(int, first)]

    return {
        "timer_ns": callback.timer_ns,
        "loop_ns": callback.loop_ns,
        "reads": callback.reads,
        "phase_ns": callback.phase_ns,
        "subscription": callback.subscription,
        "execution_ns": drawn(callback.execution, number),
        "afterwards_ns": drawn(callback.afterwards, FIRST_AFTER + number),
        "publishes": callback.publishes,
    }


def _topic(application: Application, topic: str) -> dict[str, Any]:
    described = application.topic(topic)
    return {
        "depth": described.depth,
        "reliability": described.reliability,
        "lifespan_ns": described.lifespan_ns,
        "payload": described.payload,
        "is_taken": any(topic in callback.subscriptions for _, callback in application.callbacks()),
    }


def _refuse(application: Application, name: str) -> None:
    """Raise InputError if a node does what these nodes do not."""
    node = application.nodes[name]
    if node.threads > 1:
        raise _refusal(f"{name}: `executor`", "of several threads")
    for number, callback in enumerate(node.callbacks):
        for field, reason in _reasons(application, callback).items():
            if reason is not None:
                raise _refusal(f"{name}: callback {number}: `{field}`", reason)


def _reasons(application: Application, callback: CallbackDescription) -> dict[str, str | None]:
    """Return why fields of a callback are refused; None: they are not."""
    asynchronous = [
        topic
        for topic in callback.publishes
        if application.topic(topic).publication == "asynchronous"
    ]
    return {
        "gate": None if callback.gate is None else "a gate of its own",
        "computes": None if callback.computes is None else "a function that they do not call",
        "control": "a part in a control loop" if callback.control is not None else None,
        "kind": None if callback.kind == "subscription" else f"of a {callback.kind}",
        "synchronises": "a set of messages" if callback.synchronises else None,
        "announces": "names of modes" if callback.announces else None,
        "publishes": f"asynchronous on {asynchronous[0]}" if asynchronous else None,
    }


def _refusal(field: str, reason: str) -> InputError:
    return InputError(
        f"{field} is {reason}, which nodes in rclpy do not have here: describe a callback with one"
        " subscription or timer, or write nodes in C++ (`chainshaper generate`)"
    )
