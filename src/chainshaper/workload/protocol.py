"""How the launcher and its processes talk: lines of JSON on pipes, and bytes at the end.

1. launcher → process: what it is;
2. process → launcher: that it is ready;
3. launcher → process: when to start and stop (ns of CLOCK_MONOTONIC);
4. process → launcher: one line with the size of its events, then the events;
5. launcher → process: an empty line: leave.

Between 3 and 4 nobody touches a pipe, so that talking never disturbs what is measured.
"""

import json
import sys
from typing import Any

__all__ = ["receive", "send", "send_events", "wait_for_leave"]


def receive() -> dict[str, Any]:
    """The launcher's next line; ends this process when the launcher is gone."""
    line = sys.stdin.readline()
    if not line:
        sys.exit(0)
    received: dict[str, Any] = json.loads(line)
    return received


def send(**fields: Any) -> None:
    """One line to the launcher."""
    sys.stdout.write(json.dumps(fields) + "\n")
    sys.stdout.flush()


def send_events(events: bytes, **fields: Any) -> None:
    """What was recorded, behind a line that says how much it is."""
    send(bytes=len(events), **fields)
    # A process that is frozen while it writes has written a part; without a buffer
    # (PYTHONUNBUFFERED) nobody but us writes the rest.
    left = memoryview(events)
    while left:
        left = left[sys.stdout.buffer.write(left) :]
    sys.stdout.buffer.flush()


def wait_for_leave() -> None:
    """Stay until everybody is done: a participant that leaves early disturbs the others."""
    sys.stdin.readline()
