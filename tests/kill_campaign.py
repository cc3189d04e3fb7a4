"""Kill whatever runs, at any instant, among odd names and on full disks, and see what is left.

    python tests/kill_campaign.py [--kills 20] [--seed 1] [--seconds 600] [--verbs NAME…]

Each case starts a verb, beside a node that a plan may govern, and kills or stops one or two of its
processes at a random instant. Afterwards no thread may be frozen or real-time, no process, group or
journal of the run may be left, nothing in /run, /dev/shm and /tmp, and no output that cannot be
read. It prints a line of JSON for each case in which something is, and one with the sums; a case is
repeated by its own seed (`--seed SEED --kills 1`).

All of it is in namespaces of its own for processes and mounts: needs root, and harms no others. It
has threads of the machine under SCHED_FIFO, so nothing that measures should run beside it.
"""

import argparse
import contextlib
import json
import os
import random
import signal
import subprocess
import sys
import time
import uuid
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

HERE = Path(__file__).parent
CLI = [sys.executable, "-m", "chainshaper"]
WORK, SMALL = Path("/mnt"), "3m"
TIDY_S = 40.0
"""Until all is as before: a guardian has a tenth of a second, a busy machine much more."""
INSIDE = "CHAINSHAPER_KILL_CAMPAIGN"
EMPTY = (Path("/dev/shm"), Path("/tmp"))
_EMITS = """
import ctypes, signal, time
signal.signal(signal.SIGINT, signal.SIG_DFL)  # its traceback would pass for one of ours
libc = ctypes.CDLL(None)
libc.prctl(15, b"n\\xc3\\xa4\\xc3", 0, 0, 0)
libc.ros_trace_rcl_node_init(ctypes.c_uint64(1), None, b"n\\xfc", b"/")
for n in range(3000):
    libc.ros_trace_rcl_take(ctypes.c_uint64(n))
    time.sleep(0.001)
"""


@dataclass
class Case:
    """One kill: what is started, whether on a full disk, and what is left behind it."""

    seed: int
    verb: str
    full: str = ""
    faults: list[str] = field(default_factory=list)
    left: list[str] = field(default_factory=list)


def verbs(folder: Path) -> dict[str, tuple[list[str], Path | None]]:
    """The words of each verb, and what it writes."""
    application, recording, plan = (folder / name for name in ("app.yaml", "rec", "plan.yaml"))
    servers, output = str(folder / "servers.yaml"), WORK / "small" / os.fsdecode(b"out\xfc)\n")

    def writing(ending: str, *words: object) -> tuple[list[str], Path]:
        place = output.with_name(output.name + ending)
        return [*map(str, words), "-o", str(place)], place

    emitting = ("--", sys.executable, "-c", _EMITS)
    words, place = writing("", "record", "--source", "preload")
    return {
        "apply": (["apply", servers, "--backend", "freezer", "--phase", "0ms"], None),
        "apply-fifo": (["apply", servers, "--backend", "fifo", "--phase", "0ms"], None),
        "record": ([*words, *emitting], place),
        "simulate": writing("", "simulate", application, "--cycles", 300),
        "sweep": writing(".parquet", "sweep", application, "--vary", "bands=1,2,3"),
        "plan": writing(".yaml", "plan", recording),
        "report": writing(".html", "report", recording),
        "graph": writing(".svg", "graph", recording),
        "convert": writing("", "convert", recording),
        "export": writing(".pftrace", "export", recording, "--perfetto"),
        "offsets": writing(".yaml", "offsets", plan),
        "status": (["status"], None),
        "release": (["release"], None),
        "threads": (["threads"], None),
        "doctor": (["doctor", "--watch", "200ms"], None),
    }


def prepare(folder: Path) -> None:
    """A description, a recording and plans; mount points, programs and groups of odd names."""
    from applied_plans import plan_for, server
    from odd_names import ODD_NAMES

    from chainshaper.planning import save_plan

    folder.mkdir()
    save_plan(plan_for(server("first", "victim", (0, 30))), folder / "servers.yaml")
    for words in (
        ("init", "-o", "app.yaml"),
        ("simulate", "app.yaml", "--cycles", "200", "-o", "rec"),
        ("plan", "rec", "-o", "plan.yaml"),
    ):
        subprocess.run([*CLI, *words], cwd=folder, check=True, capture_output=True)
    (WORK / "small").mkdir()
    subprocess.run(
        ["mount", "-t", "tmpfs", "-o", f"size={SMALL}", "none", WORK / "small"], check=True
    )
    for number, name in enumerate(ODD_NAMES):
        place = WORK / f"{number}{os.fsdecode(name.replace(b'/', b''))}"
        place.mkdir()
        mount(place, SMALL)


