"""The sched_ext back end as far as it goes without sched_ext; `make test-kernel` does the rest."""

import hashlib
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from chainshaper.enforcement.scx import back_end as scx
from chainshaper.enforcement.scx import libbpf
from chainshaper.enforcement.scx.back_end import POLICY
from chainshaper.enforcement.servers import ReservationServer, ServerTable
from chainshaper.linux.own_processes import what_happened
from chainshaper.values.errors import InputError, OperationError, PlatformError

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


def test_without_sched_ext_the_remedy_is_a_kernel(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(scx, "SCHED_EXT", tmp_path / "none")
    assert "CONFIG_SCHED_CLASS_EXT" in (scx.missing() or "")
    with pytest.raises(PlatformError, match="back end scx: this kernel has no sched_ext"):
        scx.create(TABLE)


def machine(monkeypatch: pytest.MonkeyPatch, folder: Path, capabilities: int) -> Path:
    """A machine with everything, as far as files tell; its sched_ext folder."""
    sched_ext = folder / "sched_ext"
    (sched_ext / "root").mkdir(parents=True)
    (sched_ext / "state").write_text("disabled\n")
    status = folder / "status"
    status.write_text(f"Name:\tx\nCapEff:\t{capabilities:016x}\n")
    monkeypatch.setattr(scx, "SCHED_EXT", sched_ext)
    monkeypatch.setattr(scx, "STATUS", status)
    monkeypatch.setattr(scx, "KERNEL_TYPES", status)
    monkeypatch.setattr(scx, "load_libbpf", lambda: None)
    monkeypatch.setattr(scx, "is_realtime_kernel", lambda: False)
    return sched_ext


def test_nothing_is_missing_on_a_machine_that_has_everything(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    machine(monkeypatch, tmp_path, 1 << 39 | 1 << 38)
    assert scx.missing() is None


@pytest.mark.parametrize(
    ("capabilities", "lacking"),
    [(0, "CAP_BPF and CAP_PERFMON:"), (1 << 39, "CAP_PERFMON:"), (1 << 21, None)],
)
def test_lacking_capabilities_are_named(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capabilities: int, lacking: str | None
) -> None:
    machine(monkeypatch, tmp_path, capabilities)
    reason = scx.missing()
    assert reason is None if lacking is None else f"lacks {lacking}" in (reason or "")


def test_a_real_time_kernel_needs_two_more(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    machine(monkeypatch, tmp_path, 1 << 39 | 1 << 38)
    monkeypatch.setattr(scx, "is_realtime_kernel", lambda: True)
    monkeypatch.setattr(scx, "may_use_fifo", lambda: False)
    monkeypatch.setattr("resource.getrlimit", lambda _: (65536, 65536))
    assert "CAP_SYS_NICE and CAP_IPC_LOCK" in (scx.missing() or "")


def test_a_scheduler_that_is_in_force_is_named(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    folder = machine(monkeypatch, tmp_path, 1 << 39 | 1 << 38)
    (folder / "state").write_text("enabled\n")
    (folder / "root" / "ops").write_text("scx_lavd\n")
    assert "scx_lavd is in force" in (scx.missing() or "")


def test_a_kernel_without_type_information_is_told(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    machine(monkeypatch, tmp_path, 1 << 39 | 1 << 38)
    monkeypatch.setattr(scx, "KERNEL_TYPES", tmp_path / "none")
    assert "CONFIG_DEBUG_INFO_BTF" in (scx.missing() or "")


def test_an_absent_libbpf_is_told_with_its_package(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(libbpf, "LIBRARY", "libbpf-that-is-not-there.so.1")
    libbpf.load_libbpf.cache_clear()
    try:
        with pytest.raises(PlatformError, match="apt install libbpf1"):
            libbpf.load_libbpf()
    finally:
        libbpf.load_libbpf.cache_clear()


def test_an_old_libbpf_is_told_with_its_version(monkeypatch: pytest.MonkeyPatch) -> None:
    class Old:
        def libbpf_major_version(self) -> int:
            return 1

        def libbpf_minor_version(self) -> int:
            return 1

    monkeypatch.setattr("ctypes.CDLL", lambda *_, **__: Old())
    libbpf.load_libbpf.cache_clear()
    try:
        with pytest.raises(PlatformError, match=r"is version 1\.1: install libbpf 1\.4 or newer"):
            libbpf.load_libbpf()
    finally:
        libbpf.load_libbpf.cache_clear()


def test_a_core_that_is_not_there_is_refused() -> None:
    wrong = ServerTable(1000, (ReservationServer("A", 500, 1, ((0, 10),)),))
    with pytest.raises(PlatformError, match="core 500, which server A asks for"):
        scx.create(wrong)


def test_before_it_is_armed_threads_run_freely_and_release_is_harmless() -> None:
    servers = scx.ScxServers(TABLE)
    servers.assign(threading.get_native_id(), "A")
    assert servers.failure() is None
    assert servers.counters()["A"].slots == 0
    servers.release()
    servers.release()
    with pytest.raises(OperationError, match="released"):
        servers.arm(0)


def test_an_unknown_server_is_refused() -> None:
    with pytest.raises(InputError, match="no server is named B: A are"):
        scx.ScxServers(TABLE).assign(os.getpid(), "B")


def test_a_thread_that_has_ended_is_passed_over() -> None:
    process = subprocess.Popen([sys.executable, "-c", ""])
    process.wait()
    scx.ScxServers(TABLE).assign(process.pid, "A")


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


def _until(process: subprocess.Popen[bytes], wanted: str) -> None:
    deadline = time.monotonic() + 30
    while wanted not in (what_happened(process) or ""):
        assert time.monotonic() < deadline, what_happened(process)
        time.sleep(0.01)


def test_a_kicker_that_stops_or_dies_is_noticed() -> None:
    process = subprocess.Popen([shutil.which("sleep") or "sleep", "60"])
    try:
        assert what_happened(process) is None
        process.send_signal(signal.SIGSTOP)
        _until(process, f"was stopped by signal {int(signal.SIGSTOP)}")
        process.kill()
        _until(process, "was killed by signal 9")
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
