"""What the names of threads say."""

import pytest

from chainshaper.linux.threads import DdsKind, dds_kind, role_of

KINDS: dict[DdsKind, tuple[str, ...]] = {
    "receive": ("recv", "recvUC", "recvMC", "dds.udp.7410", "dds.shm.7413", "dds.tcp.5100"),
    "delivery": ("dq.user", "dq.camera"),
    "transmit": ("xmit.user", "sendq"),
    "event": ("tev", "dds.ev.0"),
    "discovery": ("dq.builtins", "dds.ds_ev.0", "dds.tls.replies"),
    "lease": ("lease",),
    "garbage collection": ("gc",),
    "asynchronous publisher": ("dds.asyn.0.1", "dds.asyn.0.1234"),
    "connection": ("dds.tcp_accept", "dds.tcp_keep", "fsm"),
    "housekeeping": ("dds.shm.wdog", "dds.log", "dds.fwatch.cb", "dds.something", "debmon"),
}


@pytest.mark.parametrize(("kind", "names"), KINDS.items(), ids=list(KINDS))
def test_threads_of_cyclone_dds_and_fast_dds_are_known_by_name(
    kind: DdsKind, names: tuple[str, ...]
) -> None:
    assert {dds_kind(name) for name in names} == {kind}
    role = "publisher" if kind == "asynchronous publisher" else "dds"
    assert {role_of(name, is_main=False) for name in names} == {role}


@pytest.mark.parametrize("name", ["talker", "recvX", "gcc", "ddsperf", "", "python3", "tevatron"])
def test_names_of_others_say_nothing(name: str) -> None:
    assert dds_kind(name) is None
    assert role_of(name, is_main=False) == "unknown"


def test_the_main_thread_executes_whatever_it_is_called() -> None:
    assert role_of("gc", is_main=True) == "executor"
    assert role_of("talker", is_main=True) == "executor"
