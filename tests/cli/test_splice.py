"""`chainshaper splice` as a person or a script runs it."""

from pathlib import Path
from typing import TypeAlias

import pytest
from bare_recordings import recorded
from command_line import called, json_of, refused
from known import known
from small_chain import small_chain_plan

from chainshaper.flow.launch_shaping import _with_types
from chainshaper.planning import ChainPlan, save_plan
from chainshaper.planning.chain_plan import revised
from chainshaper.planning.plan import Plan

ROBOT = '<launch>\n  <node pkg="robot" exec="third" name="third"/>\n</launch>\n'


Files: TypeAlias = tuple[Path, Path, Path]


@pytest.fixture
def files(tmp_path: Path, plan: ChainPlan) -> Files:
    """A plan, a launch file that starts its publisher, and a folder that is not there yet."""
    save_plan(Plan.of(plan), tmp_path / "plan.yaml")
    (tmp_path / "robot.launch.xml").write_text(ROBOT)
    return tmp_path / "plan.yaml", tmp_path / "robot.launch.xml", tmp_path / "spliced"


def test_it_shows_what_is_redirected_and_what_to_launch(files: Files) -> None:
    plan, robot, folder = files
    copy = f"{folder}/robot.launch.py"
    finished = called("splice", plan, robot, "n:=1 2", "-o", folder)
    assert finished.code == 0
    # On a slow machine a line says what it is doing, too.
    sample, kind = [line for line in finished.err.splitlines() if line.startswith("note: ")]
    assert sample.startswith("note: the sample is small: 2 cycles"), "before the plan is used"
    assert kind.startswith("note: /t3: the shaping node is in Python; it needs no building")
    assert finished.out.splitlines() == [
        "/third publishes /t3_tmp in place of /t3, for /chainshaper_t3",
        f"ros2 launch {copy} 'n:=1 2'",
    ]
    assert robot.read_text() == ROBOT
    said = json_of("splice", plan, robot, "-o", folder)
    nodes, standbys = ["chainshaper_t3"], ["chainshaper_t3_standby"]
    logs = [f"{folder}/logs/{name}.csv" for name in (*nodes, *standbys)]
    wanted: dict[str, object] = {
        "folder": str(folder),
        "launch": {str(robot): copy},
        "originals": {copy: str(robot)},
    }
    wanted |= {"nodes": nodes, "standbys": standbys, "logs": logs}
    assert [note.split(";")[0] for note in said.pop("notes")] == [
        "/t3: the shaping node is in Python"
    ]
    wanted |= {"setup": None, "redirected": [], "environment": {}}
    assert said.pop("diff").startswith("--- /dev/null\n")
    assert said == wanted
    again = called("splice", plan, copy, "-o", folder)
    assert f"note: {copy}: spliced from its original, {robot}" in again.err


def test_a_dry_run_of_a_gate_in_the_publishers_process_names_nothing_that_is_not_there(
    files: Files, plan: ChainPlan, monkeypatch: pytest.MonkeyPatch
) -> None:
    """No ROS 2 is needed here: such a gate redirects no topic."""
    _, robot, folder = files
    file = folder.with_name("inside.yaml")
    inside = known(plan.shaping_node).model_copy(update={"in_process": True})
    save_plan(Plan.of(revised(plan, shaping_node=inside, anchor="cycle")), file)
    flow = "chainshaper.flow.launch_splicing"
    library = "chainshaper.splicing.gate_settings.gate_library"
    monkeypatch.setattr(library, lambda: Path("/gate.so"))
    monkeypatch.setattr(f"{flow}._tried", lambda *_: [])
    finished = called("splice", file, robot, "-o", folder, "--dry-run")
    assert (finished.code, finished.out) == (0, "what is launched would get the gate\n")
    assert not folder.exists()


def test_what_ros2_run_starts_is_given_behind_two_dashes(files: Files) -> None:
    plan, _, folder = files
    run = ("ros2", "run", "robot", "third", "--ros-args", "-r", "__node:=third")
    finished = called("splice", plan, "-o", folder, "--", *run)
    assert finished.out.splitlines()[-1] == f"ros2 launch {folder}/third.launch.py"
    throttled = folder.with_name("throttled")
    finished = called("splice", "--throttle", "/third:/t1=1s", "-o", throttled, "--", *run)
    assert finished.out.splitlines()[-1] == f"ros2 launch {throttled}/third.launch.py"


def test_the_fallback_is_the_plan_s_or_the_option_s(files: Files) -> None:
    plan, robot, folder = files
    fallbacks = []
    for options in ([], ["--fallback", "silence"]):
        assert called("splice", plan, robot, "-o", folder, *options).code == 0
        parameters = folder / "shaping_nodes" / "chainshaper_t3_standby.yaml"
        fallbacks.append("fallback: silence" in parameters.read_text())
    assert fallbacks == [False, True]
    refusal = refused(2, "splice", "--throttle", "/a:/t=1ms", robot, "-o", folder, *options)
    assert "a throttler has no fallback" in refusal
    twice = ("--throttle", "/a:/t=1ms", "--throttle", "/b:/t=2ms")
    assert "/t is throttled twice" in refused(2, "splice", *twice, robot, "-o", folder)


