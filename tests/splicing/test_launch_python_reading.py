"""Reading Python launch files: what they would do is found without doing it."""

import textwrap
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from launch_cases import plan_for

from chainshaper import splice_launch_files
from chainshaper.splicing.launch.actions import NodeAction, Unreadable, flattened
from chainshaper.splicing.launch.file import read_text
from chainshaper.splicing.launch.substitutions import Surroundings, resolve
from chainshaper.values.errors import InputError

FILE = Path("/robot/launch/robot.launch.py")
IMPORTS = """
import os
from pathlib import Path
from launch import LaunchDescription
from launch.actions import *
from launch.substitutions import *
from launch_ros.actions import Node
"""


def names_of(body: str) -> list[str | None]:
    """The names of the nodes that a launch file with this body starts; None where unknown."""
    lines = textwrap.indent(textwrap.dedent(body), "    ")
    text = f"{IMPORTS}\n\ndef generate_launch_description():\n{lines}"
    nodes = [one for one in flattened(read_text(FILE, text).actions) if isinstance(one, NodeAction)]
    where = Surroundings({}, FILE)
    return [None if node.name is None else resolve(node.name, where) for node in nodes]


@pytest.mark.parametrize(
    ("expression", "name"),
    [
        ("'a'", "a"),
        ("'a' 'b'", "ab"),
        ("'a' + '_' + str(1)", "a_1"),
        ("f'a_{1 - 2}'", "a_-1"),
        ("'{}_{x}'.format('a', x=1)", None),
        ("'{}_{}'.format('a', 1)", "a_1"),
        ("'%s_%d' % ('a', 1)", "a_1"),
        ("'%100000000d' % 1", None),
        ("'{:100000000}'.format(1)", None),
        ("'_'.join(['a', 'b'])", "a_b"),
        ("'A'.lower()", "a"),
        ("['a', 'b'][-1]", "b"),
        ("{'x': 'a'}['x']", "a"),
        ("{'x': 'a'}.get('y', 'b')", "b"),
        ("{**{'x': 'a'}, 'y': 'b'}['x']", "a"),
        ("'a' if 1 > 2 else 'b'", "b"),
        ("'a' if 'x' in ['x'] else 'b'", "a"),
        ("'a' if os.path.exists('/') else 'b'", None),
        ("['a', '_', 'b']", "a_b"),
        ("TextSubstitution(text='a')", "a"),
        ("LaunchConfiguration('n', default='a')", "a"),
        ("f\"{LaunchConfiguration('n', default='a')}_1\"", "a_1"),
        ("PythonExpression(['1', '+', '1'])", None),
        ("os.path.basename(__file__)", None),
        ("Path(__file__).parent / 'a'", "/robot/launch/a"),
        ("os.path.join(os.path.dirname(__file__), 'a')", "/robot/launch/a"),
        ("PathJoinSubstitution([ThisLaunchFileDir(), 'a'])", "/robot/launch/a"),
        ("os.environ.get('CHAINSHAPER_NOT_SET', 'a')", "a"),
        ("not_known", None),
        ("(lambda: 'a')()", None),
        ("[n for n in ('a', 'b') if n != 'a'][0]", "b"),
        ("9 ** 9 ** 9 ** 9", None),
    ],
)
def test_names_are_put_together_as_python_would(expression: str, name: str | None) -> None:
    assert names_of(f"return LaunchDescription([Node(name={expression})])") == [name]


@pytest.mark.parametrize(
    ("body", "names"),
    [
        ("a, (b, *_) = 'x', ('y', 'z')\nreturn LaunchDescription([Node(name=a)])", ["x"]),
        (
            "nodes = []\nfor i, n in enumerate(['a', 'b'], 1):\n"
            "    nodes.append(Node(name=n + str(i)))\n"
            "return LaunchDescription(nodes)",
            ["a1", "b2"],
        ),
        (
            "nodes = []\nfor n in ('a', 'b', 'c'):\n    if n == 'a':\n        continue\n"
            "    nodes += [Node(name=n)]\n    if n == 'b':\n        break\n"
            "return LaunchDescription(nodes)",
            ["b"],
        ),
        (
            "n = 'a'\nif os.path.exists('/'):\n    n = 'b'\n"
            "return LaunchDescription([Node(name=n)])",
            [None],
        ),
        (
            "ld = LaunchDescription()\nif os.path.exists('/'):\n    ld.add_action(Node(name='a'))\n"
            "    return ld\nld.add_action(Node(name='b'))\nreturn ld",
            ["a", "b"],
        ),
        (
            "with open('/dev/null') as f:\n    n = Node(name='a')\nreturn LaunchDescription([n])",
            ["a"],
        ),
        (
            "def make(n='a', *more, sep='_'):\n    return [Node(name=n + sep + m) for m in more]\n"
            "return LaunchDescription(make('x', 'y', 'z', sep='-'))",
            ["x-y", "x-z"],
        ),
        (
            "def one(context, n, k='_'):\n    return [Node(name=n + k)]\n"
            "more = {'k': '1'}\n"
            "return LaunchDescription([OpaqueFunction(function=one, args=['a'], kwargs=more)])",
            ["a1"],
        ),
        ("d = {}\nd['n'] = 'a'\nreturn LaunchDescription([Node(name=d['n'])])", ["a"]),
        ("n: str = 'a'\nn += 'b'\nreturn LaunchDescription([Node(name=n)])", ["ab"]),
        ("while True:\n    pass\nreturn LaunchDescription([Node(name='a')])", ["a"]),
        ("return LaunchDescription([Node(name='a') for _ in zip([1, 2], [3, 4])])", ["a", "a"]),
    ],
)
def test_statements_are_followed_as_python_would(body: str, names: list[str | None]) -> None:
    assert names_of(body) == names


