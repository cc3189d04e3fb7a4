"""The points of a sweep: what each is, who computes it, and where its row goes when it is done.

A point is what a careful person would do by hand: simulate the application with its chain in front
of all others (the profile), plan, splice, simulate again. The run that is planned from and the run
that is judged are two runs, as on a machine: their execution times are drawn with different seeds.
So a margin is tried against latencies that the plan has not seen, and all points of one seed are
judged by the same ones.

One loop (:func:`rows_of`) hands points out: to threads of this process, or to the workers of a
Dask cluster. Threads suffice, because the compiled engine runs without the interpreter's lock; and
they open no port and start no process that other users of the machine could reach.
"""

import asyncio
import fcntl
import importlib.metadata
import json
import os
import re
import time
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping
from concurrent.futures import CancelledError, Future, ThreadPoolExecutor
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from pathlib import Path
from queue import SimpleQueue
from threading import Event
from typing import IO, Any, TypeAlias

import numpy as np
import polars as pl

from chainshaper.analysis import latency_statistics
from chainshaper.analysis.latency import PERCENTILES
from chainshaper.planning import Plan, Profile, plan_chain, publish_slots
from chainshaper.planning.overruns import cycles_until_output
from chainshaper.simulation.grid import (
    Grid,
    Values,
    application_at,
    changes_application,
    plan_at,
    request_at,
)
from chainshaper.simulation.layout import Int64s
from chainshaper.simulation.simulating import Progress, simulate_latencies
from chainshaper.values.errors import ChainshaperError, InputError, OperationError, extra_library

__all__ = ["FIGURES", "Row", "finished_rows", "row_at", "rows_beside", "rows_of"]

OTHER_RUN = 1 << 32
"""Added to a seed for the run that is judged; seeds that people count up never meet it."""

_BAND = pl.Struct(
    {
        "start_ns": pl.Int64,
        "end_ns": pl.Int64,
        "predicted_share": pl.Float64,
        "share": pl.Float64,
        "jitter_ns": pl.Int64,
    }
)
_OF_PLAN = (
    *("profile_min_ns", "profile_mean_ns", "profile_max_ns"),
    *("predicted_mean_ns", "predicted_max_ns", "predicted_jitter_ns"),
)
_OF_RUN = ("min_ns", "mean_ns", "max_ns", "jitter_ns", "spread_ns")

FIGURES: dict[str, Any] = {
    **dict.fromkeys((*_OF_PLAN, "count", "incomplete", "late", *_OF_RUN), pl.Int64),
    **{f"p{percentile:g}_ns": pl.Int64 for percentile in PERCENTILES},
    "band_jitter_ns": pl.Int64,
    "per_band": pl.List(_BAND),
    "error": pl.String,
    "seconds": pl.Float64,
}
"""The columns of a row behind those of the axes.

``profile_…`` are L̲, the average and L̄ that the plan rests on, ``predicted_…`` the plan's own
(eq. 5). All others are of the judged run, in which ``incomplete`` instances of the chain gave no
output, and ``late`` ones gave it behind the last slot it was due in (or later than the plan says,
where there are no slots). ``per_band`` has the bands, with the outputs that left in their slots;
``band_jitter_ns`` is the widest of their jitters. ``error`` says why there is nothing else.
``seconds`` is the computing time, without that of the profile, which points share.
"""

Row: TypeAlias = Mapping[str, Any]
ProfileAt: TypeAlias = Callable[[Grid, Values, Progress | None], "Profile | str"]
"""The measurements that a point is planned from, or why there are none."""


def row_at(
    grid: Grid, values: Values, profile: Profile | str | None, progress: Progress | None = None
) -> dict[str, Any]:
    """The figures of one point, under the names of :data:`FIGURES`.

    ``profile`` None: no plan is made. An impossible point raises nothing, its row has the reason.
    """
    began = time.perf_counter()
    figures: dict[str, Any] = dict.fromkeys(FIGURES)
    try:
        figures |= (
            {"error": profile}
            if isinstance(profile, str)
            else _judged(grid, values, profile, progress)
        )
    except ChainshaperError as error:
        figures["error"] = str(error)
    return {**figures, "seconds": round(time.perf_counter() - began, 6)}


