"""Who computes the points of a sweep: processes of this machine, or a Dask cluster.

Points that differ in nothing that was measured share a profile: it is simulated once, and goes to
whoever computes one of them. Rows come in any order, but do not depend on it, nor on who else
computes: a point's row is a function of the point.
"""

import asyncio
import importlib.metadata
import json
import os
import pickle
import re
import subprocess
import tempfile
import time
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from queue import SimpleQueue
from typing import Any, TypeAlias

from chainshaper.linux.own_processes import LIBRARIES, module_command
from chainshaper.planning import Profile
from chainshaper.simulation.sweeping.grid import Grid, Values, changes_application, request_at
from chainshaper.simulation.sweeping.points import profile_at, row_at
from chainshaper.values.errors import ChainshaperError, InputError, OperationError, extra_library

__all__ = ["Group", "groups_of", "rows_from_cluster", "rows_from_here"]

CONNECT_S = 10
WITHOUT_WORKERS_S = 60
LOOK_S = 0.5
_ADDRESS = re.compile(r"((tcp|tls|ws|wss|ucx)://)?[^/]+:\d+")
WARM_UP_CYCLES = 10
SAME = ("chainshaper", "numpy", "distributed")
"""Packages whose versions rows depend on: NumPy's generators may draw differently."""

Worker: TypeAlias = "subprocess.Popen[bytes]"
Rows: TypeAlias = Generator[tuple[int, dict[str, Any]], None, None]


@dataclass(frozen=True)
class Group:
    """Points, by their numbers, that share a profile; ``profiled``: or need none."""

    profiled: bool
    points: tuple[tuple[int, Values], ...]


def groups_of(grid: Grid, points: Iterable[tuple[int, Values]]) -> list[Group]:
    """Points in groups of one profile each, in their order."""
    groups: dict[str, list[tuple[int, Values]]] = {}
    for number, values in points:
        profiled = request_at(grid, values) is not None
        application = {name: value for name, value in values.items() if changes_application(name)}
        per_callback = values.get("policy") == "server-per-callback"
        key = json.dumps([profiled, profiled and per_callback, application])
        groups.setdefault(key, []).append((number, values))
    return [Group(json.loads(key)[0], tuple(points)) for key, points in groups.items()]


def rows_from_here(grid: Grid, groups: Sequence[Group], workers: int) -> Rows:
    """Rows by the numbers of their points, computed by ``workers`` processes (1: by this one).

    Raises:
        OperationError: a process was killed.
    """
    if workers > 1:
        yield from _rows_from_processes(grid, groups, workers)
        return
    for group in groups:
        profile = _profile_of(grid, group)
        for number, values in group.points:
            yield number, row_at(grid, values, profile)


def _profile_of(grid: Grid, group: Group) -> Profile | str | None:
    return profile_at(grid, group.points[0][1]) if group.profiled else None


def _rows_from_processes(grid: Grid, groups: Sequence[Group], workers: int) -> Rows:
    # What has to be compiled is compiled once, here, and found on disk by the others.
    _, values = groups[0].points[0]
    warm = replace(grid, cycles=WARM_UP_CYCLES)
    row_at(warm, values, _profile_of(warm, groups[0]))
    with tempfile.TemporaryDirectory(prefix="chainshaper-sweep-") as folder:
        pool = ThreadPoolExecutor(workers)
        processes = [_start_worker() for _ in range(workers)]
        try:
            yield from _rows_from_pool(pool, processes, grid, groups, Path(folder))
        finally:
            for process in processes:
                process.kill()  # which ends the thread that waits for it
            pool.shutdown(cancel_futures=True)
            for process in processes:
                process.communicate()


def _start_worker() -> Worker:
    """A process that computes; Ctrl-C is for us."""
    return subprocess.Popen(
        [*module_command("chainshaper.simulation.sweeping.worker", LIBRARIES), str(os.getpid())],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        start_new_session=True,
    )


def _rows_from_pool(
    pool: ThreadPoolExecutor,
    processes: Sequence[Worker],
    grid: Grid,
    groups: Sequence[Group],
    folder: Path,
) -> Rows:
    """Points whose profile is there come first, so that few profiles are kept at a time."""
    idle: SimpleQueue[Worker] = SimpleQueue()
    for process in processes:
        idle.put(process)
    coming = iter(groups)
    ready: deque[tuple[tuple[int, Values], Path]] = deque()
    pending: dict[Future[Any], Group | tuple[int, Path]] = {}
    points_left: dict[Path, int] = {}
    while True:
        while len(pending) < 2 * len(processes):
            if ready:
                (number, values), profile = ready.popleft()
                asked = pool.submit(_computed, idle, _row_by, grid, values, profile)
                pending[asked] = (number, profile)
            elif (group := next(coming, None)) is not None:
                profile = folder / str(group.points[0][0])
                points_left[profile] = len(group.points)
                pending[pool.submit(_computed, idle, _keep_profile, grid, group, profile)] = group
            else:
                break
        if not pending:
            return
        for future in wait(pending, return_when=FIRST_COMPLETED).done:
            of = pending.pop(future)
            if isinstance(of, Group):
                ready.extend((point, future.result()) for point in of.points)
                continue
            number, profile = of
            points_left[profile] -= 1
            if points_left[profile] == 0:
                profile.unlink()
            yield number, future.result()


