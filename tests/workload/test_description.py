"""The description of an application: what is right is kept, what is wrong is said where."""

from pathlib import Path

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st
from small_chain import small_chain_text

from chainshaper.flow.demonstration import synthetic_chain
from chainshaper.values.errors import InputError
from chainshaper.workload.description import (
    Application,
    TopicDescription,
    application_as_written,
    load_application,
    origin_timer,
)

_TABLE = yaml.safe_load(Path(__file__).with_name("description_mistakes.yaml").read_text())
RIGHT: str = _TABLE["right"]


def _refusal(path: Path, content: str | bytes = "") -> str:
    """What is said about a file, with this content if there is one."""
    if content:
        path.write_bytes(content.encode() if isinstance(content, str) else content)
    with pytest.raises(InputError) as refused:
        load_application(path)
    return str(refused.value)


@pytest.mark.parametrize("mistake", _TABLE["mistakes"].values(), ids=_TABLE["mistakes"])
def test_a_mistake_is_named_once_with_line_key_reason_and_remedy(
    mistake: tuple[str, str, int, str, str, str], tmp_path: Path
) -> None:
    right, wrong, line, key, reason, remedy = mistake
    assert RIGHT.count(right) == 1, "the test itself is wrong"
    path = tmp_path / "robot.yaml"
    said = _refusal(path, RIGHT.replace(right, wrong))
    (named,) = (each for each in said.splitlines() if f"{key}: " in each)
    assert named.startswith(f"{path}:{line}: {key}: ")
    assert reason in named and remedy in named


def test_every_mistake_is_said_at_once(tmp_path: Path) -> None:
    path = tmp_path / "robot.yaml"
    said = _refusal(path, RIGHT.replace("50ms", "50").replace("core: 1,", "core: x,"))
    assert [line.split(": ")[0] for line in said.splitlines()] == [f"{path}:4", f"{path}:9"]


def test_topics_in_a_circle_are_shown(tmp_path: Path) -> None:
    path = tmp_path / "robot.yaml"
    circle = "  back:\n    callbacks:\n      - {subscription: /command, publishes: [/scan]}\n"
    said = _refusal(path, RIGHT.replace("topics:\n", circle + "topics:\n"))
    assert said.startswith(f"{path}:6: nodes: the topics form a cycle")
    assert "/command → /scan → /command" in said or "/scan → /command → /scan" in said
    assert "break it at one of these topics" in said
    itself = RIGHT.replace("publishes: [/command]", "publishes: [/command, /scan]")
    assert "/scan → /scan" in _refusal(path, itself)


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"", ":1: the file is empty"),
        (b"# only a comment\n", ":1: the file is empty"),
        (b"- a\n- list\n", ":1: expected a YAML mapping"),
        (b"just text", ":1: expected a YAML mapping"),
        (b"name: x\nnodes: [1, 2\n", ": not YAML: "),
        (b"name: x\n\tchain: y\n", ":2: not YAML: "),
        (b"name: 'x\n", ": not YAML: "),
        (b"a: 1\n---\nb: 2\n", ":2: not YAML: but found another document"),
        (bytes(range(256)), ":2: not a text in UTF-8"),
        (b"\x7fELF\x02\x01\x01\x00\x00", ":1: not YAML: the character 0x007f"),
        (b"name: \xe9\n", ":1: not a text in UTF-8"),  # Latin-1
        (b"a: &loop [*loop]\n", ":1: a[0]: refers to this by a YAML alias"),
        (b"[" * 5000, ":1: not YAML: more than 100 lists"),
    ],
)
def test_files_that_are_no_descriptions(content: bytes, said: str, tmp_path: Path) -> None:
    path = tmp_path / "robot.yaml"
    path.touch()
    text = _refusal(path, content)
    assert text.startswith(f"{path}")
    assert said in text
    assert "\n" not in text, "one message"


def test_paths_that_are_no_files(tmp_path: Path) -> None:
    missing = _refusal(tmp_path / "missing.yaml")
    assert missing.startswith(f"{tmp_path / 'missing.yaml'}: cannot be read (No such file")
    assert "chainshaper init" in missing, "where to find a description to begin with"
    assert f"{tmp_path}: is a folder; wanted is a file" in _refusal(tmp_path)


def test_the_right_one_is_read(tmp_path: Path) -> None:
    path = tmp_path / "robot.yaml"
    path.write_text(RIGHT)
    application = load_application(path)
    assert application.seed == 1
    assert application.topic("/command") == TopicDescription(depth=3)
    assert application.topic("/scan") == TopicDescription()
    planner = application.nodes["planner"]
    assert planner.callbacks[0].execution.within_ns == (4_000_000, 14_000_000)
    assert application.scheduling_of("planner").core == 0
    assert application.scheduling_of("planner").priority == 80
    assert application.dds_scheduling_of("lidar").priority == 90
    assert application.cores() == {0: "node planner", 1: "node lidar"}


