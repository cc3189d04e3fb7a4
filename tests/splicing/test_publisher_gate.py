"""The gates in the processes that publish and subscribe, loaded into such a process.

`rmw_stand_in.cpp` stands in for ROS 2, which is not here; `test_shape_in_ros.py` has the real one.
"""

import os
import re
import shutil
import subprocess
import threading
import time
import uuid
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pytest
from gate_table import Case, cases, walk
from native_build import built_for_arm64
from processes import wait_for

from chainshaper.linux.scheduling import available_cores, may_use_fifo
from chainshaper.linux.threads import gate_thread_name
from chainshaper.robot.gate import Gate
from chainshaper.robot.handover import ASKED, CHANGES, FIELDS, page_folders
from chainshaper.robot.node_parameters import gate_parameters
from chainshaper.sources.gate_log import read_gate_log
from chainshaper.splicing.gate_settings import gate_library, settings_text
from chainshaper.splicing.shaped_outputs import (
    FollowedOutput,
    ShapedOutput,
    ask_phase,
    find_outputs,
)
from chainshaper.values.errors import OperationError

MS = 1_000_000
pytestmark = pytest.mark.skipif(
    shutil.which("g++") is None, reason="g++ is not installed, so the gate cannot be compiled"
)


@dataclass(frozen=True)
class Run:
    """What a process that publishes has printed, and the logs of its gates by output."""

    lines: list[list[str]]
    errors: str
    logs: Mapping[str, list[dict[str, Any]]]
    start_ns: int

    def of(self, *words: str) -> list[list[str]]:
        return [line for line in self.lines if line[: len(words)] == [*words]]

    def written(self, topic: str = "/t5") -> list[int]:
        return [int(line[2]) for line in self.of("serialized", topic)]


