"""What cannot be spliced is said, with its place and a remedy, and nothing is written."""

import os
from collections.abc import Callable
from pathlib import Path

import pytest
from launch_cases import plan_for

from chainshaper import Splicing, splice_launch_files
from chainshaper.planning.plan import revised
from chainshaper.values.errors import ChainshaperError, InputError, OperationError

NDT = '<launch>\n  <node pkg="l" exec="n" name="ndt"/>\n</launch>\n'
PYTHON = """
from launch import LaunchDescription
from launch.actions import GroupAction
from launch_ros.actions import Node, SetRemap


def generate_launch_description():
    return LaunchDescription([{actions}])
"""

Splice = Callable[[str, str], Splicing]


@pytest.fixture
def splice(tmp_path: Path) -> Splice:
    """Splice a launch file of this name and text; /ndt publishes /pose."""

    def splice(name: str, text: str) -> Splicing:
        (tmp_path / name).write_text(text)
        return splice_launch_files(
            plan_for("/ndt", "/pose"), [tmp_path / name], tmp_path / "spliced"
        )

    return splice


@pytest.fixture(autouse=True)
def nothing_is_half_written(tmp_path: Path) -> object:
    yield
    names = {path.name for path in tmp_path.iterdir()}
    assert "spliced" not in names
    assert not [name for name in names if name.startswith(".")]


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        (
            "a.launch.xml",
            "<launch>\n  <node pkg='x'>\n</launch>",
            "a.launch.xml:3: not well-formed",
        ),
        ("a.launch.xml", "", "a.launch.xml:1: not well-formed XML: no element found"),
        ("a.launch.xml", "<robot/>", "a.launch.xml:1: the root element is <robot>"),
        ("a.launch.yaml", "launch:\n- node: {pkg: [}\n", "a.launch.yaml:2: not YAML"),
        ("a.launch.yaml", "", "a.launch.yaml:1: a launch file in YAML is one key, `launch`"),
        ("a.launch.yaml", "robot: 1\n", "a.launch.yaml:1: a launch file in YAML is one key"),
        ("a.launch.yaml", "launch:\n\n  node: x\n", "a.launch.yaml:3: `launch` holds no list"),
        (
            "a.launch.yaml",
            "launch:\n- node: {a: b}\n- just text\n",
            "a.launch.yaml:3: an action is",
        ),
        ("a.launch.yaml", "launch:\n- [a]: {}\n", "a.launch.yaml:2: an action is one key"),
        ("a.launch.yaml", "launch:\n- node: {[a]: b}\n", "a.launch.yaml:2: an attribute's name"),
        ("a.launch.yaml", "launch:\n- &a\n  group: [*a]\n", "a.launch.yaml:2: with its"),
        ("a.launch.py", "def f(:\n    pass\n", "a.launch.py:1: not Python: "),
        ("a.launch.py", "x = 1\ny = (\n", "a.launch.py:2: not Python: '(' was never closed"),
        ("a.launch.py", "print('hello')\n", "a.launch.py: no function generate_launch_description"),
        ("a.launch.py", "x = '\0'\n", "a.launch.py"),
        ("a.launch", "nothing", "a.launch:1: a launch file in YAML is one key"),
        ("a.txt", NDT, "a.txt: a launch file's name ends in .py, .xml, .yaml, .yml or .launch"),
    ],
)
def test_what_is_no_launch_file_is_named_with_its_line(
    splice: Splice, name: str, text: str, message: str
) -> None:
    with pytest.raises(InputError) as caught:
        splice(name, text)
    assert message in str(caught.value)


def test_a_file_that_is_not_there_or_not_text_is_named(splice: Splice, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"no\.launch\.xml: cannot be read \(No such file"):
        splice_launch_files(
            plan_for("/ndt", "/pose"), [tmp_path / "no.launch.xml"], tmp_path / "spliced"
        )
    (tmp_path / "a.launch.xml").write_bytes(b"<launch>\xff</launch>")
    with pytest.raises(InputError, match=r"a\.launch\.xml:1: not a text in UTF-8"):
        splice_launch_files(
            plan_for("/ndt", "/pose"), [tmp_path / "a.launch.xml"], tmp_path / "spliced"
        )


def test_a_topic_that_nobody_publishes_is_refused_with_the_nodes_there_are(splice: Splice) -> None:
    with pytest.raises(InputError) as caught:
        splice("a.launch.xml", NDT.replace('name="ndt"', 'name="icp" namespace="slam"'))
    assert str(caught.value) == (
        "nobody publishes /pose: the launch files start no node /ndt, only /slam/icp: give the "
        "launch file that starts it, or correct `chain.publisher`"
    )


def test_includes_that_were_not_found_are_told_where_nobody_publishes(splice: Splice) -> None:
    with pytest.raises(
        InputError, match=r"Not found were the files included at .*a\.launch\.xml:1"
    ):
        splice(
            "a.launch.xml",
            '<launch><include file="$(find-pkg-share no_such)/ndt.launch.xml"/></launch>',
        )


def test_a_name_that_matches_twice_is_refused_with_both_places(splice: Splice) -> None:
    node = '  <node pkg="l" exec="n" name="ndt"/>\n'
    twice = f"<launch>\n{node}{node}</launch>"
    with pytest.raises(InputError, match=r"/ndt matches twice: .*a\.launch\.xml:2 and .*xml:3"):
        splice("a.launch.xml", twice)


