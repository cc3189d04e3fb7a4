"""`make test-kernel`: the sched_ext back end on kernels that have it, in QEMU.

Fetches Debian's newest normal and PREEMPT_RT kernels (`debian_packages.py`), boots each with one
core in virtual time and with two cores, runs `guest/kernel_checks.py` inside, and prints one table.
Status 0: all checks passed on all kernels; 1: some did not; 3: there is no QEMU or no kernel.

    run_kernel_checks.py [--kernel PACKAGE]... [--check NAME]...

takes the kernels of other packages (`linux-image-6.16.12+deb13-cloud-amd64`), or only some checks.
"""

import argparse
import platform
import shutil
import sys
import tempfile
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from debian_packages import PackageError, fetch
from guest_image import make_image, unpack_kernel
from rich.console import Console
from rich.markup import escape
from rich.table import Table
from virtual_machine import command, run

TOOLS = {
    "qemu-system-x86_64": "qemu-system-x86",
    "dpkg-deb": "dpkg",
    "apt-get": "apt",
    "cc": "gcc libc6-dev",
}


@dataclass
class Outcome:
    """What one machine has reported."""

    kernel: str
    cores: int
    release: str = "?"
    checks: list[tuple[str, bool, str]] = field(default_factory=list)
    done: bool = False
    trouble: str = ""

    @property
    def passed(self) -> bool:
        """A machine that says nothing has not passed."""
        return self.done and bool(self.checks) and all(ok for _, ok, _ in self.checks)


def say(text: str, end: str = "\n") -> None:
    """Progress, to standard error."""
    sys.stderr.write(text + end)
    sys.stderr.flush()


def observe(kernel: Path, image: Path, cores: int, checks: list[str], folder: Path) -> Outcome:
    """Boot one machine and listen."""
    outcome = Outcome(kernel.name, cores)
    clock = "none"

    def seen(message: dict[str, Any]) -> None:
        nonlocal clock
        outcome.release = message.get("kernel", outcome.release)
        clock = message.get("clock", clock)
        outcome.done |= message.get("done", False)
        outcome.trouble += message.get("fault", "")
        if "check" in message:
            outcome.checks.append((message["check"], message["passed"], message["text"]))
            say("." if message["passed"] else "F", end="")

    results = folder / f"results-{kernel.parent.name}-{cores}"
    words = command(kernel, image, results, cores=cores, checks=checks)
    end_of_console = run(words, results, seen)
    say("")
    if cores == 1 and clock != "tsc":
        outcome.checks.append(("the guest's clock is exact", False, f"clock source {clock}"))
    if not outcome.done and not outcome.trouble:
        outcome.trouble = f"the machine did not finish; the end of its console:\n{end_of_console}"
    return outcome


def show(outcomes: list[Outcome]) -> None:
    """One table, and the whole text of what failed below it."""
    screen = Console(width=max(Console().width, 160))
    rows = Table("kernel", "cores", "check", "", "measured", title="sched_ext back end")
    for outcome in outcomes:
        for name, ok, text in outcome.checks:
            short = escape(text).strip().splitlines()[-1] if text.strip() else "-"
            rows.add_row(outcome.release, str(outcome.cores), name, "ok" if ok else "FAILED", short)
        rows.add_section()
    screen.print(rows)
    for outcome in outcomes:
        for name, ok, text in outcome.checks:
            if not ok:
                screen.print(f"\n{outcome.release}: {name}\n{text}", markup=False)
        if outcome.trouble:
            screen.print(f"\n{outcome.release}: {outcome.trouble}", markup=False)


def main() -> int:
    """The exit status."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kernel", action="append", default=[], help="a Debian kernel package")
    parser.add_argument("--check", action="append", default=[], help="a function's name")
    options = parser.parse_args()
    absent = [package for tool, package in TOOLS.items() if shutil.which(tool) is None]
    if absent or platform.machine() != "x86_64":
        say(f"error: needs a Debian-like x86-64 machine with: apt install {' '.join(absent)}")
        return 3
    try:
        userland, kernels = fetch(options.kernel)
    except PackageError as error:
        say(f"error: {error}")
        return 3
    with tempfile.TemporaryDirectory(prefix="chainshaper-kernel-") as name:
        folder = Path(name)
        image = make_image(userland, folder)
        outcomes = []
        for package in kernels:
            unpacked = folder / package.name
            unpacked.mkdir()
            kernel = unpack_kernel(package, unpacked)
            for cores in (1, 2):
                say(f"{package.name}, {cores} core(s) ", end="")
                outcomes.append(observe(kernel, image, cores, options.check, folder))
    show(outcomes)
    return 0 if all(outcome.passed for outcome in outcomes) else 1


if __name__ == "__main__":
    sys.exit(main())
