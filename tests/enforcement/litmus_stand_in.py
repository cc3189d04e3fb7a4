"""A stand-in for LITMUS^RT where the kernel is none: its tools, as programs on $PATH.

This is a border that the tests cannot cross. The programs read their arguments by the rules of
liblitmus's `resctl` and `setsched` (decimal times, cut to whole nanoseconds), and refuse what those
or the kernel's P-RES plugin refuse. What the kernel would keep they keep in a file. A thread in a
reservation gets SCHED_BATCH, which no test uses otherwise, in place of SCHED_LITMUS.

`slots` of a reservation are closed intervals in ns, as the kernel gets them.
"""

import json
import os
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

__all__ = ["StandIn", "install"]

_PROGRAM = """#!{python} -S
import getopt, json, os, re, sys
from pathlib import Path

proc = Path({proc!r})
state = json.loads((proc / "state.json").read_text())
with (proc / "calls").open("a") as calls:
    calls.write(json.dumps([Path(sys.argv[0]).name, *sys.argv[1:]]) + "\\n")

def save():
    (proc / "state.json").write_text(json.dumps(state))
    (proc / "active_plugin").write_text(state["plugin"] + "\\n")

def fail(code, text, stream=sys.stderr):
    print(text, file=stream)
    sys.exit(code)

def is_real_time(tid):
    try:
        return os.sched_getscheduler(tid) == os.SCHED_BATCH
    except OSError:
        return False
"""

_SETSCHED = """
if len(sys.argv) != 2 or sys.argv[1] not in ("Linux", "P-RES", "GSN-EDF"):
    fail(1, "Error: Setting new plugin failed.", sys.stdout)
if any(is_real_time(tid) for tid in state["attached"]):
    fail(1, "Error: Setting new plugin failed.\\nAre there any active real-time tasks?", sys.stdout)
state.update(plugin=sys.argv[1], reservations=[], attached=[])
save()
"""

_RESCTL = r"""
INTERVAL = re.compile(r"\[(-?\d+(?:\.\d*)?),(-?\d+(?:\.\d*)?)([)\]])")

def nanoseconds(milliseconds):
    return int(milliseconds * 1_000_000)

def intervals(texts, major_cycle):
    slots = []
    for text in texts:
        match = INTERVAL.match(text)
        if match is None:
            fail(5, f"could not parse '{text}' as interval")
        start, end = float(match.group(1)), float(match.group(2))
        if start < 0:
            fail(5, f"interval {text}: must not start before zero")
        if end <= start:
            fail(5, f"interval {text}: end before start")
        slot = [nanoseconds(start), nanoseconds(end) - (match.group(3) == ")")]
        if slots and slots[-1][1] >= slot[0]:
            fail(5, f"interval {text}: overlaps with previous interval")
        if slot[1] >= major_cycle:
            fail(5, f"interval {text}: exceeds major cycle length ({slot[1]} >= {major_cycle})")
        slots.append(slot)
    return slots

try:
    options, rest = getopt.gnu_getopt(sys.argv[1:], "n:a:r:t:c:b:p:d:o:q:m:h")
except getopt.GetoptError:
    fail(1, "Bad argument.")
number_of, core, kind, priority, major_cycle, attach, create = 0, 0, "", 0, 1000.0, 0, False
for option, value in options:
    if option in ("-n", "-r"):
        number_of, create = int(value), create or option == "-n"
    elif option == "-c":
        core = int(value)
    elif option == "-t":
        kind = value
    elif option == "-q":
        priority = int(value)
    elif option == "-m":
        major_cycle = float(value)
    elif option == "-a":
        attach = int(value)
if kind == "table-driven":
    slots = intervals(rest, nanoseconds(major_cycle))
    if not slots:
        fail(1, "Table-driven reservations require at least one interval to be specified.")
if create:
    def refused(why):
        fail(1, f"failed to create reservation {number_of} ({why})")
    if state["plugin"] != "P-RES":
        refused("Function not implemented")
    if core >= os.cpu_count() or len(slots) > 1024 or any(end <= start for start, end in slots):
        refused("Invalid argument")
    if any((r["number"], r["core"]) == (number_of, core) for r in state["reservations"]):
        refused("File exists")
    state["reservations"].append(
        {"number": number_of, "core": core, "priority": priority or 1, "slots": slots,
         "cycle": nanoseconds(major_cycle)}
    )
if attach:
    try:
        os.sched_setaffinity(attach, [core])
    except OSError:
        fail(4, f"failed to migrate task {attach} to CPU {core}")
    if is_real_time(attach):
        fail(2, f"failed to set RT task parameters for task {attach} (Device or resource busy)")
    known = [(r["number"], r["core"]) for r in state["reservations"]]
    if state["plugin"] != "P-RES" or (number_of, core) not in known:
        fail(3, f"failed to transition task {attach} to LITMUS^RT class (Invalid argument)")
    os.sched_setscheduler(attach, os.SCHED_BATCH, os.sched_param(0))
    state["attached"].append(attach)
    state.setdefault("home", {})[str(attach)] = [core, number_of]
save()
"""


@dataclass(frozen=True)
class StandIn:
    """The installed stand-in: ``proc`` in place of /proc/litmus, ``programs`` for $PATH."""

    proc: Path
    programs: Path

    @property
    def plugin(self) -> str:
        return (self.proc / "active_plugin").read_text().strip()

    @property
    def state(self) -> dict[str, Any]:
        """What the kernel would hold: reservations, and the reservation of each thread."""
        return json.loads((self.proc / "state.json").read_text())  # type: ignore[no-any-return]

    @property
    def calls(self) -> list[list[str]]:
        """All commands so far."""
        with (self.proc / "calls").open("a+") as calls:
            calls.seek(0)
            return [json.loads(line) for line in calls]


def install(folder: Path, plugin: str = "Linux") -> StandIn:
    """Write the programs and an empty state below ``folder``."""
    proc, programs = folder / "proc-litmus", folder / "programs"
    proc.mkdir()
    programs.mkdir()
    (proc / "active_plugin").write_text(plugin + "\n")
    state = {"plugin": plugin, "reservations": [], "attached": []}
    (proc / "state.json").write_text(json.dumps(state))
    head = _PROGRAM.format(python=os.path.realpath(sys.executable), proc=str(proc))
    for name, body in (("setsched", _SETSCHED), ("resctl", _RESCTL)):
        (programs / name).write_text(head + body)
        (programs / name).chmod(0o755)
    return StandIn(proc, programs)
