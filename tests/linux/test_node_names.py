"""Nodes' names from command lines, by rcl's rules."""

import shlex

import pytest
from hypothesis import given
from hypothesis import strategies as st

from chainshaper.linux.processes import guessed_name, named_nodes, takes_ros_arguments

CASES = {
    "talker": (),
    "talker --ros-args": (),
    "talker --ros-args -r __node:=x": ("/x",),
    "talker --ros-args --remap __node:=x": ("/x",),
    "talker --ros-args -r __name:=x": ("/x",),
    "talker --ros-args -r __node:=x -r __ns:=/y": ("/y/x",),
    "talker --ros-args -r __ns:=/y/z -r __node:=x": ("/y/z/x",),
    "talker --ros-args -r __node:=x -r __ns:=/": ("/x",),
    "talker --ros-args -r old:__node:=x": ("/x",),
    "talker --ros-args -r old:__node:=x -r old:__ns:=/y": ("/y/x",),
    "talker --ros-args -r old:__ns:=/y": ("/y/old",),
    "two --ros-args -r a:__node:=x -r b:__node:=y": ("/x", "/y"),
    "two --ros-args -r a:__node:=x -r b:__node:=y -r __ns:=/n": ("/n/x", "/n/y"),
    # Of rules that apply the first counts.
    "talker --ros-args -r __node:=x -r __node:=y": ("/x",),
    "two --ros-args -r __node:=x -r b:__node:=y": ("/x",),
    "two --ros-args -r b:__node:=y -r __node:=x": ("/y", "/x"),
    "two --ros-args -r b:__node:=y -r __ns:=/n -r b:__ns:=/late": ("/n/y",),
    "two --ros-args -r b:__node:=y -r b:__ns:=/early -r __ns:=/n": ("/early/y",),
    # Parameters, their files and levels are values, whatever they look like.
    "talker --ros-args -p text:=__node:=no -r __node:=x": ("/x",),
    "talker --ros-args -p __node:=no": (),
    "talker --ros-args -p 'text:=-r __node:=no'": (),
    "talker --ros-args --params-file -r __node:=x": (),
    "talker --ros-args --log-level debug -r __node:=x": ("/x",),
    "talker --ros-args --log-level rcl:=debug --disable-rosout-logs -r __node:=x": ("/x",),
    "talker --ros-args -r chatter:=__node -r a/b:=/c": (),
    # Only behind --ros-args, and not behind --.
    "talker -r __node:=x": (),
    "talker __node:=x": (),
    "talker --ros-args -r a:=b -- -r __node:=no": (),
    "talker --ros-args -- --ros-args -r __node:=x": ("/x",),
    "sh -c 'talker --ros-args -r __node:=x'": (),
    # What rcl refuses to start with names nobody.
    "talker --ros-args -r": (),
    "talker --ros-args -r __node:=": (),
    "talker --ros-args -r __node:=/foo/bar": (),
    "talker --ros-args -r __node:=3d": (),
    "talker --ros-args -r __ns:=foo -r __node:=x": ("/x",),
    "talker --ros-args -r :__node:=x": (),
    "talker --ros-args -r ~:__node:=x": (),
}


@pytest.mark.parametrize(("line", "names"), CASES.items(), ids=list(CASES))
def test_nodes_are_named_as_rcl_names_them(line: str, names: tuple[str, ...]) -> None:
    assert named_nodes(shlex.split(line)) == names


NAMES = st.from_regex(r"[A-Za-z_][A-Za-z0-9_]{0,8}", fullmatch=True)
NAMESPACES = st.from_regex(r"/|(/[a-z][a-z0-9_]{0,5}){1,3}", fullmatch=True)
VALUES = st.text(st.characters(exclude_characters="\0", exclude_categories=["Cs"]), max_size=12)
# Whatever else may stand behind --ros-args, with its value where it takes one.
OTHERS = st.one_of(
    st.tuples(st.just("-p"), st.builds("{}:={}".format, NAMES, VALUES)),
    st.tuples(st.just("-p"), st.builds("text:=__node:={}".format, NAMES)),
    st.tuples(st.sampled_from(["--params-file", "--log-level", "-e", "--enclave"]), VALUES),
    st.tuples(st.just("-r"), st.builds("{}:=/{}".format, NAMES.filter(str.islower), NAMES)),
    st.tuples(st.sampled_from(["--disable-rosout-logs", "--enable-stdout-logs"])),
)


@given(
    st.lists(VALUES.filter(lambda value: value != "--ros-args"), max_size=3),
    NAMES,
    NAMESPACES,
    st.lists(OTHERS, max_size=4),
    st.data(),
)
def test_a_node_is_found_among_whatever_else_there_is(
    before: list[str], name: str, namespace: str, others: list[tuple[str, ...]], data: st.DataObject
) -> None:
    rules = [("-r", f"__node:={name}"), ("--remap", f"__ns:={namespace}")]
    arguments = data.draw(st.permutations([*others, *rules]))
    command = ["program", *before, "--ros-args", *(word for part in arguments for word in part)]
    assert named_nodes(command) == (f"{namespace.rstrip('/')}/{name}",)
    assert takes_ros_arguments(command)


@given(st.lists(VALUES, max_size=8))
def test_any_command_line_can_be_read(command: list[str]) -> None:
    for name in (*named_nodes(["a", "--ros-args", *command]), *named_nodes(command)):
        assert name.startswith("/")
    guessed_name(command)


@pytest.mark.parametrize(
    ("line", "name"),
    [
        ("/opt/ros/jazzy/lib/demo_nodes_cpp/talker --ros-args", "/talker"),
        ("/usr/bin/python3 -u /opt/ros/jazzy/lib/demo_nodes_py/listener.py", "/listener"),
        ("python3.12 -m", None),
        ("python3 -c 'import rclpy'", None),
        ("./my-node", "/my_node"),
    ],
)
def test_without_a_rule_the_program_gives_a_guess(line: str, name: str | None) -> None:
    assert guessed_name(shlex.split(line)) == name
    assert named_nodes(shlex.split(line)) == ()
