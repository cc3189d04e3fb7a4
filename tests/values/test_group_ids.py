"""Ids and files of callback_isolated_executor: answers by hand, from its sources."""

from pathlib import Path

import pytest
import yaml

from chainshaper.values.callback_groups import (
    CallbackGroup,
    group_configuration_text,
    parse_group_id,
    read_group_configuration,
    sorted_group,
)
from chainshaper.values.errors import InputError

# The examples of its README, in the order of earlier versions.
SERVICES = "@Service(/sample_node/get_parameters)@Service(/sample_node/list_parameters)"
DEFAULT = f"/sample_node@Subscription(/parameter_events){SERVICES}"
FILE = f"""\
hardware_info: {{model_name: A processor}}
callback_groups:
  - id: {DEFAULT}@Waitable@Waitable
    affinity: ~
    policy: SCHED_OTHER
    priority: -5
  - id: /sample_node@Timer(1333000000)
    affinity: [2, 1]
    policy: SCHED_FIFO
    priority: 50
  - id: /sample_node@Subscription(/topic_in)@Timer(100000000)
    policy: SCHED_DEADLINE
    runtime: 10000000
    deadline: 15000000
    period: 20000000
  - id: /front/filter/*
    domain_id: 3
    affinity: []
    policy: SCHED_RR
    priority: 7
non_ros_threads:
  - name: worker
    policy: SCHED_BATCH
    nice: 3
"""


@pytest.fixture
def path(tmp_path: Path) -> Path:
    path = tmp_path / "groups.yaml"
    path.write_text(FILE)
    return path


@pytest.mark.parametrize(
    ("text", "node", "entries", "triggers"),
    [
        (DEFAULT, "/sample_node", 3, ()),
        (f"{DEFAULT}@Waitable@Waitable", "/sample_node", 3, ()),
        ("/a/b@Timer(1333000000)", "/a/b", 1, ("every 1.333s",)),
        ("/n@Subscription(/t)@Timer(1)@Timer(1)", "/n", 3, ("/t", "every 1ns")),
        ("/n@Client(/c)@Service(/s)", "/n", 2, ()),
        ("/n", "/n", 0, ()),  # a group with nothing but waitables
    ],
)
def test_an_id_names_a_node_and_what_its_group_holds(
    text: str, node: str, entries: int, triggers: tuple[str, ...]
) -> None:
    group = parse_group_id(text)
    assert (group.node, len(group.entries), group.triggers) == (node, entries, triggers)
    assert group.id == text.replace("@Waitable", "")
    assert parse_group_id(group.id) == group


def test_ids_of_newer_versions_are_sorted() -> None:
    entries = ("Subscription(/t)", "Service(/s)", "Client(/c)", "Timer(20)", "Timer(100)")
    newer = sorted_group("/n", entries)
    assert newer.id == "/n@Client(/c)@Service(/s)@Subscription(/t)@Timer(100)@Timer(20)"
    assert newer.key == CallbackGroup("/n", entries).key
    assert newer.key != CallbackGroup("/n", (*entries, "Timer(20)")).key


@pytest.mark.parametrize(
    "text", ["", "n@Timer(1)", "/n@Timer(1ms)", "/n@Timer()", "/n@", "/n@Guard(/x)", "/*", "/n@*"]
)
def test_what_is_no_id_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match="callback group"):
        parse_group_id(text)


def test_a_file_says_what_each_thread_gets(path: Path) -> None:
    read = read_group_configuration(path)
    shown = [(group.id, entry.text) for group, entry in read.groups]
    assert shown == [
        (DEFAULT, "SCHED_OTHER, nice -5"),
        ("/sample_node@Timer(1333000000)", "SCHED_FIFO 50, cores 2, 1"),
        ("/sample_node@Subscription(/topic_in)@Timer(100000000)", "SCHED_DEADLINE 10ms of 20ms"),
        ("/front/filter/*", "SCHED_RR 7"),
    ]
    (worker,) = read.non_ros_threads or ()
    assert worker.text == "SCHED_BATCH, nice 3"


def test_a_thread_is_known_by_what_it_runs(path: Path) -> None:
    read = read_group_configuration(path)

    def of(*callbacks: tuple[str, str]) -> str | None:
        pair = read.of_thread(callbacks)
        return None if pair is None else pair[0].id

    mixed = "/sample_node@Subscription(/topic_in)@Timer(100000000)"
    assert of(("/sample_node", "every 1.333s")) == "/sample_node@Timer(1333000000)"
    assert of(("/sample_node", "/topic_in")) == mixed
    assert of(("/sample_node", "/topic_in"), ("/sample_node", "every 100ms")) == mixed
    assert of(("/front/filter", "/anything")) == "/front/filter/*"
    assert of(("/sample_node", "every 1.333s"), ("/sample_node", "/topic_in")) is None
    assert of(("/sample_node", "every 1.333s"), ("/front/filter", "/x")) is None
    assert of() is None
    assert of(("/else", "every 1.333s")) is None


def test_groups_that_cannot_be_told_apart_are_nobodys(tmp_path: Path) -> None:
    path = tmp_path / "groups.yaml"
    entry = "{id: /n@%sTimer(5), policy: SCHED_FIFO, priority: 1}"
    path.write_text(f"callback_groups: [{entry % ''}, {entry % 'Subscription(/t)@'}]\n")
    read = read_group_configuration(path)
    assert read.of_thread([("/n", "every 5ns")]) is None
    assert read.of_thread([("/n", "/t")]) is not None


def test_a_file_is_written_as_it_was_read(path: Path, tmp_path: Path) -> None:
    text = group_configuration_text(read_group_configuration(path), "two\nlines")
    assert text.startswith("# two\n# lines\n")
    assert yaml.safe_load(text) == yaml.safe_load(FILE)
    (tmp_path / "again.yaml").write_text(text)
    assert read_group_configuration(tmp_path / "again.yaml").groups == (
        read_group_configuration(path).groups
    )


@pytest.mark.parametrize(
    ("wrong", "right", "problem"),
    [
        ("priority: 50", "priority: 0", r"\[1\]\.priority: SCHED_FIFO needs a priority from 1"),
        ("priority: -5", "priority: 50", r"a nice value is from -20 to 19"),
        ("    period: 20000000\n", "", r"\[2\]\.period: SCHED_DEADLINE needs it, in ns"),
        ("SCHED_RR", "SCHED_ROUND", r"groups.yaml:\d+: callback_groups\[3\]\.policy"),
        ("/topic_in)@", "/topic_in@", "is no part of a callback group"),
        ("callback_groups:", "groups:", "callback_groups: is missing"),
        ("/front/filter/*", "/sample_node@Timer(1333000000)", None),  # of another domain
        ("    domain_id: 3\n", "", None),
    ],
)
def test_mistakes_are_named_with_their_line(
    path: Path, wrong: str, right: str, problem: str | None
) -> None:
    path.write_text(FILE.replace(wrong, right, 1))
    if problem is None:
        read_group_configuration(path)
        return
    with pytest.raises(InputError, match=problem):
        read_group_configuration(path)


def test_a_group_stands_once(path: Path) -> None:
    doubled = FILE.replace("/front/filter/*", "/sample_node@Timer(1333000000)@Waitable", 1)
    path.write_text(doubled.replace("    domain_id: 3\n", "", 1))
    with pytest.raises(InputError, match=r"\[3\]\.id: stands twice"):
        read_group_configuration(path)
