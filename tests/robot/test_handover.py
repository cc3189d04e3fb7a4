"""Who publishes a shaped output while shaping node and standby are killed, stopped and started."""

import os
import random
import select
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path

import pytest
from cpp_program import compiled
from processes import wait_for

from chainshaper.robot.decision import DROPPED
from chainshaper.robot.gate import Gate
from chainshaper.robot.handover import (
    CHANGES,
    MOVING,
    NEW_MOVE,
    NEW_PHASE,
    RING,
    STANDING_BY,
    VERSION,
    Change,
    Page,
    Standby,
    Turn,
    open_page,
)
from chainshaper.robot.schedules import Schedule, first_schedule
from chainshaper.robot.waiting import Queue
from chainshaper.splicing.shaped_outputs import remove_abandoned_pages

pytestmark = pytest.mark.timed

MS = 1_000_000
PROCESS = Path(__file__).parent / "output_process.py"
KILLS = int(os.environ.get("CHAINSHAPER_KILLS", "10"))
PERIOD_S, HOLD_NS = 0.004, 2 * MS
FOLDERS = "chainshaper.robot.handover.page_folders"


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Pages of these tests, and of the processes that they start, in a folder of their own."""
    monkeypatch.setattr(FOLDERS, lambda: iter([str(tmp_path / "outputs")]))
    return tmp_path / "outputs"


@dataclass
class Output:
    """An output with its two processes, a publisher before it and a subscriber behind it."""

    command: dict[str, list[str]]
    running: dict[str, "subprocess.Popen[bytes]"] = field(default_factory=dict)
    ports: dict[str, int] = field(default_factory=dict)
    came: list[tuple[str, int]] = field(default_factory=list)
    sent: int = 0

    def __post_init__(self) -> None:
        self.reading, self.writing = os.pipe()
        self.sender = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)

    def start(self, what: str) -> None:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
            free.bind(("127.0.0.1", 0))
            self.ports[what] = free.getsockname()[1]
        command = [*self.command[what], what, "t5", str(self.ports[what]), str(HOLD_NS)]
        self.running[what] = subprocess.Popen(command, stdout=self.writing)

    def kill(self, *every: str) -> None:
        for what in every or self.running:
            self.running[what].kill()
            self.running[what].wait()

    def restart(self, *every: str) -> None:
        self.kill(*every)
        for what in every:
            self.start(what)
        for what in every:
            self.await_ready(what)

    def send(self) -> None:
        """Publish one message, to all that listen by now."""
        self.sent += 1
        for port in self.ports.values():
            self.sender.sendto(self.sent.to_bytes(8, "little"), ("127.0.0.1", port))
        self.receive(PERIOD_S)

    def receive(self, seconds: float) -> None:
        until = time.monotonic() + seconds
        while (left := until - time.monotonic()) > 0:
            if select.select([self.reading], [], [], left)[0]:
                record = os.read(self.reading, 9)
                self.came.append((chr(record[0]), int.from_bytes(record[1:], "little")))

    def await_ready(self, what: str) -> None:
        while ("R", self.running[what].pid) not in self.came:
            self.send()

    def send_many(self, count: int) -> None:
        for _ in range(count):
            self.send()

    def check(self, since: int) -> None:
        """Every message sent behind that one has come once, in order."""
        self.receive(0.2)
        came = [number for number in self.numbers if number > since]
        assert came == sorted(came), f"out of order: {self.came[-30:]}"
        assert len(came) == len(set(came)), "twice"
        assert came == list(range(since + 1, self.sent + 1)), "lost"

    @property
    def numbers(self) -> list[int]:
        return self.by("SB")

    def by(self, words: str) -> list[int]:
        return [number for found, number in self.came if found in words]


@pytest.fixture(scope="module")
def in_cpp(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return compiled(PROCESS.with_suffix(".cpp"), tmp_path_factory.mktemp("cpp"))


@pytest.fixture(params=["python", "cpp"])
def program(request: pytest.FixtureRequest, folder: Path, in_cpp: Path) -> list[str]:
    """The command of a process with the shaping node's side, in either language."""
    started = [str(in_cpp)] if request.param == "cpp" else [sys.executable, str(PROCESS)]
    return [*started, str(folder)]


