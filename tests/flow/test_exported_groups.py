"""Plans as configurations of callback_isolated_executor, and these as what is in force."""

from pathlib import Path

import pytest
import yaml
from bare_plans import MS, bare_plan
from story import OFFSET, Story

from chainshaper import export_callback_groups, load_plan, save_plan, with_callback_groups
from chainshaper.enforcement.thread_scheduling import server_priorities
from chainshaper.planning.chain_plan import Server, Thread
from chainshaper.planning.plan import Plan
from chainshaper.values.callback_groups import (
    ANNOUNCEMENTS,
    GroupConfiguration,
    read_group_configuration,
)
from chainshaper.values.errors import InputError, OperationError
from chainshaper.values.recording import Recording, RecordingInfo, ThreadInfo, write_recording

CYCLE_NS = 100 * MS
SOURCE = "/source@Timer(100000000)"
FILTER = "/filter@Subscription(/points)"
BESIDE = "/filter@Timer(20000000)"


def _recording(folder: Path, *threads: ThreadInfo, services: bool = False) -> Recording:
    """/source publishes for /filter, which has a timer beside: three threads of one process."""
    story = Story()
    story.publisher(story.node("/cie_thread_configurator/client_node_1", 1), ANNOUNCEMENTS)
    source, node = story.node("/source", 1), story.node("/filter", 1)
    if services:
        story.service(node, "/reset")
    timer, reader = story.timer(source, CYCLE_NS), story.subscription(node, "/points")
    beside, points = story.timer(node, 20 * MS), story.publisher(source, "/points")
    for at in range(CYCLE_NS, 10 * CYCLE_NS, CYCLE_NS):
        story.runs(timer, at, at + 3, writes=((points, at + 2),), tid=11)
        story.runs(reader, at + 5, at + 8, reads=at + 2, tid=12)
        story.runs(beside, at + 9, at + 10, tid=13)
    info = RecordingInfo(source="lttng", clock_offset_ns=OFFSET, threads=threads)
    return write_recording(folder / "rec", story.tables(), info)


def _plan(*threads: Thread, core: int = 1) -> Plan:
    chain = Server(name="chain", core=core, priority=2, slots=((0, 50 * MS),), threads=threads)
    return Plan.of(bare_plan("/source../points", CYCLE_NS, chain))


CHAIN = (Thread(node="/source"), Thread(node="/filter", callbacks=("/points",)))


def _entries(configuration: GroupConfiguration) -> dict[str, tuple[str, int | None, list[int]]]:
    return {
        entry.id or "": (entry.policy, entry.priority, [*(entry.affinity or ())])
        for entry in configuration.callback_groups or ()
    }


def test_a_plan_is_exported_with_the_priorities_that_apply_would_give(tmp_path: Path) -> None:
    exported = export_callback_groups(_plan(*CHAIN), _recording(tmp_path))
    first, second = server_priorities({2: 2})[2]
    expected = {SOURCE: ("SCHED_FIFO", first, [1]), FILTER: ("SCHED_FIFO", second, [1])}
    assert _entries(exported.configuration) == expected
    assert first > second
    values = yaml.safe_load(exported.text)
    assert values["non_ros_threads"] == []
    assert set(values["callback_groups"][0]) == {"id", "affinity", "policy", "priority"}
    assert "slots" in " ".join(exported.notes)
    path = tmp_path / "groups.yaml"
    path.write_text(exported.text)
    assert _entries(read_group_configuration(path)) == expected


def test_a_thread_without_callbacks_is_all_groups_of_its_node(tmp_path: Path) -> None:
    exported = export_callback_groups(_plan(Thread(node="/filter")), _recording(tmp_path))
    assert set(_entries(exported.configuration)) == {FILTER, BESIDE}


def test_best_effort_threads_have_nice_and_priority_for_old_and_new_versions(
    tmp_path: Path,
) -> None:
    server = Server(
        name="rest",
        core=0,
        priority=9,
        slots=((0, CYCLE_NS),),
        threads=(Thread(node="/filter", callbacks=("every 20ms",)),),
        best_effort=True,
    )
    plan = Plan.of(bare_plan("/source../points", CYCLE_NS, server))
    (entry,) = (
        export_callback_groups(plan, _recording(tmp_path)).configuration.callback_groups or ()
    )
    assert (entry.policy, entry.priority, entry.nice) == ("SCHED_OTHER", 0, 0)


