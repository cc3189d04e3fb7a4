"""Shaping node and standby, both as they are written for a launch, on a stand-in for rclpy."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from known import known
from node_run import NodeRun, banded, outputs, parameters_of, running_node, stamped
from processes import wait_for
from strangers import NOBODY, needs_root, strange

from chainshaper.planning import ChainPlan
from chainshaper.planning.chain_plan import revised
from chainshaper.robot.handover import MOVING, NEW_MOVE, VERSION, Change, Page, open_page
from chainshaper.sources.gate_log import read_gate_log, releases_so_far
from chainshaper.splicing.shaped_outputs import FollowedOutput, ask_phase, find_outputs, output_text
from chainshaper.splicing.shaping_process import ShapingProcess, write_shaping_process
from chainshaper.values.errors import OperationError

MS = 1_000_000


def written(
    plan: ChainPlan, folder: Path, patience_ns: int = 20_000 * MS
) -> tuple[ShapingProcess, ShapingProcess]:
    """A shaping node and its standby, for which a node on a busy machine is late only then."""
    process = write_shaping_process(
        plan, known(plan.shaping_node), "python", folder, log=folder / "gate.csv"
    )
    assert process.standby is not None
    before = parameters_of(process.standby, patience_ns=patience_ns)
    assert before["patience_ns"] == max(plan.cycle_ns // 2, 10 * MS)
    return process, process.standby


@contextmanager
def both(
    process: ShapingProcess, beside: ShapingProcess, folder: Path
) -> Iterator[tuple[NodeRun, NodeRun]]:
    """Shaping node and standby at work; the node is in force with a first message, 1."""
    with running_node(beside, folder) as standby, running_node(process, folder) as shaping:
        take_over(1, folder, shaping)
        yield shaping, standby


def came(run: NodeRun) -> list[int]:
    return [payload[-1] for payload in run.published]


def say(number: int, *runs: NodeRun) -> None:
    payload = stamped(bytes([number]))
    for run in runs:
        run.send(payload, 1000 + number)


def say_until_shaped(number: int, shaping: NodeRun, standby: NodeRun) -> int:
    """Messages until the shaping node publishes again; the last one's number."""
    while not shaping.heard(lambda words: words.get("published") == "/t3", within_s=0.7):
        number += 1  # a busy machine is late again
        say(number, shaping, standby)
    return number


def take_over(number: int, folder: Path, shaping: NodeRun) -> None:
    """Give a message to a shaping node, which comes into force with it."""
    say(number, shaping)
    wait_for(lambda: outputs(folder)[0].shaping_node == shaping.process.pid, "it to be in force")


def diagnosed(standby: NodeRun) -> tuple[int, str]:
    standby.tell(tick=1)
    report = standby.hear(lambda words: "diagnostics" in words)
    assert report["diagnostics"] == "chainshaper: /t3"
    return report["level"], report["message"]