def _judged(
    grid: Grid, values: Values, profile: Profile | None, progress: Progress | None
) -> dict[str, Any]:
    application, plan = application_at(grid, values), plan_at(grid, values)
    request = request_at(grid, values)
    if profile is not None and request is not None:
        plan = plan_chain(profile, request)
    seed = application.seed + OTHER_RUN
    latencies = simulate_latencies(
        application, plan, cycles=grid.cycles, seed=seed, progress=progress
    )
    complete = latencies[latencies >= 0]
    measured = latency_statistics(complete, incomplete=latencies.size - complete.size)
    figures = {name: getattr(measured, name) for name in ("count", "incomplete", *_OF_RUN)}
    figures |= {f"p{name}_ns": value for name, value in measured.percentiles_ns.items()}
    return figures if plan is None else {**figures, **_beside(plan, complete)}


def _beside(plan: Plan, latencies: Int64s) -> dict[str, Any]:
    """What the plan says, and what became of its bands."""
    evidence, predicted = plan.evidence, plan.predicted
    delay = cycles_until_output(plan) * plan.cycle_ns
    slots = publish_slots(plan)
    latest = delay + slots[-1][1] - 1 if slots else predicted.max_ns
    shares = predicted.shares if len(predicted.shares) == len(slots) else [None] * len(slots)
    # An output belongs to the last slot that had started when it left, if it is not late.
    until = [*(start for start, _ in slots[1:]), *(end for _, end in slots[-1:])]
    bands = [
        _band(latencies, (start, end), last, delay, share)
        for (start, end), last, share in zip(slots, until, shares, strict=True)
    ]
    jitters = [band["jitter_ns"] for band in bands if band["jitter_ns"] is not None]
    return {
        "profile_min_ns": evidence.min_latency_ns,
        "profile_mean_ns": evidence.mean_latency_ns,
        "profile_max_ns": evidence.max_latency_ns,
        "predicted_mean_ns": predicted.mean_ns,
        "predicted_max_ns": predicted.max_ns,
        "predicted_jitter_ns": predicted.jitter_ns,
        "late": int(np.count_nonzero(latencies > latest)),
        "band_jitter_ns": max(jitters, default=None),
        "per_band": bands,
    }


def _band(
    latencies: Int64s, slot: tuple[int, int], until: int, delay: int, predicted: float | None
) -> dict[str, Any]:
    start, end = slot[0] + delay, slot[1] + delay
    inside = latencies[(latencies >= start) & (latencies < until + delay)]
    return {
        "start_ns": start,
        "end_ns": end,
        "predicted_share": predicted,
        "share": inside.size / latencies.size if latencies.size else None,
        "jitter_ns": int(inside.max() - inside.min()) if inside.size else None,
    }


# Who computes ------------------------------------------------------------------------------

CONNECT_S = 10
WITHOUT_WORKERS_S = 60
LOOK_S = 0.5
ASKED_OF_CLUSTER = 10_000
"""So many points at a time are with a cluster: more than its workers compute at once."""
SAME = ("chainshaper", "numpy", "distributed")
"""Packages whose versions rows depend on: NumPy's generators may draw differently."""

_ADDRESS = re.compile(r"((tcp|tls|ws|wss|ucx)://)?[^/]+:\d+")


@dataclass(frozen=True)
class Group:
    """Points, by their numbers, that share a profile; ``profiled``: or need none."""

    profiled: bool
    points: tuple[tuple[int, Values], ...]


@dataclass(frozen=True)
class _Engine:
    """Who computes: ``submit`` (a function and its arguments, futures among them), the next future
    that is ``finished``, and how many may be ``under_way``."""

    submit: Callable[..., Any]
    finished: Callable[[], Any]
    under_way: int


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


