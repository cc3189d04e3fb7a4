"""The machine's own files as the guest's: the same programs, under another kernel.

QEMU shares them read-only (9p). What the guest writes goes to an overlay in its memory, which is
gone with it; only `/results` is a folder that stays.
"""

import ctypes
import json
import os
import subprocess
from collections.abc import Callable
from pathlib import Path

LIBC = ctypes.CDLL(None, use_errno=True)
MACHINE = Path("/machine")
TOLD = Path("/machine.json")
FINIT_MODULE = 313  # of x86-64
READ_ONLY, BIND = 1, 4096
OVER_VIRTIO = "trans=virtio,version=9p2000.L,cache=loose"
OWN = (
    ("proc", "proc"),
    ("sysfs", "sys"),
    ("tracefs", "sys/kernel/tracing"),
    ("debugfs", "sys/kernel/debug"),
    ("devtmpfs", "dev"),
    ("tmpfs", "dev/shm"),
    ("tmpfs", "run"),
    ("tmpfs", "tmp"),
)


def run_tests(report: Callable[[str], object]) -> None:
    """Run what was told among the machine's files; a line of the report for each test.

    Raises:
        RuntimeError: the tests could not be run.
        OSError: a module or a file system is refused.
    """
    for module in sorted(Path("/modules").iterdir()):
        _insert(module)
    told = json.loads(TOLD.read_text())
    for folder in ("/lower", "/upper", "/machine"):
        Path(folder).mkdir()
    mount("9p", Path("/lower"), "machine", OVER_VIRTIO, READ_ONLY)
    mount("tmpfs", Path("/upper"))
    for folder in ("/upper/changes", "/upper/work", "/upper/changes/results"):
        Path(folder).mkdir()
    layers = "lowerdir=/lower,upperdir=/upper/changes,workdir=/upper/work"
    mount("overlay", MACHINE, options=layers)
    mount("9p", MACHINE / "results", "results", OVER_VIRTIO)
    modules = MACHINE / "lib/modules"
    modules.mkdir(parents=True, exist_ok=True)
    mount("", modules, f"/lower{told['modules']}", flags=BIND)
    for kind, place in OWN:
        (MACHINE / place).mkdir(exist_ok=True)
        mount(kind, MACHINE / place)
    project = MACHINE / told["folder"][1:]
    if not project.exists():  # it is in one of those
        project.mkdir(parents=True)
        mount("", project, f"/lower{told['folder']}", flags=BIND)
    with subprocess.Popen(
        told["command"],
        env={"PATH": "/usr/sbin:/usr/bin:/sbin:/bin", "HOME": "/root"},
        preexec_fn=lambda: _enter(told["folder"]),  # noqa: PLW1509 - one thread
        stdout=subprocess.PIPE,
        text=True,
    ) as tests:
        assert tests.stdout is not None
        for line in tests.stdout:
            report(line)
    if tests.returncode not in (0, 1):
        raise RuntimeError(f"the tests could not be run: exit code {tests.returncode}")


def mount(kind: str, place: Path, source: str = "none", options: str = "", flags: int = 0) -> None:
    """mount(2); an error names the place."""
    words = [text.encode() for text in (source, str(place), kind)]
    if LIBC.mount(*words, flags, options.encode()):
        raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()), str(place))


def _insert(module: Path) -> None:
    with module.open("rb") as file:
        if LIBC.syscall(FINIT_MODULE, file.fileno(), b"", 0):
            raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()), str(module))


def _enter(folder: str) -> None:
    os.chroot(MACHINE)
    os.chdir(folder)