@pytest.fixture(scope="module")
def program(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder, source = tmp_path_factory.mktemp("rmw"), Path(__file__).with_name("rmw_stand_in.cpp")
    library = folder / "libstd_msgs__rosidl_typesupport_c.so"
    options = ["g++", "-std=c++17", "-O1", "-Wall", "-Wextra", "-Werror", str(source), "-o"]
    subprocess.run([*options, library, "-shared", "-fPIC"], check=True, timeout=100)
    subprocess.run([*options, folder / "program", "-DPROGRAM", library], check=True, timeout=100)
    return folder / "program"


@pytest.fixture
def run(program: Path, tmp_path: Path) -> Callable[..., Run]:
    def started(
        gates: Mapping[str, Gate],
        lines: list[tuple[int, str]],
        meanwhile: Callable[[int, Path], None] = lambda *_: None,
        change: tuple[str, str] = ("", ""),
        deliveries: str = "",
        *,
        largest_file: str = "unlimited",
        on_time: bool = False,
        **env: str,
    ) -> Run:
        """Publish as the lines say, each at a time (ns), on outputs with gates, and /other.

        The process lives for half a second behind the last.
        """
        logs: dict[str, Path] = {}
        domain = str(uuid.uuid4().int % 10**9)  # so that pages of other runs are not ours
        # In blocks of 1 kB. Python ignores the signal that ends a process beyond it; nodes do not.
        limited = f'ulimit -f {largest_file}; exec env --default-signal=XFSZ "$@"'
        # Its messages have to come on time beside other tests.
        urgent = ["chrt", "--fifo", "1"] if on_time and may_use_fifo() else []
        with subprocess.Popen(
            ["bash", "-c", limited, "bash", *urgent, program],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            env={
                **os.environ,
                "ROS_DISTRO": "jazzy",
                "LD_PRELOAD": str(gate_library()),
                "LD_LIBRARY_PATH": str(program.parent),
                "CHAINSHAPER_GATES": str(tmp_path / "gates"),
                "ROS_DOMAIN_ID": domain,
                **env,
            },
        ) as process:
            assert process.stdout is not None
            assert process.stdout.readline() == "ready\n"
            start = time.monotonic_ns() + 200 * MS
            blocks, makes = [deliveries], ["subscription /t5 sink", "subscription /t5 other"]
            makes += ["publisher /other /nobody 10"]
            for topic, gate in gates.items():
                logs[topic] = tmp_path / f"{topic[1:]}.csv"
                logs[topic].unlink(missing_ok=True)
                node = f"shaping_{topic[1:]}"
                about = {"output": topic, "input": f"{topic}_tmp", "node": node, "log": logs[topic]}
                about |= {"thread": gate_thread_name(node), "publisher": "/node5"}
                about["depth"] = gate.depth
                values = gate_parameters(gate, f"/modes{topic}") | {"handover": node}
                values["phase_ns"] = (start + gate.phase_ns) % gate.cycle_ns
                blocks.append(settings_text(about | values))
                makes.append(f"publisher {topic} node5 {gate.depth}")
            (tmp_path / "gates").write_text("".join(blocks).replace(*change))
            over = max((ns for ns, _ in lines), default=0) + 500 * MS
            ordered = [text for _, text in sorted([*lines, (over, f"until {over}")])]
            beside = threading.Thread(target=meanwhile, args=(process.pid, tmp_path / "gates"))
            beside.start()
            words = [str(start), *makes, *ordered]
            out, err = process.communicate("\n".join(words) + "\n", timeout=30)
            beside.join()
        assert process.returncode == 0, err
        for folder in page_folders():
            for page in Path(folder).glob(f"*.{domain}.v*"):
                page.unlink()
        rows = {
            topic: read_gate_log(log).sort("row").to_dicts()
            if log.exists() and log.stat().st_size
            else []
            for topic, log in logs.items()
        }
        return Run([line.split() for line in out.splitlines()], err, rows, start)

    return started


@pytest.mark.timeout(900)
def test_it_is_built_for_arm64() -> None:
    built = (built_for_arm64() / gate_library().name).read_bytes()
    assert int.from_bytes(built[18:20], "little") == 183  # EM_AARCH64
    here = {line.split()[-1] for line in _exported(gate_library())}
    assert {"rmw_publish", "pthread_mutex_init"} < here
    assert not [name for name in here if not re.match("rmw_|rcl_|ros_trace_|pthread_mutex", name)]


def _exported(library: Path) -> list[str]:
    words = ["nm", "--dynamic", "--defined-only", str(library)]
    return subprocess.check_output(words, text=True).splitlines()


def at(ns: int, publisher: int = 1, stamp: int | None = None, what: str = "at") -> tuple[int, str]:
    return ns, f"{what} {ns} {publisher} {'-' if stamp is None else stamp}"


def decided(rows: list[dict[str, Any]]) -> list[tuple[Any, ...]]:
    """What a log says of each message of a case, as they came."""
    return [
        (row["dropped"], row["slot"], row["cycles_waited"], row["overrun"], row["mode"])
        for row in sorted(rows, key=lambda one: one["source_timestamp"])
    ]


def in_real_time(case: Case) -> bool:
    """Whether no slot is short, no message is there just as a slot that it may miss opens, and none
    comes in the last millisecond of a slot behind which it is discarded.
    """
    ages = [arrival - (stamp or 0) for arrival, stamp in case.arrivals]
    opening = {start for start, _ in case.gate.slots}
    just = any(age in opening for age in ages)
    last = case.gate.into_open_slot == "next-slot" and just
    left = [end - age % case.gate.cycle_ns for age in ages for _, end in case.gate.slots]
    closing = case.gate.overrun == "discard" and any(0 < ns < MS for ns in left)
    return not (last or closing) and min(end - start for start, end in case.gate.slots) >= MS


def expected(case: Case) -> list[tuple[Any, ...]]:
    releases = [outcome.release for outcome in walk(case)]
    return [(o.dropped, o.slot, o.cycles_waited, o.overrun, o.mode) for o in releases]


def test_it_does_what_the_table_of_all_gates_says(run: Callable[..., Run]) -> None:
    """All cases at once, one that the machine disturbed again; in real time, so without those that
    need it to the microsecond.
    """
    # What else changes has tests of its own; the machine's clock is not stepped.
    unmoved = [
        case
        for case in cases()
        if not case.steps and all(change.kind == "mode" for change in case.changes)
    ]
    left = {f"/t{number}": case for number, case in enumerate(filter(in_real_time, unmoved))}
    assert len(left) > len(unmoved) * 0.8
    wrong: dict[str, Any] = {}
    for _ in range(6):
        for half in (0, 1) if left else ():
            chosen = dict(list(left.items())[half::2])
            lines: list[tuple[int, str]] = []
            for place, (topic, case) in enumerate(chosen.items(), start=1):
                lines += [at(arrival, place, stamp) for arrival, stamp in case.arrivals]
                lines += [
                    (change.from_ns, f"mode {change.from_ns} /modes{topic} {change.value}")
                    for change in case.changes
                ]
            gates = {topic: case.gate for topic, case in chosen.items()}
            done = run(gates, lines, on_time=True)
            wrong |= {t: (decided(done.logs[t]), expected(case)) for t, case in chosen.items()}
        left = {topic: case for topic, case in left.items() if wrong[topic][0] != wrong[topic][1]}
    assert not {case.name: wrong[topic] for topic, case in left.items()}


SLOT = Gate(slots=((60 * MS, 65 * MS),), cycle_ns=100 * MS)


def test_tracers_see_a_node_behind_the_publisher_which_waits_for_nothing(
    run: Callable[..., Run],
) -> None:
    times = [n * 100 * MS + 20 * MS for n in range(4)]
    lines = [at(ns, stamp=ns - 20 * MS) for ns in times] + [at(10 * MS, 0)]
    done = run({"/t5": SLOT}, lines, on_time=True)
    assert done.written() == [1, 2, 3, 4]
    assert [line[2] for line in done.of("typed", "/other")] == ["0"]
    # Handing over is nothing beside the 40 ms for which each message waits.
    assert max(int(line[1]) for line in done.of("took")) < 20 * MS
    (other, unshaped, shaped) = done.of("trace", "rcl_publisher_init")
    assert [line[5] for line in (other, unshaped, shaped)] == ["/other", "/t5_tmp", "/t5"]
    assert unshaped[3] != shaped[3]  # the application's node, and ours
    (node,), (subscription,) = (
        done.of("trace", f"rcl_{what}_init") for what in ("node", "subscription")
    )
    assert f"0x{node[2]}" == shaped[3]
    assert subscription[3] == node[2]
    # What was published unshaped is what our callback takes, between its start and end.
    sent = [line[4] for line in done.of("trace", "rmw_publish")]
    traced = ("rmw_take", "callback_start", "callback_end")
    order = [
        " ".join((line[1], *line[4:5] * (line[1] == "rmw_take"))) if line[0] == "trace" else line[0]
        for line in done.lines
        if line[1] in traced or line[0] == "serialized"
    ]
    each = ("callback_start", "serialized", "callback_end")
    assert len(sent) == 4
    assert [row["source_timestamp"] for row in done.logs["/t5"]] == [
        int(line.split()[1]) for line in order if line.startswith("rmw_take")
    ]
    assert order == [
        word for line in done.of("trace", "rmw_take") for word in (f"rmw_take {line[4]}", *each)
    ]
    assert [line[2] for line in done.of("trace", "rcl_publish")] == [
        other[2],
        *[unshaped[2], shaped[2]] * 4,
    ]


def test_on_humble_a_message_is_stamped_behind_the_event_of_its_publication(
    run: Callable[..., Run],
) -> None:
    """Its publication is the last one before its stamp: events of publications have none there."""
    times = [n * 100 * MS + 20 * MS for n in range(4)]
    lines = [at(ns, stamp=ns - 20 * MS) for ns in times]
    done = run({"/t5": SLOT}, lines, on_time=True, ROS_DISTRO="humble")
    of_input = done.of("trace", "rmw_publish")[::2]  # each waits for its slot, and goes on then
    stamps = [row["source_timestamp"] for row in done.logs["/t5"]]
    published = [int(event[5]) for event in of_input]
    assert len(published) == 4
    assert all(event < stamp for event, stamp in zip(published, stamps, strict=True))
    assert all(stamp < later for stamp, later in zip(stamps, published[1:], strict=False))


def test_what_is_serialized_already_or_would_be_loaned_waits_like_any_other(
    run: Callable[..., Run],
) -> None:
    loaned = [at(ns * MS, number, 0, "loaned") for number, ns in enumerate((20, 21))]
    done = run({"/t5": SLOT}, [*loaned, at(30 * MS, stamp=0, what="serialized")])
    assert [line[1] for line in done.of("borrowed")] == ["0", "3"]  # unsupported
    assert len(done.of("loaned", "/other")) == 1
    assert done.written() == [1, 2]
    assert all(row["slot"] == 0 for row in done.logs["/t5"])
    assert done.errors.count("no messages are loaned") == 1


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"ROS_DISTRO": "zebra"}, "ROS 2 zebra with rmw_cyclonedds_cpp is not known"),
        ({"STAND_IN_FOR": "rmw_new"}, "ROS 2 jazzy with rmw_new is not known"),
        ({"CHAINSHAPER_GATES": "/nowhere"}, ""),
        ({"change": ("anchor stamp", "anchor chain")}, "/t5 leaves at once: its gate in .*'chain'"),
        ({"change": ("/node5", "/node6")}, ""),  # another node's gate
    ],
)
def test_what_it_cannot_shape_passes_at_once_and_it_says_so(
    run: Callable[..., Run], changed: dict[str, Any], said: str
) -> None:
    done = run({"/t5": SLOT}, [at(20 * MS)], **changed)
    assert len(done.of("typed", "/t5")) == 1
    assert not done.written()
    assert re.search(said, done.errors) if said else not done.errors


