"""Callbacks that compute: real functions on real messages, over DDS, and what can go wrong."""

import sys
from itertools import count
from pathlib import Path

import pytest
from calm_runs import calm_run
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from processes import wait_for
from small_chain import DDS_CORE, EXECUTOR_CORE

from chainshaper import run_application, simulate
from chainshaper.analysis import analyse_latency
from chainshaper.simulation.simulating import with_recorded_times
from chainshaper.values.errors import InputError, OperationError
from chainshaper.values.recording import Recording
from chainshaper.workload import dds
from chainshaper.workload.description import Application, load_application
from chainshaper.workload.executor import computing, load_function

TEXT = f"""\
name: sums
chain: /squares../sum
scheduling:
  executors: {{core: {EXECUTOR_CORE}, priority: 80}}
  dds: {{core: {DDS_CORE}, priority: 90}}
nodes:
  source:
    callbacks: [{{timer: 50ms, computes: "sums:numbers", publishes: [/numbers]}}]
  squares:
    callbacks: [{{subscription: /numbers, computes: "sums:squares", publishes: [/squares]}}]
  total:
    callbacks: [{{synchronises: [/numbers, /squares], computes: "sums:total", publishes: [/sum]}}]
  check:
    callbacks: [{{subscription: /sum, computes: "sums:check"}}]
"""

FUNCTIONS = """\
import itertools, threading, time
import numpy as np
from chainshaper.workload.dds import data_message, data_of, number_in
from chainshaper import origin_of

COUNT = itertools.count()
threading.Thread(target=threading.Event().wait, daemon=True).start()

def numbers():
    print(3, flush=True)
    values = np.arange(250_000, dtype=np.float32) % 7 + next(COUNT)
    return data_message(values.data, time.time_ns())

def squares(message):
    values = np.frombuffer(data_of(message), dtype=np.float32)
    if int(values[0]) % 4 == 3:  # one in four is held back
        return None
    return data_message((values ** 2).data, origin_of(message))

def total(numbers, squares):
    pair = [np.frombuffer(data_of(one), dtype=np.float32) for one in (numbers, squares)]
    lengths = np.array([len(one) for one in pair], np.float32)
    return data_message(lengths.data, origin_of(squares), number=5)

def check(message):
    assert number_in(message) == 5
    assert 0 < time.time_ns() - origin_of(message) < 10**9
    assert np.frombuffer(data_of(message), np.float32).tolist() == [250_000, 250_000]

def fails_beside_the_main_thread():
    if threading.current_thread() is not threading.main_thread():
        1 / 0
    time.sleep(0.2)
"""

BESIDE = f"""\
name: beside
chain: /out
scheduling:
  executors: {{core: {EXECUTOR_CORE}, priority: 80}}
  dds: {{core: {DDS_CORE}, priority: 90}}
nodes:
  source:
    executor: multi_threaded
    threads: 2
    callback_groups: {{one: mutually_exclusive, two: mutually_exclusive}}
    callbacks:
      - timer: 50ms
        computes: "sums:fails_beside_the_main_thread"
        group: one
        publishes: [/out]
      - {{timer: 50ms, computes: "sums:fails_beside_the_main_thread", group: two}}
"""


def _application(folder: Path, monkeypatch: pytest.MonkeyPatch, **change: str) -> Application:
    """The application, its functions in the working directory; what is named is replaced."""
    text = TEXT
    for old, new in change.items():
        text = text.replace(f'"sums:{old}"', f'"{new}"')
    (folder / "sums.yaml").write_text(text)
    (folder / "sums.py").write_text(FUNCTIONS)
    monkeypatch.chdir(folder)
    return load_application(folder / "sums.yaml")


def test_a_data_message_is_the_message_that_topics_carry() -> None:
    data = bytes(range(37))
    header = dds.Header(dds.Time(12, 345_678_901), "")
    serialized = dds.Stamped(header, 0, list(data)).serialize()  # type: ignore[arg-type]
    message = dds.data_message(data, 12_345_678_901)
    assert message == serialized + bytes(-len(serialized) % 4)
    assert bytes(dds.data_of(message)) == data