@pytest.fixture
def output(program: list[str], folder: Path) -> Iterator[Output]:
    """The two processes of an output, with a shaping node in either language."""
    standby = [sys.executable, str(PROCESS), str(folder)]
    made = Output({"shaping": program, "standby": standby})
    try:
        for what in ("standby", "shaping"):
            made.start(what)
            made.await_ready(what)
        yield made
    finally:
        made.kill()


def test_a_node_that_is_killed_at_random_loses_doubles_and_reorders_nothing(output: Output) -> None:
    begun, dice = output.sent, random.Random(13)
    for number in range(KILLS):
        what = "standby" if number % 5 == 4 else "shaping"
        output.send_many(dice.randrange(5, 12))
        output.receive(dice.random() * PERIOD_S)
        output.restart(what)
    output.check(begun)
    assert output.by("B")
    assert output.by("S")


def test_a_node_that_is_stopped_is_gone_around_until_it_goes_on(output: Output) -> None:
    begun, shaping = output.sent, output.running["shaping"]
    for _ in range(2):
        output.send_many(5)
        bypassed = len(output.by("B"))
        shaping.send_signal(signal.SIGSTOP)
        output.send_many(30)
        assert len(output.by("B")) > bypassed + 10
        shaping.send_signal(signal.SIGCONT)
        output.send_many(20)
        assert output.by("S")[-1] > output.by("B")[-1], "shaped again"
    output.check(begun)


def test_a_standby_that_is_stopped_is_in_nobody_s_way(output: Output) -> None:
    begun, standby = output.sent, output.running["standby"]
    output.send_many(5)
    standby.send_signal(signal.SIGSTOP)
    output.send_many(5)
    output.restart("shaping")
    output.send_many(30)
    assert output.by("S")[-1] > output.sent - 3, "the new node publishes"
    standby.send_signal(signal.SIGCONT)
    output.send_many(20)
    output.receive(0.2)
    late = [number for number in output.numbers if number > begun]
    assert len(late) == len(set(late)), "twice"


def test_a_standby_that_is_stopped_with_the_lock_silences_no_node(program: list[str]) -> None:
    page = open_page("t5", "/t5")
    assert page.lock()
    assert page.lock(STANDING_BY)
    page["listening"] = 1
    output = Output({"shaping": program})
    try:
        output.start("shaping")
        output.await_ready("shaping")
        output.receive(0.2)
        begun = output.sent
        output.send_many(20)
        output.check(begun)
        page.unlock()  # the standby goes on
        output.send_many(3)
        output.check(begun)
        assert page.is_locked(), "the node is in force"
    finally:
        output.kill()