def test_messages_that_wait_as_their_publisher_ends_are_counted(run: Callable[..., Run]) -> None:
    done = run(
        {"/t5": SLOT}, [at(10 * MS, stamp=0), at(20 * MS, stamp=0), (30 * MS, f"end {30 * MS} 1")]
    )
    assert not done.written()
    assert "/t5: its publisher has ended, messages that were not published: 2" in done.errors


def test_a_child_of_fork_has_no_gate_and_ends(run: Callable[..., Run]) -> None:
    lines = [at(20 * MS, stamp=0), (40 * MS, f"fork {40 * MS} 1"), at(120 * MS, stamp=100 * MS)]
    assert run({"/t5": SLOT}, lines).written() == [0, 1]


TWELVE = [n * 100 * MS + 20 * MS for n in range(12)]
THIRTY = [n * 100 * MS + 20 * MS for n in range(30)]
"""For so long that, on a busy machine too, the test gets to what it does meanwhile."""


@pytest.mark.parametrize("largest_file", ["0", "3"])
def test_a_limit_on_file_sizes_costs_log_and_page_but_no_output(
    run: Callable[..., Run], largest_file: str
) -> None:
    """The kernel sends SIGXFSZ, which ends a process by default."""
    lines = [at(ns, stamp=ns - 20 * MS) for ns in TWELVE]
    done = run({"/t5": SLOT}, lines, largest_file=largest_file)
    assert done.written() == [*range(12)]
    assert "/t5 is not among the outputs that are shown: " in done.errors