TEMPLATE = f"""\
hardware_info: {{model_name: A processor}}
callback_groups:
  - {{id: "{SOURCE}@Waitable", affinity: ~, policy: SCHED_OTHER, priority: 0}}
  - {{id: "/filter@Subscription(/points)@Service(/reset)", policy: SCHED_OTHER, priority: 0}}
  - {{id: "{BESIDE}", affinity: [0], policy: SCHED_RR, priority: 3}}
non_ros_threads:
  - {{id: worker, affinity: ~, policy: SCHED_OTHER, priority: 0}}
"""


def test_the_ids_of_their_own_file_are_kept_and_so_is_what_the_plan_does_not_concern(
    tmp_path: Path,
) -> None:
    path = tmp_path / "template.yaml"
    path.write_text(TEMPLATE)
    template = read_group_configuration(path)
    recording = _recording(tmp_path, services=True)
    with pytest.raises(OperationError, match=r"not show for sure .* /filter has.*--template"):
        export_callback_groups(_plan(*CHAIN), recording)
    exported = export_callback_groups(_plan(*CHAIN), recording, template)
    entries = _entries(exported.configuration)
    assert [*entries] == [entry.id for entry in template.callback_groups or ()]
    assert [policy for policy, _, _ in entries.values()] == ["SCHED_FIFO", "SCHED_FIFO", "SCHED_RR"]
    values = yaml.safe_load(exported.text)
    assert values["hardware_info"] == {"model_name": "A processor"}
    assert values["non_ros_threads"] == yaml.safe_load(TEMPLATE)["non_ros_threads"]


def test_a_node_that_has_no_groups_is_named(tmp_path: Path) -> None:
    with pytest.raises(OperationError, match="no callback group of /else"):
        export_callback_groups(_plan(Thread(node="/else")), _recording(tmp_path))


def test_a_plan_names_the_thread_of_a_callback_group(tmp_path: Path) -> None:
    thread = Thread.model_validate({"callback_group": FILTER})
    assert (thread.node, thread.callbacks) == ("/filter", ("/points",))
    plan = _plan(Thread(node="/source"), thread)
    path = tmp_path / "plan.yaml"
    save_plan(plan, path)
    assert f"{{role: executor, callback_group: {FILTER}}}" in path.read_text()
    assert load_plan(path) == plan
    exported = export_callback_groups(load_plan(path), _recording(tmp_path))
    assert set(_entries(exported.configuration)) == {SOURCE, FILTER}
    path.write_text(path.read_text().replace(FILTER, "/filter@Service(/reset)"))
    with pytest.raises(InputError, match="neither timer nor subscription"):
        load_plan(path)
    with pytest.raises(ValueError, match="not that of"):
        Thread.model_validate({"callback_group": FILTER, "node": "/else"})


def test_a_configuration_tells_what_was_in_force_where_the_kernel_was_not_asked(
    tmp_path: Path,
) -> None:
    path = tmp_path / "groups.yaml"
    path.write_text(
        f"""callback_groups:
  - {{id: "{SOURCE}", affinity: [1], policy: SCHED_FIFO, priority: 60}}
  - {{id: "{FILTER}", policy: SCHED_DEADLINE, runtime: 1, deadline: 2, period: 3}}
  - {{id: "{BESIDE}", policy: SCHED_OTHER, priority: 4}}
  - {{id: "/gone@Timer(5)", policy: SCHED_OTHER, priority: 4}}
"""
    )
    configuration = read_group_configuration(path)
    has = ThreadInfo(
        tid=13, pid=1, comm="x", node="", role="executor", policy="SCHED_RR", priority=2, cores=(0,)
    )
    read, notes = with_callback_groups(_recording(tmp_path, has), configuration)
    threads = {
        known.tid: (known.policy, known.priority, known.cores) for known in read.info.threads
    }
    assert threads == {
        11: ("SCHED_FIFO", 60, (1,)),
        12: ("SCHED_DEADLINE", 0, ()),
        13: ("SCHED_RR", 2, (0,)),
    }
    assert len(notes) == 2
    assert "has SCHED_RR 2, and the file gives SCHED_OTHER, nice 4" in notes[0]
    assert "/gone@Timer(5)" in notes[1]
