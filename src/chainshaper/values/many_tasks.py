"""Run many tasks on threads of this process, or on a Dask cluster.

Threads suffice on a single machine: decoding, Polars and the simulator run without the
interpreter's lock. And they open no port that other users could reach.
"""

import asyncio
import importlib
import importlib.metadata
import logging
import os
import re
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import CancelledError, Future, ThreadPoolExecutor
from contextlib import AbstractContextManager, contextmanager, suppress
from dataclasses import dataclass
from queue import SimpleQueue
from threading import Event
from typing import Any, TypeVar

from chainshaper.values.errors import ChainshaperError, InputError, OperationError, extra_library

CONNECT_S = 10  # how long a scheduler may take to answer at first
WITHOUT_WORKERS_S = 60  # how long a cluster may be without workers, or not answer
LOOK_S = 0.5  # between two looks for workers
ANSWER_S = 5  # how long a scheduler may take to say how many workers it has
CLOSE_S = 3  # how long closing may take
ASKED_OF_CLUSTER = 10_000
"""So many tasks at a time are with a cluster: more than its workers compute at once."""
SAME = ("chainshaper", "numpy", "distributed")
"""Packages whose versions results depend on: NumPy's generators may draw differently."""
_ADDRESS = re.compile(r"((tcp|tls|ws|wss|ucx)://)?[^/]+:\d+")

Item = TypeVar("Item")
Result = TypeVar("Result")


@dataclass(frozen=True)
class Engine:
    """Runs tasks somewhere.

    * ``submit``: takes a function and its arguments, futures among them; returns a future.
    * ``finished``: waits for the next future that is finished; returns it and its result.
    * ``under_way``: how many tasks should be submitted and not finished.
    """

    submit: Callable[..., Any]
    finished: Callable[[], tuple[Any, Any]]
    under_way: int


def engine(
    workers: int, scheduler: str | None, purpose: str, stays: str = ""
) -> AbstractContextManager[Engine]:
    """Return an engine of ``workers`` threads or, given a ``scheduler``, of its Dask cluster.

    On threads, functions get an argument ``progress``, which they should call now and then. In
    messages, ``purpose`` says what is computed, and ``stays`` what is kept if the cluster fails.

    Raises InputError: ``scheduler`` is no address. PlatformError: `distributed` is not installed.
    OperationError: the cluster fails, or has other versions of the packages in :data:`SAME`.
    """
    return _threads(workers) if scheduler is None else _cluster(scheduler, purpose, stays)


def computed(
    function: Callable[..., Result],
    items: Sequence[Item],
    *more: Any,
    scheduler: str | None = None,
    purpose: str,
    progress: Callable[[float, str], None] = lambda *_: None,
) -> list[Result]:
    """Return the results of ``function(item, *more)`` for all items, in their order.

    As many are computed at a time as there are cores, or as a cluster takes (:func:`engine`).
    """
    results: dict[int, Result] = {}
    coming, pending = iter(enumerate(items)), dict[Any, int]()
    workers = min(len(items), len(os.sched_getaffinity(0))) or 1
    with engine(workers, scheduler, purpose) as computing:
        while len(results) < len(items):
            while len(pending) < computing.under_way and (numbered := next(coming, None)):
                number, item = numbered
                pending[computing.submit(function, item, *more)] = number
            future, result = computing.finished()
            results[pending.pop(future)] = result
            progress(len(results) / len(items), f"{len(results)} of {len(items)} recordings")
    return [results[number] for number in range(len(items))]


@contextmanager
def _threads(workers: int) -> Iterator[Engine]:
    """Run tasks on threads of this process; tasks are left unfinished if the context ends early."""
    ending, done = Event(), SimpleQueue["Future[Any]"]()

    def go_on(*_: object) -> None:
        if ending.is_set():
            raise CancelledError

    def submit(function: Callable[..., Any], *arguments: Any) -> "Future[Any]":
        values = [
            argument.result() if isinstance(argument, Future) else argument
            for argument in arguments
        ]
        future = pool.submit(function, *values, progress=go_on)
        future.add_done_callback(done.put)
        return future

    def finished() -> tuple[Any, Any]:
        future = done.get()
        return future, future.result()

    pool = ThreadPoolExecutor(workers, "computing")
    try:
        yield Engine(submit, finished, 2 * workers)
    finally:
        ending.set()
        pool.shutdown(cancel_futures=True)


