"""The sched_ext back end as far as it goes without sched_ext; `make test-kernel` does the rest."""

import hashlib
import os
import platform
import shutil
import signal
import struct
import subprocess
import threading
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
from hypothesis import given
from hypothesis import strategies as st
from processes import wait_for

from chainshaper.enforcement.scx import back_end as scx
from chainshaper.enforcement.scx import libbpf
from chainshaper.enforcement.scx.back_end import (
    POLICY,
    check_table,
    numbered,
    pack_cores,
    pack_in_force,
    pack_servers,
    unpack_counters,
    unpack_exit,
)
from chainshaper.enforcement.servers import ReservationServer, ServerCounters, ServerTable
from chainshaper.linux.child_processes import what_happened
from chainshaper.values.errors import InputError, OperationError, PlatformError

pytestmark = pytest.mark.timed

ROOT = Path(__file__).parent.parent.parent
_CACHE = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
CORE = min(os.sched_getaffinity(0))
TABLE = ServerTable(50_000_000, (ReservationServer("A", CORE, 1, ((0, 10_000_000),)),))


def test_the_compiled_policy_is_up_to_date_with_its_sources() -> None:
    names = ("kernel_abi.h", "table_abi.h", "table.bpf.c")
    sources = [POLICY.with_name(name) for name in names]
    digest = hashlib.sha256(b"".join(source.read_bytes() for source in sources)).hexdigest()
    assert digest.encode() in POLICY.read_bytes(), "run scripts/build_policy"


def test_compiling_the_policy_again_gives_the_same_bytes(tmp_path: Path) -> None:
    made = tmp_path / "table.bpf.o"
    command = [str(ROOT / "scripts" / "build_policy"), str(made)]
    unpacked = _CACHE / "chainshaper" / "libbpf" / "usr" / "include"  # by scripts/test-tools
    include = {"LIBBPF_INCLUDE": str(unpacked)} if unpacked.is_dir() else {}
    environment = {**include, **os.environ}
    done = subprocess.run(command, capture_output=True, text=True, check=False, env=environment)
    if done.returncode == 3:
        pytest.skip(f"the policy cannot be compiled here: {done.stderr.strip()}")
    if done.returncode and "bpf_ksym_exists" in done.stderr:
        pytest.skip("libbpf's headers are older than 1.4: see scripts/build_policy")
    assert done.returncode == 0, done.stderr
    version = subprocess.run(["clang-14", "--version"], capture_output=True, text=True, check=True)
    if made.read_bytes() != POLICY.read_bytes() and b"14.0.6" not in version.stdout.encode():
        pytest.skip(f"another compiler than 14.0.6: {version.stdout.splitlines()[0]}")
    assert made.read_bytes() == POLICY.read_bytes()