def _computed(idle: "SimpleQueue[Worker]", function: Callable[..., Any], *arguments: Any) -> Any:
    """What a function returns, or raises, in the next process that is idle."""
    process = idle.get()
    assert process.stdin is not None  # noqa: S101 - it was started so
    assert process.stdout is not None  # noqa: S101
    try:
        pickle.dump((function, arguments), process.stdin)
        process.stdin.flush()
        result, error = pickle.load(process.stdout)  # noqa: S301 - ours
    except (OSError, EOFError, pickle.UnpicklingError) as failure:
        raise OperationError(
            "a process that computed points was killed; finished rows are kept: free memory,"
            " or ask for fewer with --workers, and the same command goes on"
        ) from failure
    finally:
        idle.put(process)
    if error is not None:
        raise error
    return result


def _keep_profile(grid: Grid, group: Group, file: Path) -> Path:
    file.write_bytes(pickle.dumps(_profile_of(grid, group)))
    return file


def _row_by(grid: Grid, values: Values, profile: Path) -> dict[str, Any]:
    return row_at(grid, values, pickle.loads(profile.read_bytes()))  # noqa: S301 - ours


def rows_from_cluster(grid: Grid, groups: Sequence[Group], address: str) -> Rows:
    """The same, computed by the workers of the Dask cluster whose scheduler is at ``address``.

    Points of a worker that dies are computed by others.

    Raises:
        InputError: that is no address.
        PlatformError: `distributed` is not installed.
        OperationError: no scheduler is there, or it is gone; there are no workers, or one has
            other versions of what rows depend on; or a point killed one worker after another.
    """
    distributed = extra_library("distributed", "a sweep on a Dask cluster")
    with _connected(distributed, address) as client:
        here = _versions()
        numbers: dict[Any, int] = {}
        for group in groups:
            profile = client.submit(_profile_for, here, grid, group, pure=False)
            for number, values in group.points:
                numbers[client.submit(_row_for, here, grid, values, profile, pure=False)] = number
        completed = distributed.as_completed(list(numbers), loop=client.loop)
        while numbers:
            with _failures_named(address):
                _wait_for_one(completed, client)
                future = next(completed)
                row = future.result()
            yield numbers.pop(future), row


def _connected(distributed: Any, address: str) -> Any:
    if not _ADDRESS.fullmatch(address):
        raise InputError(f"{address!r} is no scheduler's address: write one like tcp://HOST:8786")
    try:
        return distributed.Client(address, timeout=CONNECT_S, set_as_default=False)
    except (OSError, asyncio.TimeoutError) as error:  # from Python 3.11 on they are one
        raise OperationError(
            f"no Dask scheduler answers at {address} ({error}): start one with `dask scheduler`,"
            " and give the address that it prints, such as --scheduler tcp://HOST:8786"
        ) from error


def _wait_for_one(completed: Any, client: Any) -> None:
    """Wait for a row. Workers may come and go, but somebody has to be there now and then."""
    seen = looked = time.monotonic()
    while not completed.has_ready():
        time.sleep(0.02)
        if time.monotonic() - looked > LOOK_S:
            looked = time.monotonic()
            seen = looked if client.nthreads() else seen
            if looked - seen > WITHOUT_WORKERS_S:
                raise TimeoutError(f"it has had no workers for {WITHOUT_WORKERS_S} s")


@contextmanager
def _failures_named(address: str) -> Iterator[None]:
    """Dask has many errors of its own for what happens to its parts: lost, killed, unable to load.

    All of them leave the sweep where it is, and the user with the same things to look at.
    """
    try:
        yield
    except ChainshaperError:
        raise
    except Exception as error:
        raise OperationError(
            f"the Dask cluster at {address} failed ({type(error).__name__}: {error}); finished"
            " rows are kept. See that its workers run, that chainshaper is installed on each, and"
            " that they have memory; then the same command goes on"
        ) from error


def _versions() -> dict[str, str]:
    return {name: importlib.metadata.version(name) for name in SAME}


def _profile_for(client: dict[str, str], grid: Grid, group: Group) -> Profile | str | None:
    _refuse_other_versions(client)
    return _profile_of(grid, group)


def _row_for(
    client: dict[str, str], grid: Grid, values: Values, profile: Profile | str | None
) -> dict[str, Any]:
    _refuse_other_versions(client)
    return row_at(grid, values, profile)


def _refuse_other_versions(client: dict[str, str]) -> None:
    """On a worker, which may have come later than the rest: rows must not depend on who it is."""
    own = _versions()
    different = [f"{n} {own[n]}, not {client[n]}" for n in SAME if own[n] != client[n]]
    if different:
        worker = importlib.import_module("distributed").get_worker().address
        raise OperationError(
            f"the Dask worker at {worker} has {' and '.join(different)}: install the same versions"
            " there as here"
        )