def test_counterparts_that_are_discovered_while_they_are_counted_end_no_node(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """At the second look DDS knows one more than at the first."""
    monkeypatch.setenv("CYCLONEDDS_URI", dds.closed_domain_configuration())
    participant = dds.Participant(dds.free_domain())
    publisher = dds.Publisher(participant, "/t", "reliable", 1)
    subscription = dds.Subscription(participant, "/t", "reliable", 1)
    known, counts = count(1), ("_get_matched_subscriptions", "_get_matched_publications")
    monkeypatch.setattr(DataWriter, counts[0], lambda *_: next(known))
    monkeypatch.setattr(DataReader, counts[1], lambda *_: next(known))
    assert [publisher.matched(), subscription.matched()] == [1, 2]
    monkeypatch.undo()
    wait_for(lambda: publisher.matched() == subscription.matched() == 1, "discovery")
    monkeypatch.setattr(DataWriter, counts[0], lambda *_: -3)
    with pytest.raises(OperationError, match="code -3"):
        publisher.matched()


@pytest.mark.timed
def test_megabytes_are_computed_on_and_what_returns_nothing_publishes_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    application = _application(tmp_path, monkeypatch)
    recording = calm_run(
        lambda place: run_application(application, place / "rec", cycles=12), tmp_path
    )
    analysis = analyse_latency(recording, application.chain)
    # Three in four of the squares begin the chain with a message; the first five cycles warm up.
    assert analysis.statistics.count == 9
    source = [one.role for one in recording.info.threads if one.node == "/source"]
    assert source.count("executor") == 1, "what its module started executes nothing"
    totals = recording.events["rclcpp_publish"].filter(pid=_pid(recording, "/total"))
    assert totals.height == 9, "one a set"
    with pytest.raises(InputError, match=r"node source computes sums:numbers.*--execution-times"):
        simulate(application, tmp_path / "simulated")
    simulated = simulate(with_recorded_times(application, recording), tmp_path / "sim", cycles=10)
    assert analyse_latency(simulated, application.chain).statistics.count == 10


def _pid(recording: Recording, node: str) -> int:
    return next(pid for pid, name in recording.info.processes.items() if name == node)


def test_a_function_that_fails_ends_the_run_with_its_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    application = _application(tmp_path, monkeypatch, numbers="sums:squares")
    with pytest.raises(OperationError, match=r"sums:squares failed at .*executor.py:\d+: TypeErr"):
        run_application(application, tmp_path / "rec", cycles=200, realtime=False)
    assert not (tmp_path / "rec").exists()


def test_a_function_that_fails_in_another_thread_ends_the_run_as_well(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    _application(tmp_path, monkeypatch)
    (tmp_path / "beside.yaml").write_text(BESIDE)
    application = load_application(tmp_path / "beside.yaml")
    said = r"ended with code 1 .*: sums:fails_beside\w+ failed at .*sums.py:\d+: ZeroDivisionError"
    with pytest.raises(OperationError, match=said):
        run_application(application, tmp_path / "rec", cycles=200, realtime=False)
    assert not (tmp_path / "rec").exists()


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("nowhere:numbers", "nowhere:numbers cannot be loaded: ModuleNotFoundError"),
        ("broken:numbers", r"broken:numbers cannot be loaded: ZeroDivisionError.*broken.py:1\)"),
        ("sums:digits", r"sums:digits cannot be loaded: .*/sums.py has no digits"),
        ("sums:COUNT", "sums:COUNT cannot be called: name a function"),
        ("itertools:count", "itertools:count returned count: return the message to publish"),
    ],
)
def test_what_is_no_function_for_callbacks_is_named_with_the_reason(
    name: str, said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    _application(tmp_path, monkeypatch)
    (tmp_path / "broken.py").write_text("1 / 0")
    monkeypatch.setattr(sys, "path", [*sys.path])
    monkeypatch.delitem(sys.modules, "sums", raising=False)
    with pytest.raises(SystemExit, match=said):
        computing(name, load_function(name), 1)((), 0, 0)