def test_when_both_are_killed_nothing_comes_twice_and_either_goes_on(output: Output) -> None:
    dice = random.Random(13)
    for _ in range(KILLS // 5):
        output.send_many(dice.randrange(5, 12))
        output.restart("standby", "shaping")
        begun = output.sent
        output.send_many(5)
        output.check(begun)
    assert output.numbers == sorted(set(output.numbers)), "twice, or out of order"


def test_of_two_shaping_nodes_one_publishes(output: Output) -> None:
    begun, first = output.sent, output.running["shaping"]
    output.running["another"] = first
    output.ports["another"] = output.ports["shaping"]
    output.start("shaping")
    output.await_ready("shaping")
    output.send_many(10)
    output.check(begun)
    first.kill()
    first.wait()
    del output.ports["another"]
    killed = output.sent
    output.send_many(20)
    output.check(begun)
    assert output.by("S")[-1] > killed, "the other has taken over"


def test_a_page_that_is_removed_while_it_is_used_is_made_again(
    output: Output, folder: Path
) -> None:
    begun = output.sent
    output.send_many(5)
    shutil.rmtree(folder)
    output.send_many(10)
    output.kill("shaping")
    output.send_many(5)
    output.check(begun)
    assert [path.name for path in folder.iterdir()] == [f"t5.0.v{VERSION}"]


def test_pages_that_no_process_has_are_removed_and_the_folder_behind_is_not_made(
    tmp_path: Path, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each launch left a page in /run for good, and an empty folder in /dev/shm beside it."""
    behind = tmp_path / "behind"
    monkeypatch.setattr(FOLDERS, lambda: iter([str(folder), str(behind)]))
    open_page("gone", "/gone").close()
    (folder / f"no_room.0.v{VERSION}").touch()
    in_force = open_page("t5", "/t5")
    assert in_force.lock()
    assert not behind.exists()
    opened = tmp_path / "chainshaper-1"
    opened.mkdir(mode=0o700)
    with closing(Page(str(opened), f"t.0.v{VERSION}", "/t", os.O_RDWR | os.O_CREAT)) as page:
        inherited = os.open(page.path, os.O_RDONLY)
        with subprocess.Popen(["sleep", "1000"], pass_fds=[inherited]) as child:
            os.close(inherited)
            places = (str(folder), str(opened), str(behind))
            gone = [f"{folder}/{name}.0.v{VERSION}" for name in ("gone", "no_room")]
            assert remove_abandoned_pages(places) == gone
            child.kill()
    in_force.unlock()
    assert len(remove_abandoned_pages(places)) == 2
    assert not in_force.is_current


def test_a_node_that_finds_its_page_made_anew_puts_its_slots_back(folder: Path) -> None:
    turn = Turn("t5", "/t5")
    assert turn.take(1)
    follower = open_page("t5", "/t5")
    assert follower.lock(MOVING)
    follower.ask(Change(1000, NEW_MOVE, 5))
    queue = Queue(Gate(((0, 1),), 100))
    turn.follow(queue)
    assert queue.schedules[-1] == Schedule(1000, phase_ns=0, moved_ns=5)
    shutil.rmtree(folder)
    turn.done(1)
    turn.follow(queue)
    assert queue.schedules[-1].moved_ns == 0
    assert 0 <= time.monotonic_ns() - queue.schedules[-1].from_ns < 1000 * MS
    known_before = queue.schedules
    turn.follow(queue)
    assert queue.schedules is known_before


def test_a_gate_is_asked_for_a_phase_while_it_runs_and_a_new_one_is_not() -> None:
    asking, cycle_ns = open_page("t5", "/t5"), 100
    asking.ask(Change(1000, NEW_PHASE, 7))
    turn, queue = Turn("t5", "/t5"), Queue(Gate(((0, 1),), cycle_ns))
    turn.follow(queue)
    assert queue.schedules == (first_schedule(queue.gate),), "that was asked of the gate before"
    for number in range(CHANGES + 10):
        asking.ask(Change(2000 + 1000 * number, NEW_PHASE, number))
    turn.follow(queue)
    latest = queue.schedules[-1]
    assert latest.phase_ns == CHANGES + 9
    assert latest.from_ns == 2000 + 1000 * (CHANGES + 9) + CHANGES + 9, "the next such start"


def test_who_asks_at_the_same_time_loses_nothing(folder: Path) -> None:
    Turn("t5", "/t5")

    def ask(value: int) -> None:
        with closing(Page(str(folder), f"t5.0.v{VERSION}", flags=os.O_RDWR)) as page:
            for from_ns in range(10):
                page.ask(Change(from_ns, NEW_MOVE, value))

    threads = [threading.Thread(target=ask, args=[value]) for value in range(5)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    asked = open_page("t5", "/t5").asked()
    assert len(asked) == 50
    for value in range(5):
        assert [change.from_ns for change in asked if change.value == value] == [*range(10)]


def test_a_standby_that_finds_its_page_made_anew_begins_anew_but_is_silent_still(
    folder: Path,
) -> None:
    turn, passed = Turn("t5", "/t5"), list[int]()
    standby = Standby(
        *("t5", "/t5", lambda _, key, __: passed.append(key or 0), lambda _: None, 0), silent=True
    )
    assert turn.take(1)
    time.sleep(0.001)
    standby.arrived(b"", 1)
    time.sleep(0.001)
    standby.look()
    assert passed == [1], "the node has taken one message, and hangs"
    shutil.rmtree(folder)
    turn.done(1)
    assert turn.take(2)
    turn.hold(time.monotonic_ns() + 3600_000 * MS, 0)
    standby.arrived(b"", 2)
    assert standby.page["silent"] == turn.page["silent"] == 1
    assert passed == [1], "it has taken one of those on the new page, too"


# Pages ------------------------------------------------------------------------------------------


def test_starting_over_and_over_takes_longer_each_time_until_a_message_is_dealt_with(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    waits = [Turn("t5", "/t5").wait_s for _ in range(9)]
    assert waits == [0, 0, 0, 0.5, 1, 2, 4, 8, 10]
    turn = Turn("t5", "/t5")
    assert turn.take(1)
    turn.done(1)
    assert Turn("t5", "/t5").wait_s == 0
    for _ in range(5):
        turn = Turn("t5", "/t5")
    assert turn.wait_s > 0
    turn.page["started_ns"] -= 60_000 * MS
    assert Turn("t5", "/t5").wait_s == 0, "that was long ago"


def test_only_a_node_of_the_same_launch_goes_on_in_its_cycle_and_mode(
    folder: Path, program: list[str]
) -> None:
    command = [*program, "starting", "t5", "0", "0"]
    launch = ["sh", "-c", '"$@"; true', "launch"]  # a parent of its own

    def started(*before: str) -> str:
        done = subprocess.run([*before, *command], check=True, timeout=60, stdout=subprocess.PIPE)
        return done.stdout.decode().strip()

    assert started() == ""
    page = Page(str(folder), f"t5.0.v{VERSION}", "/t5", os.O_RDWR)
    for age_ns, before, wanted in (
        (0, [], "12345 highway"),
        (40_000 * MS, [], ""),  # its parent may be that of all launches
        (0, launch, ""),
        (0, [], ""),
    ):
        page["phase_ns"], page["phase_known"], page["mode"] = 12_345, 1, 2
        page["until_ns"] = time.monotonic_ns() - age_ns
        assert started(*before) == wanted


def test_what_a_node_counts_is_in_the_page_for_those_who_look(
    folder: Path, program: list[str]
) -> None:
    command = [*program, "counting", "t5", "0", "0"]
    for times in (1, 2):  # a node that its launch starts again goes on counting
        if times == 2:
            page = Page(str(folder), f"t5.0.v{VERSION}", "/t5", os.O_RDWR)
            page["until_ns"] = time.monotonic_ns()
        subprocess.run(command, check=True, timeout=60)
        page = Page(str(folder), f"t5.0.v{VERSION}")
        assert [page[reason] for reason in DROPPED] == [times, 2 * times, 3 * times]
        assert page["published"] == times
        assert page["lost_by_dds"] == times * (0 + 2 * 1 + 3 * 2)
        assert page["late"] == times * 2
    page = Page(str(folder), f"t5.0.v{VERSION}", "/t5", os.O_RDWR)
    page.ask(Change(time.monotonic_ns() + 10**15, NEW_MOVE, -5))
    assert page.lock(MOVING)
    subprocess.run(command, check=True, timeout=60)
    page.unlock(MOVING)  # who moved the slots is gone
    subprocess.run(command, check=True, timeout=60)
    assert page.lock(MOVING)
    page["asked"] = 0  # nothing was asked for on this page
    subprocess.run(command, check=True, timeout=60)
    latencies, each = page.latest("measured", 0), [0, 1, 1, 2, 2, 2]
    assert latencies == [one for last in (77, 77, -5, 0, 77) for one in (*each, last)]
    assert page.latest("measured", 34) == [77]


def test_each_launch_counts_from_nought(folder: Path, program: list[str]) -> None:
    command = [*program, "counting", "t5", "0", "0"]
    launch = ["sh", "-c", '"$@"; true', "launch"]  # a parent of its own
    for _ in range(3):
        subprocess.run([*launch, *command], check=True, timeout=60)
        page = Page(str(folder), f"t5.0.v{VERSION}")
        counts = [page[name] for name in ("starts", "published", *DROPPED, "lost_by_dds", "late")]
        assert counts == [1, 1, 1, 2, 3, 0 + 2 * 1 + 3 * 2, 2]
    assert page["measured"] == 3 * 7, "who reads latencies goes on where it was"
    page = Page(str(folder), f"t5.0.v{VERSION}", "/t5", os.O_RDWR)
    assert page.lock()  # a node of another launch is in force: its counts stay
    subprocess.run([*launch, *program, "starting", "t5", "0", "0"], check=True, timeout=60)
    assert page["published"] == 1


@pytest.mark.parametrize("how", ["mode", "owner", "link", "file", "foreign page"])
def test_a_folder_that_is_not_ours_alone_is_not_used(
    tmp_path: Path, folder: Path, how: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    if how in ("owner", "foreign page") and os.geteuid():
        pytest.skip("giving files to another user takes root")
    if how == "link":
        (tmp_path / "elsewhere").mkdir(mode=0o700)
        folder.symlink_to(tmp_path / "elsewhere")
    elif how == "file":
        folder.touch()
    else:
        folder.mkdir(mode=0o700)
    if how == "mode":
        folder.chmod(0o777)
    if how == "foreign page":
        (folder / f"t5.0.v{VERSION}").touch()
    if how in ("owner", "foreign page"):
        os.chown(folder if how == "owner" else folder / f"t5.0.v{VERSION}", 65534, -1)
    with pytest.raises(OSError, match=r"outputs: .*(not a folder|exists|not a file of)"):
        open_page("t5", "/t5")
    spare = str(tmp_path / "spare")
    monkeypatch.setattr(FOLDERS, lambda: iter([str(folder), spare]))
    assert open_page("t5", "/t5").path == f"{spare}/t5.0.v{VERSION}"


def test_a_page_for_which_there_is_no_room_is_made_elsewhere_and_found_there(
    full_disk: Path, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folders = [f"{full_disk}/outputs", str(folder)]
    monkeypatch.setattr(FOLDERS, lambda: iter(folders))
    page = open_page("t5", "/t5")
    assert page.path == f"{folder}/t5.0.v{VERSION}"
    folders[0] = f"{folder.parent}/room"
    assert open_page("t5", "/t5").path == page.path


def test_a_message_that_is_too_old_for_the_ring_is_left_out_too() -> None:
    turn, passed = Turn("t5", "/t5"), list[int]()
    assert turn.take(1)
    turn.done(1)
    standby = Standby("t5", "/t5", lambda _, key, __: passed.append(key or 0), lambda _: None, 0)
    numbers = range(2, RING + 10)
    for number in numbers:  # the node has the lock, and is later than it may be
        standby.arrived(b"", number)
        standby.look()
    assert passed == list(numbers)
    assert not any(turn.take(number) for number in numbers)
    assert turn.take(RING + 10)


def test_a_node_whose_end_its_parent_has_not_seen_keeps_the_standby_no_busier() -> None:
    page = open_page("t5", "/t5")
    ended = subprocess.Popen(["true"])
    os.waitid(os.P_PID, ended.pid, os.WEXITED | os.WNOWAIT)  # a zombie from here on
    page["holder"] = ended.pid
    standby, looks = Standby("t5", "/t5", lambda *_: None, lambda _: None, 0), list[int]()
    standby.look = lambda: looks.append(1)  # type: ignore[method-assign]
    threading.Thread(target=standby.watch, daemon=True).start()
    wait_for(lambda: bool(looks), "the standby to see that the node has ended")
    time.sleep(0.2)  # several hundred looks, one for each millisecond, unless it waits
    ended.wait()
    assert len(looks) < 5