@pytest.mark.parametrize(
    ("one", "other"),
    [
        ('if="$(var a)"', ""),
        ('if="$(var a)"', 'if="$(var a)"'),
    ],
)
def test_conditions_that_do_not_keep_two_apart_do_not_help(
    splice: Splice, one: str, other: str
) -> None:
    nodes = [f'<node {condition} pkg="l" exec="n" name="ndt"/>' for condition in (one, other)]
    with pytest.raises(InputError, match="matches twice"):
        splice("a.launch.xml", f"<launch>{''.join(nodes)}</launch>")


def test_a_file_included_twice_alike_makes_the_name_match_twice(
    splice: Splice, tmp_path: Path
) -> None:
    (tmp_path / "ndt.launch.xml").write_text(NDT)
    include = '<include file="$(dirname)/ndt.launch.xml"/>'
    with pytest.raises(InputError, match=r"matches twice: .*ndt\.launch\.xml:2 and .*ndt\.launch"):
        splice("a.launch.xml", f"<launch>{include}{include}</launch>")


def test_files_that_include_each_other_are_refused(splice: Splice, tmp_path: Path) -> None:
    (tmp_path / "b.launch.xml").write_text(
        '<launch><include file="$(dirname)/a.launch.xml"/></launch>'
    )
    with pytest.raises(InputError, match=r"b\.launch\.xml:1: includes .*which includes it in turn"):
        splice("a.launch.xml", '<launch><include file="$(dirname)/b.launch.xml"/></launch>')


def test_a_mistake_in_an_included_file_is_named_there(splice: Splice, tmp_path: Path) -> None:
    (tmp_path / "b.launch.yaml").write_text("launch:\n- {\n")
    with pytest.raises(InputError, match=r"b\.launch\.yaml:3: not YAML"):
        splice("a.launch.xml", '<launch><include file="$(dirname)/b.launch.yaml"/></launch>')


def test_a_publisher_that_publishes_elsewhere_is_refused(splice: Splice) -> None:
    node = '<node pkg="l" exec="n" name="ndt"><remap from="/pose" to="/other"/></node>'
    with pytest.raises(
        InputError, match=r"a\.launch\.xml:1: /ndt has /other in place of /pose, so it"
    ):
        splice("a.launch.xml", f"<launch>{node}</launch>")


def test_a_publisher_that_is_remapped_already_is_refused(splice: Splice) -> None:
    node = '<node pkg="l" exec="n" name="ndt"><remap from="out" to="/pose_tmp"/></node>'
    with pytest.raises(InputError, match="/ndt is remapped to /pose_tmp already"):
        splice("a.launch.xml", f"<launch>{node}</launch>")


def test_a_name_that_the_shaping_node_wants_is_refused(splice: Splice) -> None:
    other = '<node pkg="l" exec="n" name="chainshaper_pose"/>'
    with pytest.raises(InputError, match="a node chainshaper_pose is there already"):
        splice("a.launch.xml", NDT.replace("</launch>", f"{other}</launch>"))


def test_a_command_line_that_cannot_be_edited_is_left_to_a_person(splice: Splice) -> None:
    # The command line precedes every other rule, so that no rule from outside would help.
    node = "*[Node(executable=n, name=n, arguments=['-r', 'out:=/pose']) for n in ('a', 'ndt')]"
    with pytest.raises(OperationError, match="the command line of ndt remaps /out and precedes"):
        splice("a.launch.py", PYTHON.format(actions=node))


def test_a_group_that_forwards_nothing_is_left_to_a_person(splice: Splice) -> None:
    nodes = "[Node(executable=n, name=n) for n in ('a', 'ndt')]"
    with pytest.raises(OperationError, match="a group around it forwards nothing from outside"):
        splice("a.launch.py", PYTHON.format(actions=f"GroupAction({nodes}, forwarding=False)"))


def test_a_plan_without_a_shaping_node_is_refused(tmp_path: Path) -> None:
    plan = revised(plan_for("/ndt", "/pose"), shaping_node=None)
    (tmp_path / "a.launch.xml").write_text(NDT)
    with pytest.raises(InputError, match="the plan has no `shaping_node`, so there is nothing"):
        splice_launch_files(plan, [tmp_path / "a.launch.xml"], tmp_path / "spliced")


def test_a_plan_that_does_not_know_the_publisher_is_refused(tmp_path: Path) -> None:
    known = plan_for("/ndt", "/pose")
    plan = revised(known, chain=known.chain.model_copy(update={"publisher": None}))
    (tmp_path / "a.launch.xml").write_text(NDT)
    with pytest.raises(InputError, match="the plan does not say who publishes /pose: name a rec"):
        splice_launch_files(plan, [tmp_path / "a.launch.xml"], tmp_path / "spliced")


@pytest.mark.parametrize("name", ["a'b", "a$b", "a&b", 'a"b', "a\\b", "a<b", "a#b"])
def test_a_folder_that_launch_files_cannot_name_is_refused(tmp_path: Path, name: str) -> None:
    (tmp_path / "a.launch.xml").write_text(NDT)
    with pytest.raises(InputError, match="launch files could not name this folder"):
        splice_launch_files(plan_for("/ndt", "/pose"), [tmp_path / "a.launch.xml"], tmp_path / name)
    assert not (tmp_path / name).exists()


def test_a_folder_that_cannot_be_written_leaves_nothing(full_disk: Path, tmp_path: Path) -> None:
    (tmp_path / "a.launch.xml").write_text(NDT)
    with pytest.raises(ChainshaperError, match="No space left"):
        splice_launch_files(
            plan_for("/ndt", "/pose"), [tmp_path / "a.launch.xml"], full_disk / "spliced"
        )
    assert os.listdir(full_disk) == ["filling"]  # noqa: PTH208
