"""Plans and callback_isolated_executor: one's priorities in the file of the other, both ways.

callback_isolated_executor gives each callback group a thread, and has a YAML file with the
scheduling of each (:mod:`chainshaper.values.callback_groups`). A plan's priorities and cores can be
written as such a file, for who wants these without us running. And such a file tells what is in
force where a recording does not.
"""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from itertools import count

from chainshaper.enforcement.configured_threads import difference
from chainshaper.enforcement.node_threads import Allocation, NodeThread
from chainshaper.enforcement.thread_scheduling import WantedScheduling, plan_scheduling
from chainshaper.linux.scheduling import SchedulingRequest, available_cores
from chainshaper.linux.threads import POLICIES, RunningThread, ThreadRole
from chainshaper.planning.plan import Plan
from chainshaper.values.callback_groups import (
    CallbackGroup,
    GroupConfiguration,
    ThreadConfiguration,
    group_configuration_text,
)
from chainshaper.values.errors import OperationError
from chainshaper.values.recording import Recording, ThreadInfo

_THEIR_FILE = (
    "name the file that `thread_configurator_node --prerun` writes (--template), which has the ids"
)
_COMMENT = """\
The priorities and cores of a chainshaper plan, for callback_isolated_executor:
  ros2 run cie_thread_configurator thread_configurator_node --config-file THIS_FILE
Time slots and gates are not in it: those `chainshaper apply` puts in force."""


@dataclass(frozen=True)
class ExportedGroups:
    """A plan as a configuration of callback_isolated_executor."""

    configuration: GroupConfiguration
    notes: tuple[str, ...]  # what of the plan is not in it

    @property
    def text(self) -> str:
        return group_configuration_text(self.configuration, _COMMENT)


def export_callback_groups(
    plan: Plan, recording: Recording, template: GroupConfiguration | None = None
) -> ExportedGroups:
    """Return the priorities and cores of a plan, as its threads would get them, by callback group.

    The groups and their ids are those of the ``template``, whose further entries stay as they are;
    or, without, those of the ``recording``, in which the application ran on
    callback_isolated_executor.

    Raises OperationError: a thread of the plan has no callback group there, or its id is not
    certain.
    """
    gates = {node.thread.node for node in plan.shaping_nodes}
    planned = [
        thread
        for server in plan.servers
        for thread in server.threads
        if thread.node not in gates and thread.role == "executor"
    ]
    nodes = {thread.node for thread in planned}
    if template is not None:
        groups = [group for group, _ in template.groups]
    else:
        groups = _certain_groups(recording, nodes)
    callbacks_of = {
        node: tuple(name for thread in planned if thread.node == node for name in thread.callbacks)
        for node in nodes
    }
    for node in sorted(nodes - {group.node for group in groups}):
        where = "the template" if template is not None else str(recording.path)
        raise OperationError(
            f"{where} has no callback group of {node}, which the plan has in a server: its process"
            f" does not run callback_isolated_executor, or {_THEIR_FILE}"
        )
    numbers, pid_of = count(1), dict[str, int]()
    group_of = dict[int, CallbackGroup]()  # by the number that stands for its thread

    def stand_in(node: str, names: Iterable[str], role: ThreadRole = "executor") -> NodeThread:
        """Make a thread as if it ran, so that it gets what it would get then."""
        tid, pid = next(numbers), pid_of.setdefault(node, len(pid_of) + 1)
        thread = RunningThread(tid, pid, "", role, "SCHED_OTHER", 0, cores, tid)
        callbacks = tuple((node, name) for name in names)
        return NodeThread(thread, (node,), "recording", "recording", callbacks)

    cores = tuple(sorted({*available_cores(), *(server.core for server in plan.servers)}))
    threads = list[NodeThread]()
    for group in groups:
        names = callbacks_of.get(group.node, ()) if group.every else group.triggers
        threads.append(stand_in(group.node, names))
        group_of[threads[-1].thread.tid] = group
    for server in plan.servers:
        threads += [
            stand_in(thread.node, thread.callbacks, thread.role)
            for thread in server.threads
            if thread.node in gates or thread.role == "publisher"
        ]
    given, left = dict[CallbackGroup, WantedScheduling](), set[str]()
    for wanted in plan_scheduling(plan, Allocation(tuple(threads), ()), cores):
        number = wanted.node_thread.thread.tid
        if number in group_of:
            given[group_of[number]] = wanted
        elif wanted.server is not None:
            left.update(wanted.node_thread.nodes)
    notes = ["time slots are not in it, nor what DDS threads get: `chainshaper apply` does both"]
    if left:
        which = ", ".join(sorted(left))
        notes.append(
            f"not in it, since they have no callback group: shaping node, sender of {which}"
        )
    return ExportedGroups(_configuration(given, template), tuple(notes))


