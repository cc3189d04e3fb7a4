"""What is written for a shaping node, and the Python node at work on a stand-in for rclpy."""

import ast
import os
import signal
import sys
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from known import known
from node_run import (
    PUBLISHERS,
    RELIABLE,
    SLOTS,
    NodeRun,
    banded,
    parameters_of,
    running_node,
    stamped,
)
from processes import wait_for
from small_chain import EXECUTOR_CORE

from chainshaper.planning import ChainPlan
from chainshaper.planning.chain_plan import ShapingNode, revised
from chainshaper.robot import decision
from chainshaper.robot.node_parameters import PARAMETERS, gate_parameters, parameters_from
from chainshaper.robot.shaper import READER_DEPTH
from chainshaper.sources.gate_log import read_gate_log
from chainshaper.splicing.gate_settings import gate_of
from chainshaper.splicing.node_kinds import NodeKind
from chainshaper.splicing.shaping_process import (
    ShapingProcess,
    write_shaping_process,
    write_throttler,
)
from chainshaper.values.errors import InputError, OperationError

MS = 1_000_000
LATENCY = Path("/dev/cpu_dma_latency")


@pytest.fixture
def node(plan: ChainPlan) -> ShapingNode:
    return known(plan.shaping_node)


def test_a_python_node_is_one_file_with_the_gate_of_the_live_workload(
    tmp_path: Path, plan: ChainPlan, node: ShapingNode
) -> None:
    process = write_shaping_process(plan, node, "python", tmp_path)
    shaping, standby = (
        ShapingProcess(
            name=name,
            command=("python3", str(tmp_path / f"{name}.py")),
            package=None,
            executable=None,
            parameters_file=tmp_path / f"{name}.yaml",
            remappings=(("input", "/t3_tmp"), ("output", "/t3")),
        )
        for name in ("chainshaper_t3", "chainshaper_t3_standby")
    )
    assert process == replace(shaping, standby=standby)
    assert (tmp_path / "chainshaper_t3_standby.py").read_text().count("__main__") == 1
    text = (tmp_path / "chainshaper_t3.py").read_text()
    assert "\n".join(Path(decision.__file__).read_text().splitlines()[15:]) in text
    assert text.count("\nclass Gate:") == text.count("\nclass Shaper:") == 1
    imported = [
        getattr(statement, "module", None) or statement.names[0].name
        for statement in ast.walk(ast.parse(text))
        if isinstance(statement, ast.Import | ast.ImportFrom)
    ]
    assert not [module for module in imported if module.startswith("chainshaper")]


def test_the_parameters_say_what_the_plan_says(
    tmp_path: Path, plan: ChainPlan, node: ShapingNode
) -> None:
    longer = plan.predicted.model_copy(update={"max_ns": 3 * plan.cycle_ns})  # edited: no matter
    plan = revised(plan, overrun="discard", messages="newest", anchor="cycle", offset_ns=7 * MS)
    plan = revised(plan, predicted=longer, into_open_slot="next-slot")
    process = write_shaping_process(plan, node, "python", tmp_path, log=tmp_path / "gate.csv")
    same = {"handover": parameters_of(process)["handover"], "depth": 0, "output_depth": 10}
    assert parameters_of(process) == {
        "slots_ns": [21 * MS, 22 * MS],
        "cycle_ns": 50 * MS,
        "anchor": "cycle",
        "phase_ns": 7 * MS,
        "overrun": "discard",
        "due_cycles": 0,
        "messages": "newest",
        "into_open_slot": "next-slot",
        "spin_ns": node.spin_ns,
        "pause_ns": node.pause_ns,
        "core": EXECUTOR_CORE,
        "fifo_priority": node.fifo_priority,
        "log": str(tmp_path / "gate.csv"),
        **same,
    }
    assert parameters_of(known(process.standby)) == {
        "shaping_node": "chainshaper_t3",
        "fallback": "bypass",
        "patience_ns": 25 * MS,
        "server_cores": sorted({server.core for server in plan.servers}),
        "log": str(tmp_path / "chainshaper_t3_standby.csv"),
        **same,
    }
    elsewhere = write_shaping_process(plan, node, "python", tmp_path / "elsewhere")
    assert parameters_of(elsewhere)["handover"] != same["handover"]