def mount(folder: Path, size: str) -> None:
    words = ["mount", "-t", "tmpfs", "-o", f"size={size}", "none", str(folder)]
    subprocess.run(words, check=True)


def output_of() -> bytes:
    """What the verb has printed so far."""
    return (WORK / "said").read_bytes()


@contextlib.contextmanager
def filled(folder: Path) -> Iterator[None]:
    """A disk on which there is no room."""
    filling = folder / "filling"
    with contextlib.suppress(OSError), filling.open("wb", buffering=0) as file:
        while file.write(bytes(1 << 16)):
            pass
    try:
        yield
    finally:
        filling.unlink()


class Victim:
    """A node in a group of its own that is no text, which everything is to leave as it was."""

    def __init__(self) -> None:
        from applied_plans import node_command, scheduling

        from chainshaper.linux.cgroups import mount_point

        self.group = mount_point() / os.fsdecode(b"victim\xfc-%d" % random.getrandbits(32))
        self.group.mkdir()
        output = WORK / "victim"
        self.process = subprocess.Popen(node_command("victim", output, 10_000_000, 1_000_000))
        (self.group / "cgroup.procs").write_text(str(self.process.pid))
        wait(lambda: output.exists() and output.stat().st_size > 0, 30)
        self.before = scheduling(self.process.pid)

    def changed(self) -> list[str]:
        """What is not as it was."""
        from applied_plans import scheduling
        from gated import cpu_ns

        pid, said = self.process.pid, []
        if (now := scheduling(pid)) != self.before:
            said.append(f"the node's scheduling is {now}, and was {self.before}")
        said += [f"the group {one.name} is left" for one in self.group.iterdir() if one.is_dir()]
        ran = cpu_ns(pid)
        if not wait(lambda: cpu_ns(pid) > ran, 2):
            said.append("the node does not run")
        return said

    def end(self) -> None:
        self.process.kill()
        self.process.wait()
        wait(lambda: not _removed(self.group), 5)


def _removed(group: Path) -> bool:
    with contextlib.suppress(OSError):
        group.rmdir()
    return group.exists()


def wait(condition: Callable[[], bool], seconds: float) -> bool:
    """Whether it comes true before the time is over."""
    deadline = time.monotonic() + seconds
    while not condition():
        if time.monotonic() > deadline:
            return False
        time.sleep(0.02)
    return True


def run_case(case: Case, folder: Path, victim: Victim) -> None:
    """Start the verb, kill, and look."""
    from processes import marked_processes

    chance, marker = random.Random(case.seed), f"CASE={uuid.uuid4().hex}"
    words, output = verbs(folder)[case.verb]
    environment = {**os.environ, **dict([marker.split("=")])}
    with contextlib.ExitStack() as disks:
        case.full = chance.choice(("", "", "", "its disk", "/run"))
        if case.full:
            disks.enter_context(filled(WORK / "small" if case.full == "its disk" else Path("/run")))
        with (WORK / "said").open("wb") as said:
            process = subprocess.Popen(
                [*CLI, *words], env=environment, stdin=subprocess.DEVNULL, stdout=said, stderr=said
            )
        in_force = case.verb.startswith("apply") and chance.random() < 0.7
        if in_force:
            wait(
                lambda: b"in force" in (WORK / "said").read_bytes() or process.poll() is not None,
                30,
            )
        time.sleep(chance.uniform(0, 0.5 if in_force else 4))
        pids = sorted(marked_processes(marker))
        chosen = {process.pid} if chance.random() < 0.7 else set()
        if pids and chance.random() < 0.6:
            chosen.add(chance.choice(pids))
        number = chance.choice((signal.SIGKILL, signal.SIGKILL, signal.SIGTERM, signal.SIGINT))
        stops = chance.random() < 0.3
        for pid in chosen or {process.pid}:
            name = "the verb" if pid == process.pid else marked_processes(marker).get(pid, "gone")
            case.faults.append(f"{'SIGSTOP, then ' if stops else ''}{number.name} to {name}")
            for one in (signal.SIGSTOP, number) if stops else (number,):
                with contextlib.suppress(ProcessLookupError):
                    os.kill(pid, one)
        if not wait(lambda: process.poll() is not None, 3):
            with contextlib.suppress(ProcessLookupError):  # stopped, or it had another killed
                os.kill(process.pid, signal.SIGKILL)
                case.faults.append("SIGKILL to the verb")
        process.wait()
    look_behind(case, victim, marker, output)
    for pid in marked_processes(marker):
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)