def _certain_groups(recording: Recording, nodes: Iterable[str]) -> list[CallbackGroup]:
    """Return the groups of a recording. Raises OperationError: a node's ids are not certain."""
    from chainshaper.analysis import recorded_flow  # slow to import
    from chainshaper.analysis.callback_groups import recorded_groups

    groups = recorded_groups(recorded_flow(recording))
    wanted = set(nodes)
    unsure = sorted({known.group.node for known in groups if not known.certain} & wanted)
    if unsure:
        raise OperationError(
            f"{recording.path} does not show for sure which callback groups {', '.join(unsure)}"
            " has: services, clients or callbacks that never ran may be in any; record for longer,"
            f" or {_THEIR_FILE}"
        )
    return list(dict.fromkeys(known.group for known in groups if known.certain))


def _configuration(
    given: dict[CallbackGroup, WantedScheduling], template: GroupConfiguration | None
) -> GroupConfiguration:
    """Return the configuration that gives groups their scheduling, in a template's other words."""
    if template is None:
        entries = [_entry(group, wanted.scheduling) for group, wanted in given.items()]
        return GroupConfiguration(callback_groups=tuple(entries), non_ros_threads=())
    by_key = {group.key: wanted.scheduling for group, wanted in given.items()}
    of_template = {id(entry): group for group, entry in template.groups}
    kept = list[ThreadConfiguration]()
    for entry in template.callback_groups or ():
        group = of_template[id(entry)]
        if (wanted := by_key.get(group.key)) is None:
            kept.append(entry)
            continue
        domain = {} if entry.domain_id is None else {"domain_id": entry.domain_id}
        kept.append(_entry(group, wanted, entry.id, domain))
    return template.model_copy(update={"callback_groups": tuple(kept)})


def _entry(
    group: CallbackGroup,
    wanted: SchedulingRequest,
    written: str | None = None,
    more: dict[str, int] | None = None,
) -> ThreadConfiguration:
    """Return what a group's thread gets, under the id as it is ``written`` (default: ours)."""
    values = {"id": written or group.id, **(more or {}), "affinity": tuple(wanted.cores or ())}
    values |= {"policy": POLICIES[wanted.policy], "priority": wanted.priority or 0}
    if not wanted.priority:
        values["nice"] = 0  # newer versions read it in place of the priority
    return ThreadConfiguration.model_validate(values)


def with_callback_groups(
    recording: Recording, configuration: GroupConfiguration
) -> tuple[Recording, tuple[str, ...]]:
    """Return a recording whose threads have what a configuration gives them; and notes.

    What the kernel showed while the application ran counts before it, and notes name where the two
    differ. Of groups that stand in the file, but in no thread of the recording, a note says so.
    """
    from chainshaper.analysis import executors, recorded_flow  # slow to import

    known = {(thread.pid, thread.tid): thread for thread in recording.info.threads}
    groups, notes = dict[CallbackGroup, bool](), list[str]()
    for executor in executors(recorded_flow(recording)):
        pair = configuration.of_thread(executor.names)
        if pair is None:
            continue
        group, entry = pair
        groups[group] = True
        for tid in executor.threads:
            at = executor.pid, tid
            if at in known:
                if differs := difference(entry, known[at]):
                    notes.append(f"{group.id}, thread {tid}: {differs}; what it had is taken")
                continue
            known[at] = ThreadInfo(
                tid=tid,
                pid=executor.pid,
                comm="",
                node=group.node,
                role="executor",
                policy=entry.policy,
                priority=entry.real_time_priority,
                cores=tuple(entry.affinity or ()),
            )
    missing = [
        group.id for group, _ in configuration.groups if group not in groups and group.triggers
    ]
    if missing:
        notes.append(f"no thread of the recording is known to run {', '.join(missing)}")
    info = recording.info.model_copy(update={"threads": tuple(known.values())})
    return replace(recording, info=info), tuple(notes)
