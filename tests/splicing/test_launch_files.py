"""What splicing writes for launch files: the nodes that it adds, and whose topics it redirects.

And which launch file a `ros2 launch …` means, and the same command for another one.
"""

import ast
import shutil
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import pytest
from bare_recordings import recorded
from launch_cases import NDT, ROBOTS, plan_for, robot_file
from node_run import parameters_of

from chainshaper import ChainPlan, Splicing, ThrottledInput, splice_launch_files, splice_throttlers
from chainshaper.planning import Plan
from chainshaper.planning.chain_plan import publish_slots, revised
from chainshaper.splicing.node_kinds import copies_made, kind_of, language_of
from chainshaper.splicing.spliced_launch import parse_launch_command, undo_splice
from chainshaper.values.errors import InputError, PlatformError
from chainshaper.values.plan_choices import NodeChoice
from chainshaper.values.recording import Recording

MS = 1_000_000
REAR = ThrottledInput(topic="/rear", period_ns=100 * MS)
FRONT = ThrottledInput(topic="/front", period_ns=100 * MS)
PLAN = plan_for("/ndt", "/pose")

robot = pytest.fixture(robot_file)


def launched(spliced: Splicing) -> dict[str, Any]:
    (file,) = set(spliced.launch.values())
    return {
        statement.targets[0].id: ast.literal_eval(statement.value)
        for statement in ast.parse(file.read_text()).body
        if isinstance(statement, ast.Assign) and isinstance(statement.targets[0], ast.Name)
    }


def redirects(spliced: Splicing) -> dict[str, tuple[str, tuple[str, ...]]]:
    return {one["topic"]: (one["target"], one["nodes"]) for one in launched(spliced)["REDIRECTS"]}


@pytest.fixture
def recording(tmp_path: Path) -> Recording:
    """One in which a player publishes two inputs, and one node subscribes to each."""
    ends = {"/player": "publisher", "/fusion": "subscription"}.items()
    every = [(node, topic, kind) for topic in ("/rear", "/front") for node, kind in ends]
    return recorded(tmp_path, *every)


@pytest.mark.parametrize("name", ROBOTS)
def test_the_user_s_file_is_included_as_it_is(name: str, tmp_path: Path) -> None:
    (tmp_path / name).write_text(ROBOTS[name])
    spliced = splice_launch_files(Plan.of(PLAN), [tmp_path / name], tmp_path / "out")
    assert (tmp_path / name).read_text() == ROBOTS[name]
    assert spliced.launch == {tmp_path / name: tmp_path / "out/robot.launch.py"}
    assert spliced.originals == {tmp_path / "out/robot.launch.py": tmp_path / name}
    written = launched(spliced)
    assert written["LAUNCH_FILES"] == [str(tmp_path / name)]
    (redirect,) = written["REDIRECTS"]
    assert redirect == {
        "kind": "publisher",
        "topic": "/pose",
        "target": "/pose_tmp",
        "nodes": ("/ndt",),
        "added": ("/chainshaper_pose", "/chainshaper_pose_standby"),
    }
    assert "+++ " + str(tmp_path / "out/robot.launch.py") in spliced.diff
    other = tmp_path / "sensing.launch.yaml"
    other.write_text("launch: []\n")
    both = splice_launch_files(
        Plan.of(PLAN), [tmp_path / name, other, tmp_path / name], tmp_path / "out"
    )
    assert both.launch == dict.fromkeys([tmp_path / name, other], tmp_path / "out/robot.launch.py")
    assert launched(both)["LAUNCH_FILES"] == [str(tmp_path / name), str(other)]


