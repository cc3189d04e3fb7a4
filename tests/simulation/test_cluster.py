"""A sweep on a Dask cluster: a real scheduler and real workers, each a process of this machine."""

import json
import os
import signal
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import polars as pl
import pytest
from processes import wait_for
from quick_chain import quick_chain

from chainshaper import open_recording, simulate, sweep
from chainshaper.flow.sweep import rows_beside
from chainshaper.monitor.budgets import check_budgets, propose_budget
from chainshaper.values import many_tasks
from chainshaper.values.errors import InputError, OperationError
from chainshaper.verify.slowdowns import slowdowns_in

distributed = pytest.importorskip("distributed", reason="Dask's `distributed` is not installed")

AXES: dict[str, list[Any]] = {"bands": [1, 2, 3], "seed": [1, 2]}
Start = Callable[..., "subprocess.Popen[bytes]"]


@pytest.fixture(scope="module")
def start(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Start]:
    """Start a part of a cluster; all of them end with the tests."""
    parts: list[subprocess.Popen[bytes]] = []
    folder = tmp_path_factory.mktemp("cluster")

    def start_one(part: str, *arguments: str, path: Path | None = None) -> Any:
        command = [sys.executable, "-m", f"distributed.cli.dask_{part}", *arguments]
        environment = {**os.environ, **({} if path is None else {"PYTHONPATH": str(path)})}
        process = subprocess.Popen(
            [*command, "--no-dashboard"],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            cwd=folder,
            env=environment,
        )
        parts.append(process)
        return process

    yield start_one
    for process in parts:
        process.kill()
        process.wait()


@pytest.fixture(scope="module")
def scheduler(start: Start, tmp_path_factory: pytest.TempPathFactory) -> str:
    """The address of a scheduler without workers."""
    file = tmp_path_factory.mktemp("scheduler") / "scheduler.json"
    start("scheduler", "--host", "127.0.0.1", "--port", "0", "--scheduler-file", str(file))
    wait_for(lambda: file.exists() and file.stat().st_size > 0, "the scheduler")
    return str(json.loads(file.read_text())["address"])


def worker(start: Start, scheduler: str, path: Path | None = None) -> Any:
    return start("worker", scheduler, "--no-nanny", "--nthreads", "1", path=path)


@pytest.fixture(scope="module")
def helped(start: Start, scheduler: str) -> str:
    """The same address, from now on of a cluster with a worker."""
    worker(start, scheduler)
    return scheduler


def swept(output: Path, **wishes: Any) -> pl.DataFrame:
    application = quick_chain(*[{"uniform": ["1ms", "6ms"]}] * 2)
    return sweep(application, AXES, output, cycles=50, **wishes).drop("seconds")


def test_a_worker_with_another_version_is_named(
    start: Start, scheduler: str, tmp_path: Path
) -> None:
    information = tmp_path / "other" / "chainshaper-9.9.dist-info"
    information.mkdir(parents=True)
    (information / "METADATA").write_text(
        "Metadata-Version: 2.1\nName: chainshaper\nVersion: 9.9\n"
    )
    other = worker(start, scheduler, path=tmp_path / "other")
    with pytest.raises(OperationError) as refused:
        swept(tmp_path / "out.parquet", scheduler=scheduler)
    other.kill()
    other.wait()
    assert "the Dask worker at tcp://127.0.0.1:" in str(refused.value)
    assert "has chainshaper 9.9, not " in str(refused.value)
    assert "numpy" not in str(refused.value)
    assert not rows_beside(tmp_path / "out.parquet").exists()