def look_behind(case: Case, victim: Victim, marker: str, output: Path | None) -> None:
    """Note what is left when there was time enough, and `release` has had its turn."""
    from processes import marked_processes

    def orphans() -> list[str]:
        return [f"{name} ({pid}) runs" for pid, name in marked_processes(marker).items()]

    wait(lambda: not orphans() and not victim.changed(), TIDY_S)
    released = subprocess.run([*CLI, "release"], capture_output=True, check=False)
    if b"Traceback" in released.stderr:
        case.left.append(f"release: {released.stderr.decode(errors='replace')[-300:]}")
    case.left += orphans() + victim.changed()
    said = output_of()
    if b"Traceback" in said:
        case.left.append(f"a traceback: {said.decode(errors='replace')[-300:]}")
    for place in EMPTY:
        case.left += [f"{one} is left" for one in place.iterdir()]
    runs = Path("/run/chainshaper")
    case.left += [f"{one} is left" for one in runs.iterdir()] if runs.is_dir() else []
    if output is not None:
        case.left += half_written(output)
    for one in (WORK / "small").iterdir():
        subprocess.run(["rm", "-rf", str(one)], check=True)
    for place in EMPTY:
        for one in place.iterdir():
            subprocess.run(["rm", "-rf", str(one)], check=True)


def half_written(output: Path) -> Iterator[str]:
    """What stands where an output was to be, and is none; and what stands beside it, unnamed."""
    import polars as pl

    if output.is_dir():
        read = subprocess.run([*CLI, "info", str(output)], capture_output=True, check=False)
        if read.returncode:
            yield f"half an output: {read.stderr.decode(errors='replace')[-200:]}"
    elif output.suffix == ".parquet" and output.exists():
        pl.read_parquet(output.read_bytes())  # its name may be no text
    elif output.exists() and not output.stat().st_size:
        yield f"{output.name!r} is empty"
    for one in output.parent.iterdir():
        if one.name.startswith("."):
            yield f"beside the output: {one.name!r}"


def main() -> None:
    arguments = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    arguments.add_argument("--kills", type=int, default=20)
    arguments.add_argument("--seed", type=int, default=1)
    arguments.add_argument("--seconds", type=float, default=600.0, help="no case begins later")
    arguments.add_argument("--verbs", nargs="+", help="of these alone; apply alone is real-time")
    given = arguments.parse_args()
    if INSIDE not in os.environ:
        os.environ[INSIDE] = "1"
        apart = ("--mount", "--propagation", "private", "--pid", "--fork", "--kill-child")
        command = [sys.executable, __file__, *sys.argv[1:]]
        sys.exit(subprocess.call(["unshare", *apart, "--mount-proc", *command]))
    for place, size in ((Path("/run"), "256k"), (WORK, "64m"), *((one, "64m") for one in EMPTY)):
        mount(place, size)
    folder, sums, until = WORK / "inputs", Counter[str](), time.monotonic() + given.seconds
    prepare(folder)
    names = given.verbs or sorted(verbs(folder))
    for seed in range(given.seed, given.seed + given.kills):
        if time.monotonic() > until:
            break
        case, victim = Case(seed, names[seed % len(names)]), Victim()
        try:
            run_case(case, folder, victim)
        finally:
            victim.end()
        sums["kills"] += 1
        sums["cases with something left"] += bool(case.left)
        for one in case.left:
            sums[one.split(":")[0].split(" (")[0][:60]] += 1
        if case.left:
            sys.stdout.write(json.dumps(vars(case)) + "\n")
            sys.stdout.flush()
    sys.stdout.write(json.dumps(sums) + "\n")
    sys.exit(bool(sums["cases with something left"]))


if __name__ == "__main__":
    sys.path.insert(0, str(HERE))
    main()