@pytest.mark.skipif(shutil.which("g++") is None, reason="g++ compiles the gate")
def test_a_gate_in_the_publisher_s_process_adds_no_node_and_redirects_nothing(robot: Path) -> None:
    assert PLAN.shaping_node is not None
    inside = PLAN.shaping_node.model_copy(update={"in_process": True})
    plan, out = revised(PLAN, shaping_node=inside, anchor="cycle"), robot.parent / "out"
    spliced = splice_launch_files(Plan.of(plan), [robot], out)
    written = launched(spliced)
    assert (written["PROCESSES"], written["REDIRECTS"]) == ([], [])
    assert written["ENVIRONMENT"] == spliced.environment
    assert Path(spliced.environment["LD_PRELOAD"]).is_file()
    assert spliced.environment["CHAINSHAPER_GATES"] == str(out / "shaping_nodes/gates")
    lines = (out / "shaping_nodes/gates").read_text().splitlines()
    assert lines[:4] == [
        "output /pose",
        "input /pose_tmp",
        "node chainshaper_pose",
        "publisher /ndt",
    ]
    slots = [int(line.split()[1]) for line in lines if line.startswith("slots_ns")]
    assert slots == [bound for slot in publish_slots(plan) for bound in slot]
    undo_splice(out)
    assert not out.exists()


@pytest.mark.parametrize("folder", ["out", "two 'words'", 'a$"\\b#\nc'])
def test_both_nodes_are_started_with_their_files_and_again_when_they_end(
    robot: Path, folder: str
) -> None:
    nodes = robot.parent / folder / "shaping_nodes"
    same = {"output": "screen", "respawn": True, "respawn_delay": 0.1}
    for process in launched(splice_launch_files(Plan.of(PLAN), [robot], robot.parent / folder))[
        "PROCESSES"
    ]:
        name, words = process["name"], process["cmd"]
        assert process.items() >= same.items()
        assert words[:2] == ["python3", str(nodes / f"{name}.py")]
        assert words[-2:] == ["--params-file", str(nodes / f"{name}.yaml")]
        assert {"__ns:=/", f"__node:={name}", "input:=/pose_tmp", "output:=/pose"} <= {*words}
        assert all(Path(word).is_file() for word in (words[1], words[-1]))
    spliced = splice_launch_files(Plan.of(PLAN), [robot], robot.parent / folder, node="cpp")
    node, standby = launched(spliced)["PROCESSES"]
    assert (nodes / node["package"] / "package.xml").is_file()
    assert standby.items() >= same.items()
    assert node == {
        "package": "chainshaper_shaping",
        "executable": "shaping_node",
        "namespace": "/",
        "parameters": [str(nodes / "chainshaper_pose.yaml")],
        "remappings": [("input", "/pose_tmp"), ("output", "/pose")],
        "name": "chainshaper_pose",
        **same,
    }


def test_a_component_goes_into_its_publishers_container_and_has_no_standby(robot: Path) -> None:
    out, type_ = robot.parent / "out", "sensor_msgs/msg/PointCloud2"
    evidence = PLAN.evidence.model_copy(update={"intra_process": True})
    plan = revised(PLAN, evidence=evidence)
    spliced = splice_launch_files(Plan.of(plan), [robot], out, node="cpp", message_type=type_)
    assert "/pose: the shaping node is a component in C++" in spliced.notes[0]
    written, nodes = launched(spliced), out / "shaping_nodes"
    assert written["PROCESSES"] == []
    assert written["REDIRECTS"][0]["component"] == {
        "package": "shaping_sensor_msgs_point_cloud2",
        "plugin": "shaping_sensor_msgs_point_cloud2::ShapingNode",
        "name": "chainshaper_pose",
        "remappings": (("input", "/pose_tmp"), ("output", "/pose")),
        "parameters": str(nodes / "chainshaper_pose.yaml"),
    }
    parameters = parameters_of(spliced.processes[0]).values()
    assert [] not in parameters, "a list without elements has no type"
    assert [log.name for log in spliced.logs] == ["chainshaper_pose.csv"]
    assert not list(nodes.glob("*standby*"))


def test_what_a_node_costs_where_messages_are_not_copied_is_said() -> None:
    assert not [*copies_made(PLAN, "python", within_container=False)]
    evidence = PLAN.evidence.model_copy(update={"intra_process": True})
    plan = revised(PLAN, evidence=evidence)
    (said,) = copies_made(plan, "python", within_container=True)
    assert said.startswith("/pose: subscribers in the process of /ndt get its messages without a")
    assert said.endswith("choose --node cpp")
    (said,) = copies_made(plan, "generic", within_container=True)
    assert "name the type of the output with --type" in said
    assert not [*copies_made(plan, "component", within_container=True)]


