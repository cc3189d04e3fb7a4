"""Kill whatever runs, at any instant, among odd names and on full disks, and see what is left.

    python tests/helpers/kill_campaign.py [--kills 20] [--seed 1] [--seconds 600] [--verbs NAME…]
                                  [--lanes 1] [--core N] [--pause-while FILE]

Each case starts a verb, beside a node that a plan may govern, and kills or stops one or two of its
processes at a random instant while it runs. Afterwards no thread may be frozen or real-time, no
process, group or journal of the run may be left, nothing in /run, /dev/shm and /tmp, and no output
that cannot be read; what is hidden beside an output, `release` must remove or name. It prints a
line of JSON for each case, and one with the sums of each lane; a case is repeated by its own seed
(`--seed SEED --kills 1`).

The instant is a random share of the time for which the verb went on the last time, behind its
start, its first writing, or the moment from which its plan was in force. A case whose verb has
ended before it is counted as `too late`, and not as a kill.
Each verb goes on to its end once before (`behind` is `end`): so all lanes know for how long, and a
verb that is refused at once is seen.

Python's own traceback is a finding, but for Ctrl-C before the first line of ours could run: until
then the interpreter has its own handler, which no program can replace (`before our first line`).
Applications that verbs start are Python too: what they say is kept apart.

All of it is in namespaces of its own for processes, mounts, networks and groups, one set a lane:
needs root, and harms no others. It has threads of the machine under SCHED_FIFO, so nothing that
measures should run beside it; it pauses between two cases while the FILE exists.
"""

import argparse
import contextlib
import itertools
import json
import os
import random
import re
import signal
import subprocess
import sys
import tempfile
import time
import uuid
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

from chainshaper.planning import Plan

HERE = Path(__file__).parent
CLI = [sys.executable, "-m", "chainshaper"]
WORK, SMALL = Path("/mnt"), "3m"
TIDY_S = 90.0
"""Until all is as before: a guardian has a tenth of a second, a busy machine much more.

A run waits a minute for a node that is stopped (:data:`chainshaper.workload.launcher.ANSWER_S`).
"""
INSIDE = "CHAINSHAPER_KILL_CAMPAIGN"
EMPTY = (Path("/dev/shm"), Path("/tmp"))
LONGEST_S = {"start": 12.0, "writing": 12.0, "in force": 0.5}
"""A kill comes this long at most behind each of these."""
FIRST_S = {"start": 1.0, "writing": 0.1, "in force": 0.5}
"""The same while nobody knows yet how long the verb goes on."""
LONGER = 1.1
"""So much longer a verb is taken to go on for each kill that hits: too few are too late else."""
PATIENCE_S = (2.0, 2.0, 40.0)
"""What was asked to end may take so long, then it is killed."""
_EMITS = """
import ctypes, time
libc = ctypes.CDLL(None)
libc.prctl(15, b"n\\xc3\\xa4\\xc3", 0, 0, 0)
libc.ros_trace_rcl_node_init(ctypes.c_uint64(1), None, b"n\\xfc", b"/")
for n in range(3000):
    libc.ros_trace_rcl_take(ctypes.c_uint64(n))
    time.sleep(0.001)
"""


LIVE = """
name: short
chain: /a../b
scheduling:
  executors: {core: CORE, priority: 40}
  dds: {core: CORE, priority: 50}
nodes:
  first:
    callbacks:
      - {timer: 20ms, execution: {constant: 200us}, publishes: [/a]}
  second:
    callbacks:
      - {subscription: /a, execution: {constant: 200us}, publishes: [/b]}
  last:
    callbacks:
      - {subscription: /b, execution: {constant: 100us}}
topics:
  /b: {publication: synchronous, reliability: reliable, depth: 10, payload: 64}
"""
_PAIR = """
import subprocess, sys
folder, program = sys.argv[1:]
words = [sys.executable, program, folder]
pair = [
    subprocess.Popen(
        [*words, what, "t5", port, "2000000"],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    for what, port in (("shaping", "7001"), ("standby", "7002"))
]
for process in pair:
    process.wait()
"""
_LAUNCH = """
from launch import LaunchDescription
from launch_ros.actions import Node

def generate_launch_description():
    return LaunchDescription([Node(package="p", executable="node5", name="node5")])
"""


