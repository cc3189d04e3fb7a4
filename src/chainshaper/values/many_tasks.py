"""Who computes what there is much of: threads of this process, or a Dask cluster.

Threads suffice on one machine: decoding, Polars and the compiled engine run without the
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

CONNECT_S = 10
WITHOUT_WORKERS_S = 60
LOOK_S = 0.5
ANSWER_S = 5
CLOSE_S = 3
ASKED_OF_CLUSTER = 10_000
"""So many points at a time are with a cluster: more than its workers compute at once."""
SAME = ("chainshaper", "numpy", "distributed")
"""Packages whose versions results depend on: NumPy's generators may draw differently."""
_ADDRESS = re.compile(r"((tcp|tls|ws|wss|ucx)://)?[^/]+:\d+")

One = TypeVar("One")
Other = TypeVar("Other")


@dataclass(frozen=True)
class Engine:
    """Who computes: ``submit`` (a function and its arguments, futures among them), the next future
    that is ``finished`` and its result, and how many may be ``under_way``."""

    submit: Callable[..., Any]
    finished: Callable[[], tuple[Any, Any]]
    under_way: int


def engine(
    workers: int, scheduler: str | None, purpose: str, stays: str = ""
) -> AbstractContextManager[Engine]:
    """So many threads, or the cluster of a Dask ``scheduler``; a thread's function also gets
    ``progress``, to be called now and then. For messages: ``purpose``, and what ``stays`` where the
    cluster fails. Raises InputError: that is no address. PlatformError: `distributed` is not
    installed. OperationError: the cluster fails, or has other versions of what results depend on.
    """
    return _threads(workers) if scheduler is None else _cluster(scheduler, purpose, stays)


def computed(
    function: Callable[..., Other],
    items: Sequence[One],
    *more: Any,
    scheduler: str | None = None,
    purpose: str,
    progress: Callable[[float, str], None] = lambda *_: None,
) -> list[Other]:
    """``function`` of each item, and of ``more``, in the items' order; as many at a time as there
    are cores, or as a cluster has (:func:`engine`)."""
    found: dict[int, Other] = {}
    coming, pending = iter(enumerate(items)), dict[Any, int]()
    with engine(
        min(len(items), len(os.sched_getaffinity(0))) or 1, scheduler, purpose
    ) as computing:
        while len(found) < len(items):
            while len(pending) < computing.under_way and (one := next(coming, None)):
                pending[computing.submit(function, one[1], *more)] = one[0]
            future, result = computing.finished()
            found[pending.pop(future)] = result
            progress(len(found) / len(items), f"{len(found)} of {len(items)} recordings")
    return [found[number] for number in range(len(items))]


@contextmanager
def _threads(workers: int) -> Iterator[Engine]:
    """Threads of this process, which leave their tasks unfinished when the work ends early."""
    ending, done = Event(), SimpleQueue["Future[Any]"]()

    def go_on(*_: object) -> None:
        if ending.is_set():
            raise CancelledError

    def submit(function: Callable[..., Any], *arguments: Any) -> "Future[Any]":
        known = [one.result() if isinstance(one, Future) else one for one in arguments]
        future = pool.submit(function, *known, progress=go_on)
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
    """A Dask cluster; all of Dask's many errors leave the user with the same things to look at."""
    distributed, here = extra_library("distributed", f"{purpose} on a Dask cluster"), _versions()
    if not _ADDRESS.fullmatch(address):
        raise InputError(f"{address!r} is no scheduler's address: write one like tcp://HOST:8786")
    try:
        connected = distributed.Client(address, timeout=CONNECT_S, set_as_default=False)
    except (OSError, asyncio.TimeoutError) as error:  # from Python 3.11 on they are one
        raise OperationError(
            f"no Dask scheduler answers at {address} ({error}): start one with `dask scheduler`,"
            " and give the address that it prints"
        ) from error
    # Dask logs a traceback for each connection that breaks; what that means is said below.
    logging.getLogger("distributed").setLevel(logging.CRITICAL)
    with _closed_in_time(connected) as client:
        completed = distributed.as_completed(loop=client.loop)

        def submit(function: Callable[..., Any], *arguments: Any) -> Any:
            future = client.submit(_same_versions, here, function, *arguments, pure=False)
            completed.add(future)
            return future

        def finished() -> tuple[Any, Any]:
            """The next result. Workers may come and go, but one has to be there now and then; one
            that has a result may hang before it has sent it.
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
    """A client of a cluster that may not answer any more when it is closed."""
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
    """On a worker, which may have come late: results must not depend on who it is."""
    own = _versions()
    different = [f"{n} {own[n]}, not {client[n]}" for n in SAME if own[n] != client[n]]
    if different:
        worker = importlib.import_module("distributed").get_worker().address
        versions = " and ".join(different)
        raise OperationError(f"the Dask worker at {worker} has {versions}: install the same there")
    return function(*arguments)