def test_the_kind_of_shaping_node_is_found_out_and_said(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    type_ = "sensor_msgs/msg/PointCloud2"
    header = tmp_path / "include/sensor_msgs/sensor_msgs/msg/point_cloud2.hpp"
    header.parent.mkdir(parents=True)
    monkeypatch.setenv("AMENT_PREFIX_PATH", str(tmp_path))
    assert kind_of("python", type_, within_container=True)[0] == "python"
    assert kind_of("cpp", None, within_container=True)[0] == "generic"
    kind, reason = kind_of("cpp", type_, within_container=True)
    assert (kind, f"no headers of {type_}" in reason) == ("generic", True)
    header.touch()
    assert kind_of("cpp", type_, within_container=False)[0] == "typed"
    assert kind_of("cpp", type_, within_container=True)[0] == "component"


def test_auto_is_cpp_where_it_is_built_and_can_be(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("colcon", "cmake", "c++"):
        (tmp_path / name).touch(0o755)
    (tmp_path / "share/rclcpp").mkdir(parents=True)
    monkeypatch.delenv("CXX", raising=False)
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.setenv("AMENT_PREFIX_PATH", str(tmp_path))
    assert language_of("auto", builds=True)[0] == "cpp"
    assert language_of("auto", builds=False)[0] == "python"
    assert language_of("python", builds=True) == ("python", "")
    (tmp_path / "share/rclcpp").rmdir()
    language, reason = language_of("auto", builds=True)
    assert (language, "has no rclcpp" in reason) == ("python", True)
    monkeypatch.setenv("PATH", "/nowhere")
    assert "colcon" in language_of("auto", builds=True)[1]
    assert language_of("cpp", builds=True) == ("cpp", "")


def test_what_ros2_run_starts_is_launched(tmp_path: Path) -> None:
    words = ["ros2", "run", "l", "n", "--ros-args", "-r", "__node:=ndt"]
    spliced = splice_launch_files(Plan.of(PLAN), words, tmp_path / "out")
    assert spliced.launch == {Path("n"): tmp_path / "out/n.launch.py"}
    written = launched(spliced)
    assert (written["LAUNCH_FILES"], written["PROCESSES"][-1]["cmd"]) == ([], words)
    again = splice_launch_files(Plan.of(PLAN), [*spliced.launch.values()], tmp_path / "again")
    assert launched(again)["PROCESSES"][-1]["cmd"] == words
    other = tmp_path / "robot.launch.xml"
    other.write_text(NDT)
    for both in ([*spliced.launch.values(), other], [other, *spliced.launch.values()]):
        with pytest.raises(InputError, match=r"for `ros2 run l n .*, which is spliced alone"):
            splice_launch_files(Plan.of(PLAN), both, tmp_path / "third")


@pytest.mark.parametrize(
    ("options", "executable"),
    [
        (["--prefix", "/usr/bin/time"], "n"),
        (["--prefix=nice -n 5"], "scripts/n.py"),
        (["-h", "--prefix", "a b"], "/opt/n"),
    ],
)
def test_options_of_ros2_run_are_not_what_it_starts(
    tmp_path: Path, options: list[str], executable: str
) -> None:
    words = ["ros2", "run", *options, "l", executable, "--ros-args", "-r", "__node:=ndt"]
    (tmp_path / "here").mkdir()
    spliced = splice_launch_files(Plan.of(PLAN), words, tmp_path / "here/out")
    assert [*spliced.launch.values()] == [tmp_path / "here/out/n.launch.py"]
    assert launched(spliced)["PROCESSES"][-1]["cmd"] == words
    assert [path.name for path in tmp_path.iterdir()] == ["here"]


def with_further_node(plan: ChainPlan, output: str, publisher: str | None = None) -> ChainPlan:
    """The plan with a shaping node for another topic, in slots of its own."""
    assert plan.shaping_node is not None
    name = "chainshaper" + output.replace("/", "_")
    change = {"name": name, "output": output, "input": f"{output}_tmp", "publisher": publisher}
    node = plan.shaping_node.model_copy(update=change)
    slots = {"name": name, "slots": ((90 * MS, 91 * MS),), "threads": (node.thread,)}
    server = plan.servers[-1].model_copy(update=slots)
    return revised(plan, servers=(*plan.servers, server), further_shaping_nodes=(node,))


@pytest.mark.parametrize("known", ["by the plan", "by a recording"])
def test_all_shaping_nodes_of_a_plan_are_spliced(robot: Path, known: str) -> None:
    by_plan = known == "by the plan"
    plan = with_further_node(plan_for("/second", "/t2"), "/t1", "/first" if by_plan else None)
    seen = None if by_plan else recorded(robot.parent, ("/first", "/t1", "publisher"))
    spliced = splice_launch_files(Plan.of(plan), [robot], robot.parent / "out", recording=seen)
    names = ["chainshaper_t2", "chainshaper_t1"]
    assert [process.name for process in spliced.processes] == names
    started = [process["name"] for process in launched(spliced)["PROCESSES"]]
    assert started == [f"{name}{end}" for name in names for end in ("", "_standby")]
    wanted = {"/t2": ("/t2_tmp", ("/second",)), "/t1": ("/t1_tmp", ("/first",))}
    assert redirects(spliced) == wanted


@pytest.mark.parametrize("distribution", ["jazzy", "lyrical"])
@pytest.mark.parametrize("node", ["python", "cpp"])
@pytest.mark.parametrize("field", ["uint8[] data  # bytes", "uint8[4] data"])
def test_a_node_that_would_get_no_message_is_refused(
    robot: Path, monkeypatch: pytest.MonkeyPatch, node: NodeChoice, distribution: str, field: str
) -> None:
    """Lyrical's Fast DDS has another reader for messages with bytes, which `typed` takes from."""
    definition = robot.parent / "share" / "robot_msgs" / "msg" / "Cloud.msg"
    definition.parent.mkdir(parents=True)
    definition.write_text(f"float32 x\n{field}\n")
    header = robot.parent / "include/robot_msgs/robot_msgs/msg/cloud.hpp"
    header.parent.mkdir(parents=True)
    header.touch()
    monkeypatch.setenv("AMENT_PREFIX_PATH", f"/elsewhere:{robot.parent}")
    # Its standby is no second publisher.
    ends = [(name, "/pose", "publisher") for name in ("/ndt", "/chainshaper_pose_standby")]
    known = {"rmw": "rmw_fastrtps_cpp", "distribution": distribution}
    seen = recorded(robot.parent, *ends, type_="robot_msgs/msg/Cloud", **known)
    refused = (node, distribution, field[:7]) == ("python", "lyrical", "uint8[]")
    with pytest.raises(InputError, match="use --node cpp") if refused else nullcontext():
        spliced = splice_launch_files(
            Plan.of(PLAN), [robot], robot.parent / "out", node=node, recording=seen
        )
        assert redirects(spliced) == {"/pose": ("/pose_tmp", ("/ndt",))}
        package = "shaping_robot_msgs_cloud" if node == "cpp" else None
        assert spliced.processes[0].package == package


def test_an_input_reaches_its_subscribers_by_way_of_one_throttler(
    robot: Path, recording: Recording
) -> None:
    spliced = splice_throttlers([REAR, FRONT], [robot], robot.parent / "out", recording=recording)
    (process,) = launched(spliced)["PROCESSES"]  # one throttler, as in the paper
    assert process["name"] == "chainshaper_throttler"
    topics = ["/rear", "/front"]
    throttled = [f"{topic}_throttled" for topic in topics]
    wanted = {topic: (end, ("/fusion",)) for topic, end in zip(topics, throttled, strict=True)}
    assert redirects(spliced) == wanted
    assert {one["kind"] for one in launched(spliced)["REDIRECTS"]} == {"subscription"}
    known = {"inputs": topics, "outputs": throttled, "period_ns": 100 * MS, "fifo_priority": 85}
    assert parameters_of(spliced.processes[0]).items() >= known.items()


def test_inputs_of_other_periods_or_rules_have_a_throttler_of_their_own(robot: Path) -> None:
    both = [REAR.model_copy(update={"subscriber": node}) for node in ("/fusion", "/icp")]
    inputs = [*both, ThrottledInput(topic="/front", period_ns=50 * MS, subscriber="/fusion")]
    inputs += [inputs[-1].model_copy(update={"topic": "/side", "rule": "first"})]
    spliced = splice_throttlers(inputs, [robot], robot.parent / "out", node="cpp")
    names = ["chainshaper_throttler", "chainshaper_throttler_2", "chainshaper_throttler_3"]
    read = [one.parameters_file.read_text() for one in spliced.processes]
    assert ["rule: first" in text for text in read] == [False, False, True]
    assert [process.name for process in spliced.processes] == names
    assert [one["added"] for one in launched(spliced)["REDIRECTS"]] == [(f"/{n}",) for n in names]
    assert redirects(spliced)["/rear"] == ("/rear_throttled", ("/fusion", "/icp"))
    assert launched(spliced)["PROCESSES"][0]["executable"] == "throttler"


def test_a_plan_is_spliced_into_the_throttled_launch_file_and_again_from_its_own(
    robot: Path, recording: Recording
) -> None:
    out = robot.parent / "throttled"
    throttled = splice_throttlers([REAR], [robot], out, recording=recording)
    text = (out / "robot.launch.py").read_text()
    shaped = splice_launch_files(
        Plan.of(PLAN), [*throttled.launch.values()], robot.parent / "shaped"
    )
    again = splice_launch_files(Plan.of(PLAN), [*shaped.launch.values()], robot.parent / "shaped")
    assert again.diff == shaped.diff
    assert f"spliced from its original, {out / 'robot.launch.py'}" in again.notes[-1]
    for spliced in (shaped, again):
        assert launched(spliced)["LAUNCH_FILES"] == [str(out / "robot.launch.py")]
        assert list(redirects(spliced)) == ["/pose"]
    same = splice_throttlers([REAR], [*throttled.launch.values()], out, recording=recording)
    assert (out / "robot.launch.py").read_text() == text
    assert same.diff == throttled.diff


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("a.launch.xml", b"<robot/>", "a.launch.xml: no launch file"),
        ("a.launch.yaml", b"robot: 1\n", "a.launch.yaml: no launch file"),
        ("a.launch.py", b"print('hello')\n", "a.launch.py: no launch file"),
        ("a.txt", NDT.encode(), "a launch file's name ends in .py, .xml, .yaml, .yml or .launch"),
        ("a.launch.xml", b"<launch>\xff</launch>", "1: not a text in UTF-8"),
        ("a.launch.xml", None, "a.launch.xml: cannot be read .No such file"),
    ],
)
def test_what_is_no_launch_file_is_refused(
    tmp_path: Path, name: str, text: bytes | None, message: str
) -> None:
    if text is not None:
        (tmp_path / name).write_bytes(text)
    with pytest.raises(InputError, match=message):
        splice_launch_files(Plan.of(PLAN), [tmp_path / name], tmp_path / "spliced")
    assert not (tmp_path / "spliced").exists()