def _shown(pid: int) -> ShapedOutput:
    """The output of a process, as soon as its gate shows it."""
    shown = list[ShapedOutput]()

    def is_there() -> bool:
        shown[:] = [output for output in find_outputs() if output.shaping_node == pid]
        return bool(shown)

    wait_for(is_there, f"the page of process {pid}")
    (output,) = shown
    return output


def _page_of(pid: int) -> Path:
    return Path(_shown(pid).page)


def test_a_page_that_is_cut_is_whole_again_and_ends_no_process(run: Callable[..., Run]) -> None:
    states = list[str]()

    def cut(pid: int, _: Path) -> None:
        time.sleep(0.5)
        page = _page_of(pid)
        os.truncate(page, 0)
        states.append(_shown(pid).state)

    done = run({"/t5": SLOT}, [at(ns, stamp=ns - 20 * MS) for ns in THIRTY], cut)
    assert (done.written(), states) == ([*range(30)], ["in process"])


def test_numbers_of_a_damaged_page_are_no_places_outside_it(run: Callable[..., Run]) -> None:
    def damage(pid: int, _: Path) -> None:
        time.sleep(0.5)
        page = _page_of(pid)
        for value in (-1, -(10**15), (1 << 63) - 1, -(1 << 63)):
            number = value.to_bytes(8, "little", signed=True)
            with page.open("r+b") as file:
                file.seek(8 * ASKED)
                file.write(number * 3 * CHANGES)
                for name in ("released", "measured", "mode", "phase_ns", "asked", "starts"):
                    file.seek(8 * FIELDS.index(name))
                    file.write(number)
            time.sleep(0.15)

    done = run({"/t5": SLOT}, [at(ns, stamp=ns - 20 * MS) for ns in THIRTY], damage)
    assert done.written() == [*range(30)]


