"""`chainshaper record`, from the command line to the recording, with a real LTTng."""

import json
import os
import re
import shutil
import signal
import tempfile
from collections.abc import Mapping
from pathlib import Path

import polars as pl
import pytest
from command_line import Running, called, chainshaper, json_of, refused
from lttng_node import LTTNG, chain_command, required_node
from processes import wait_for

from chainshaper import open_recording
from chainshaper.flow import record
from chainshaper.values import events
from chainshaper.values import recording as recording_module
from chainshaper.values.errors import OperationError
from chainshaper.values.events import EventTables
from chainshaper.values.recording import RecordingInfo

pytestmark = pytest.mark.waiting

CYCLES = 30


@pytest.fixture(scope="module")
def node() -> Path:
    return required_node()


@pytest.fixture(scope="module")
def recorded(node: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A chain of two nodes, /source → /x → /relay → /y, recorded to its own end."""
    path = tmp_path_factory.mktemp("recorded") / "rec"
    command = chain_command(node, CYCLES, period_us=40_000)
    said = json_of_recording("-o", path, "--watch-stalls", "--", *command)
    assert said["recording"] == str(path)
    assert said["exit_code"] == 0
    assert said["lost"] == {"discarded_events": 0, "lost_packets": 0}
    return path


def json_of_recording(*arguments: str | Path) -> Mapping[str, object]:
    finished = called("record", "--json", *LTTNG, *arguments)
    assert finished.code == 0, finished
    found: Mapping[str, object] = json.loads(finished.out)
    return found


def files_in(folder: Path) -> list[str]:
    return sorted(entry.name for entry in folder.iterdir())


def test_a_recording_has_every_cycle_and_its_trace(recorded: Path) -> None:
    figures = json_of("latency", recorded, "--chain", "/x../y")
    assert (figures["count"], figures["incomplete"]) == (CYCLES, 0)
    counts = {one["node"]: one["count"] for one in json_of("callbacks", recorded)}
    assert counts == {"/source": CYCLES, "/relay": CYCLES}
    shown = []
    for path in (recorded, recorded / "trace"):  # the trace does not show the machine's stalls
        cycles = json_of("latency", path, "--chain", "/x../y", "--instances")["instances"]
        events = {n.removeprefix("ros2:"): c for n, c in json_of("info", path)["events"].items()}
        events.pop("machine_stall", None)
        shown.append(([(one["start_ns"], one["end_ns"]) for one in cycles], events))
    assert shown[0] == shown[1]


def test_the_recording_says_who_ran_how(recorded: Path, node: Path) -> None:
    recording = open_recording(recorded)
    info, meter = recording.info, recording.info.stall_meter
    assert info.command == chain_command(node, CYCLES, period_us=40_000)
    assert (info.distribution, info.rmw) == ("jazzy", "rmw_cyclonedds_cpp")
    assert sorted(info.processes.values()) == ["/relay", "/source"]
    for name in ("/source", "/relay"):
        threads = [thread for thread in info.threads if thread.node == name]
        roles = {thread.comm: thread.role for thread in threads}
        assert (roles["recvUC"], roles["tev"]) == ("dds", "dds")
        (executor,) = (thread for thread in threads if thread.role == "executor")
        assert (executor.tid, executor.policy) == (executor.pid, "SCHED_OTHER")
    assert info.realtime is False
    ends = {(one.node, one.topic, one.kind, one.depth) for one in info.endpoints}
    assert ends == {
        ("/source", "/x", "publisher", 7),
        ("/relay", "/x", "subscription", 7),
        ("/relay", "/y", "publisher", 7),
    }
    assert any("types and QoS" in note and "ended by itself" in note for note in info.notes)
    assert meter is not None, "as --watch-stalls asks"
    assert meter.wakeups > CYCLES * 40 // 2
    assert recording.events["machine_stall"].columns == ["time", "pid", "tid", "cpu", "duration"]


def test_ctrl_c_ends_the_application_and_the_recording_is_whole(node: Path, tmp_path: Path) -> None:
    path, sent = tmp_path / "rec", tmp_path / "sent"
    (shell, option, pipe) = chain_command(node, 100_000)
    pipe = pipe.replace("|", f"| tee {sent} |")
    running = Running.start("record", *LTTNG, "-o", path, "--", shell, option, pipe)
    wait_for(lambda: sent.exists() and sent.stat().st_size > 100, "the chain's first messages")
    running.process.send_signal(signal.SIGINT)
    finished = running.end()  # waits for the end of all its descendants
    assert finished.code == 0, finished
    assert finished.out == f"{path}\n"
    figures = json_of("latency", path, "--chain", "/x../y")
    assert figures["count"] > 0
    assert files_in(tmp_path) == ["rec", "sent"]


def test_an_application_that_fails_is_reported_and_what_was_recorded_is_kept(
    node: Path, tmp_path: Path
) -> None:
    path, words = tmp_path / "rec", "ended with code 3"
    finished = called("record", *LTTNG, "-o", path, "--", "sh", "-c", f"{node} flood 10 0; exit 3")
    assert finished.code == 1
    assert f"error: the command {words}; what was recorded until then is in {path}" in finished.err
    recording = open_recording(path)
    assert recording.events["callback_start"].height == 10
    assert any(f"the command {words} after" in note for note in recording.info.notes)


def test_an_application_that_is_not_traced_leaves_no_recording(node: Path, tmp_path: Path) -> None:
    said = refused(1, "record", *LTTNG, "-o", tmp_path / "rec", "--", "sh", "-c", "exit 4")
    assert re.search(r"no process with LTTng trace points was seen.*source ebpf`", said)
    assert "; the command ended with code 4 after" in said
    assert files_in(tmp_path) == []


def test_lost_events_are_named_wherever_figures_are(node: Path, tmp_path: Path) -> None:
    path = tmp_path / "rec"
    command = ("--buffer", "1", "--", node, "flood", "300000", "0")
    finished = called("record", *LTTNG, "-o", path, *command)
    assert finished.code == 0
    lost = json.loads((path / "recording.json").read_text())["lost"]["discarded_events"]
    assert lost > 0
    assert f"lost while recording: {lost} discarded events" in finished.err
    assert f"{lost} events were lost: buffers were too small. Record again with" in finished.err
    assert json_of("info", path)["lost"]["discarded_events"] == lost
    latency = called("latency", path, "--chain", "/flood../x")
    assert f"{lost} discarded events" in latency.out + latency.err


def test_an_ordinary_user_records_with_a_daemon_of_their_own(
    node: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if os.geteuid() != 0:
        pytest.skip("only root can become another user")
    with tempfile.TemporaryDirectory() as readable:  # pytest's own folders are root's alone
        folder = Path(readable)
        folder.chmod(0o777)
        program = folder / "node"
        shutil.copy(node, program)
        program.chmod(0o755)
        monkeypatch.setenv("HOME", readable)
        nobody = ("setpriv", "--reuid=65534", "--regid=65534", "--clear-groups")
        arguments = ("-o", folder / "rec", "--", program, "flood", "20", "0")
        run = chainshaper("record", *LTTNG, *arguments, prefix=nobody)
        assert run.code == 0, run
        assert open_recording(folder / "rec").events["callback_start"].height == 20
        assert "root or the group `tracing`" in run.err  # for sched_switch


def test_what_is_wrong_is_said_before_anything_starts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, program = tmp_path / "rec", ("--", "true")
    (tmp_path / "mine").write_text("mine")
    ebpf = ("--source", "ebpf")
    for arguments, words in (
        (("-o", path, "--", "no_such", "launch"), "no_such: no such command"),
        (("-o", path, *ebpf, "--buffer", "8", *program), "--buffer is about LTTng's buffers"),
        (("-o", tmp_path / "mine", *program), "exists already and is not overwritten"),
    ):
        assert words in refused(2, "record", *arguments)
    (tmp_path / "true").symlink_to("/bin/true")
    monkeypatch.setenv("PATH", str(tmp_path))
    said = refused(3, "record", *LTTNG, "-o", path, *program)
    assert "install LTTng" in said
    assert "--source ebpf" in said
    assert files_in(tmp_path) == ["mine", "true"]


class BrokenTracer:
    """A tracer whose trace cannot be read."""

    removed = 0

    def __init__(self, error: BaseException, folder: Path) -> None:
        self.folder, self.error = folder, error

    def start(self) -> Mapping[str, str]:
        (self.folder / "events").write_text("what was traced")
        return {}

    def failure(self) -> str | None:
        return "it broke"

    def stop(self) -> None:
        pass

    def remove(self) -> None:
        self.removed += 1

    def recording(self) -> tuple[EventTables, RecordingInfo]:
        raise self.error

    def written(self) -> None:
        raise AssertionError("nothing was")


@pytest.mark.parametrize("error", [OperationError("it cannot be read"), MemoryError()])
def test_a_trace_is_kept_and_named_whatever_reading_it_ends_with(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: BaseException
) -> None:
    tracers, said = list[BrokenTracer](), list[str]()

    def tracer(_: None, folder: Path, *__: object, **___: object) -> BrokenTracer:
        tracers.append(BrokenTracer(error, folder))
        return tracers[-1]

    monkeypatch.setattr(record, "_tracer", tracer)
    with pytest.raises(type(error)) as caught:
        record.record_command(
            tmp_path / "rec", ["sleep", "60"], progress=lambda _, what: said.append(what)
        )
    (kept,) = tmp_path.iterdir()
    assert kept.name.startswith("rec.tracing-")
    assert (kept / "events").read_text() == "what was traced"
    assert (str(caught.value) or said[-1]).endswith(
        "it cannot be read; tracing ended before the application did: it broke; what was traced "
        f"stays in {kept}"
    )
    assert [one.removed for one in tracers] == [1]


def test_a_full_disk_is_named(node: Path, full_disk: Path) -> None:
    said = refused(
        1, "record", *LTTNG, "-o", full_disk / "rec", "--", node, "flood", "100000", "1000"
    )
    assert f"the disk of {full_disk} is full" in said
    assert "rec" not in files_in(full_disk)


@pytest.mark.ros2("demo_nodes_cpp", "ros2run")
@pytest.mark.usefixtures("in_ros2")
def test_real_nodes_are_recorded_with_types_and_qos(tmp_path: Path) -> None:
    path = tmp_path / "rec"
    nodes = "ros2 run demo_nodes_cpp talker & ros2 run demo_nodes_cpp listener"
    json_of_recording("-o", path, "--duration", "8s", "--", "sh", "-c", nodes)
    info = open_recording(path).info
    assert sorted(info.processes.values()) == ["/listener", "/talker"]
    chatter = {one.kind: one for one in info.endpoints if one.topic == "/chatter"}
    assert chatter["publisher"].node == "/talker"
    assert chatter["subscription"].node == "/listener"
    for one in chatter.values():
        # from Lyrical on the latter
        assert one.type in ("std_msgs/msg/String", "example_interfaces/msg/String")
        assert one.reliability == "reliable"
        assert one.depth
    # A ROS 2 that was built from source need not say its name.
    assert info.distribution == os.environ.get("ROS_DISTRO", info.distribution)
    assert info.distribution is not None
    executors = {thread.node for thread in info.threads if thread.role == "executor"}
    assert executors == {"/talker", "/listener"}
    assert json_of("latency", path, "--chain", "/talker../chatter")["count"] >= 3


class FullTracer(BrokenTracer):
    """A tracer with an event, whose files say no more than that."""

    def __init__(self, folder: Path) -> None:
        super().__init__(OperationError("-"), folder)

    def failure(self) -> None:
        return None

    def recording(self) -> tuple[EventTables, RecordingInfo]:
        table = events.empty("rcl_take").clear(1).with_columns(time=pl.lit(1), message=pl.lit(7))
        assert (self.folder / "events").exists()
        return {"rcl_take": table}, RecordingInfo(source="preload", clock_offset_ns=0)

    def written(self) -> None:
        (self.folder / "events").unlink()


@pytest.fixture
def full_tracer(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(record, "_tracer", lambda _, folder, *__, **___: FullTracer(folder))


@pytest.mark.usefixtures("full_tracer")
def test_what_was_traced_is_removed_when_the_tables_are_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    record.record_command(tmp_path / "rec", ["true"])
    assert files_in(tmp_path) == ["rec"]
    assert open_recording(tmp_path / "rec").events["rcl_take"]["message"].to_list() == [7]

    def full(*_: object) -> None:
        raise OperationError("the disk is full")

    monkeypatch.setattr(recording_module, "write_recording", full)
    with pytest.raises(OperationError, match="the disk is full; what was traced stays in "):
        record.record_command(tmp_path / "lost", ["true"])
    (left,) = (one for one in tmp_path.iterdir() if one.name != "rec")
    assert (left / "events").exists()


@pytest.mark.usefixtures("full_tracer")
def test_events_are_written_whatever_fails_beside_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object) -> None:
        raise ValueError("an odd name")

    for name in ("_look", "_known_endpoints", "_recorded_threads", "with_found_nodes"):
        monkeypatch.setattr(record, name, fail)
    found = record.record_command(tmp_path / "rec", duration_ns=1, source="preload").recording
    assert found.events["rcl_take"].height == 1
    said = "".join(found.info.notes)
    for what in ("nodes", "threads", "endpoints"):
        assert f"the application's {what} are not known: reading them failed (ValueError" in said
    assert "looking at it has failed (ValueError: an odd name)" in said