@pytest.mark.parametrize(
    "body",
    [
        "def f():\n    return f()\nreturn f()",
        "x = 'a'\nfor i in range(1000):\n    x = x + x\nreturn LaunchDescription([Node(name=x)])",
        "x = ['a']\nfor i in range(1000):\n    x += x\nreturn LaunchDescription([Node(name=x)])",
        "for a in range(1000):\n    for b in range(1000):\n        Node(name='x')\nreturn 1",
        "x = 'a'\nfor i in range(99):\n    x = x.replace('a', 'aa')\nreturn LaunchDescription()",
    ],
)
def test_a_file_that_computes_without_end_is_given_up(body: str) -> None:
    text = f"{IMPORTS}\ndef generate_launch_description():\n{textwrap.indent(body, '    ')}\n"
    actions = read_text(FILE, text).actions
    assert any(isinstance(action, Unreadable) for action in actions)


def test_reading_a_launch_file_runs_nothing_of_it(tmp_path: Path) -> None:
    ran = tmp_path / "ran"
    touch = f"open({str(ran)!r}, 'w').close()"
    robot = tmp_path / "robot.launch.py"
    robot.write_text(
        f"{IMPORTS}\n{touch}\nimport no_such_module\n"
        f"class Own(Node):\n    {touch}\n"
        f"def decorated(f):\n    {touch}\n    return f\n"
        f"@decorated\ndef generate_launch_description(x={touch}):\n    {touch}\n"
        f"    os.system('touch {ran}')\n"
        f"    return LaunchDescription([Node(executable='n', name='ndt', output={touch})])\n"
    )
    splice_launch_files(plan_for("/ndt", "/pose"), [robot], tmp_path / "spliced")
    assert not ran.exists()


@pytest.mark.parametrize("mark", ["", "\ufeff"])
def test_places_are_right_behind_any_characters(tmp_path: Path, mark: str) -> None:
    robot = tmp_path / "robot.launch.py"
    text = (
        f"{mark}from launch import LaunchDescription; from launch_ros.actions import Node\r\n"
        "def generate_launch_description():\r\n"
        "    return LaunchDescription(['äöü𝄞' and Node(executable='n', name='x'), "
        "Node(executable='ß𝄞', name='ndt', remappings=[('ä𝄞', '/pose')])])\r\n"
    )
    robot.write_bytes(text.encode())
    splice_launch_files(plan_for("/ndt", "/pose"), [robot], tmp_path / "spliced")
    copy = (tmp_path / "spliced/robot.launch.py").read_bytes().decode()
    assert "remappings=[('ä𝄞', '/pose_tmp')])])\r\n" in copy
    assert copy.startswith(mark)


PIECES = st.sampled_from(
    [
        "x", "y", "'a'", "1", "[x, 'b']", "(x, y)", "{'k': x}", "Node(name=x)", "f'{x}_{y}'",
        "x + y", "x[0]", "x['k']", "x.append(y)", "x.items()", "x()", "LaunchConfiguration(x)",
        "LaunchDescription(x)", "GroupAction(x)", "OpaqueFunction(function=x)", "os.getenv(x, y)",
        "Node(**x)", "[z for z in x]", "x if y else x", "not x", "x % y", "lambda: x", "x / y",
        "IncludeLaunchDescription(x)", "SetRemap(x, y)", "range(x)", "zip(x, y)", "x.format(y)",
    ]
)  # fmt: skip
STATEMENTS = st.lists(
    st.tuples(
        st.sampled_from(
            ["x = {}", "y = {}", "{}", "x += {}", "for x in {}:\n        y = x", "return {}",
             "if {}:\n        x = y", "def x(a=1):\n        return {}", "x, y = {}", "x[0] = {}"]
        ),
        PIECES,
    ),
    max_size=8,
)  # fmt: skip


@given(STATEMENTS)
def test_whatever_python_says_can_be_read(statements: list[tuple[str, str]]) -> None:
    body = "".join(f"    {form.format(piece)}\n" for form, piece in statements)
    text = f"{IMPORTS}\nx = y = 'start'\n\ndef generate_launch_description():\n{body}    return x\n"
    try:
        file = read_text(FILE, text)
    except InputError as error:  # such as a `return` of what is no launch file's
        assert "not Python" in str(error)
    else:
        assert isinstance(file.actions, tuple)