def test_files_of_the_node_under_our_numbers_are_left_alone(run: Callable[..., Run]) -> None:
    """A node closes all descriptors and opens files of its own: nothing of ours goes there."""
    lines = [at(ns, stamp=ns - 20 * MS) for ns in TWELVE]
    done = run({"/t5": SLOT}, [*lines, (150 * MS, f"reuse {150 * MS} -")])
    assert done.written() == [*range(12)]
    assert [line[1:] for line in done.of("own")] == [["1", "0"]] * 20
    assert len(done.logs["/t5"]) == 12, "the log has all of it still"


@pytest.mark.skipif(not may_use_fifo(), reason="SCHED_FIFO is not permitted here")
def test_who_has_a_mutex_of_dds_runs_with_the_priority_of_who_waits_for_it(tmp_path: Path) -> None:
    """20 ms of work behind a thread of middle priority that takes the core for 200 ms; a mutex that
    the robot's own code makes stays as it is.
    """
    source = str(Path(__file__).with_name("mutexes.c"))
    library, program = tmp_path / "libddsc.so", tmp_path / "mutexes"
    compiler = ["gcc", "-O1", "-Wall", source]
    shared = [*compiler, "-DMIDDLEWARE", "-shared", "-fPIC", "-o", str(library)]
    subprocess.run(shared, check=True)
    subprocess.run([*compiler, "-o", str(program), str(library), "-lpthread"], check=True)

    def waited_ms(*words: str, **env: str) -> float:
        command = [str(program), str(available_cores()[-1]), *words]
        run = subprocess.run(command, env={**os.environ, **env}, check=True, capture_output=True)
        return float(run.stdout)

    front = str(gate_library())
    of_dds, of_robot = waited_ms("of-dds", LD_PRELOAD=front), waited_ms(LD_PRELOAD=front)
    assert of_dds < waited_ms("of-dds") / 2
    assert of_dds < of_robot / 2


def test_cycles_begin_elsewhere_from_the_next_one_on(run: Callable[..., Run]) -> None:
    gate = replace(SLOT, anchor="cycle")

    def move(pid: int, gates: Path) -> None:
        values = dict(line.split(" ", 1) for line in gates.read_text().splitlines())
        time.sleep(0.6)
        ask_phase("/t5", (pid,), int(values["phase_ns"]) + 10 * MS)

    done = run({"/t5": gate}, [at(ns) for ns in THIRTY], move)
    origins = [(row["origin"] - done.start_ns) % (100 * MS) for row in done.logs["/t5"]]
    assert sorted(set(origins)) == [0, 10 * MS]
    assert origins == sorted(origins)
    with pytest.raises(OperationError, match="no gates publish it now"):
        ask_phase("/not_published", (), 0)


DELIVERY_NS = 3 * MS


