"""Which rules redirect a node, in all ways to write a command line or a request; without ROS 2."""

import shlex
from types import SimpleNamespace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from chainshaper.splicing.redirection import (
    Redirect,
    expanded,
    nodes_of,
    redirect_command,
    redirect_request,
    redirecting,
)


def pose(*nodes: str, kind: str = "publisher") -> Redirect:
    return Redirect(kind, "/pose", "/pose_tmp", nodes or ("/ndt",), ("/shaping", "/standby"))


def topic_of(name: str, node: str, rules: list[str]) -> str:
    """What `rcl_remap_first_match` makes of a name: written down a second time, for topics."""
    base, full = node.rpartition("/")[2], expanded(name, node)
    for rule in rules:
        match, target = rule.split(":=", 1)
        owner, colon, rest = match.partition(":")
        if colon and owner not in ("rostopic", base):
            continue
        if not match.startswith("__") and expanded(rest if owner == base else match, node) == full:
            return expanded(target, node)
    return full


@pytest.mark.parametrize(
    ("rules", "added"),
    [
        (["/loc/out:=/pose", "out:=/pose"], {"/loc/out": 0, "/pose": 2}),  # one name: the first
        (["points:=/p", "ndt:out:=/pose"], {"out": 1, "/pose": 2}),
        (["planner:out:=/pose"], {"/pose": 1}),
        (["rostopic://out:=rostopic:///pose"], {"out": 0, "/pose": 1}),
        (["rosservice://out:=/pose"], {"/pose": 1}),
        (["~/out:=/pose", "__node:=ndt", "__ns:=/loc"], {"~/out": 0, "/pose": 3}),
        (["{node}/out:=/pose"], {"{node}/out": 0, "/pose": 1}),
        (["/pose:=/other", "out:=/pose"], {"out": 1}),
        (["/pose:=/other"], None),
        (["/pose:=/pose_tmp"], {}),
    ],
)
def test_every_name_that_has_the_topic_gets_the_target(
    rules: list[str], added: dict[str, int] | None
) -> None:
    found = redirecting(rules, "/loc/ndt", "/pose", "/pose_tmp")
    wanted = [(place, f"ndt:{match}:=/pose_tmp") for match, place in (added or {}).items()]
    assert found == (None if added is None else wanted)


NAMES = st.sampled_from(["out", "~/out", "/pose", "pose", "/loc/out", "/loc/pose", "ndt/out", "x"])
RULES = st.lists(
    st.builds(
        lambda owner, match, target: f"{owner}{match}:={target}",
        *(st.sampled_from(["", "ndt:", "planner:", "rostopic://"]), NAMES, NAMES),
    ),
    max_size=6,
)


@given(RULES, NAMES, st.sampled_from(["/ndt", "/loc/ndt"]))
def test_exactly_the_topic_is_redirected_whatever_the_rules(
    rules: list[str], name: str, node: str
) -> None:
    added = redirecting(rules, node, "/pose", "/pose_tmp") or []
    after = list(rules)
    for place, rule in reversed(added):
        after.insert(place, rule)
    was, now = topic_of(name, node, rules), topic_of(name, node, after)
    assert now == ("/pose_tmp" if was == "/pose" else was)
    for other in ("/planner", "/loc/planner"):
        assert topic_of(name, other, after) == topic_of(name, other, rules)


RULE = "--ros-args -r ndt:/pose:=/pose_tmp"


@pytest.mark.parametrize(
    ("command", "wanted"),
    [
        ("n -r x:=y --ros-args -r __node:=ndt", "{0} " + RULE),
        (
            "n --ros-args --remap a:=/pose -r __node:=ndt -- -r b:=/pose",
            "n --ros-args -r ndt:a:=/pose_tmp --remap a:=/pose -r __node:=ndt -- -r b:=/pose "
            + RULE,
        ),
        ("nice ros2 run l n --ros-args -r __ns:=/", "{0} " + RULE),
        ("n --ros-args -r __node:=ndt -r __ns:=/a", "{0}"),
        ("n --ros-args -r __node:=icp", "{0}"),
        ("n --ros-args -r a:__node:=ndt", "{0} " + RULE),
        ("ls -r x", "{0}"),
    ],
)
@pytest.mark.parametrize("shell", [False, True])
def test_a_command_line_is_redirected_if_it_starts_the_node(
    command: str, wanted: str, shell: bool
) -> None:
    words = [command] if shell else command.split()
    redirect_command(words, [pose()], "n-1", SimpleNamespace(shell=shell))
    assert shlex.split(" ".join(words)) == wanted.format(command).split()


@pytest.mark.parametrize(
    ("command", "wanted"),
    [
        ("F='[{x}] $y' ros2 run l n", f"F='[{{x}}] $y' ros2 run l n {RULE}"),
        ("A= B='' C=c ros2 run l 'n m'", f"A='' B='' C=c ros2 run l 'n m' {RULE}"),
        ("F='[{x}] $y' ros2 run l n --ros-args -r __node:='icp'", None),  # not meant: as it was
        # What only a shell understands.
        *((f"ros2 run {text}", None) for text in ("l n; ls", "l $N", "'l n", "l [a-n]")),
        *((f"ros2 run l {text}", None) for text in ("\"'$N'\"", "\\' $N \\'")),  # no such quotes
    ],
)
def test_a_shell_sees_variables_that_are_set_before_one_plain_command(
    command: str, wanted: str | None
) -> None:
    words = [command]
    redirect_command(words, [pose()], "n-1", SimpleNamespace(shell=True))  # noqa: S604 - none is called
    assert words == [wanted or command]