@pytest.fixture
def machine(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """A machine with everything, as far as files tell."""
    (tmp_path / "sched_ext" / "root").mkdir(parents=True)
    (tmp_path / "sched_ext" / "state").write_text("disabled\n")
    (tmp_path / "status").write_text(f"Name:\tx\nCapEff:\t{1 << 39 | 1 << 38:016x}\n")
    monkeypatch.setattr(scx, "SCHED_EXT", tmp_path / "sched_ext")
    for name in ("STATUS", "KERNEL_TYPES"):
        monkeypatch.setattr(scx, name, tmp_path / "status")
    monkeypatch.setattr(scx, "load_libbpf", lambda: None)
    monkeypatch.setattr(scx, "is_realtime_kernel", lambda: False)
    assert scx.missing() is None
    return tmp_path


@pytest.mark.parametrize(
    ("capabilities", "lacking"),
    [(0, "CAP_BPF and CAP_PERFMON:"), (1 << 39, "CAP_PERFMON:"), (1 << 21, None)],
)
def test_lacking_capabilities_are_named(
    machine: Path, capabilities: int, lacking: str | None
) -> None:
    (machine / "status").write_text(f"Name:\tx\nCapEff:\t{capabilities:016x}\n")
    reason = scx.missing()
    assert reason is None if lacking is None else f"lacks {lacking}" in (reason or "")


def test_what_else_a_machine_lacks_is_named_with_the_remedy(
    machine: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(scx, "may_use_fifo", lambda: False)
    monkeypatch.setattr("resource.getrlimit", lambda _: (65536, 65536))
    with monkeypatch.context() as on_a_real_time_kernel:
        on_a_real_time_kernel.setattr(scx, "is_realtime_kernel", lambda: True)
        assert "CAP_SYS_NICE and CAP_IPC_LOCK" in (scx.missing() or "")
    (machine / "sched_ext" / "state").write_text("enabled\n")
    (machine / "sched_ext" / "root" / "ops").write_text("scx_lavd\n")
    assert "scx_lavd is in force" in (scx.missing() or "")
    monkeypatch.setattr(scx, "KERNEL_TYPES", machine / "none")
    assert "CONFIG_DEBUG_INFO_BTF" in (scx.missing() or "")
    monkeypatch.setattr(scx, "SCHED_EXT", machine / "none")
    for release, reason in (
        (
            "6.18.44-cloud",
            r"scx: this kernel \(6.18.44-cloud\) was built without CONFIG_SCHED_CLASS_E",
        ),
        ("6.8.0-45-generic", r"\(6.8.0-45-generic\) has no sched_ext: use Linux 6.12 or newer"),
        ("6.1", r"has no sched_ext: use Linux 6.12"),
    ):
        monkeypatch.setattr(platform, "release", lambda release=release: release)
        with pytest.raises(PlatformError, match=reason):
            scx.create(TABLE)


def test_an_absent_or_old_libbpf_is_named_with_its_package(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(libbpf, "LIBRARY", "libbpf-that-is-not-there.so.1")
    load = libbpf.load_libbpf.__wrapped__
    with pytest.raises(PlatformError, match="apt install libbpf1"):
        load()
    old = SimpleNamespace(libbpf_major_version=lambda: 1, libbpf_minor_version=lambda: 1)
    monkeypatch.setattr("ctypes.CDLL", lambda *_, **__: old)
    with pytest.raises(PlatformError, match=r"is version 1\.1: install libbpf 1\.4 or newer"):
        load()


def test_a_core_that_is_not_there_is_refused() -> None:
    with pytest.raises(PlatformError, match="core 500, which server A asks for"):
        scx.create(table(server("A", 500)))


def test_before_it_is_armed_threads_run_freely_and_release_is_harmless() -> None:
    servers = scx.ScxServers(TABLE)
    servers.assign(threading.get_native_id(), "A")
    ended = subprocess.Popen(["true"])
    ended.wait()
    servers.assign(ended.pid, "A")
    with pytest.raises(InputError, match="no server is named B: A are"):
        servers.assign(os.getpid(), "B")
    assert servers.failure() is None
    assert servers.counters()["A"].slots == 0
    servers.release()
    servers.release()
    with pytest.raises(OperationError, match="released"):
        servers.arm(0)


def test_a_thread_that_may_not_run_on_the_core_is_refused() -> None:
    others = os.sched_getaffinity(0) - {CORE}
    if not others:
        pytest.skip("there is one core only")
    process = subprocess.Popen(["sleep", "60"])
    try:
        os.sched_setaffinity(process.pid, others)
        with pytest.raises(OperationError, match=f"may not run on core {CORE}"):
            scx.ScxServers(TABLE).assign(process.pid, "A")
    finally:
        process.kill()
        process.wait()


def test_a_kicker_that_stops_or_dies_is_noticed() -> None:
    process = subprocess.Popen(["sleep", "60"])
    stopped = f"was stopped by signal {int(signal.SIGSTOP)}"
    try:
        assert what_happened(process) is None
        process.send_signal(signal.SIGSTOP)
        wait_for(lambda: what_happened(process) == stopped, "it to be stopped")
        process.kill()
        wait_for(lambda: what_happened(process) == "was killed by signal 9", "it to be killed")
    finally:
        process.kill()
        process.wait()


def test_on_this_machine_arming_needs_make_test_kernel() -> None:
    reason = scx.missing()
    if reason is not None:
        pytest.skip(f"sched_ext cannot be used here (make test-kernel does): {reason}")
    servers = scx.create(TABLE)
    try:
        servers.arm(0)
        assert servers.failure() is None
    finally:
        servers.release()
    assert scx.scheduler_in_force() is None


ABI = POLICY.with_name("table_abi.h")
MS = 1_000_000


def server(
    name: str = "a", core: int = 0, priority: int = 1, *slots: tuple[int, int]
) -> ReservationServer:
    return ReservationServer(name, core, priority, slots or ((10 * MS, 20 * MS),))


def table(*servers: ReservationServer) -> ServerTable:
    return ServerTable(50 * MS, servers)


def test_layouts_and_limits_are_those_that_a_c_compiler_makes_of_the_header(tmp_path: Path) -> None:
    compiler = shutil.which("cc")
    if compiler is None:
        pytest.skip("no C compiler to ask: apt install gcc")
    expected = {
        "sizeof(struct table_server)": scx.SERVER.size + scx.MAX_SLOTS * scx.SLOT.size,
        "offsetof(struct table_server, slots)": scx.SERVER.size,
        "sizeof(struct table_slot)": scx.SLOT.size,
        "offsetof(struct table_server, cpu)": 16,
        "sizeof(struct table_in_force)": scx.IN_FORCE.size,
        "sizeof(struct table_cpu)": scx.CORE.size,
        "sizeof(struct table_counters)": scx.COUNTERS.size,
        "sizeof(struct table_exit)": scx.EXIT.size,
        "offsetof(struct table_exit, reason)": 4,
        "offsetof(struct table_exit, message)": 68,
        "sizeof(struct table_config)": scx.CONFIG.size,
        "sizeof(struct table_wake)": scx.WAKE.size,
        "offsetof(struct table_wake, planning)": scx.INSTANT.size,
        "TABLE_MAX_SERVERS": scx.MAX_SERVERS,
        "TABLE_MAX_SLOTS": scx.MAX_SLOTS,
        "TABLE_MAX_SERVERS_PER_CPU": scx.MAX_SERVERS_PER_CORE,
        "TABLE_MAX_CPUS": scx.MAX_CORES,
    }
    source = tmp_path / "layout.c"
    source.write_text(
        f'#include <stddef.h>\n#include <stdio.h>\n#include "{ABI}"\nint main(void)\n{{\n'
        + "".join(f'\tprintf("%zu\\n", (size_t){what});\n' for what in expected)
        + "\treturn 0;\n}\n"
    )
    program = tmp_path / "layout"
    subprocess.run([compiler, "-o", program, source], check=True)
    found = subprocess.run([program], check=True, capture_output=True, text=True).stdout.split()
    assert dict(zip(expected, map(int, found), strict=True)) == expected


def test_a_server_is_packed_field_by_field() -> None:
    two_slots = server("a", 3, 7, (1 * MS, 2 * MS), (4 * MS, 6 * MS))
    value = pack_servers(table(server("x"), two_slots))[2]
    assert struct.unpack_from("<QQIIII", value) == (50 * MS, scx.ROTATION_NS, 3, 7, 2, 0)
    assert struct.unpack_from("<QQQQ", value, 32) == (1 * MS, 2 * MS, 4 * MS, 6 * MS)
    assert not any(value[64:])


def test_servers_of_a_core_stand_best_first_and_equals_in_the_order_of_the_table() -> None:
    servers = table(
        server("worst", 0, 9), server("b", 0, 2), server("c", 0, 2), server("x", 1), server("a", 0)
    )
    ids, packed = numbered(servers), pack_cores(servers)
    names = {number: name for name, number in ids.items()}
    count, *numbers = struct.unpack("<33I", packed[0])
    assert [names[number] for number in numbers[:count]] == ["a", "b", "c", "worst"]
    assert not any(numbers[count:])
    assert struct.unpack_from("<II", packed[1]) == (1, ids["x"])


def test_the_more_urgent_of_a_servers_threads_are_in_a_better_server_of_their_own() -> None:
    two = replace(server("two", 0, 2), places=2)
    apart = scx.with_places_apart(table(two, server("best", 0, 1), server("equal", 1, 2)))
    assert [(one.name, one.priority) for one in apart.servers] == [
        ("two", 2),
        ("two\0001", 3),
        ("best", 1),
        ("equal", 2),
    ]
    assert {one.slots for one in apart.servers} == {two.slots}
    many = [replace(server(f"s{k}", 0, k), places=5) for k in range(1, 10)]
    apart = scx.with_places_apart(table(*many))
    check_table(apart)
    assert len(apart.servers) == 27, "three places each: with a fourth, the core would have 36"
    counted = [ServerCounters(9, 1, 500, 2), ServerCounters(9, 1, 500, 8)]
    assert scx.in_all_places(counted) == ServerCounters(9, 1, 500, 9)


@given(st.integers(0, 1), st.integers(0, 2**61 - 1), st.booleans(), st.integers(-(2**40), 2**40))
def test_one_word_says_which_anchor_holds_at_each_instant(
    place: int, instant: int, replaces: bool, offset: int
) -> None:
    word, *anchors = struct.unpack("<3Q", pack_in_force(place, (7, 9), instant, replaces=replaces))
    now = instant + offset
    # as the policy reads it
    assert anchors[(word ^ (now < word >> 2)) & 1] == (7, 9)[place if offset >= 0 else 1 - place]
    assert bool(word & 2) == replaces


def test_counters_and_the_reason_of_the_end_are_read_back() -> None:
    counted = unpack_counters(struct.pack("<6Q", 5, 1, 123456, 2, 99, 98))
    assert counted == ServerCounters(5, 1, 123456, 2)
    ended = unpack_exit(struct.pack("<i64s192s", 1026, b"stall", b"late\0rest"))
    assert ended == "stall: late"
    assert unpack_exit(bytes(260)) is None


def test_a_full_table_is_accepted() -> None:
    slots = tuple((k * 1000, k * 1000 + 1000) for k in range(64))
    servers = [ReservationServer(f"s{k}", k % 4, k, slots) for k in range(127)]
    check_table(ServerTable(64_000, tuple(servers)))


@pytest.mark.parametrize(
    ("wrong", "reason"),
    [
        (table(*(server(f"s{k}", k) for k in range(128))), "128 servers are more than the 127"),
        (table(*(server(f"s{k}", 3) for k in range(33))), "33 servers on core 3 are more than"),
        (table(server("a", 512)), "core 512; back end scx knows 0 to 511"),
        (table(ReservationServer("a", 0, 1, ())), "0 slots; back end scx takes 1 to 64"),
        (table(server("a", 0, 1, *((k, k + 1) for k in range(65)))), "has 65 slots"),
    ],
)
def test_a_wrong_table_is_refused_with_its_reason(wrong: ServerTable, reason: str) -> None:
    with pytest.raises(InputError, match=reason):
        check_table(wrong)
