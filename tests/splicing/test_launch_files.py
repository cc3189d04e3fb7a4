"""Launch files before and after splicing: `launch_files/` holds them, from simple to nasty."""

import hashlib
import json
import re
import xml.etree.ElementTree as ET  # our own files
from pathlib import Path

import pytest
import yaml
from launch_cases import CASES, Case, plan_for, splice_case, texts_of

from chainshaper import Plan, splice_launch_files
from chainshaper.planning.plan import revised
from chainshaper.splicing.launch.actions import NodeAction, SetRemap, flattened
from chainshaper.splicing.launch.file import read_launch_file, read_text
from chainshaper.values.errors import InputError
from chainshaper.values.recording import open_recording

LAUNCH = Path(__file__).parent / "launch_files"


def _hashes(folder: Path) -> dict[str, str]:
    return {
        str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_the_copies_are_as_they_should_be_and_the_originals_as_they_were(
    case: Case, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    spliced = splice_case(case, tmp_path, monkeypatch)

    before, now = (_hashes(folder / "before") for folder in (case.folder, tmp_path))
    assert now == before
    wanted = {path.name: path.read_bytes().decode() for path in (case.folder / "after").iterdir()}
    assert texts_of(tmp_path) == wanted
    notes = [note.replace(str(tmp_path / "before"), "{BEFORE}") for note in spliced.notes]
    for begin in case.notes:
        assert any(note.startswith(f"{{BEFORE}}/{begin}") for note in notes), notes


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_copies_are_launch_files_with_the_same_nodes(
    case: Case, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    spliced = splice_case(case, tmp_path, monkeypatch)

    for copy, original in spliced.originals.items():
        if "written by `chainshaper splice`" in copy.read_text():
            continue
        before, after = (
            [
                (action.label, action.name, action.namespace, action.conditions)
                for action in flattened(read_launch_file(file).actions)
                if isinstance(action, NodeAction)
            ]
            for file in (original, copy)
        )
        assert after == before


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_comments_and_line_ends_stay(
    case: Case, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    spliced = splice_case(case, tmp_path, monkeypatch)

    for copy, original in spliced.originals.items():
        text, was = copy.read_bytes().decode(), original.read_bytes().decode()
        if "written by `chainshaper splice`" in text:
            continue
        comments = re.compile(r"<!--.*?-->" if "<" in was[:5] else r"#[^'\"\n]*$", re.M | re.S)
        assert comments.findall(text) == comments.findall(was)
        if "\r\n" in was:
            assert text.count("\n") == text.count("\r\n")


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_splicing_again_gives_the_same(
    case: Case, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    spliced = splice_case(case, tmp_path, monkeypatch)
    first = _hashes(tmp_path / "after")
    plan = plan_for(case.publisher, case.output)

    originals = [tmp_path / "before" / name for name in case.launch]
    copies = list(spliced.launch.values())
    for files in (originals, copies, [*originals, *copies]):
        again = splice_launch_files(plan, files, tmp_path / "after", arguments=case.arguments)
        assert _hashes(tmp_path / "after") == first
        assert again.diff == spliced.diff or files is copies


def test_a_copy_spliced_into_another_folder_is_spliced_from_its_original(tmp_path: Path) -> None:
    robot = tmp_path / "robot.launch.xml"
    robot.write_text('<launch><node pkg="l" exec="n" name="ndt"/></launch>')
    plan = plan_for("/ndt", "/pose")
    splice_launch_files(plan, [robot], tmp_path / "one")

    again = splice_launch_files(plan, [tmp_path / "one/robot.launch.xml"], tmp_path / "two")

    texts = [(tmp_path / name / "robot.launch.xml").read_text() for name in ("one", "two")]
    assert texts[1] == texts[0].replace(str(tmp_path / "one"), str(tmp_path / "two"))
    assert texts[1].count("<remap") == 1
    assert f"spliced from its original, {robot}" in again.notes[0]


def test_conditions_of_both_sides_are_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (case,) = (case for case in CASES if case.name == "xml_variables_and_conditions")
    splice_case(case, tmp_path, monkeypatch)

    nodes = ET.parse(tmp_path / "after/robot.launch.xml").getroot().findall("node")  # noqa: S314
    assert [(node.get("if"), node.get("unless")) for node in nodes] == [
        ("$(var simulated)", None),
        (None, "$(var simulated)"),
    ]
    assert [[one.get("to") for one in node.findall("remap")] for node in nodes] == [
        ["/pose_tmp"]
    ] * 2


def test_all_shaping_nodes_of_a_plan_are_spliced(tmp_path: Path) -> None:
    robot = tmp_path / "robot.launch.yaml"
    robot.write_text(
        "launch:\n"
        "- node: {pkg: a, exec: a, name: first, remap: [{from: out, to: /t1}]}\n"
        "- node: {pkg: a, exec: a, name: second}\n"
    )
    plan = _with_further_node(plan_for("/second", "/t2"), "/t1")
    recording = open_recording(_recording_with_publishers(tmp_path, {"/t1": "/first"}))

    spliced = splice_launch_files(plan, [robot], tmp_path / "out", recording=recording)

    assert [process.name for process in spliced.processes] == ["chainshaper_t2", "chainshaper_t1"]
    launched = yaml.safe_load((tmp_path / "out/robot.launch.yaml").read_text())["launch"]
    *started, first, second = launched
    nodes = ("chainshaper_t2", "chainshaper_t2_standby", "chainshaper_t1", "chainshaper_t1_standby")
    for node, process in zip(nodes, started, strict=True):
        assert f"/{node}.py" in process["executable"]["cmd"]
    assert first["node"]["remap"] == [{"from": "out", "to": "/t1_tmp"}]
    assert second["node"]["remap"] == [{"from": "/t2", "to": "/t2_tmp"}]


def test_a_plan_that_names_its_publishers_needs_no_recording(tmp_path: Path) -> None:
    robot = tmp_path / "robot.launch.yaml"
    robot.write_text(
        "launch:\n- node: {pkg: a, exec: a, name: first}\n- node: {pkg: a, exec: a, name: second}\n"
    )
    plan = _with_further_node(plan_for("/second", "/t2"), "/t1", publisher="/first")

    splice_launch_files(plan, [robot], tmp_path / "out")

    *_, first, second = yaml.safe_load((tmp_path / "out/robot.launch.yaml").read_text())["launch"]
    assert first["node"]["remap"] == [{"from": "/t1", "to": "/t1_tmp"}]
    assert second["node"]["remap"] == [{"from": "/t2", "to": "/t2_tmp"}]


def test_one_node_may_publish_two_of_the_topics(tmp_path: Path) -> None:
    robot = tmp_path / "robot.launch.py"
    robot.write_text(
        "from launch import LaunchDescription\n"
        "from launch_ros.actions import Node\n"
        "def generate_launch_description():\n"
        "    common = []\n"
        "    return LaunchDescription([Node(executable='a', name='one', remappings=common)])\n"
    )
    plan = _with_further_node(plan_for("/one", "/t2"), "/t1")
    recording = open_recording(_recording_with_publishers(tmp_path, {"/t1": "/one"}))

    splice_launch_files(plan, [robot], tmp_path / "out", recording=recording)

    copy = (tmp_path / "out/robot.launch.py").read_text()
    assert "remappings=[('/t2', '/t2_tmp'), ('/t1', '/t1_tmp'), *common]" in copy


def test_who_publishes_a_further_topic_must_be_known(tmp_path: Path) -> None:
    plan = _with_further_node(plan_for("/second", "/t2"), "/t1")
    robot = tmp_path / "robot.launch.yaml"
    robot.write_text("launch:\n- node: {pkg: a, exec: a, name: second}\n")

    with pytest.raises(InputError, match="does not say who publishes /t1: name a recording"):
        splice_launch_files(plan, [robot], tmp_path / "out")


def test_two_publishers_of_the_output_are_refused(tmp_path: Path) -> None:
    robot = tmp_path / "robot.launch.yaml"
    robot.write_text("launch:\n- node: {pkg: a, exec: a, name: ndt}\n")
    folder = _recording_with_publishers(tmp_path, {"/pose": "/ndt"}, {"/pose": "/other"})

    with pytest.raises(InputError, match="/pose has 2 publishers, /ndt, /other"):
        splice_launch_files(
            plan_for("/ndt", "/pose"), [robot], tmp_path / "out", recording=open_recording(folder)
        )
    assert not (tmp_path / "out").exists()


def test_a_standby_is_no_second_publisher(tmp_path: Path) -> None:
    robot = tmp_path / "robot.launch.yaml"
    robot.write_text("launch:\n- node: {pkg: a, exec: a, name: ndt}\n")
    nodes = ({"/pose": "/chainshaper_pose"}, {"/pose": "/chainshaper_pose_standby"})
    recording = open_recording(_recording_with_publishers(tmp_path, *nodes))

    spliced = splice_launch_files(
        plan_for("/ndt", "/pose"), [robot], tmp_path / "out", recording=recording
    )

    assert len(spliced.launch) == 1


def test_a_package_s_node_is_started_with_its_parameters_and_remaps(tmp_path: Path) -> None:
    for name, text in {
        "robot.launch.xml": '<launch>\n  <node pkg="l" exec="n" name="ndt"/>\n</launch>',
        "robot.launch.yaml": "launch:\n- node: {pkg: l, exec: n, name: ndt}\n",
        "robot.launch.py": "from launch import LaunchDescription\n"
        "from launch_ros.actions import Node\n"
        "def generate_launch_description():\n"
        "    return LaunchDescription([Node(package='l', executable='n', name='ndt')])\n",
    }.items():
        (tmp_path / name).write_text(text)
        out = tmp_path / f"{name}.spliced"

        spliced = splice_launch_files(plan_for("/ndt", "/pose"), [tmp_path / name], out, node="cpp")

        (process,) = spliced.processes
        assert (out / "shaping_nodes" / str(process.package) / "package.xml").is_file()
        file = read_launch_file(out / name)
        nodes = [action for action in flattened(file.actions) if isinstance(action, NodeAction)]
        assert nodes[0].label == f"{process.package}/{process.executable}"
        assert (nodes[0].name, nodes[0].namespace) == (("chainshaper_pose",), ("/",))
        pairs = [(rule.match, rule.target) for rule in nodes[0].rules]
        assert pairs == [(("input",), ("/pose_tmp",)), (("output",), ("/pose",))]
        assert str(process.parameters_file) in (out / name).read_text()


def test_a_typed_node_takes_its_type_from_the_recording(tmp_path: Path) -> None:
    robot = tmp_path / "robot.launch.xml"
    robot.write_text('<launch><node pkg="l" exec="n" name="ndt"/></launch>')
    folder = _recording_with_publishers(tmp_path, {"/pose": "/ndt"}, type_="std_msgs/msg/Header")

    spliced = splice_launch_files(
        plan_for("/ndt", "/pose"),
        [robot],
        tmp_path / "out",
        node="typed",
        recording=open_recording(folder),
    )

    assert spliced.processes[0].package == "shaping_std_msgs_header"


@pytest.mark.parametrize("suffix", ["xml", "yaml", "py"])
def test_a_folder_with_spaces_is_one_word_on_the_command_line(tmp_path: Path, suffix: str) -> None:
    case = {"xml": "xml_plain", "yaml": "yaml_plain", "py": "python_loop"}[suffix]
    (source,) = (LAUNCH / case / "before").iterdir()
    publisher, output = ("/node5", "/t5") if suffix == "py" else ("/ndt", "/pose")
    folder = tmp_path / "two words"

    spliced = splice_launch_files(plan_for(publisher, output), [source], folder)

    text = (folder / source.name).read_text().replace("&apos;", "'")
    script = (spliced.processes[0].command or ())[1]
    assert f"'{script}'" in text


def _with_further_node(plan: Plan, output: str, publisher: str | None = None) -> Plan:
    """The plan with a shaping node for another topic, in slots of its own."""
    assert plan.shaping_node is not None
    name = "chainshaper" + output.replace("/", "_")
    node = plan.shaping_node.model_copy(
        update={
            "name": name,
            "output": output,
            "input": f"{output}_tmp",
            "publisher": publisher,
        }
    )
    server = plan.servers[-1].model_copy(
        update={"name": name, "slots": ((90_000_000, 91_000_000),), "threads": (node.thread,)}
    )
    return revised(plan, servers=(*plan.servers, server), further_shaping_nodes=(node,))


def _recording_with_publishers(
    folder: Path, *topics: dict[str, str], type_: str | None = None
) -> Path:
    """A recording that saw nothing but who publishes what."""
    place = folder / "recording"
    place.mkdir()
    endpoints = [
        {"node": node, "topic": topic, "kind": "publisher", "type": type_}
        for one in topics
        for topic, node in one.items()
    ]
    info = {"source": "lttng", "clock_offset_ns": 0, "endpoints": endpoints}
    (place / "recording.json").write_text(json.dumps(info))
    return place


def test_rules_for_a_scope_are_read_with_their_names() -> None:
    text = '<launch><set_remap from="ndt:out" to="/pose"/></launch>'
    (action,) = read_text(Path("/robot.launch.xml"), text).actions
    assert isinstance(action, SetRemap)
    assert (action.rule.match, action.rule.target) == (("ndt:out",), ("/pose",))
