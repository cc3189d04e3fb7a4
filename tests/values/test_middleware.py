"""The table of middleware: each entry is known by its names, and by no other's."""

import pytest

from chainshaper.values.middleware import (
    CONNEXT,
    CYCLONE_DDS,
    FAST_DDS,
    GURUM_DDS,
    MIDDLEWARE_LIMITS,
    MIDDLEWARES,
    ZENOH,
    Middleware,
    limit_by_settings,
    limit_by_thread,
    middleware_of,
    rmw_of_threads,
    rmw_of_vendor,
    runtime_work,
    thread_work,
)

THREADS: dict[Middleware, tuple[str, ...]] = {  # as a process of each shows them
    CYCLONE_DDS: ("python3", "recvUC", "recvMC", "tev", "gc", "lease", "dq.builtins", "dq.user"),
    FAST_DDS: ("python3", "dds.ev.1", "dds.udp.7410", "dds.shm.7411", "dds.asyn.0.0"),
    CONNEXT: ("talker", "rCo00101####Evt", "rTr00101DtbEvt"),
    ZENOH: ("talker", "rx-0", "tx-0", "acc-0", "net-0", "app-0"),
    GURUM_DDS: ("talker", "talker"),
}


@pytest.mark.parametrize("middleware", MIDDLEWARES, ids=lambda one: one.rmw)
def test_a_middleware_is_known_by_its_names_and_taken_for_no_other(
    middleware: Middleware,
) -> None:
    assert middleware_of(middleware.rmw) is middleware
    threads = THREADS[middleware]
    works = runtime_work(threads)
    named = [name for name in threads if thread_work(name) is not None or name in works]
    if middleware.thread_names or middleware.runtimes:
        assert named == [name for name in threads if name not in ("python3", "talker")]
        assert rmw_of_threads(threads) == middleware.rmw
    else:
        assert not named
        assert rmw_of_threads(threads) is None
    if middleware.vendor is not None:
        assert rmw_of_vendor([*middleware.vendor, *range(14)]) == middleware.rmw


def test_limits_of_distributions_and_settings_are_known() -> None:
    assert limit_by_settings(FAST_DDS, "humble", {}) == "unnamed"
    assert limit_by_settings(FAST_DDS, "jazzy", {}) is None
    iceoryx = {"CYCLONEDDS_URI": "<SharedMemory><Enable>true</Enable></SharedMemory>"}
    assert limit_by_settings(CYCLONE_DDS, "jazzy", iceoryx) == "iceoryx"
    assert limit_by_settings(CYCLONE_DDS, "jazzy", {}) is None
    assert limit_by_settings(ZENOH, None, {}) is None
    assert limit_by_thread("KeepAlive") == "iceoryx"
    assert middleware_of("rmw_of_tomorrow") is middleware_of(None) is None
    used = {middleware.limit for middleware in MIDDLEWARES} - {None}
    used |= {limit for one in MIDDLEWARES for _, limit in one.limiting_threads}
    assert used <= set(MIDDLEWARE_LIMITS)


def test_short_words_name_a_middlewares_threads_only_if_there_are_several() -> None:
    assert runtime_work(["net-0", "net-1", "app-0"]) == {}
    assert runtime_work(["net-0", "app-0", "rx-3", "rx"]).keys() == {"net-0", "app-0", "rx-3"}