@dataclass
class Case:
    """One kill: what is started, whether on a full disk, and what is left behind it.

    It comes ``after_s`` behind what it is ``behind``. ``ended`` is how a verb ended before it.
    """

    seed: int
    verb: str
    full: str = ""
    behind: str = "start"
    after_s: float = 0.0
    kill: str = ""
    ended: str = ""
    faults: list[str] = field(default_factory=list)
    left: list[str] = field(default_factory=list)


def command(verb: str, words: list[str]) -> list[str]:
    """How a verb is started: the command line's, and two nodes of an output."""
    if verb == "handover":
        return [sys.executable, "-c", _PAIR, *words]
    return [*CLI, *words]


def verbs(folder: Path) -> dict[str, tuple[list[str], Path | None]]:
    """The words of each verb, and what it writes."""
    application, recording, plan = (folder / name for name in ("app.yaml", "rec", "plan.yaml"))
    servers, output = str(folder / "servers.yaml"), WORK / "small" / os.fsdecode(b"out\xfc)\n")

    def writing(ending: str, *words: object) -> tuple[list[str], Path]:
        place = output.with_name(output.name + ending)
        return [*map(str, words), "-o", str(place)], place

    said_apart = f'exec "$0" -S -c "$@" 2> {WORK}/application'
    node = ("--ros-args", "-r", "__node:=first")
    emitting = ("--", "sh", "-c", said_apart, sys.executable, _EMITS, *node)
    recorded, at = writing("", "record", "--source", "preload")
    profiling = ("profile", "--node", "first", "--source", "preload", "--core", core())
    profiled, _ = writing("", *profiling)
    live, live_plan, budget = (folder / name for name in ("live.yaml", "lplan.yaml", "budget.yaml"))
    package, figures = WORK / "small" / "pkg", WORK / "small" / "figures"
    watch = ("watch", "--every", "100ms", "--json", "--recorder", str(WORK / "small"))
    chain = ("--chain", "/a../b")
    shape = ("shape", live, live_plan, "--cycles", 60)
    kept_plan, adapted = folder / "kplan.yaml", WORK / "small" / "adapted"
    adapting = ("apply", kept_plan, "--backend", "freezer", "--adapt", "--", *CLI, "shape")
    adapting = (*adapting, folder / "slow.yaml", kept_plan, "--cycles", 300, "-o", adapted)
    return {
        "version": (["--version"], None),
        "info": (["info", str(recording)], None),
        "callbacks": (["callbacks", str(recording), "--json"], None),
        "chains": (["chains", str(recording)], None),
        "latency": (["latency", str(recording), "--json", "--instances"], None),
        "init": writing(".yaml", "init"),
        "run": writing("", "run", live, "--cycles", 60),
        "shape": writing("", *shape),
        "shape-adapt": writing("", *shape, "--adapt"),
        "apply-adapt": ([*map(str, adapting)], adapted),
        "watch": ([*watch, *chain, *emitting], None),
        "watch-plan": ([*watch, "--plan", str(plan), *emitting], None),
        "watch-metrics": ([*watch, *chain, "--metrics", "9464", *emitting], None),
        "watch-budget": ([*watch, "--budget", str(budget), *emitting], None),
        "generate": (["generate", str(application), "-o", str(package)], package),
        "describe": writing(".yaml", "describe", recording),
        "compare": (["compare", *[str(recording)] * 2, "--figures", str(figures)], figures),
        "budget": writing(".yaml", "budget", recording),
        "check": (
            ["check", str(recording), "--budget", str(budget), "--junit", f"{output}.xml"],
            output.with_name(output.name + ".xml"),
        ),
        "splice": (
            ["splice", str(plan), str(folder / "app.launch.py"), "-o", str(package)],
            package,
        ),
        "plan-bands": writing(".yaml", "plan", recording, "--bands", 2, "--solver", "pso"),
        "demo": (
            ["demo", "--application", str(live), "--cycles", "60", "-o", str(WORK / "small" / "d")],
            None,
        ),
        "profile": ([*profiled, *emitting], at),
        "handover": ([str(WORK / "pages"), str(HERE.parent / "robot" / "output_process.py")], None),
        "apply": (["apply", servers, "--backend", "freezer", "--phase", "0ms"], None),
        "apply-fifo": (["apply", servers, "--backend", "fifo", "--phase", "0ms"], None),
        "record": ([*recorded, *emitting], at),
        "simulate": writing("", "simulate", application, "--cycles", 300),
        "sweep": writing(
            ".parquet", "sweep", application, "--cycles", 2000, "--vary", "bands=1,2,3"
        ),
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


def core() -> int:
    """Where the live workload's executors run."""
    return max(os.sched_getaffinity(0))


def write_inputs(folder: Path) -> None:
    """A description, a recording and plans."""
    from applied_plans import plan_for, server

    from chainshaper.planning import save_plan

    save_plan(Plan.of(plan_for(server("first", "victim", (0, 30)))), folder / "servers.yaml")
    (folder / "live.yaml").write_text(LIVE.replace("CORE", str(core())))
    slower = (folder / "live.yaml").read_text().replace("constant: 200us", "constant: 900us")
    (folder / "slow.yaml").write_text(slower)  # slots that follow its latencies are moved
    (folder / "app.launch.py").write_text(_LAUNCH)
    for words in (
        ("simulate", "live.yaml", "--cycles", "200", "-o", "lrec"),
        ("plan", "lrec", "-o", "lplan.yaml"),
        ("plan", "lrec", "--shaping-thread", "in-slots", "-o", "kplan.yaml"),
        ("init", "-o", "app.yaml"),
        ("simulate", "app.yaml", "--cycles", "200", "-o", "rec"),
        ("plan", "rec", "-o", "plan.yaml"),
        ("budget", "rec", "-o", "budget.yaml"),
    ):
        subprocess.run([*CLI, *words], cwd=folder, check=True, capture_output=True)


def mount_disks() -> None:
    """A small disk for outputs, and mount points of odd names."""
    from odd_names import ODD_NAMES

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


def writes() -> bool:
    """Whether the verb has begun to write: an output, a temporary file."""
    return any({*os.listdir(folder)} - {"filling"} for folder in (WORK / "small", *EMPTY))  # noqa: PTH208


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
        self.process = subprocess.Popen(node_command("victim", output, 100_000_000, 100_000))
        (self.group / "cgroup.procs").write_text(str(self.process.pid))
        wait(lambda: output.exists() and output.stat().st_size > 0, 30)
        self.before = scheduling(self.process.pid)

    def changed(self) -> list[str]:
        """What is not as it was."""
        from applied_plans import scheduling
        from gated import cpu_ns

        pid, changes = self.process.pid, []
        if (now := scheduling(pid)) != self.before:
            changes.append(f"the node's scheduling is {now}, and was {self.before}")
        groups = [place.name for place in self.group.iterdir() if place.is_dir()]
        changes += [f"the group {name} is left" for name in groups]
        ran = cpu_ns(pid)
        if not wait(lambda: cpu_ns(pid) > ran, 10):
            changes.append("the node does not run")
        return changes

    def end(self) -> None:
        self.process.kill()
        self.process.wait()
        wait(lambda: not _removed(self.group), 5)


def _removed(group: Path) -> bool:
    with contextlib.suppress(OSError):
        group.rmdir()
    return group.exists()


def wait(condition: Callable[[], bool], seconds: float) -> bool:
    """Whether it comes true before the time is over; what takes long is looked at less often."""
    began = time.monotonic()
    while not condition():
        waited_s = time.monotonic() - began
        if waited_s > seconds:
            return False
        time.sleep(min(0.2, max(0.003, waited_s / 100)))
    return True


def known_span(folder: Path, case: Case) -> float:
    """For how long the verb goes on (s) behind what the kill is to be behind, as far as known."""
    for place in (_span_file(folder, case, case.full), _span_file(folder, case, "")):
        with contextlib.suppress(OSError, ValueError):  # a lane writes it
            return float(place.read_text())
    return FIRST_S[case.behind]


def note_span(folder: Path, case: Case, seconds: float) -> None:
    """Have all lanes know for how long the verb goes on."""
    longest_s = LONGEST_S[case.behind]
    _span_file(folder, case, case.full).write_text(str(min(longest_s, max(0.005, seconds))))


def _span_file(folder: Path, case: Case, full: str) -> Path:
    return folder / "-".join(("span", case.verb, case.behind, full.replace("/", "")))


def await_instant(
    case: Case, process: subprocess.Popen[bytes], folder: Path, chance: random.Random
) -> None:
    """Wait until the verb is to be killed, or has ended before; note for how long it goes on."""

    def ended() -> bool:
        return process.poll() is not None

    if case.behind == "in force":
        wait(lambda: b"in force" in output_of() or ended(), 60)
    elif case.behind == "writing":
        wait(lambda: writes() or ended(), 60)
    if ended():
        case.ended = f"before {case.behind}: "
        return
    began, span_s = time.monotonic(), known_span(folder, case)
    case.after_s = round(chance.uniform(0, span_s), 4)
    with contextlib.suppress(subprocess.TimeoutExpired):
        process.wait(case.after_s)
    note_span(folder, case, time.monotonic() - began if ended() else span_s * LONGER)


def started(verb: str, words: list[str]) -> tuple[subprocess.Popen[bytes], str]:
    """Start a verb; return it, and what the environment of all its processes has in it."""
    name, mark = "CASE", uuid.uuid4().hex
    with (WORK / "said").open("wb") as printed:  # on a mount of this lane alone
        process = subprocess.Popen(
            command(verb, words),
            env={**os.environ, name: mark},
            stdin=subprocess.DEVNULL,
            stdout=printed,
            stderr=printed,
        )
    return process, f"{name}={mark}"


def how_it_ended(process: subprocess.Popen[bytes]) -> str:
    """Say with which exit code a verb has ended, and its last line."""
    last = output_of().decode(errors="replace").strip().rpartition("\n")[2]
    return f"exit code {process.returncode}: {last[-300:]}"


def run_case(case: Case, folder: Path, victim: Victim) -> None:
    """Start the verb, kill, and look."""
    from processes import kill_marked, marked_processes

    chance = random.Random(case.seed)
    words, output = verbs(folder)[case.verb]
    with contextlib.ExitStack() as disks:
        case.full = chance.choice(("", "", "", "its disk", "/run"))
        if case.full:
            disks.enter_context(filled(WORK / "small" if case.full == "its disk" else Path("/run")))
        process, marker = started(case.verb, words)
        if case.verb.startswith("apply") and case.full != "/run" and chance.random() < 0.7:
            case.behind = "in force"
        elif output is not None and not case.full and chance.random() < 0.5:
            case.behind = "writing"
        await_instant(case, process, folder, chance)
        pids = marked_processes(marker)
        case.kill = "a kill" if pids else "too late"
        if process.poll() is not None:
            case.ended += how_it_ended(process)
        kill_some(case, process, pids, marker, chance)
        process.wait()
    look_behind(case, victim, marker, output)
    kill_marked(marker)


def rehearse(verb: str, folder: Path) -> Case:
    """Let a verb go on to its end, and note for how long it does.

    A plan that is in force is ended by Ctrl-C, nodes are killed.
    """
    from processes import kill_marked

    case, began = Case(0, verb, behind="end"), time.monotonic()
    words, output = verbs(folder)[verb]
    process, marker = started(verb, words)
    stays = verb.startswith("apply") and output is None

    def done() -> bool:
        return process.poll() is not None or (stays and b"in force" in output_of())

    wait(lambda: done() or writes(), 90)
    wrote = time.monotonic()
    wait(done, 3 if verb == "handover" else 90)
    now = time.monotonic()
    note_span(folder, Case(0, verb, behind="start"), now - began)
    if output is not None:
        note_span(folder, Case(0, verb, behind="writing"), now - wrote)
    if process.poll() is None:
        case.faults.append("SIGINT, for it went on")
        process.send_signal(signal.SIGINT)
    if not wait(lambda: process.poll() is not None, 60):
        case.faults.append("SIGKILL, for it did not end")
        process.kill()
    process.wait()
    case.after_s = round(time.monotonic() - began, 3)
    case.ended = how_it_ended(process)
    kill_marked(marker)
    remove_outputs()
    return case


def kill_some(
    case: Case,
    process: subprocess.Popen[bytes],
    pids: dict[int, str],
    marker: str,
    chance: random.Random,
) -> None:
    """Kill or stop the verb, one of its processes or both; then the verb, if it does not end."""
    from processes import send_to_marked

    chosen = {process.pid} & {*pids} if chance.random() < 0.7 else set[int]()
    if pids and (not chosen or chance.random() < 0.6):
        chosen.add(chance.choice(sorted(pids)))
    if case.verb == "handover" and chance.random() < 0.7:  # both nodes at once
        chosen = {*pids} - {process.pid}
    number = chance.choice((signal.SIGKILL, signal.SIGKILL, signal.SIGTERM, signal.SIGINT))
    stops = chance.random() < 0.3
    for pid in chosen:
        name = "the verb" if pid == process.pid else pids[pid]
        case.faults.append(f"{'SIGSTOP, then ' if stops else ''}{number.name} to {name}")
        if stops:
            send_to_marked(marker, pid, signal.SIGSTOP)
        send_to_marked(marker, pid, number)
    patience_s = chance.choice(PATIENCE_S)
    if stops or process.pid not in chosen:
        patience_s = min(PATIENCE_S)
    if not wait(lambda: process.poll() is not None, patience_s):
        process.kill()  # it is stopped, or had another killed
        case.faults.append(f"SIGKILL to the verb after {patience_s:.0f} s")
    # Nobody ends what is stopped but is no guardian and no dispatcher: an application, which only
    # hears SIGINT, or a process that had not come to its first line.
    for pid in chosen - {process.pid} if stops else ():
        if not pids[pid].startswith(("guardian", "dispatcher")):
            send_to_marked(marker, pid, signal.SIGCONT)


def look_behind(case: Case, victim: Victim, marker: str, output: Path | None) -> None:
    """Note what is left when there was time enough, and `release` has had its turn."""
    from processes import kill_marked, marked_processes

    def orphans() -> list[str]:
        if case.verb == "handover":  # the nodes of a robot outlive who has started them
            kill_marked(marker)
            return []
        return [f"{name} ({pid}) runs" for pid, name in marked_processes(marker).items()]

    wait(lambda: not orphans() and not victim.changed(), TIDY_S)
    small = WORK / "small"
    for place in (small, *EMPTY):
        for file in place.iterdir():  # as if time had passed, for what has just been made is left
            os.utime(file, (time.time() - 60,) * 2, follow_symlinks=False)
    released = subprocess.run([*CLI, "release"], capture_output=True, check=False, cwd=small)
    if b"Traceback" in released.stderr:
        case.left.append(f"release: {released.stderr.decode(errors='replace')[-900:]}")
    case.left += orphans() + victim.changed()
    if (printed := output_of()) and b"Traceback" in printed:
        case.left += tracebacks(case, printed)
    for place in EMPTY:  # the folder of pages of a user stays where /run had no room
        of_user = f"chainshaper-{os.geteuid()}"
        case.left += [f"{file} is left" for file in place.iterdir() if file.name != of_user]
    runs = Path("/run/chainshaper")
    pages = [*(runs / "outputs").iterdir()] if (runs / "outputs").is_dir() else []
    if runs.is_dir():
        case.left += [f"{file} is left" for file in runs.iterdir() if file.name != "outputs"]
    for page in pages:
        case.left.append(f"the page {page} is left")
        page.unlink()
    for file in small.iterdir():
        mark = file.name.rpartition(".tracing-")
        named = mark[1] and mark[2].encode() in released.stderr
        if file.name.startswith(".") and not named:
            case.left.append(f"beside the output: {file.name!r}")
    if output is not None:
        case.left += half_written(output)
    remove_outputs()


def remove_outputs() -> None:
    for place in (WORK / "small", *EMPTY):
        for left in place.iterdir():
            subprocess.run(["rm", "-rf", str(left)], check=True)


_FRAME = re.compile(r'File "([^"]+)"')


def tracebacks(case: Case, printed: bytes) -> Iterator[str]:
    """Tracebacks of ours; those of Ctrl-C before our first line are noted as what they are."""
    text = printed.decode(errors="replace")
    for trace in text.split("Traceback (most recent call last)")[1:]:
        frames = [name for name in _FRAME.findall(trace) if "/chainshaper/" in name]
        early = all(name.endswith(("chainshaper/__init__.py", "__main__.py")) for name in frames)
        asked = any("SIGINT" in fault for fault in case.faults)
        if "KeyboardInterrupt" in trace and early and asked:
            case.faults.append("a traceback before our first line")
        else:
            yield f"a traceback: {trace[-1500:]}"


_WHOLE = {".html": b"</html>", ".svg": b"</svg>", ".xml": b">", ".yaml": b"\n"}


def half_written(output: Path) -> Iterator[str]:
    """What stands where an output was to be, and is none."""
    import polars as pl

    if output.is_dir() and output.name == "figures":
        for figure in output.iterdir():
            if not figure.read_bytes().endswith(b"IEND\xaeB`\x82"):
                yield f"half a figure: {figure}"
    elif output.is_dir() and output.name == "pkg":
        files = [path for path in output.rglob("*") if path.is_file()]
        if empty := [path for path in files if not path.stat().st_size]:
            yield f"an empty file in a package: {empty}"
        if not [*output.iterdir()]:
            yield "an empty package"
    elif output.is_dir():
        read = subprocess.run([*CLI, "info", str(output)], capture_output=True, check=False)
        if read.returncode:
            yield f"half an output: {read.stderr.decode(errors='replace')[-200:]}"
    elif output.suffix == ".parquet" and output.exists():
        pl.read_parquet(output.read_bytes())  # its name may be no text
    elif output.exists():
        content = output.read_bytes()
        if not content or not content.rstrip(b" ").endswith(_whole_end(output, content)):
            yield f"{output.name!r} is not whole: it ends in {content[-40:]!r}"


def _whole_end(output: Path, content: bytes) -> bytes:
    end = _WHOLE.get(output.suffix, b"")
    return end + b"\n" if content.endswith(b"\n") and not end.endswith(b"\n") else end


def own_namespaces(lane: int, inputs: str) -> subprocess.Popen[bytes]:
    """Start a lane: this script again, in namespaces and in a group of its own."""
    from chainshaper.linux.cgroups import mount_point

    group = mount_point() / f"kills-{os.getpid()}-{lane}"
    group.mkdir()
    apart = ("--mount", "--propagation", "private", "--pid", "--fork", "--kill-child")
    words = ["unshare", *apart, "--mount-proc", "--net", "--cgroup", sys.executable, __file__]
    enter = 'echo 0 > "$0/cgroup.procs"; exec "$@"'
    return subprocess.Popen(
        ["sh", "-c", enter, str(group), *words, *sys.argv[1:]],
        env={**os.environ, INSIDE: f"{lane} {inputs}"},
        start_new_session=True,  # cores are shared out by sessions
    )


def main() -> None:
    arguments = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    arguments.add_argument("--kills", type=int, default=20, help="so many in time, in all lanes")
    arguments.add_argument("--seed", type=int, default=1)
    arguments.add_argument("--seconds", type=float, default=600.0, help="no case begins later")
    arguments.add_argument("--verbs", nargs="+", help="of these alone; apply alone is real-time")
    arguments.add_argument("--lanes", type=int, default=1, help="so many cases side by side")
    arguments.add_argument("--core", type=int, help="run on this core alone")
    arguments.add_argument("--pause-while", type=Path, metavar="FILE")
    given = arguments.parse_args()
    if given.core is not None:
        os.sched_setaffinity(0, {given.core})
    if INSIDE not in os.environ:
        with tempfile.TemporaryDirectory(dir="/var/tmp") as inputs:  # seen in all lanes
            write_inputs(Path(inputs))
            lanes = [own_namespaces(lane, inputs) for lane in range(given.lanes)]
            codes = [lane.wait() for lane in lanes]
        from chainshaper.linux.cgroups import mount_point

        for lane in range(given.lanes):
            group = mount_point() / f"kills-{os.getpid()}-{lane}"
            _remove_groups(group)
            wait(lambda group=group: not _removed(group), 5)  # type: ignore[misc]
        sys.exit(any(codes))
    number, _, inputs = os.environ.pop(INSIDE).partition(" ")
    sys.exit(run_lane(given, int(number), Path(inputs)))


def _remove_groups(folder: Path) -> None:
    for group in folder.iterdir():
        if group.is_dir():
            _remove_groups(group)
            _removed(group)


def run_lane(given: argparse.Namespace, lane: int, folder: Path) -> bool:
    """Cases one after the other, in namespaces of their own: whether something was left."""
    from chainshaper.linux.cgroups import mount_point

    # A shell has what it runs in the background ignore these, and so would all that a lane starts.
    for number in (signal.SIGINT, signal.SIGQUIT, signal.SIGHUP):
        signal.signal(number, signal.SIG_DFL)
    pause = given.pause_while and os.open(given.pause_while.parent, os.O_RDONLY | os.O_DIRECTORY)
    groups = mount_point()
    for words in (
        ["umount", str(groups)],
        ["mount", "-t", "cgroup2", "none", str(groups)],
        ["ip", "link", "set", "lo", "up"],
    ):
        subprocess.run(words, check=True)
    mount(Path("/run"), "256k")
    for place in (WORK, *EMPTY):
        mount(place, "64m")
    sums, until = Counter[str](), time.monotonic() + given.seconds
    mount_disks()
    (groups / "cases").mkdir()  # beside the victim's: threads of a group that has others in it
    (groups / "cases" / "cgroup.procs").write_text("0")  # are not frozen one by one
    names = given.verbs or sorted(verbs(folder))
    victim, kills = Victim(), -(-given.kills // given.lanes)

    def pauses() -> None:
        while pause is not None and given.pause_while.name in os.listdir(pause):  # noqa: PTH208
            time.sleep(1)

    for verb in names[lane :: given.lanes]:
        pauses()
        sys.stdout.write(json.dumps(vars(rehearse(verb, folder))) + "\n")
        sys.stdout.flush()
    for seed in itertools.count(given.seed + lane, given.lanes):
        pauses()
        if sums["a kill"] == kills or time.monotonic() > until:
            break
        case = Case(seed, names[seed % len(names)])
        run_case(case, folder, victim)
        sums[case.kill] += 1
        sums[f"{case.kill} of {case.verb}"] += 1
        sums["cases with something left"] += bool(case.left)
        sums["before our first line"] += "a traceback before our first line" in case.faults
        sys.stdout.write(json.dumps(vars(case)) + "\n")
        sys.stdout.flush()
        if case.left:
            victim.end()
            victim = Victim()
    victim.end()
    _remove_groups(groups)
    sys.stdout.write(json.dumps(sums) + "\n")
    return bool(sums["cases with something left"])


if __name__ == "__main__":
    sys.path.insert(0, str(HERE))
    main()