@contextmanager
def _cluster(address: str, purpose: str, stays: str) -> Iterator[Engine]:
    """Run tasks on a Dask cluster.

    Whichever of Dask's many errors occurs, the message names the same things to look at.
    """
    distributed, here = extra_library("distributed", f"{purpose} on a Dask cluster"), _versions()
    if not _ADDRESS.fullmatch(address):
        raise InputError(f"{address!r} is no scheduler's address: write one like tcp://HOST:8786")
    try:
        connected = distributed.Client(address, timeout=CONNECT_S, set_as_default=False)
    except (OSError, asyncio.TimeoutError) as error:  # the same from Python 3.11 on
        raise OperationError(
            f"no Dask scheduler answers at {address} ({error}): start one with `dask scheduler`,"
            " and give the address that it prints"
        ) from error
    # Dask logs a traceback for each connection that breaks; our message says what it means.
    logging.getLogger("distributed").setLevel(logging.CRITICAL)
    with _closed_in_time(connected) as client:
        completed = distributed.as_completed(loop=client.loop)

        def submit(function: Callable[..., Any], *arguments: Any) -> Any:
            future = client.submit(_same_versions, here, function, *arguments, pure=False)
            completed.add(future)
            return future

        def finished() -> tuple[Any, Any]:
            """Wait for the next result.

            Workers may come and go, but there has to be one now and then. A worker that has a
            result may hang before it has sent it.
            """
            seen = looked = time.monotonic()
            while not completed.has_ready():
                time.sleep(0.02)
                if time.monotonic() - looked > LOOK_S:
                    looked = time.monotonic()
                    there = _has_workers(client)
                    seen = time.monotonic() if there else seen
                    if time.monotonic() - seen > WITHOUT_WORKERS_S:
                        none = "it does not answer" if there is None else "it has had no workers"
                        raise TimeoutError(f"{none} for {WITHOUT_WORKERS_S} s")
            future = next(completed)
            return future, future.result(timeout=WITHOUT_WORKERS_S)

        try:
            yield Engine(submit, finished, ASKED_OF_CLUSTER)
        except ChainshaperError:
            raise
        except Exception as error:
            raise OperationError(
                f"the Dask cluster at {address} failed ({type(error).__name__}: {error}){stays}."
                " See that workers run, with chainshaper and memory; then the same command goes on"
            ) from error


@contextmanager
def _closed_in_time(client: Any) -> Iterator[Any]:
    """Close a client at the end of the context, even if its cluster does not answer any more."""
    try:
        yield client
    finally:
        with suppress(Exception):  # its scheduler is gone, or hangs
            client.close(timeout=CLOSE_S)


def _has_workers(client: Any) -> bool | None:
    """Whether a cluster has workers; None: its scheduler does not answer, as when it is stopped."""
    try:
        return bool(client.sync(client.scheduler.ncores, callback_timeout=ANSWER_S))
    except (TimeoutError, asyncio.TimeoutError):
        return None


def _versions() -> dict[str, str]:
    return {name: importlib.metadata.version(name) for name in SAME}


def _same_versions(client: dict[str, str], function: Callable[..., Any], *arguments: Any) -> Any:
    """Call a function on a worker, if it has the client's versions of the packages in `SAME`.

    Each task asks, since a worker may join the cluster at any time.
    """
    here = _versions()
    different = [
        f"{name} {here[name]}, not {client[name]}" for name in SAME if here[name] != client[name]
    ]
    if different:
        worker = importlib.import_module("distributed").get_worker().address
        versions = " and ".join(different)
        raise OperationError(f"the Dask worker at {worker} has {versions}: install the same there")
    return function(*arguments)
