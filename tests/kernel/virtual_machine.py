"""QEMU, as a machine whose time is a count of its instructions.

With `-icount` and one processor, each instruction takes 1 ns of the guest's time whatever the host
does meanwhile, idle time is skipped, and a run can be repeated exactly. That shows what the
scheduler costs and how exact it is, without any of the host's noise; it is not how fast a real
machine would be. With two processors there is no such time, and only function can be checked.
"""

import json
import selectors
import subprocess
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

MEMORY_MB, MEMORY_WITH_FILES_MB = 768, 2048
LIMIT_S = 900
"""Without a word; beside other work on its host a machine has a fraction of a core."""
MACHINE, RESULTS = "machine", "results"
"""Tags under which a guest finds the machine's own files, read-only, and a folder that stays."""


def command(
    kernel: Path,
    image: Path,
    results: Path,
    *,
    cores: int,
    checks: Sequence[str] = (),
    shared: Path | None = None,
) -> list[str]:
    """How QEMU is started; the console is its output, the second serial port is ``results``.

    With a folder that is ``shared``, the guest has that and can read all of the machine's files.
    """
    words = ["console=ttyS0", "nokaslr", "panic=-1", "quiet", "PYTHONHASHSEED=0", "rdinit=/init"]
    clock = ["-icount", "shift=0,sleep=off"] if cores == 1 else []
    memory = str(MEMORY_MB if shared is None else MEMORY_WITH_FILES_MB)
    local = "local,security_model=none,multidevs=remap"
    folders = [
        *("-virtfs", f"{local},path=/,readonly=on,mount_tag={MACHINE}"),
        *("-virtfs", f"{local},path={shared},mount_tag={RESULTS}"),
    ]
    return [
        *("qemu-system-x86_64", "-accel", "tcg", *clock, "-smp", str(cores), "-m", memory),
        *("-cpu", "max,-rdrand,-rdseed", "-seed", "1", "-rtc", "base=2026-01-01,clock=vm"),
        *(
            "-kernel",
            str(kernel),
            "-initrd",
            str(image),
            "-append",
            " ".join([*words, "--", *checks]),
        ),
        *("-nodefaults", "-display", "none", "-no-reboot"),
        *("-serial", "stdio", "-serial", f"file:{results}"),
        *(folders if shared else ()),
    ]


def run(words: list[str], results: Path, seen: Callable[[dict[str, Any]], None]) -> str:
    """Run a machine to its end, with each result as it comes; returns the end of its console."""
    results.touch()
    console = bytearray()
    with (
        subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.STDOUT) as machine,
        results.open() as lines,
        selectors.DefaultSelector() as selector,
    ):
        assert machine.stdout is not None
        selector.register(machine.stdout, selectors.EVENT_READ)
        deadline = time.monotonic() + LIMIT_S
        rest, running = "", True
        try:
            while running:
                if selector.select(timeout=0.5):
                    text = machine.stdout.read1(65536)  # type: ignore[attr-defined]
                    console += text
                    running = bool(text)
                rest += lines.read()
                *whole, rest = rest.split("\n")
                for line in whole:
                    seen(json.loads(line))
                    deadline = time.monotonic() + LIMIT_S
                if time.monotonic() > deadline:
                    console += f"\nnot a word for {LIMIT_S} s\n".encode()
                    break
        finally:
            machine.kill()
    return console.decode(errors="replace")[-4000:]
