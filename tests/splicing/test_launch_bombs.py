"""Launch files that would keep a reader busy for ever: read in time, or refused with the limit."""

from pathlib import Path

import pytest
from launch_cases import plan_for

from chainshaper.flow.launch_splicing import splice_launch_files
from chainshaper.values.errors import ChainshaperError, InputError

NODE = '<node pkg="p" exec="e" name="ndt"/>'
TOP = "from launch import LaunchDescription\nfrom launch_ros.actions import Node\n"
PYTHON = TOP + "def generate_launch_description():\n{body}    return LaunchDescription([{made}])\n"
MADE = 'Node(package="p", executable="e", name="ndt")'


def _doubled(first: str, step: str, times: int = 40) -> str:
    lines = [first, *[step] * times]
    return PYTHON.format(body="".join(f"    {line}\n" for line in lines), made=f"{MADE}, *[x]")


def _aliases(first: str, step: str) -> str:
    lines = [first.format(n=0), *(step.format(n=n, m=n - 1) for n in range(1, 30))]
    return "launch:\n" + "".join(f"- {line}\n" for line in lines)


ENTITIES = "".join(f'<!ENTITY e{n + 1} "{f"&e{n};" * 10}">' for n in range(12))
BOMBS = {
    "nested.launch.xml": (
        f"<launch>{'<group>' * 900}{NODE}{'</group>' * 900}</launch>", "more than 100 elements"),
    "nested.launch.yaml": (
        "launch: " + "[{group: " * 900 + "[]" + "}]" * 900, "more than 100 lists and mappings"),
    "many.launch.xml": (
        "<launch>" + "".join(f'<node pkg="p" exec="e" name="n{n}"/>\n' for n in range(40_000))
        + NODE + "</launch>", "more than 5000 nodes"),
    "nameless.launch.xml": (
        "<launch>" + '<node pkg="p" exec="e" if="$(var x)"/>\n' * 4_900 + NODE + "</launch>", None),
    "rules.launch.xml": (
        "<launch>" + '<set_remap from="/a" to="/b"/>' * 4_000 + NODE * 4_000 + "</launch>",
        "more than 5000000 rules"),
    "entities.launch.xml": (
        f'<!DOCTYPE x [<!ENTITY e0 "lol">{ENTITIES}]><launch><node name="&e12;"/></launch>',
        "the XML entity e1 is not"),
    "external.launch.xml": (
        f'<!DOCTYPE x [<!ENTITY e SYSTEM "/etc/passwd">]><launch>{NODE}</launch>',
        "the XML entity e is not"),
    "texts.launch.xml": (
        '<launch><let name="x" value="xxxxxxxx"/>'
        + '<let name="x" value="$(var x)$(var x)"/>' * 60 + f"{NODE}</launch>", None),
    "substitutions.launch.xml": (
        f'<launch><let name="x" value="{"$(var " * 5_000}x{")" * 5_000}"/>{NODE}</launch>', None),
    "aliases.launch.yaml": (
        _aliases("group: &a{n} [{{let: {{name: x, value: y}}}}]",
                 "group: &a{n} [{{group: *a{m}}}, {{group: *a{m}}}]"), "with its aliases"),
    "merges.launch.yaml": (
        _aliases("node: &a{n} {{pkg: p, exec: e, name: ndt}}",
                 "let: &a{n} {{<<: [*a{m}, *a{m}, *a{m}], name: x, value: y}}"), None),
    "lists.launch.py": (_doubled("x = [[1], [2]]", "x = [x, x]"), None),
    "actions.launch.py": (
        _doubled("x = GroupAction([])", "x = GroupAction([x, x])"), "more than 100000 actions"),
    "paths.launch.py": (
        _doubled("x = LaunchConfiguration('x')", "x = os.path.join(x, x)").replace(
            TOP, TOP + "import os\nfrom launch.substitutions import LaunchConfiguration\n"), None),
    "sums.launch.py": (_doubled("x = LaunchConfiguration('x')", "x = x + x"), None),
    "printed.launch.py": (_doubled("x = ['x'] * 1", "x = [x, str([x, x])]"), None),
    "loops.launch.py": (
        PYTHON.format(made=MADE, body="    x = range(1000)\n" + "".join(
            "    " + " " * n + "for y in x:\n" for n in range(9)) + " " * 13 + "pass\n"), None),
    "conditions.launch.py": (
        PYTHON.format(made=MADE.replace(")", ", condition=x)"),
                      body="    x = [1]\n" + "    x = [x, x]\n" * 40), None),
    "brackets.launch.py": ("x = " + "[" * 5_000 + "]" * 5_000 + "\n", "not Python"),
    "signs.launch.py": ("x = " + "-" * 100_000 + "1\n" + PYTHON.format(body="", made=MADE), None),
}  # fmt: skip
BOMBS["actions.launch.py"] = (
    BOMBS["actions.launch.py"][0].replace(TOP, TOP + "from launch.actions import GroupAction\n"),
    BOMBS["actions.launch.py"][1],
)


@pytest.mark.parametrize("name", BOMBS)
def test_it_is_read_in_time_or_refused_with_the_limit(name: str, tmp_path: Path) -> None:
    text, reason = BOMBS[name]
    file = tmp_path / name
    file.write_text(text)
    plan = plan_for("/ndt", "/pose")
    if reason is not None:
        with pytest.raises(InputError, match=reason) as refused:
            splice_launch_files(plan, [file], tmp_path / "spliced")
        assert str(refused.value).startswith(f"{file}:")
        return
    try:
        splice_launch_files(plan, [file], tmp_path / "spliced")
    except ChainshaperError as error:
        assert len(str(error)) < 1_000_000, "a message for a person"


def test_includes_that_double_are_refused_with_the_limit(tmp_path: Path) -> None:
    for number in range(22):
        twice = f'<include file="$(dirname)/{number + 1}.launch.xml"/>' * 2
        (tmp_path / f"{number}.launch.xml").write_text(f"<launch>{twice}</launch>")
    (tmp_path / "22.launch.xml").write_text(f"<launch>{NODE}</launch>")
    with pytest.raises(InputError, match=r"0\.launch\.xml has more than 2000 included files"):
        splice_launch_files(
            plan_for("/ndt", "/pose"), [tmp_path / "0.launch.xml"], tmp_path / "spliced"
        )


def test_includes_in_a_long_row_are_refused_with_the_limit(tmp_path: Path) -> None:
    for number in range(400):
        (tmp_path / f"{number}.launch.xml").write_text(
            f'<launch><include file="$(dirname)/{number + 1}.launch.xml"/></launch>'
        )
    (tmp_path / "400.launch.xml").write_text(f"<launch>{NODE}</launch>")
    with pytest.raises(InputError, match="more than 150 groups and includes inside each other"):
        splice_launch_files(
            plan_for("/ndt", "/pose"), [tmp_path / "0.launch.xml"], tmp_path / "spliced"
        )
