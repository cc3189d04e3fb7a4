"""What has to be so before a plan is carried out: by its back end, and by the running application.

Slots count from stamps in our clock; publishers that the plan gates have to publish by threads of
their own, as their processes' settings say.
"""

import os
import re
from collections.abc import Iterable, Iterator
from contextlib import suppress
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING
from xml.etree import ElementTree

from chainshaper.enforcement.back_ends import gates
from chainshaper.enforcement.node_threads import Allocation
from chainshaper.linux.threads import of_another_clock, read_proc
from chainshaper.planning.chain_plan import publisher_servers, shaping_nodes
from chainshaper.planning.overruns import Writer, check_publication
from chainshaper.planning.plan import Plan
from chainshaper.planning.request import simulated_stamps
from chainshaper.values.errors import InputError, OperationError, PlatformError, text_of
from chainshaper.values.files import read_regular
from chainshaper.values.middleware import FAST_DDS_PUBLICATION

if TYPE_CHECKING:
    from chainshaper.values.recording import Recording  # slow to import

_LONGEST_SETTINGS = 1 << 20  # of a file of a node's parameters or profiles (bytes)


def refuse_several_hosts(plan: Plan) -> None:
    """Refuse to put a plan in force whose chain goes over several hosts. Raises InputError."""
    for chain in plan.chains:
        if chain.evidence.hosts:
            raise InputError(
                f"{chain.chain.spec} goes over {', '.join(chain.evidence.hosts)}: its slots count"
                " from when a node of another computer began, by that one's clock, which nothing"
                " follows yet. Plan the part of the chain that runs on this computer, from its"
                " recording"
            )


def refuse_unfit(plan: Plan, back_end: str) -> None:
    """Refuse a back end that cannot carry out all of the plan. Raises InputError."""
    if not gates(back_end) and any(chain.offset_ns for chain in plan.chains):
        raise InputError(
            f"the back end {back_end} sets priorities only, and chains whose cycles start at"
            " offsets have to be stopped until then: choose freezer or scx"
        )
    if not gates(back_end) and any(chain.slot_ends == "closed" for chain in plan.chains):
        raise InputError(
            f"the back end {back_end} sets priorities only, and the plan's servers close at their"
            " slots' ends (slot_ends: closed): choose freezer, scx or litmus (--backend freezer)"
        )
    if plan.takes_turns and back_end == "scx":
        raise InputError(
            "equal_priorities: round-robin, but under the back end scx servers of one priority run"
            " in the plan's order: choose another (--backend freezer)"
        )


def refuse_simulated(plan: Plan, allocation: Allocation) -> None:
    """Refuse slots that count from stamps of nodes whose commands have them follow `/clock`.

    Raises InputError.
    """
    stamped = [chain for chain in plan.chains if chain.anchor == "stamp" and shaping_nodes(chain)]
    servers = [server for chain in stamped for server in chain.servers]
    nodes = {thread.node for server in servers for thread in server.threads}
    for node, pid in _processes_of(nodes, allocation):
        if _follows_clock(pid):
            raise InputError(simulated_stamps(node))


def refuse_other_clocks(plan: Plan, allocation: Allocation) -> None:
    """Refuse shaping nodes with another clock, since they get their slots in ours.

    Raises PlatformError.
    """
    shaping = {node.thread.node for node in plan.shaping_nodes}
    for node, pid in _processes_of(shaping, allocation):
        if of_another_clock(pid):
            raise PlatformError(
                f"the shaping node {node} (process {pid}) has another clock than we, that of a"
                f" time namespace: apply the plan in there (`nsenter --time --target {pid} …`)"
            )


def _processes_of(nodes: set[str], allocation: Allocation) -> Iterator[tuple[str, int]]:
    """Yield those of the nodes whose threads were recognised, and the process of each thread."""
    for allocated in allocation.threads:
        for node in nodes.intersection(allocated.nodes):
            yield node, allocated.thread.pid


def _follows_clock(pid: int) -> bool:
    """Return whether a process's command, or a file of parameters there, sets `use_sim_time`."""
    words = os.fsdecode(read_proc(f"/proc/{pid}/cmdline")).split("\0")
    texts = [word for word in words if word.startswith("use_sim_time")]
    for option, file in pairwise(words):
        if option == "--params-file":  # as `ros2 launch` writes one for each node
            with suppress(OSError):
                texts.append(
                    text_of(read_regular(Path(f"/proc/{pid}/cwd", file), _LONGEST_SETTINGS))
                )
    return any(re.search(r"\buse_sim_time\W+true\b", text, re.IGNORECASE) for text in texts)


def check_publishers(
    plan: Plan, allocation: Allocation, recordings: Iterable["Recording"] = ()
) -> list[str]:
    """Return what a person must know where a plan gates publishers' threads (design 1).

    Recordings know the writers; the processes' settings say whether threads publish for them.
    Raises InputError: as :func:`.check_publication`.
    """
    gating = [chain for chain in plan.chains if any(publisher_servers(chain))]
    endpoints = dict.fromkeys(
        endpoint for recording in recordings for endpoint in recording.info.endpoints
    )
    if not gating or not endpoints:
        return []
    pid_of = {node: listed.thread.pid for listed in allocation.threads for node in listed.nodes}
    modes = {pid: _asynchronous_topics(pid) for pid in set(pid_of.values())}
    writers = list[Writer]()
    for endpoint in endpoints:
        pid = pid_of.get(endpoint.node)
        if endpoint.kind == "publisher" and pid is not None:
            is_asynchronous = modes[pid].get(endpoint.topic, modes[pid].get(""))
            writers.append(
                Writer(endpoint.node, endpoint.topic, endpoint.depth, is_asynchronous, pid)
            )
    return [
        note
        for chain in gating
        if any(writer.node == chain.chain.publisher for writer in writers)
        for note in check_publication(chain, writers)
    ]


def _asynchronous_topics(pid: int) -> dict[str, bool]:
    """Return topic → whether a process publishes it asynchronously, by its middleware's settings.

    "" stands for all other topics.
    """
    from chainshaper.sources.ros import environment_of  # slow to import; few plans need it

    try:
        variables = environment_of(pid).variables
    except OperationError:
        return {}
    settings = FAST_DDS_PUBLICATION
    mode = variables.get(settings.mode)
    if mode != "AUTO" and variables.get(settings.prefer_profiles) != "1":
        return {"": mode == "ASYNCHRONOUS"} if mode in ("ASYNCHRONOUS", "SYNCHRONOUS") else {}
    files = [variables.get(variable) for variable in settings.profile_variables]
    modes: dict[str, bool] = {}
    for name in (*files, *settings.profile_files):
        with suppress(OSError, ElementTree.ParseError):
            content = read_regular(Path(f"/proc/{pid}/cwd", name or ""), _LONGEST_SETTINGS)
            root = ElementTree.fromstring(content)  # noqa: S314 - expat bounds entities
            for element in root.iter():
                if element.tag.rpartition("}")[2] in ("data_writer", "publisher"):
                    kind = element.findtext(".//{*}publishMode/{*}kind", "").strip()
                    modes.setdefault(element.get("profile_name", ""), kind == "ASYNCHRONOUS")
                    if element.get("is_default_profile") == "true":
                        modes[""] = kind == "ASYNCHRONOUS"
            modes.setdefault("", False)
    return modes
