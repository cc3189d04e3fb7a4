"""Callbacks of rclpy, recorded, beside what the callbacks note of themselves (`noting.py`)."""

import json
import os
import subprocess
import sys
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeAlias

import polars as pl
import pytest
from ros2 import ros2_environment

from chainshaper import open_recording
from chainshaper.analysis import DataFlow, data_flow

pytestmark = [pytest.mark.ros2, pytest.mark.timeout(300)]
NODES = Path(__file__).parent / "noting.py"
Ran: TypeAlias = Callable[..., tuple[DataFlow, list[dict[str, Any]]]]

# Programs in front of the nodes: as users have them, and an interpreter that ignores its
# environment. What they print proves that they ran.
CUSTOMIZE = "import sys; print('the site is the user\\'s', file=sys.stderr)"
ISOLATED = """
import runpy, sys
sys.path[:0] = {path!r}
sys.argv = {arguments!r}
runpy.run_path(sys.argv[0], run_name="__main__")
"""


@pytest.fixture
def ran(tmp_path: Path) -> Ran:
    def ran(
        kind: str, *options: str, python: tuple[str, ...] = ("python3",), **variables: str
    ) -> tuple[DataFlow, list[dict[str, Any]]]:
        environment = {**ros2_environment(), "ROS_DOMAIN_ID": str(100 + os.getpid() % 100)}
        asked = "import rclpy.experimental"
        if (
            kind == "events"
            and subprocess.run(
                ["env", "python3", "-c", asked], env=environment, capture_output=True, check=False
            ).returncode
        ):
            pytest.skip("this rclpy has no events executor")
        words = [str(NODES), str(tmp_path / "notes"), kind, "4", *options]
        if "-I" in python:
            path = subprocess.run(
                ["env", "python3", "-c", "import json, sys; print(json.dumps(sys.path[1:]))"],
                env=environment,
                capture_output=True,
                check=True,
            )
            words = ["-c", ISOLATED.format(path=json.loads(path.stdout), arguments=words)]
        folder = tmp_path / "recording"
        command = [sys.executable, "-m", "chainshaper", "record", "-o", str(folder)]
        run = subprocess.run(
            [*command, "--source", "preload", "--", *python, *words],
            env={**environment, **variables},
            capture_output=True,
            text=True,
            check=False,
        )
        assert run.returncode == 0, run.stderr[-3000:]
        (tmp_path / "printed").write_text(run.stderr)
        recording = open_recording(folder)
        assert not any(recording.info.lost.values())
        flow = data_flow(recording.events, recording.info.clock_offset_ns, complete=True)
        lines = (tmp_path / "notes").read_text().splitlines()
        return flow, [json.loads(line) for line in lines]

    return ran


def instances(flow: DataFlow) -> dict[tuple[str, str], list[dict[str, Any]]]:
    """The instances by node and callback, in order."""
    about = flow.objects.callbacks.unique("callback_id", keep="first")
    about = about.select("callback_id", "node", "symbol", topic=pl.col("topic").cast(pl.String))
    rows = flow.instances.join(about, on="callback_id", maintain_order="left")
    listed = defaultdict[tuple[str, str], list[dict[str, Any]]](list)
    for row in rows.drop_nulls("symbol").iter_rows(named=True):
        name = row["symbol"].split(".")[-1]
        name += row["topic"] if name == "take" else ""
        listed[row["node"], name].append(row)
    return listed


def check_each(flow: DataFlow, notes: list[dict[str, Any]]) -> set[str]:
    """Every note lies in an instance of its callback, which no other one has, and none is left.

    An instance begins before its note, and after what its thread ran before; the same for its end.
    Returns the callbacks that were noted.
    """
    recorded, noted = instances(flow), defaultdict[tuple[str, str], list[dict[str, Any]]](list)
    for note in sorted(notes, key=lambda note: int(note["runs"][0][0])):
        noted["/" + note["node"], note["callback"]].append(note)
    for callback, of_callback in noted.items():
        free = list(recorded[callback])
        for note in of_callback:
            began, ended = note["runs"][0][0], note["runs"][-1][1]
            (row,) = [
                row
                for row in free
                if row["start"] <= began
                and ended <= (row["end"] or 0)
                and row["tid"] == note["tids"][0]
            ][-1:]
            free.remove(row)
            ran = sum(until - since for since, until in note["runs"])
            around = (row["end"] - row["start"]) - (ended - began)
            # Up to 0.2 ms of what interrupted a piece may count as its own (docs/record.md), and
            # before it waits and behind that it computes beside its note; it waits for 15 ms.
            left_open = 1_000_000 * len(note["runs"])
            assert row["execution_ns"] <= ran + around + left_open, callback
        # The program ends in the midst of some coroutines, and before the last notes are made.
        free = [row for row in free if row["end"] is not None]
        assert len(free) <= 3, (callback, free)
        assert all(row["start"] > of_callback[-1]["runs"][0][0] - 10**9 for row in free)
    return {name for _, name in noted}