@pytest.mark.parametrize(
    ("humble", "rmw", "cleared"),
    [("1", "rmw_fastrtps_cpp", 0), ("", "rmw_fastrtps_cpp", 1), ("1", "rmw_cyclonedds_cpp", 1)],
)
def test_a_core_is_cleared_for_delivering_threads_that_have_names(
    tmp_path: Path, plan: ChainPlan, humble: str, rmw: str, cleared: int
) -> None:
    """Others have no priority there, and would wait too."""
    process = write_shaping_process(plan, known(plan.shaping_node), "python", tmp_path)
    parameters_of(process, server_cores=[100_000])
    environment = {"STAND_IN_HUMBLE": humble, "RMW_IMPLEMENTATION": rmw}
    with running_node(process, tmp_path, environment=environment) as run:
        pid = run.process.pid
        children = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
        commands = [Path(f"/proc/{child}/cmdline").read_text() for child in children]
    assert sum("def _clear(" in command for command in commands) == cleared


def test_every_parameter_is_documented() -> None:
    docs = Path(__file__).parents[2] / "docs"
    text = (docs / "shaping_node.md").read_text() + (docs / "throttler.md").read_text()
    throttled = {"inputs", "outputs", "period_ns"}
    assert [name for name in PARAMETERS if f"`{name}`" not in text] == sorted(throttled)


def test_a_gate_with_modes_is_the_same_behind_its_parameters(
    plan: ChainPlan, node: ShapingNode
) -> None:
    gate = gate_of(banded(plan), node)
    parameters = gate_parameters(gate, "/mode")
    assert parameters_from(parameters).gate() == gate
    assert parameters["slots_ns"] == [bound for slot in SLOTS for bound in slot]
    modes = {key: value for key, value in parameters.items() if key.startswith("mode")}
    names = {"mode_names": ["city", "highway"], "mode_slots": [2, 1]}
    usual = {"mode_topic": "/mode", "mode_default": "city", "mode_late": "next-slot"}
    assert modes == names | usual