def test_what_a_killed_node_had_in_hand_goes_around_it_until_it_is_back(
    tmp_path: Path, plan: ChainPlan
) -> None:
    process, beside = written(plan, tmp_path)
    parameters_of(process, cycle_ns=1_000 * MS, slots_ns=[400 * MS, 401 * MS])
    with running_node(beside, tmp_path) as standby:
        with running_node(process, tmp_path) as shaping:
            take_over(1, tmp_path, shaping)
            say(1, standby)
            shaping.hear_published()
            (output,) = outputs(tmp_path)
            assert (output.topic, output.state) == ("/t3", "shaped")
            pids = (shaping.process.pid, standby.process.pid)
            assert (output.shaping_node, output.standby) == pids
            say(2, shaping, standby)
            time.sleep(0.02)  # the node holds it for 0.4 s: it is in time on a busy machine, too
            shaping.process.kill()
            standby.hear_published()
        say(3, standby)
        standby.hear_published()
        wait_for(lambda: outputs(tmp_path)[0].messages == 2, "both to be counted")
        (output,) = outputs(tmp_path)
        assert (output.state, output.shaping_node) == ("bypassed", None)
        assert "/t3 is bypassed for " in output_text(output)
        level, text = diagnosed(standby)
        assert (level, text.endswith("2 messages")) == (1, True)
        with running_node(process, tmp_path) as again:
            take_over(3, tmp_path, again)
            for number in (4, 5):
                say(number, again, standby)
                again.hear_published()
            assert diagnosed(standby) == (0, "shaped")
            again.end()
        standby.end()
    assert (came(shaping), came(standby), came(again)) == ([1], [2, 3], [4, 5])
    assert "chainshaper_t3 is not there: /t3: messages go around it" in standby.logged
    assert any("is back after " in text and "2 messages came" in text for text in standby.logged)
    logs = [tmp_path / "gate.csv", tmp_path / "chainshaper_t3_standby.csv"]
    gate, bypass = map(read_gate_log, logs)
    assert gate["source_timestamp"].to_list() == [1001, 1004, 1005]
    assert bypass["source_timestamp"].to_list() == [1002, 1003]
    assert bypass["overrun"].to_list() == ["bypass"] * 2
    assert (bypass["published"] >= bypass["release"]).all()
    assert releases_so_far(logs).size == gate.height, "the others left in no slot"


@pytest.mark.parametrize(
    ("changes", "dropped"),
    [({"depth": 3}, 5), ({"overrun": "discard", "slots_ns": [0, 1]}, 8)],
    ids=["overflowed", "discarded"],
)
def test_what_waits_in_a_killed_node_goes_around_it_but_not_what_it_has_dropped(
    tmp_path: Path, plan: ChainPlan, changes: dict[str, Any], dropped: int
) -> None:
    process, beside = written(plan, tmp_path)
    slot = [59_000 * MS, 59_500 * MS]
    timing = {"cycle_ns": 60_000 * MS, "slots_ns": slot, "anchor": "cycle"}
    phase = (time.monotonic_ns() - 1000 * MS) % (60_000 * MS)
    parameters_of(process, **{**timing, "phase_ns": phase, "overrun": "wait", **changes})

    def dealt_with() -> int:
        (output,) = outputs(tmp_path)
        place, name = output.page.rsplit("/", 1)
        return Page(place, name)["released"]

    with both(process, beside, tmp_path) as (shaping, standby):
        say(1, standby)
        for number in range(2, 9):
            say(number, shaping, standby)
        wait_for(lambda: dealt_with() == dropped, f"{dropped} to be dropped")
        time.sleep(0.1)  # the node takes what has come, every 50 ms
        shaping.process.kill()
        say(9, standby)
        for _ in range(dropped + 1, 10):
            standby.hear_published()
        standby.end()
    assert (came(shaping), came(standby)) == ([], list(range(dropped + 1, 10)))


def test_what_a_stopped_node_finds_when_it_goes_on_is_neither_doubled_nor_counted_as_lost(
    tmp_path: Path, plan: ChainPlan
) -> None:
    process, beside = written(plan, tmp_path, patience_ns=300 * MS)
    parameters_of(process, depth=3, cycle_ns=600 * MS, slots_ns=[300 * MS, 450 * MS])
    with both(process, beside, tmp_path) as (shaping, standby):
        shaping.process.send_signal(signal.SIGSTOP)  # while it waits for the slot
        say(1, standby)
        for number in range(2, 9):
            say(number, shaping, standby)
        for _ in range(1, 9):
            standby.hear_published()
        shaping.process.send_signal(signal.SIGCONT)
        number = say_until_shaped(8, shaping, standby)
        shaping.end()
        standby.end()
    assert came(standby)[:8] == list(range(1, 9))
    assert sorted(came(shaping) + came(standby)) == list(range(1, number + 1))
    assert read_gate_log(tmp_path / "gate.csv")["dropped"].to_list() == [None] * len(came(shaping))
    assert any("it hangs, or was stopped" in text for text in standby.logged)