@pytest.mark.parametrize(
    ("name", "namespace", "redirected"),
    [("ndt", "/", True), ("ndt", "/a", False), ("", "", True), ("icp", "", False)],
)
def test_a_request_for_a_component_is_redirected_if_it_loads_the_node(
    name: str, namespace: str, redirected: bool
) -> None:
    rules = ["out:=/pose"]
    request = SimpleNamespace(
        node_name=name, node_namespace=namespace, plugin_name="l::N", remap_rules=rules
    )
    redirect_request(request, [pose()])
    ours = ["ndt:out:=/pose_tmp", "out:=/pose", "ndt:/pose:=/pose_tmp"]
    assert request.remap_rules == (ours if redirected else rules)


def test_a_shaping_node_that_is_a_component_stands_behind_components_only() -> None:
    redirect = pose()
    redirect.component = {"name": "shaping"}
    words = ["n", "--ros-args", "-r", "__node:=ndt"]
    redirect_command(words, [redirect], "n-1")
    assert words == ["n", "--ros-args", "-r", "__node:=ndt"], "nothing would publish its output"
    assert (redirect.mistake(["/ndt"], []) or "").startswith(
        "nothing was redirected: no launch file has a container load /ndt, and its shaping node is"
    )

    request = SimpleNamespace(node_name="ndt", node_namespace="", plugin_name="l::N")
    request.remap_rules = []
    assert redirect_request(request, [redirect, pose("/icp")]) == [redirect]
    assert redirect.mistake([], ["/ndt"]) is None, "it is not loaded yet"
    redirect.loaded = True
    assert (redirect.mistake([], ["/ndt"]) or "").startswith("the container did not load /shaping")
    assert redirect.mistake(["/shaping"], ["/ndt"]) is None


def started(redirect: Redirect, *commands: str, ended: bool = False) -> Redirect:
    for number, command in enumerate(commands):
        action = SimpleNamespace(shell=False, return_code=0 if ended and number == 0 else None)
        redirect_command(command.split(), [redirect], f"n-{number}", action)
    return redirect


NAMED = "n --ros-args -r __node:=ndt"
UNNAMED = "n --ros-args"


@pytest.mark.parametrize(
    ("commands", "on_topic", "on_target", "mistake"),
    [
        ([NAMED], ["/shaping"], ["/ndt"], None),
        ([NAMED], ["/shaping", "/standby"], [], None),  # it may publish later
        ([UNNAMED], [], ["/ndt"], None),
        ([UNNAMED], [], [], "nothing was redirected: no node /ndt runs; started were an unnamed"),
        ([], ["/icp"], [], "nothing was redirected: no node /ndt runs; started were none"),
        ([f"{NAMED} -r /pose:=/x"], [], [], "nothing was redirected: /ndt has another topic"),
        ([NAMED], ["/icp"], ["/ndt"], "/icp publishes it past /shaping, /standby"),
        ([NAMED], [], ["/ndt", "/icp"], "more was redirected than meant: /icp publishes /pose_tmp"),
        ([NAMED, NAMED], [], [], "more was redirected than meant: /ndt was started more than once"),
    ],
)
def test_what_was_started_is_compared_with_the_graph(
    commands: list[str], on_topic: list[str], on_target: list[str], mistake: str | None
) -> None:
    redirect = started(pose(), *commands)
    found = redirect.mistake(on_topic, on_target)
    assert (found is None) if mistake is None else (found or "").startswith(mistake), found
    said = redirect.message(found or "", ["/icp"], [])
    assert said.startswith(f"/pose: {found or ''}. Publishers found: of /pose /icp; of /pose_tmp n")


def test_a_publisher_whose_node_discovery_has_not_named_yet_is_no_other_node() -> None:
    """What `rmw` says of an endpoint whose participant has not told its nodes yet."""
    ndt = SimpleNamespace(node_namespace="/", node_name="ndt")
    unknown = SimpleNamespace(
        node_namespace="_NODE_NAMESPACE_UNKNOWN_", node_name="_NODE_NAME_UNKNOWN_"
    )
    assert nodes_of([ndt]) == (["/ndt"], False)
    assert nodes_of([ndt, unknown]) == (["/ndt"], True)
    redirect = started(pose(), NAMED)
    assert redirect.mistake(nodes_of([unknown])[0], nodes_of([ndt, unknown])[0]) is None


def test_any_may_subscribe_to_a_throttled_topic_and_what_has_ended_may_start_again() -> None:
    redirect = started(pose("/ndt", "/icp", kind="subscription"), NAMED)
    assert redirect.mistake(["/other"], ["/ndt", "/icp", "/rviz"]) is None
    past = redirect.mistake(["/icp"], ["/ndt", "/icp"])
    assert past == "/icp subscribes to it past /shaping, /standby"
    ended = started(pose(), NAMED, ended=True).mistake([], [])
    assert (ended or "").startswith("nothing was redirected: no node /ndt runs")
    assert started(pose(), NAMED, NAMED, ended=True).mistake([], []) is None