def rows_of(
    grid: Grid,
    points: Iterable[tuple[int, Values]],
    profile_at: ProfileAt,
    workers: int,
    scheduler: str | None = None,
) -> Generator[tuple[int, Row], None, None]:
    """Rows by the numbers of their points, as they are finished.

    ``workers`` threads compute, or the Dask cluster whose ``scheduler`` is at that address, where
    points of a worker that dies are computed by others. A row is a function of its point: it does
    not depend on who computes it. Points that differ in nothing measured share a profile; those
    whose profile is there come first, so that few profiles are in memory at a time.

    Raises:
        InputError: that is no address.
        PlatformError: `distributed` is not installed.
        OperationError: no scheduler is there, or it is gone; there are no workers, or one has
            other versions of what rows depend on; or a point killed one worker after another.
    """
    coming = iter(groups_of(grid, points))
    ready: deque[tuple[int, Values, Any]] = deque()
    pending: dict[Any, Group | int] = {}
    with _threads(workers) if scheduler is None else _cluster(scheduler) as engine:
        while True:
            while len(pending) < engine.under_way:
                if ready:
                    number, values, profile = ready.popleft()
                    pending[engine.submit(row_at, grid, values, profile)] = number
                elif (group := next(coming, None)) is None:
                    break
                elif group.profiled:
                    pending[engine.submit(profile_at, grid, group.points[0][1])] = group
                else:
                    ready.extend((number, values, None) for number, values in group.points)
            if not pending:
                return
            future = engine.finished()
            result, of = future.result(), pending.pop(future)
            if isinstance(of, Group):
                ready.extend((number, values, future) for number, values in of.points)
            else:
                yield of, result


@contextmanager
def _threads(workers: int) -> Iterator[_Engine]:
    """Threads of this process, which leave their points unfinished when the sweep ends early."""
    ending, done = Event(), SimpleQueue["Future[Any]"]()

    def go_on(*_: object) -> None:
        if ending.is_set():
            raise CancelledError

    def submit(function: Callable[..., Any], *arguments: Any) -> "Future[Any]":
        known = [one.result() if isinstance(one, Future) else one for one in arguments]
        future = pool.submit(function, *known, progress=go_on)
        future.add_done_callback(done.put)
        return future

    pool = ThreadPoolExecutor(workers, "sweep")
    try:
        yield _Engine(submit, done.get, 2 * workers)
    finally:
        ending.set()
        pool.shutdown(cancel_futures=True)


@contextmanager
def _cluster(address: str) -> Iterator[_Engine]:
    """Dask has many errors of its own for what happens to its parts: lost, killed, unable to load.

    All of them leave the sweep where it is, and the user with the same things to look at.
    """
    distributed, here = extra_library("distributed", "a sweep on a Dask cluster"), _versions()
    with _connected(distributed, address) as client:
        completed = distributed.as_completed(loop=client.loop)

        def submit(function: Callable[..., Any], *arguments: Any) -> Any:
            future = client.submit(_same_versions, here, function, *arguments, pure=False)
            completed.add(future)
            return future

        def finished() -> Any:
            _wait_for_one(completed, client)
            return next(completed)

        try:
            yield _Engine(submit, finished, ASKED_OF_CLUSTER)
        except ChainshaperError:
            raise
        except Exception as error:
            raise OperationError(
                f"the Dask cluster at {address} failed ({type(error).__name__}: {error}); finished"
                " rows are kept. See that its workers run, that chainshaper is installed on each,"
                " and that they have memory; then the same command goes on"
            ) from error


def _connected(distributed: Any, address: str) -> AbstractContextManager[Any]:
    if not _ADDRESS.fullmatch(address):
        raise InputError(f"{address!r} is no scheduler's address: write one like tcp://HOST:8786")
    try:
        client: AbstractContextManager[Any] = distributed.Client(
            address, timeout=CONNECT_S, set_as_default=False
        )
    except (OSError, asyncio.TimeoutError) as error:  # from Python 3.11 on they are one
        raise OperationError(
            f"no Dask scheduler answers at {address} ({error}): start one with `dask scheduler`,"
            " and give the address that it prints, such as --scheduler tcp://HOST:8786"
        ) from error
    return client