EVERY = {"tick", "tock", "work", "judge", "ask", "sleep", "alarm", "hand_over"}


def check_outputs(flow: DataFlow) -> None:
    """Each topic is published in the callbacks that publish it, through coroutines and tasks."""
    about = flow.objects.callbacks.unique("callback_id", keep="first")
    wrote = flow.publications.join(
        about.select("callback_id", "symbol", "kind"), on="callback_id", how="left"
    ).with_columns(
        pl.col("topic").cast(pl.String), name=pl.col("symbol").str.split(".").list.last()
    )
    by = wrote.group_by("topic").agg(pl.col("name", "kind").unique())
    writers = {topic: (names, kinds) for topic, names, kinds in by.iter_rows()}
    for topic, name in {
        **{"/raw": "tick", "/slow": "tock", "/done": "work", "/asked": "ask", "/later": "sleep"},
        **{"/by_task": "hand_over", "/judge:response": "judge"},
    }.items():
        assert writers[topic][0] == [name], topic
    assert {*writers["/judge:request"][0]} == {"ask", "hand_over"}
    assert writers["/answered"][1] == ["client"]


@pytest.mark.parametrize("kind", ["single", "multi", "events"])
def test_every_instance_is_what_its_callback_notes(ran: Ran, kind: str) -> None:
    flow, notes = ran(kind)
    # The events executor refuses guard conditions, and that of Jazzy never runs coroutines.
    waiting = {"ask", "sleep", "take/asked", "take/later", "triggered"}
    expected = EVERY | waiting | {"take/done"}
    assert check_each(flow, notes) >= (expected - waiting if kind == "events" else expected)
    if kind != "events":
        check_outputs(flow)
    assert (
        not flow.instances.filter(pl.col("assumed"))
        .filter(
            ~pl.col("callback_id").is_in(
                flow.objects.callbacks.filter(kind="client")["callback_id"].implode()
            )
        )
        .height
    )
    timers = flow.objects.callbacks.filter(kind="timer").select("node", "symbol").rows()
    nodes = {symbol.split(".")[-1]: node for node, symbol in timers}
    assert nodes == {"tick": "/sensor", "tock": "/sensor", "alarm": "/worker"}
    assert not [note for note in flow.notes if "without callback events" in note]


def test_exceptions_end_instances(ran: Ran) -> None:
    flow, notes = ran("single", "raising")
    assert check_each(flow, notes) >= EVERY
    ticks = instances(flow)["/sensor", "tick"]
    assert len(ticks) > 20
    assert all(row["end"] for row in ticks)


def test_a_site_of_the_users_own_still_runs(ran: Ran, tmp_path: Path) -> None:
    (tmp_path / "site").mkdir()
    (tmp_path / "site/sitecustomize.py").write_text(CUSTOMIZE)
    path = f"{tmp_path / 'site'}:{ros2_environment().get('PYTHONPATH', '')}"
    flow, notes = ran("single", PYTHONPATH=path)
    assert check_each(flow, notes) >= EVERY
    assert "the site is the user's" in (tmp_path / "printed").read_text()


def test_an_interpreter_without_site_and_environment(ran: Ran) -> None:
    flow, notes = ran("single", python=("python3", "-I", "-S"))
    assert check_each(flow, notes) >= EVERY


def test_inference_stays_where_it_is_wished_for(ran: Ran) -> None:
    flow, _ = ran("single", CHAINSHAPER_RCLPY="inferred")
    assert not instances(flow)
    assert flow.instances["assumed"].any()
