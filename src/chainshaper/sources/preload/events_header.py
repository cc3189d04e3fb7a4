"""`events.h`: the events that `preload.c` records, as their declarations have them; `rclpy_hook.h`.

`core/preloaded/CMakeLists.txt` runs this file when the library is built. It imports the standard
library and :mod:`chainshaper.values.event_declarations` only.
"""

import sys
import zlib
from collections.abc import Iterable
from pathlib import Path

from chainshaper.values.event_declarations import (
    SLEEPING_CALLS,
    Event,
    FieldKind,
    events_of_library,
)

_LAYOUT = 4
"""To be increased when the memory of a traced process changes otherwise than by its events."""

_TEMPLATE = """\
// Made by sources/preload/events_header.py from values/event_declarations.py.
// EVENT: name, arguments that are recorded, whether the third value is the thread's CPU time.
// CREATION: name, the places of texts as bits, that of a gid (0: none).
// CALL: name of the function in rmw.
#define ALL_EVENTS(EVENT, CREATION, CALL) \\
  {lines}
// The functions by which a thread sleeps, as `thread_sleep` and `thread_wake` number them.
#define SLEEPING_CALLS(CALL) \\
  {calls}
"""


def event_line(event: Event) -> str:
    """Return the line of an event in the list of `preload.c`."""
    if event.recorded_by_library == "service call":
        return f"CALL({event.name})"
    if event.group == "creation":
        texts = sum(1 << place for place in _places(event, "text"))
        gid = next(iter(_places(event, "gid")), 0)
        return f"CREATION({event.name}, {texts}, {gid})"
    count = 1 + max(_places(event))
    is_timed = any(field.name == "thread_time" for field in event.fields)
    return f"EVENT({event.name}, {count}, {str(is_timed).lower()})"


def _places(event: Event, kind: FieldKind | None = None) -> list[int]:
    """Return the places of an event's arguments that are of a kind; None: of any kind."""
    return [
        field.argument
        for field in event.fields
        if field.argument is not None and kind in (None, field.kind)
    ]


def events_header(events: Iterable[Event]) -> str:
    """Return the text of `events.h`, without the number of its format."""
    calls = " ".join(f"CALL({name})" for name in SLEEPING_CALLS)
    return _TEMPLATE.format(lines=" \\\n  ".join(map(event_line, events)), calls=calls)


def format_of(header: str) -> int:
    """Return a number of 32 bits that stands for the events of a memory and its layout."""
    return zlib.crc32(header.encode(), _LAYOUT)


FORMAT = format_of(events_header(events_of_library()))
"""The format of memories that this version writes, and the only one it reads."""


def hook_header() -> str:
    """Return the text of `rclpy_hook.h`: `rclpy_hook.py` as a string of C."""
    lines = Path(__file__).with_name("rclpy_hook.py").read_text("ascii").splitlines()
    escaped = (line.replace("\\", r"\\").replace('"', r"\"") for line in lines)
    text = "\n".join(f'  "{line}\\n"' for line in escaped)
    return f"static const char rclpy_hook[] =\n{text};\n"


if __name__ == "__main__":
    header = events_header(events_of_library())
    folder = Path(sys.argv[1])
    (folder / "events.h").write_text(f"{header}#define FORMAT {format_of(header)}u\n", "utf-8")
    (folder / "rclpy_hook.h").write_text(hook_header(), "ascii")