def test_a_plan_that_shapes_nothing_or_does_not_know_the_publisher_is_refused(robot: Path) -> None:
    unknown = revised(PLAN, chain=PLAN.chain.model_copy(update={"publisher": None}))
    further = with_further_node(plan_for("/s", "/t2"), "/t1")
    for plan, message in (
        (revised(PLAN, shaping_node=None), "the plan has no `shaping_node`, so there is nothing"),
        (unknown, "the plan does not say who publishes /pose: name a rec"),
        (further, "does not say who publishes /t1: name a recording"),
    ):
        with pytest.raises(InputError, match=message):
            splice_launch_files(Plan.of(plan), [robot], robot.parent / "out")
    seen = recorded(robot.parent, *[(node, "/pose", "publisher") for node in ("/ndt", "/other")])
    with pytest.raises(InputError, match="/pose has 2 publishers, /ndt, /other"):
        splice_launch_files(Plan.of(PLAN), [robot], robot.parent / "out", recording=seen)
    assert not (robot.parent / "out").exists()


def test_what_cannot_be_throttled_is_named_and_nothing_written(
    robot: Path, recording: Recording
) -> None:
    side = REAR.model_copy(update={"topic": "/side"})
    for one, known, message in (
        (REAR, None, "who subscribes to /rear is not known: name a recording"),
        (side, recording, "to these topics nodes do: /front, /rear"),
    ):
        with pytest.raises(InputError, match=message):
            splice_throttlers([one], [robot], robot.parent / "out", recording=known)
    assert not (robot.parent / "out").exists()