def test_its_receivers_get_an_output_at_a_constant_time_behind_it_but_wait_no_longer(
    run: Callable[..., Run],
) -> None:
    """Taken 0.2 to 2 ms behind the publication; the other subscription is not meant. Then one that
    was older, none, and one from the future: its clock was set.
    """
    taken = [(n * 20 * MS, n % 10 * MS // 5 + MS // 5) for n in range(1, 21)]
    odd = [(420 * MS, 4 * MS), (440 * MS, 440 * MS), (460 * MS, -10_000 * MS)]
    lines = [(ns, f"take {ns} 0 {ns - age}") for ns, age in [*taken, *odd]]
    lines += [(ns, f"take {ns} 1 {ns - MS}") for ns in range(5 * MS, 400 * MS, 40 * MS)]
    block = settings_text(
        {"output": "/t5", "delivery_ns": DELIVERY_NS, "receiver": ["/x", "/sink"]}
    )
    done = run({}, lines, deliveries=block, on_time=True)
    handed = [(int(line[2]), int(line[3])) for line in done.of("handed", "0")]
    behind = [
        at - (ns - age) - DELIVERY_NS for (_, at), (ns, age) in zip(handed, taken, strict=False)
    ]
    assert min(behind) > -20_000, "never before; the two clocks are read one behind the other"
    assert sorted(behind)[10] < DELIVERY_NS / 4
    passed = sorted(int(line[3]) - int(line[2]) for line in done.of("handed", "1"))
    assert passed[5] < DELIVERY_NS / 4, "waits for nothing"
    old, none, future = (at - asked for asked, at in handed[20:])
    assert max(old, none) < DELIVERY_NS
    assert DELIVERY_NS <= future < 100 * DELIVERY_NS


def test_a_page_that_is_made_anew_moves_no_cycle_and_puts_slots_back(
    run: Callable[..., Run],
) -> None:
    """Pages of a session may be removed when its user logs out."""
    gate = replace(SLOT, anchor="cycle")
    states = list[str]()

    def log_out(pid: int, _: Path) -> None:
        time.sleep(0.5)
        page = _page_of(pid)
        followed = FollowedOutput("/t5", (pid,))
        followed.move(10 * MS, time.monotonic_ns())
        time.sleep(0.3)
        page.unlink()
        time.sleep(0.4)
        with pytest.raises(OperationError, match=r"cannot be followed: .* was removed; start"):
            followed.latencies()
        followed.close()
        states.append(_shown(pid).state)

    done = run({"/t5": gate}, [at(ns) for ns in THIRTY], log_out)
    rows = done.logs["/t5"]
    assert {(row["origin"] - done.start_ns) % (100 * MS) for row in rows} == {0}
    assert {row["moved"] for row in rows} == {0, 10 * MS}
    assert rows[-1]["moved"] == 0
    assert states == ["in process"]


def test_its_output_is_shown_and_its_slots_move_while_they_are_followed(
    run: Callable[..., Run],
) -> None:
    seen, looked, latencies = list[ShapedOutput](), list[int](), list[int]()

    def follow(pid: int, _: Path) -> None:
        time.sleep(0.7)
        _shown(pid)
        looked.append(time.monotonic_ns())
        seen.extend(one for one in find_outputs() if one.shaping_node == pid)
        looked.append(time.monotonic_ns())
        followed = FollowedOutput("/t5", (pid,))
        followed.move(10 * MS, time.monotonic_ns() + 100 * MS)
        time.sleep(0.4)
        latencies.extend(followed.latencies())
        followed.close()

    lines = [at(ns, stamp=ns - 20 * MS) for ns in THIRTY]
    done = run({"/t5": SLOT}, lines, follow, on_time=True)
    assert [one.state for one in seen] == ["in process"]
    before, after = (sum(row["release"] < ns for row in done.logs["/t5"]) for ns in looked)
    assert before - 1 <= seen[0].published <= after  # the last may have been on its way
    assert all(latency >= 20 * MS for latency in latencies)
    moved = [row["moved"] for row in done.logs["/t5"]]
    assert {*moved} == {0, 10 * MS}
    assert [row["release"] - row["origin"] - row["moved"] for row in done.logs["/t5"]] == [
        60 * MS
    ] * 30
    assert moved[-1] == 0, "who had them follow has ended"
    assert done.written() == [*range(30)]
