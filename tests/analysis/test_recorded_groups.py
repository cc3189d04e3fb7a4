"""Callback groups that recordings show: answers worked out by hand."""

from story import Callback, Node, Story

from chainshaper.analysis import data_flow
from chainshaper.analysis.callback_groups import RecordedGroup, recorded_groups
from chainshaper.values.callback_groups import ANNOUNCEMENTS

SERVICES = ("get_parameters", "list_parameters", "get_type_description")


def _node(story: Story, *, announces: bool = True) -> tuple[Node, Callback]:
    """A node with what rclcpp makes for each, in a process that may announce its groups."""
    node = story.node("/front/node", 1)
    for name in SERVICES:
        story.service(node, f"/front/node/{name}")
    parameters = story.subscription(node, "/parameter_events")
    if announces:
        story.publisher(story.node("/cie_thread_configurator/client_node_1", 1), ANNOUNCEMENTS)
    return node, parameters


def _groups(story: Story) -> tuple[RecordedGroup, ...]:
    return recorded_groups(data_flow(story.tables()))


def test_what_a_thread_ran_is_a_group_and_rclcpps_own_are_in_the_default_one() -> None:
    story = Story()
    node, parameters = _node(story)
    timer, reader = story.timer(node, 100_000_000), story.subscription(node, "/points")
    beside = story.timer(node, 20_000_000)
    story.runs(parameters, 1, 2, reads=0, tid=10)
    for at in (10, 20):
        story.runs(timer, at, at + 1, tid=11)
        story.runs(reader, at + 2, at + 3, reads=at, tid=12)
        story.runs(beside, at + 4, at + 5, tid=12)
    own = "".join(f"@Service(/front/node/{name})" for name in sorted(SERVICES))
    groups = _groups(story)
    assert [(known.group.id, known.tids, known.certain) for known in groups] == [
        (f"/front/node{own}@Subscription(/parameter_events)", (10,), True),
        ("/front/node@Subscription(/points)@Timer(20000000)", (12,), True),
        ("/front/node@Timer(100000000)", (11,), True),
    ]
    assert [known.names for known in groups] == [(), ("/points", "every 20ms"), ("every 100ms",)]


def test_a_callback_in_the_default_group_is_with_the_parameter_services() -> None:
    story = Story()
    node, parameters = _node(story)
    timer = story.timer(node, 100_000_000)
    story.runs(parameters, 1, 2, reads=0, tid=10)
    story.runs(timer, 3, 4, tid=10)
    (known,) = _groups(story)
    assert known.group.triggers == ("every 100ms",)
    assert len(known.group.entries) == 2 + len(SERVICES)
    assert known.certain


def test_what_never_ran_may_be_in_any_group() -> None:
    story = Story()
    node, parameters = _node(story)
    timer = story.timer(node, 100_000_000)
    story.service(node, "/reset")  # of the application
    story.runs(parameters, 1, 2, reads=0, tid=10)
    story.runs(timer, 3, 4, tid=11)
    assert [known.certain for known in _groups(story)] == [False, False]


def test_without_a_call_of_its_own_the_default_group_is_not_known() -> None:
    story = Story()
    node, _ = _node(story)
    story.runs(story.timer(node, 100_000_000), 3, 4, tid=11)
    (known,) = _groups(story)
    assert known.group.id == "/front/node@Timer(100000000)"
    assert not known.certain


def test_a_process_that_announces_nothing_has_no_groups_that_are_known() -> None:
    story = Story()
    node, _ = _node(story, announces=False)
    story.runs(story.timer(node, 100_000_000), 3, 4, tid=11)
    assert _groups(story) == ()


def test_actions_are_waitables_which_no_id_names() -> None:
    story = Story()
    node, parameters = _node(story)
    story.service(node, "/tidy/_action/send_goal", callbackless=True)
    story.runs(parameters, 1, 2, reads=0, tid=10)
    story.runs(story.timer(node, 100_000_000), 3, 4, tid=11)
    assert all(known.certain for known in _groups(story))