def test_a_dry_run_without_ros_2_says_what_it_needs(
    robot: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PATH", "/usr/bin:/bin")
    for name in ("PYTHONPATH", "AMENT_PREFIX_PATH"):
        monkeypatch.delenv(name, raising=False)
    with pytest.raises(PlatformError, match="a dry run needs ROS 2: source its setup"):
        splice_launch_files(Plan.of(PLAN), [robot], robot.parent / "out", dry_run=True)
    assert not (robot.parent / "out").exists()


# The command ------------------------------------------------------------------------------------

ROS2 = "/opt/ros/jazzy/bin/ros2"


@pytest.fixture
def share(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    index = tmp_path / "install/share/ament_index/resource_index/packages"
    index.mkdir(parents=True)
    (index / "robot").touch()
    share = tmp_path / "install/share/robot"
    (share / "launch").mkdir(parents=True)
    (share / "launch/all.launch.py").touch()
    monkeypatch.setenv("AMENT_PREFIX_PATH", f"/nowhere:{tmp_path / 'install'}")
    return share


def test_a_package_and_the_name_of_a_file_anywhere_in_it(share: Path) -> None:
    words = [ROS2, "launch", "-n", "--launch-prefix", "nice", "robot", "all.launch.py"]
    command = parse_launch_command([*words, "speed:=3", "map:=a:=b", "--debug"])
    assert command.file == share / "launch/all.launch.py"
    assert command.with_file(Path("/copy.py")) == [
        *words[:5],
        "/copy.py",
        "speed:=3",
        "map:=a:=b",
        "--debug",
    ]


def test_a_path_needs_no_package(robot: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(robot.parent)
    command = parse_launch_command(["ros2", "launch", robot.name, "speed:=3"])
    assert command.file == robot
    assert command.with_file(Path("/c.xml")) == ["ros2", "launch", "/c.xml", "speed:=3"]


def test_without_ros_2_it_is_not_the_package_that_is_missing(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("AMENT_PREFIX_PATH", "")
    monkeypatch.setattr(shutil, "which", lambda _: None)
    with pytest.raises(InputError, match=r"robot: ROS 2 is not sourced \(no `ros2` on the path\)"):
        parse_launch_command(["ros2", "launch", "robot", "all.launch.py"])


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["ros2", "run", "robot", "node"], "`ros2 run robot node` is not `ros2 launch"),
        (["ros2", "launch"], "is not `ros2 launch"),
        (["ros2", "launch", "-d"], "no launch file given"),
        (["ros2", "launch", "other", "all.launch.py"], "other: neither a launch file nor a pack"),
        (["ros2", "launch", "robot"], "no launch file given: `ros2 launch robot FILE`"),
        (["ros2", "launch", "robot", "a.launch.py"], "robot has no launch file a.launch.py in /"),
        (["ros2", "launch", "robot", "two.launch.py"], "2 files .*launch/two.* or .*/old/two"),
    ],
)
def test_what_cannot_be_launched_is_said(share: Path, words: list[str], said: str) -> None:
    (share / "old").mkdir()
    for folder in ("old", "launch"):
        (share / folder / "two.launch.py").touch()
    with pytest.raises(InputError, match=said):
        parse_launch_command(words)