def test_what_came_before_the_standby_is_not_published_behind_what_that_has_published(
    tmp_path: Path, plan: ChainPlan
) -> None:
    """Both are started again; the node's reader has a message which the standby's has not."""
    process, beside = written(plan, tmp_path)
    with running_node(beside, tmp_path) as standby, running_node(process, tmp_path) as shaping:
        shaping.process.send_signal(signal.SIGSTOP)
        say(1, shaping)
        for number in (2, 3):
            say(number, shaping, standby)
            standby.hear_published()
        say(4, shaping)
        shaping.process.send_signal(signal.SIGCONT)
        shaping.hear_published()
        shaping.end()
        standby.end()
    assert (came(shaping), came(standby)) == ([4], [2, 3])
    gate = read_gate_log(tmp_path / "gate.csv")
    assert gate["source_timestamp"].to_list() == [1001, 1004]
    assert gate["dropped"].to_list() == ["replaced", None], "it is counted"


def test_with_the_fallback_silence_nothing_is_published_and_all_is_counted(
    tmp_path: Path, plan: ChainPlan
) -> None:
    _, beside = written(revised(plan, fallback="silence"), tmp_path)
    with running_node(beside, tmp_path) as standby:
        for number in range(3):
            say(number, standby)
        wait_for(lambda: outputs(tmp_path)[0].messages == 3, "all to be counted")
        ours, servers = os.sched_getaffinity(0), {server.core for server in plan.servers}
        assert os.sched_getaffinity(standby.process.pid) == (ours - servers or ours)
        assert os.sched_getscheduler(standby.process.pid) == os.SCHED_OTHER
        (output,) = outputs(tmp_path)
        assert output.state == "silent"
        assert "3 messages were not published" in output_text(output)
        level, text = diagnosed(standby)
        assert (level, text.partition(" ")[0]) == (2, "silent")
        standby.end()
    assert not [words for words in standby.said if "publisher" in words and "t3" in str(words)]
    assert came(standby) == []
    log = read_gate_log(tmp_path / "chainshaper_t3_standby.csv")
    assert log["overrun"].to_list() == ["silence"] * 3
    assert log["release"].null_count() == 3


def test_a_node_that_starts_again_goes_on_in_its_cycle_and_mode(
    tmp_path: Path, plan: ChainPlan
) -> None:
    process, _ = written(banded(revised(plan, anchor="cycle")), tmp_path)
    for run_number in (1, 2):
        with running_node(process, tmp_path) as run:
            if run_number == 1:
                run.tell(set=["phase_ns", 13 * MS])
                run.tell(topic="/mode", data="highway")
                time.sleep(0.1)  # it is in force from the next cycle on
            say(run_number, run)
            run.hear_published()
            rows = tmp_path / "gate.csv"
            wait_for(lambda: read_gate_log(rows).height == run_number, "its log")  # noqa: B023
            run.process.kill()
    log = read_gate_log(tmp_path / "gate.csv")
    assert [origin % (50 * MS) for origin in log["origin"]] == [13 * MS] * log.height
    assert set(log["mode"]) == {"highway"}


def test_a_node_that_fails_at_once_waits_longer_each_time_and_says_so(
    tmp_path: Path, plan: ChainPlan
) -> None:
    process, _ = written(plan, tmp_path)
    for failed in range(4):
        if failed == 2:  # for another reason
            parameters_of(process, cycle_ns=5)
        unknown = {"/t3_tmp": [{"type": "no/msg/T", "qos": {}}]}
        with running_node(process, tmp_path, unknown, spinning=False) as run:
            assert run.end() == 1
        said = f"has failed {failed} times: starting in 0.5 s"
        assert any(said in text for text in run.logged) == (failed == 3)
        assert any("slots must ascend" in text for text in run.logged) == (failed >= 2)


