"""What babeltrace2 says, and the comparison of our frames with it, field by field."""

import functools
import pickle
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from chainshaper.sources.ctf import open_trace, read_events

DUMP = Path(__file__).with_name("babeltrace_dump.py")


@functools.cache
def interpreter() -> Any:
    """An interpreter that can import bt2, or None."""
    for candidate in (sys.executable, "/usr/bin/python3", shutil.which("python3")):
        if candidate and Path(candidate).exists():
            run = subprocess.run([candidate, "-c", "import bt2"], capture_output=True, check=False)
            if run.returncode == 0:
                return candidate
    return None


def babeltrace(*folders: Any) -> Any:
    """The reference's events and losses; skips without it, fails where it cannot read."""
    if interpreter() is None:
        pytest.skip("no reference: python3-bt2 (babeltrace2) is not installed")
    command = [interpreter(), str(DUMP), *map(str, folders)]
    run = subprocess.run(command, capture_output=True, check=False, timeout=120)
    assert run.returncode == 0, run.stderr.decode()
    return pickle.loads(run.stdout)  # noqa: S301 - from our own script


def lean(value: Any) -> Any:
    """Without what is not known; names in order of the alphabet, so that texts can be compared."""
    return {name: value[name] for name in sorted(value) if value[name] is not None}


def expected_rows(reference: Any, kernel: Any = False) -> Any:
    rows: dict[str, list[Any]] = {}
    first = ("pid", "vpid") if kernel else ("vpid", "pid")
    for name, time, packet, context, payload in reference["events"]:
        standard = {"time": time, "cpu": packet.get("cpu_id")}
        for column in ("pid", "tid"):
            order = first if column == "pid" else tuple(n.replace("pid", "tid") for n in first)
            standard[column] = next((context[n] for n in order if n in context), None)
        if "procname" in context:
            standard["procname"] = context["procname"]
        shown = {(f"payload.{n}" if n in standard else n): v for n, v in payload.items()}
        rows.setdefault(name, []).append(lean(standard | shown))
    return rows


def actual_rows(frames: Any) -> Any:
    return {
        name: [lean(row) for row in frame.rows(named=True)]
        for name, frame in frames.items()
        if len(frame)
    }


def assert_equal_to_babeltrace(*folders: Any, kernel: Any = False) -> Any:
    reference = babeltrace(*folders)
    trace = open_trace(*folders)
    frames = read_events(trace)
    expected, actual = expected_rows(reference, kernel), actual_rows(frames)
    assert expected.keys() == actual.keys()
    for name, rows in expected.items():
        assert [r["time"] for r in actual[name]] == [r["time"] for r in rows], name
        # Equal times may stand in another order.
        assert sorted(map(repr, actual[name])) == sorted(map(repr, rows)), name
    assert trace.discarded_events == reference["discarded"]
    assert trace.lost_packets == reference["lost"]
    assert frames.warnings == ()
    return trace, frames