def test_a_chain_begins_with_the_timer_that_leads_to_it_however_it_is_written(
    tmp_path: Path,
) -> None:
    path = tmp_path / "robot.yaml"
    path.write_text(RIGHT.replace("/scan../command", "scan..command"))
    application = load_application(path)
    for chain in (None, "/command", "scan..command", "lidar..command", "/lidar../command"):
        assert origin_timer(application, chain)[0] == "lidar"
    said = "has no /scam, with which the chain scam../command begins"
    with pytest.raises(InputError, match=said):
        origin_timer(application, "scam../command")


@pytest.mark.parametrize("text", [RIGHT, small_chain_text(), synthetic_chain().read_text()])
def test_an_application_written_to_yaml_is_read_back_equal(text: str, tmp_path: Path) -> None:
    path = tmp_path / "robot.yaml"
    path.write_text(text)
    application = load_application(path)
    path.write_text(yaml.safe_dump(application_as_written(application), sort_keys=False))
    assert load_application(path) == application


_durations = st.integers(0, 10**12)
_pairs = st.tuples(_durations, _durations).map(sorted).map(tuple)
_executions = st.one_of(
    _durations.map(lambda value: {"constant_ns": value}),
    _pairs.map(lambda pair: {"uniform_ns": pair}),
    _pairs.filter(lambda pair: pair[1] > pair[0]).map(
        lambda pair: {"normal_ns": (pair[0], pair[1] - pair[0]), "within_ns": pair}
    ),
)
_topics = st.fixed_dictionaries(
    {},
    optional={
        "publication": st.sampled_from(["synchronous", "asynchronous"]),
        "reliability": st.sampled_from(["reliable", "best_effort"]),
        "depth": st.integers(1, 1000),
        "payload": st.integers(0, 16_000_000),
    },
)


_sources = st.fixed_dictionaries(
    {
        "timer_ns": st.integers(1, 10**12),
        "phase_ns": _durations,
        "execution": _executions,
        "publishes": st.just(("/out",)),
    }
)


@given(_sources, _topics, st.integers(0, 2**64 - 1))
def test_whatever_is_described_survives_its_file(
    tmp_path_factory: pytest.TempPathFactory,
    source: dict[str, object],
    topic: dict[str, object],
    seed: int,
) -> None:
    application = Application.model_validate(
        {
            "name": "any: [application]",
            "chain": "/out",
            "seed": seed,
            "scheduling": {
                "executors": {"core": 0, "priority": 1},
                "dds": {"core": 3, "priority": 97},
            },
            "topics": {"/out": topic},
            "nodes": {"ns/source": {"callbacks": (source,), "dds_priority": 5}},
        }
    )
    path = tmp_path_factory.mktemp("any") / "robot.yaml"
    path.write_text(yaml.safe_dump(application_as_written(application)))
    assert load_application(path) == application


def test_a_node_that_is_bound_to_no_core_asks_for_none(tmp_path: Path) -> None:
    path = tmp_path / "robot.yaml"
    path.write_text(RIGHT.replace("    core: 0", "    core: 7"))
    assert {0, 1, 7} == load_application(path).cores().keys()
    path.write_text(path.read_text().replace("core: 7", "core: 7\n    bound: false"))
    assert {0, 1} == load_application(path).cores().keys()


LOOP = """
name: feedback
chain: /command../state
scheduling: {executors: {core: 1, priority: 80}, dds: {core: 0, priority: 90}}
nodes:
  controller:
    callbacks:
      - loop: 10ms
        phase: 2ms
        core: 2
        priority: 85
        reads: [/state]
        execution: {constant: 1ms}
        publishes: [/command]
  plant:
    callbacks:
      - {subscription: /command, publishes: [/state]}
"""


def test_a_loop_has_its_own_core_and_may_close_a_circle_of_topics(tmp_path: Path) -> None:
    path = tmp_path / "robot.yaml"
    path.write_text(LOOP)
    application = load_application(path)
    name, loop = origin_timer(application)
    assert (name, loop.period_ns, loop.phase_ns) == ("controller", 10_000_000, 2_000_000)
    assert (loop.inputs, loop.subscriptions) == ((), ("/state",))
    scheduling = application.loop_scheduling_of("controller")
    assert scheduling is not None
    assert (scheduling.core, scheduling.priority) == (2, 85)
    assert application.loop_scheduling_of("plant") is None
    assert application.cores()[2] == "the loop of node controller"
    (written,) = application_as_written(application)["nodes"]["controller"]["callbacks"]
    assert written["loop"] == "10ms"
    path.write_text(LOOP.replace("        core: 2\n        priority: 85\n", ""))
    assert load_application(path).loop_scheduling_of("controller") == application.scheduling_of(
        "controller"
    )