def test_without_a_folder_the_node_works_alone_and_the_standby_says_that_it_cannot(
    tmp_path: Path, plan: ChainPlan
) -> None:
    process, beside = written(plan, tmp_path)
    for one in (process, beside):
        script = Path(known(one.command)[1])
        text = script.read_text().replace("/dev/shm/chainshaper-", f"{tmp_path}/no/such/folder-")
        script.write_text(text)
    for name in ("outputs", "chainshaper", "no"):
        (tmp_path / name).touch()
    with running_node(beside, tmp_path, spinning=False) as standby:
        standby.hear(lambda words: "/t3 falls silent when" in words.get("log", ""))
        with running_node(process, tmp_path) as shaping:
            say(1, shaping)
            shaping.hear_published()
            assert any("nothing can be agreed" in text for text in shaping.logged)
        assert standby.process.poll() is None, "it is there"


def test_pages_of_others_are_looked_at_without_trust(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Another robot, in another domain, has an output of the same name."""
    folder, topic = tmp_path / "outputs", f"/of_{os.getpid()}"
    for module in ("robot.handover", "splicing.shaped_outputs"):
        name = f"chainshaper.{module}.page_folders"
        monkeypatch.setattr(name, lambda: iter([str(folder), str(tmp_path / "missing")]))
    good, bad = open_page("good", topic), open_page("bad", f"{topic}\x1b[31m")
    assert find_outputs([str(folder)]) == (), "none of their processes lives"
    for page in (good, bad):
        assert page.lock()
        page["holder"] = os.getpid()
    (folder / "short").write_bytes(b"x")
    (folder / "link").symlink_to(good.path)
    os.mkfifo(folder / "fifo")
    (output,) = find_outputs([str(folder), str(tmp_path / "missing")])
    assert (output.topic, output.state) == (topic, "no standby")
    assert "it falls silent when that ends" in output_text(output)
    FollowedOutput(topic, {1, os.getpid()}).close()
    FollowedOutput(topic).close()
    with pytest.raises(OperationError, match="no gates publish it now"):
        ask_phase(topic, {1}, 5)
    if os.geteuid():
        pytest.skip("giving files to another user takes root")
    for path in (folder, good.path):
        os.chown(path, 65534, -1)
    assert find_outputs([str(folder)]) == (), "root's process is named on another user's page"


@needs_root
def test_a_stranger_s_page_says_nothing_of_our_outputs() -> None:
    """A stranger may write any topic into a page, and by how much its slots are moved."""
    topic, folder = f"/of_{os.getpid()}", Path(f"/dev/shm/chainshaper-{NOBODY}")
    with strange(["/bin/sleep", "600"]) as stranger:
        folder.mkdir(mode=0o700, exist_ok=True)
        os.chown(folder, NOBODY, NOBODY)
        file = folder / f"of_{os.getpid()}.0.v{VERSION}"
        file.touch(0o600)
        os.chown(file, NOBODY, NOBODY)
        page = Page(str(folder), file.name, topic, os.O_RDWR)
        try:
            assert page.lock()
            assert page.lock(MOVING)
            page["holder"] = stranger.pid
            page.ask(Change(1, NEW_MOVE, 50_000_000))
            (output,) = (output for output in find_outputs() if output.topic == topic)
            assert (output.user, output.shaping_node) == (NOBODY, stranger.pid)
            text = output_text(output)
            assert text.startswith(f"{topic} of user nobody is shaped by process {stranger.pid}")
            with pytest.raises(OperationError, match="no gates publish it now"):
                FollowedOutput(topic)
        finally:
            file.unlink()


def test_a_program_is_started_again_until_it_is_to_end(tmp_path: Path, plan: ChainPlan) -> None:
    written(plan, tmp_path)
    (tmp_path / "child.py").write_text(
        "import os, signal, sys\nprint(os.getpid(), *sys.argv[1:], flush=True)\nsignal.pause()\n"
    )
    command = [sys.executable, str(tmp_path / "respawning.py"), "child.py", "--ros-args"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as run:
        assert run.stdout is not None
        first, argument = run.stdout.readline().split()
        assert argument == "--ros-args"
        os.kill(int(first), signal.SIGKILL)
        second = run.stdout.readline().split()[0]
        assert second != first
        run.send_signal(signal.SIGINT)
        assert run.wait(20) != 0
    with pytest.raises(ProcessLookupError):
        os.kill(int(second), 0)
