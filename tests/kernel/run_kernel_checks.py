"""`make test-kernel`: what this machine's own kernel cannot show, on others in QEMU.

The sched_ext back end: fetches Debian's newest normal and PREEMPT_RT kernels
(`debian_packages.py`), boots each with one core in virtual time and with two cores, and runs
`guest/kernel_checks.py` inside.

The tracers: boots Debian 12's kernel with LTTng's modules among this machine's own files, and
runs tests of the project there (`tracing_kernel.py`).

One table says what was found. Status 0: all passed on all kernels; 1: something did not; 3: there
is no QEMU or no kernel.

    run_kernel_checks.py [--kernel PACKAGE]... [--check NAME]... [--tracers]

takes the kernels of other packages (`linux-image-6.16.12+deb13-cloud-amd64`), or only some checks
of the back end, or only the tests of the tracers.
"""

import argparse
import platform
import shutil
import subprocess
import sys
import tempfile
import traceback
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import tracing_kernel
from debian_packages import PackageError, fetch_for_tracing, fetch_kernels, fetch_userland
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
    skipped: str = ""

    @property
    def passed(self) -> bool:
        """A machine that says nothing has not passed."""
        if self.skipped:
            return True
        return self.done and bool(self.checks) and all(ok for _, ok, _ in self.checks)


def say(text: str, end: str = "\n") -> None:
    sys.stderr.write(text + end)
    sys.stderr.flush()


def observe(outcome: Outcome, words: list[str], results: Path) -> str:
    """Boot a machine and listen; its clock."""
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

    say(f"{outcome.kernel}, {outcome.cores} core(s) ", end="")
    end_of_console = run(words, results, seen)
    say("")
    if not outcome.done:
        outcome.trouble += f"the machine did not finish; the end of its console:\n{end_of_console}"
    return clock


def check_back_end(
    userland: list[Path], packages: list[Path], checks: list[str], folder: Path
) -> list[Outcome]:
    """The sched_ext back end on each kernel, with one core and with two."""
    image = make_image(userland, folder)
    outcomes = []
    for package in packages:
        unpacked = folder / package.name
        unpacked.mkdir()
        kernel = unpack_kernel(package, unpacked)
        for cores in (1, 2):
            outcome = Outcome(package.name, cores)
            results = folder / f"results-{package.name}-{cores}"
            clock = observe(
                outcome, command(kernel, image, results, cores=cores, checks=checks), results
            )
            if cores == 1 and clock != "tsc":
                exact = ("the guest's clock is exact", False, f"clock source {clock}")
                outcome.checks.append(exact)
            outcomes.append(outcome)
    return outcomes


def check_tracers(userland: list[Path], folder: Path) -> Outcome:
    """The tracers on a kernel for which LTTng's modules can be built."""
    outcome = Outcome("a kernel with LTTng", 2)
    if absent := packages_of_absent(tracing_kernel.TOOLS):
        outcome.skipped = f"the tracers' tests need: apt install {absent}"
        return outcome
    try:
        packages = fetch_for_tracing()
    except PackageError as error:
        outcome.skipped = f"the tracers' tests need Debian 12's kernel: {error}"
        return outcome
    unpacked = folder / "unpacked"
    kernel = tracing_kernel.unpack(packages, unpacked)
    say("building LTTng's modules, a minute or two")
    try:
        tracing_kernel.build_modules(unpacked)
    except subprocess.CalledProcessError as error:
        outcome.trouble = f"LTTng's modules cannot be built: {str(error.stderr)[-4000:]}"
        return outcome
    image = make_image(userland, folder, tracing_kernel.guest_files(unpacked))
    shared = folder / "results"
    shared.mkdir()
    results = folder / "results.json"
    observe(outcome, command(kernel, image, results, cores=2, shared=shared), results)
    name = "execution times from LTTng are the threads' own CPU times"
    try:
        outcome.checks.append((name, True, tracing_kernel.compare_execution_times(shared)))
    except Exception:
        outcome.checks.append((name, False, traceback.format_exc()))
    return outcome


def packages_of_absent(tools: dict[str, str]) -> str:
    return " ".join(package for tool, package in tools.items() if shutil.which(tool) is None)


def show(outcomes: list[Outcome]) -> None:
    """One table, and the whole text of what failed below it."""
    screen = Console(width=max(Console().width, 160))
    rows = Table("kernel", "cores", "check", "", "measured", title="on other kernels")
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
        if outcome.skipped:
            screen.print(f"\nskipped: {outcome.skipped}", markup=False)
        if outcome.trouble:
            screen.print(f"\n{outcome.release}: {outcome.trouble}", markup=False)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kernel", action="append", default=[], help="a Debian kernel package")
    parser.add_argument("--check", action="append", default=[], help="a function's name")
    parser.add_argument("--tracers", action="store_true", help="only the tests of the tracers")
    options = parser.parse_args()
    absent = packages_of_absent(TOOLS)
    if absent or platform.machine() != "x86_64":
        say(f"error: needs a Debian-like x86-64 machine with: apt install {absent}")
        return 3
    try:
        userland = fetch_userland()
        named = [] if options.tracers else options.kernel or ["newest"]
        kernels = [path for name in named for path in fetch_kernels(name)]
    except PackageError as error:
        say(f"error: {error}")
        return 3
    with tempfile.TemporaryDirectory(prefix="chainshaper-kernel-") as name:
        outcomes = check_back_end(userland, kernels, options.check, Path(name, "scx"))
        if not options.check:
            outcomes.append(check_tracers(userland, Path(name, "tracers")))
    show(outcomes)
    return 0 if all(outcome.passed for outcome in outcomes) else 1


if __name__ == "__main__":
    sys.exit(main())