def test_a_throttler_needs_no_plan_and_undo_the_folder_only(files: Files) -> None:
    plan, robot, folder = files
    said = json_of("splice", "--throttle", "/third:/t1=100ms,first", robot, "n:=1", "-o", folder)
    parameters = folder / "shaping_nodes" / "chainshaper_throttler.yaml"
    assert "rule: first" in parameters.read_text()
    assert said["nodes"] == ["chainshaper_throttler"]
    assert "'target': '/t1_throttled'" in said["diff"]
    assert called("splice", "--undo", "-o", folder).out == f"{folder} is removed\n"
    assert called("splice", plan, robot, "-o", folder).code == 0
    assert json_of("splice", plan, robot, "--undo", "-o", folder) == {"removed": str(folder)}
    assert not folder.exists()
    assert "nothing to undo" in refused(2, "splice", "--undo", "-o", folder)


@pytest.mark.parametrize("word", ["typed", "component"])
def test_kinds_that_are_found_out_now_are_no_choice(files: Files, word: str) -> None:
    plan, robot, folder = files
    finished = called("splice", plan, robot, "-o", folder, "--node", word)
    assert finished.code == 2
    assert f"{word} is found out now: write --node cpp" in finished.err
    assert not folder.exists()


def test_nothing_is_written_where_it_could_not_be_built(
    files: Files, monkeypatch: pytest.MonkeyPatch
) -> None:
    plan, robot, folder = files
    monkeypatch.setenv("PATH", "/nowhere")
    said = refused(3, "splice", plan, robot, "-o", folder, "--node", "cpp", "--build")
    assert "colcon, which building the shaping node needs, is not on the PATH" in said
    assert not folder.exists()


def test_a_plan_s_own_recording_tells_publishers_where_it_exists(
    files: Files, plan: ChainPlan
) -> None:
    path, robot, folder = files
    recording = path.parent / "recording"
    recording.mkdir()
    (recording / "recording.json").write_text(
        '{"source": "lttng", "clock_offset_ns": 0, "endpoints": ['
        '{"node": "/third", "topic": "/t3", "kind": "publisher"},'
        '{"node": "/fourth", "topic": "/t3", "kind": "publisher"}]}'
    )
    two = "/t3 has 2 publishers, /fourth, /third"
    assert two in refused(2, "splice", path, robot, "-o", folder, "--recording", recording)
    path.write_text(
        path.read_text().replace("evidence:\n", f"evidence:\n    recording: {recording}\n")
    )
    assert two in refused(2, "splice", path, robot, "-o", folder)


def test_types_are_those_of_the_recording_that_saw_them(tmp_path: Path) -> None:
    """Discovery of Fast DDS has not always shown all types when a recording ends."""
    plan = Plan.of(small_chain_plan(5_000_000, 20_000_000, core=1))
    ends, header = [("/n", "/t3", "publisher")], "std_msgs/msg/Header"
    folders = [tmp_path / name for name in ("first", "before")]
    for folder in folders:
        folder.mkdir()
    first, before = recorded(folders[0], *ends), recorded(folders[1], *ends, type_=header)
    assert _with_types([first, before], plan) is before
    assert _with_types([first], plan) is first


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("PLAN -o DIR", "give a plan and the launch files"),
        ("-o DIR", "give a plan and the launch files"),
        ("PLAN ROBOT -o DIR --build --node python", "--node python needs no building"),
        ("PLAN ROBOT -o DIR --node cpp --type Header", "'Header' is not a message type"),
        ("ROBOT -o DIR --throttle /t1=100ms", "is not known: name a recording of the application"),
        ("ROBOT -o DIR --throttle /third:/t1", "write a topic and a period"),
        ("ROBOT -o DIR --throttle /third:/t1=1s,last", "'last' should be 'newest' or 'first'"),
        ("ROBOT -o DIR --throttle third:/t1=1s", "'third' is not a full ROS"),
        ("ROBOT -o DIR --throttle /third:/t1=0ms", "is zero"),
        ("-o DIR --throttle /third:/t1=1s", "give the launch files"),
        ("ROBOT -o DIR --throttle /third:/t1=1s --type p/msg/T", "a throttler is for all types"),
        ("ROBOT ROBOT -o DIR", "robot.launch.xml"),
        ("PLAN PLAN -o DIR", "plan.yaml"),
    ],
)
def test_wrong_use_is_refused_and_nothing_written(files: Files, words: str, message: str) -> None:
    places = dict(zip(("PLAN", "ROBOT", "DIR"), files, strict=True))
    assert message in refused(2, "splice", *(places.get(word, word) for word in words.split()))
    assert not files[2].exists()