def test_without_any_worker_that_can_compute_it_does_not_wait_for_ever(
    start: Start, scheduler: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Dask's worker ends when it cannot load what it is sent: here it has no chainshaper."""
    monkeypatch.setattr(many_tasks, "WITHOUT_WORKERS_S", 1)
    (tmp_path / "other" / "chainshaper").mkdir(parents=True)
    (tmp_path / "other" / "chainshaper" / "__init__.py").touch()
    # An editable installation goes before PYTHONPATH.
    (tmp_path / "other" / "sitecustomize.py").write_text(
        "import sys\n"
        "sys.meta_path = [one for one in sys.meta_path if 'editable' not in type(one).__module__]\n"
    )
    ended = worker(start, scheduler, path=tmp_path / "other")
    with distributed.Client(scheduler, set_as_default=False) as client:
        client.wait_for_workers(1, timeout=60)
    with pytest.raises(OperationError, match="it has had no workers for 1 s") as refused:
        swept(tmp_path / "out.parquet", scheduler=scheduler)
    assert ended.wait(timeout=60) is not None
    assert f"the Dask cluster at {scheduler} failed" in str(refused.value)


def test_where_no_scheduler_answers_the_address_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(many_tasks, "CONNECT_S", 1)
    with socket.socket() as reserved:
        reserved.bind(("127.0.0.1", 0))  # nothing listens there
        address = f"tcp://127.0.0.1:{reserved.getsockname()[1]}"
        with pytest.raises(OperationError, match=f"no Dask scheduler answers at {address}"):
            swept(tmp_path / "out.parquet", scheduler=address)
    with pytest.raises(InputError, match="'nowhere' is no scheduler's address"):
        swept(tmp_path / "out.parquet", scheduler="nowhere")
    assert not list(tmp_path.iterdir())


def test_the_rows_are_the_same_although_a_worker_is_killed(
    start: Start, helped: str, tmp_path: Path
) -> None:
    victim = worker(start, helped)

    def kill(share: float, _: str) -> None:
        if share:
            victim.send_signal(signal.SIGKILL)

    on_cluster = swept(tmp_path / "cluster.parquet", scheduler=helped, progress=kill)
    assert victim.wait() == -signal.SIGKILL
    assert on_cluster.equals(swept(tmp_path / "here.parquet", workers=1))


def test_a_fleet_is_checked_as_here(helped: str, tmp_path: Path) -> None:
    """Against a budget and a baseline, a file that cannot be read included."""
    application = quick_chain(*[{"uniform": ["1ms", "6ms"]}] * 2)
    paths = [simulate(application, tmp_path / f"r{n}", cycles=60).path for n in range(3)]
    budget = propose_budget(open_recording(paths[0]))
    every = [*paths, tmp_path / "gone"]
    assert check_budgets(every, budget, scheduler=helped) == check_budgets(every, budget)
    sides = paths[:2], paths[2:]
    assert slowdowns_in(*sides, scheduler=helped) == slowdowns_in(*sides)
    with pytest.raises(InputError, match="gone: no such folder"):
        slowdowns_in(every, paths, scheduler=helped)


@pytest.mark.parametrize("ending", [signal.SIGKILL, signal.SIGSTOP])
def test_a_scheduler_that_dies_or_hangs_costs_no_finished_row(
    start: Start,
    ending: signal.Signals,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    file = tmp_path / "scheduler.json"
    port = ("--host", "127.0.0.1", "--port", "0", "--scheduler-file", str(file))
    process: Any = start("scheduler", *port)
    wait_for(lambda: file.exists() and file.stat().st_size > 0, "the scheduler")
    address = str(json.loads(file.read_text())["address"])
    helper = worker(start, address)
    with distributed.Client(address, set_as_default=False) as client:
        client.wait_for_workers(1, timeout=60)

    def end(share: float, _: str) -> None:
        if share and process.poll() is None:
            process.send_signal(ending)
            helper.send_signal(signal.SIGSTOP)  # it computes no more either
            # From now on: on a busy machine the first row may take longer than this.
            monkeypatch.setattr(many_tasks, "WITHOUT_WORKERS_S", 2)
            monkeypatch.setattr(many_tasks, "ANSWER_S", 1)

    try:
        with pytest.raises(OperationError, match=f"the Dask cluster at {address} failed") as failed:
            swept(tmp_path / "out.parquet", scheduler=address, progress=end)
    finally:
        process.send_signal(signal.SIGCONT)
        helper.kill()
    assert "finished rows stay" in str(failed.value)
    assert len(rows_beside(tmp_path / "out.parquet").read_text().splitlines()) > 1
    assert "Traceback" not in capfd.readouterr().err
    process.kill()
    goes_on = swept(tmp_path / "out.parquet", workers=1)
    assert goes_on.equals(swept(tmp_path / "here.parquet", workers=1))