def _wait_for_one(completed: Any, client: Any) -> None:
    """Wait for a result. Workers may come and go, but one has to be there now and then."""
    seen = looked = time.monotonic()
    while not completed.has_ready():
        time.sleep(0.02)
        if time.monotonic() - looked > LOOK_S:
            looked = time.monotonic()
            seen = looked if client.nthreads() else seen
            if looked - seen > WITHOUT_WORKERS_S:
                raise TimeoutError(f"it has had no workers for {WITHOUT_WORKERS_S} s")


def _versions() -> dict[str, str]:
    return {name: importlib.metadata.version(name) for name in SAME}


def _same_versions(client: dict[str, str], function: Callable[..., Any], *arguments: Any) -> Any:
    """On a worker, which may have come later than the rest: rows must not depend on who it is."""
    own = _versions()
    different = [f"{n} {own[n]}, not {client[n]}" for n in SAME if own[n] != client[n]]
    if different:
        worker = importlib.import_module("distributed").get_worker().address
        raise OperationError(
            f"the Dask worker at {worker} has {' and '.join(different)}: install the same versions"
            " there as here"
        )
    return function(*arguments)


# Where finished rows stand -----------------------------------------------------------------


def rows_beside(output: str | Path) -> Path:
    """Where the finished rows of a sweep stand until it is whole."""
    output = Path(output)
    return output.with_name(output.name + ".rows")


@contextmanager
def finished_rows(
    path: Path, about: Mapping[str, Any]
) -> Iterator[tuple[dict[int, Row], Callable[[int, Row], None]]]:
    """The rows that are finished, by the number of their point, and how to add one.

    One line of JSON a row, behind a first line that says what is swept (``about``, plain data):
    rows of anything else are not mixed with it. Each is on disk before the next; a crash leaves
    half a line at most, which is removed. A file without rows is removed.

    Raises:
        InputError: the file is of another sweep; the message names what differs.
        OperationError: another process works on it, or it cannot be read or written.
    """
    about = json.loads(json.dumps(about))
    try:
        with path.open("a+", encoding="utf-8") as file:
            _claim(file, path)
            finished = _read(file, path, about)
            if finished is None:
                _append(file, about)
            rows = dict(finished or {})

            def add(number: int, row: Row) -> None:
                rows[number] = row  # first: an interruption must not take it for an empty file
                _append(file, {"number": number, "row": row})

            try:
                yield rows, add
            finally:
                if not rows:
                    path.unlink()
    except OSError as error:
        raise OperationError(
            f"{path}: finished rows cannot be kept ({error.strerror or error}); what is in it"
            " stays, and the same command goes on from there"
        ) from error


def _claim(file: IO[str], path: Path) -> None:
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        raise OperationError(
            f"{path}: another process works on this sweep: wait for it, or name another output"
        ) from error


def _read(file: IO[str], path: Path, about: Mapping[str, Any]) -> dict[int, Row] | None:
    """The rows of whole lines; what is behind them is cut off. None: the file is new."""
    file.seek(0)
    text = file.read()
    whole = text[: text.rfind("\n") + 1]
    if len(whole) < len(text):
        os.truncate(file.fileno(), len(whole.encode()))
    if not whole:
        return None
    try:
        first, *rows = map(json.loads, whole.splitlines())
        finished = {row["number"]: row["row"] for row in rows}
        changed = [name for name in about if first[name] != about[name]]
    except (ValueError, KeyError, TypeError) as error:
        raise InputError(
            f"{path}: these are no rows of a sweep: move the file away, or name another output"
        ) from error
    if changed:
        raise InputError(
            f"{path} has {len(finished)} finished rows of another sweep: {' and '.join(changed)}"
            " changed since. Undo that to go on with them, name another output, or remove the file"
        )
    return finished


def _append(file: IO[str], value: Mapping[str, Any]) -> None:
    file.write(json.dumps(value) + "\n")
    file.flush()
    os.fsync(file.fileno())