@pytest.mark.parametrize("kind", ["python", "generic", "typed"])
def test_writing_again_changes_nothing_and_what_is_there_is_not_overwritten(
    tmp_path: Path,
    plan: ChainPlan,
    node: ShapingNode,
    kind: NodeKind,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.delenv("AMENT_PREFIX_PATH", raising=False)

    def files() -> dict[Path, bytes]:
        process = write_shaping_process(
            plan, node, kind, tmp_path, message_type="sensor_msgs/msg/Image"
        )
        packages = {"generic": "chainshaper_shaping", "typed": "shaping_sensor_msgs_image"}
        assert process.package == packages.get(kind)
        assert process.executable == ("shaping_node" if kind in packages else None)
        return {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}

    assert files() == files()
    parameters = tmp_path / "chainshaper_t3.yaml"
    parameters.write_text("mine")
    with pytest.raises(InputError, match=r"chainshaper_t3\.yaml exists already with another"):
        files()
    assert parameters.read_text() == "mine"


def test_what_cannot_be_written_is_named(
    full_disk: Path, plan: ChainPlan, node: ShapingNode
) -> None:
    with pytest.raises(OperationError, match=r"cannot be written: No space left"):
        write_shaping_process(plan, node, "python", full_disk / "new")


def test_a_typed_node_needs_a_type(tmp_path: Path, plan: ChainPlan, node: ShapingNode) -> None:
    kinds: list[NodeKind] = ["typed", "component"]
    for kind in kinds:
        with pytest.raises(InputError, match=f"the {kind} shaping .* /t3 is not known: name it"):
            write_shaping_process(plan, node, kind, tmp_path)
    assert list(tmp_path.iterdir()) == []


# At work ---------------------------------------------------------------------------------------


@contextmanager
def at_work(
    plan: ChainPlan,
    folder: Path,
    publishers: dict[str, Any] | None = None,
    change: Mapping[str, object] | None = None,
    **more: Any,
) -> Iterator[NodeRun]:
    """The plan's node in Python, with its log in the folder, and parameters changed."""
    log = more.pop("log", folder / "gate.csv")
    process = write_shaping_process(plan, known(plan.shaping_node), "python", folder, log=log)
    parameters_of(process, **(change or {}))
    with running_node(process, folder, publishers, **more) as run:
        yield run


def test_messages_leave_unchanged_inside_their_slot(tmp_path: Path, plan: ChainPlan) -> None:
    payloads = []
    with at_work(banded(plan), tmp_path) as run:
        for number in range(6):
            if number == 3:
                run.tell(topic="/mode", data="highway")
                run.tell(topic="/mode", data="sea")
                run.hear(lambda words: "no mode" in words.get("log", ""))
            payloads.append(stamped(bytes([number])))
            run.send(payloads[-1], 100 + number)
            run.hear_published()
        assert run.end() == 0
    assert run.published == payloads, "byte for byte, in order"
    assert {"mode highway", "there is no mode 'sea'"} <= set(run.logged)

    releases = read_gate_log(tmp_path / "gate.csv")
    assert releases["source_timestamp"].to_list() == [100 + number for number in range(6)]
    assert releases["mode"].to_list() == ["city"] * 3 + ["highway"] * 3
    assert releases["slot"].to_list() == [1] * 3 + [0] * 3
    since_start, came = (
        (releases[column] - releases["origin"]).to_list() for column in ("release", "arrival")
    )
    opens = [SLOTS[1][0]] * 3 + [SLOTS[0][0]] * 3
    # What a busy machine delivers while the slot is open already leaves at once.
    assert since_start == [max(both) for both in zip(opens, came, strict=True)]
    assert (releases["time"] >= releases["release"]).all()
    assert (releases["published"] >= releases["time"]).all()
    times = [words["time"] for words in run.said if "published" in words]
    assert all(a <= b for a, b in zip(releases["time"], times, strict=True))
    rehearsed = [words for words in run.said if "rehearsed" in words]
    assert {words["payload"] for words in rehearsed} == {"0001000000"}
    assert {words["rehearsed"] for words in rehearsed} == {"/_chainshaper_rehearsal"}
    # Who wakes up too late, on a machine that is busy with others, does not rehearse.
    between = zip([0, *times], releases["release"], strict=False)
    assert any(before < one["time"] < release for before, release in between for one in rehearsed)


@pytest.mark.parametrize(
    ("offered", "publisher"),
    [
        ({}, {"history": 1, "depth": 10, "reliability": 1, "durability": 2}),
        (
            {"durability": 1, "depth": 3, "history": 1, "reliability": 2},
            {"durability": 1, "depth": 3, "reliability": 2},
        ),
        # All unknown: the stated defaults.
        ({"reliability": 3, "durability": 3, "liveliness": 4}, {"reliability": 1, "liveliness": 1}),
        (
            {"lifespan": "2 s", "deadline": "1 s", "liveliness": 3, "history": 2},
            {"liveliness": 3, "history": 2},
        ),
    ],
)
def test_the_output_is_offered_as_the_original_was(
    tmp_path: Path, plan: ChainPlan, offered: dict[str, Any], publisher: dict[str, Any]
) -> None:
    known = [{"type": "sensor_msgs/msg/Image", "qos": {**RELIABLE, **offered}}]
    with at_work(plan, tmp_path, {"/t3_tmp": known * 2}) as run:
        assert run.logged[:3] == [
            "waiting for a publisher of /t3_tmp",
            "/t3_tmp has 2 publishers: the QoS of the first is copied",
            "/t3_tmp is published by /ns/node5 as sensor_msgs/msg/Image",
        ]
        made = next(words for words in run.said if "publisher" in words)
        asked = next(words for words in run.said if "subscription" in words)
    assert (made["publisher"], made["type"]) == ("/t3", "Image")
    assert made["qos"].items() >= publisher.items()
    for same in ("lifespan", "deadline", "liveliness_lease_duration"):
        assert made["qos"][same] == {**RELIABLE, **offered}[same]
    assert (asked["subscription"], asked["raw"]) == ("/t3_tmp", True)
    for same in ("history", "reliability", "durability"):
        assert asked["qos"][same] == made["qos"][same], "else the two do not match"
    assert asked["qos"]["depth"] == READER_DEPTH, "what has no room in the gate, the gate drops"
    assert "lifespan" not in asked["qos"]


@pytest.mark.parametrize(
    ("how", "publishers"),
    [
        (signal.SIGINT, PUBLISHERS),
        (None, PUBLISHERS),  # without a publisher it reads no input, whose end this is
        (signal.SIGTERM, {}),
    ],
)
def test_it_stops_cleanly(
    tmp_path: Path, plan: ChainPlan, how: signal.Signals | None, publishers: Any
) -> None:
    with at_work(plan, tmp_path, publishers, spinning=False) as run:
        waits = "event" if publishers else "log"
        run.hear(lambda words: waits in words)
        assert run.end(how) == 0
    assert run.said[-1] == {"event": "shutdown"}


def test_without_its_log_core_or_class_it_works_on_and_says_so(
    tmp_path: Path, plan: ChainPlan
) -> None:
    no_core = {"core": 1023}  # is refused to all
    with at_work(plan, tmp_path, change=no_core, log=tmp_path / "nowhere/gate.csv") as run:
        run.send(stamped())
        run.hear_published()
        policy = os.sched_getscheduler(run.process.pid)
    for said in ("no log is written to", "core 1023 is refused"):
        assert any(said in text for text in run.logged)
    realtime = policy == os.SCHED_FIFO | os.SCHED_RESET_ON_FORK
    assert any("SCHED_FIFO is refused" in text for text in run.logged) != realtime


def test_cores_stay_awake_from_before_the_slot_until_the_message_is_delivered(
    tmp_path: Path, plan: ChainPlan, node: ShapingNode
) -> None:
    def allowed_latency() -> int:
        """How long cores may take to wake up (us): what all who ask for it agree on."""
        return int.from_bytes(LATENCY.read_bytes()[:4], sys.byteorder, signed=True)

    if not os.access(LATENCY, os.R_OK | os.W_OK) or allowed_latency() == 0:
        pytest.skip(f"{LATENCY} may not be used, or another process keeps all cores awake")
    resting = revised(plan, shaping_node=node.model_copy(update={"pause_ns": 500 * MS}))
    with at_work(resting, tmp_path) as run:
        assert os.sched_getaffinity(run.process.pid) == {EXECUTOR_CORE}
        usual = allowed_latency()
        run.send(stamped())
        run.hear_published()
        assert (usual > 0, allowed_latency()) == (True, 0)
        wait_for(lambda: allowed_latency() == usual, "cores to be allowed to sleep")


# The throttler --------------------------------------------------------------------------------

RAW = {"/rear/raw": PUBLISHERS["/t3_tmp"], "/front/raw": PUBLISHERS["/t3_tmp"]}


def test_the_throttler_publishes_what_is_newest_and_counts_the_rest(tmp_path: Path) -> None:
    topics = {"/rear/raw": "/rear", "/front/raw": "/front"}
    period, phase = 1_000 * MS, 350 * MS
    process = write_throttler(topics, period, "python", tmp_path, phase_ns=phase)
    with running_node(process, tmp_path, RAW) as run:
        for payload in ("aa", "bb"):
            run.tell(topic="/rear/raw", payload=payload, source=1)
        run.tell(topic="/front/raw", payload="cc", source=1)
        run.tell(tick=1)
        run.tell(topic="/front/raw", payload="dd", source=1)
        run.tell(tick=2)
        assert run.end() == 0
    published = [
        (words["published"], words["payload"]) for words in run.said if "published" in words
    ]
    assert published == [("/rear", "bb"), ("/front", "cc"), ("/front", "dd")]
    texts = [words["text"] for words in run.said if "text" in words]
    assert texts == [
        "/rear: 1 published, 1 times nothing new, 1 dropped",
        "/front: 2 published, 0 times nothing new, 0 dropped",
    ]
    assert any("nothing new for /rear" in text for text in run.logged)
    timers = [words for words in run.said if "timer" in words]
    assert [int(words["timer"] * 1e9) for words in timers] == [period] * 2
    for words in timers:  # a timer keeps the phase at which it was made
        assert (words["time"] - phase) % period < period // 4
    assert {words["clock"] for words in timers} == {3}, "CLOCK_MONOTONIC"


def test_by_the_papers_rule_the_first_message_of_a_period_is_published_as_it_comes(
    tmp_path: Path,
) -> None:
    topics = {"/rear/raw": "/rear", "/front/raw": "/front"}
    process = write_throttler(topics, 1_000 * MS, "python", tmp_path, rule="first")
    with running_node(process, tmp_path, RAW) as run:
        for payload in ("aa", "bb"):
            run.tell(topic="/rear/raw", payload=payload, source=1)
        run.tell(topic="/front/raw", payload="cc", source=1)
        run.hear(lambda words: words.get("payload") == "cc")
        time.sleep(0.9)  # four fifths of a period
        run.tell(topic="/rear/raw", payload="dd", source=1)
        assert run.end() == 0
    published = [words["payload"] for words in run.said if "published" in words]
    assert published == ["aa", "cc", "dd"]
    texts = [words["text"] for words in run.said if "text" in words]
    assert texts[0] == "/rear: 2 published, 0 times nothing new, 1 dropped"
    assert not any("timer" in words for words in run.said)


def test_a_throttler_needs_topics_and_a_period_and_is_in_the_cpp_package_too(
    tmp_path: Path,
) -> None:
    topics = {"/raw": "/scan"}
    for wrong, period in (({}, 1), (topics, 0)):
        with pytest.raises(InputError, match="needs topics and a period"):
            write_throttler(wrong, period, "python", tmp_path)
    with pytest.raises(InputError, match="`first` has no phase"):
        write_throttler(topics, 1, "python", tmp_path, rule="first", phase_ns=1)
    process = write_throttler(topics, 100 * MS, "cpp", tmp_path, core=1)
    assert (process.package, process.executable) == ("chainshaper_shaping", "throttler")
    assert (tmp_path / "chainshaper_shaping" / "src" / "throttler.cpp").is_file()
    assert parameters_of(process)["core"] == 1
