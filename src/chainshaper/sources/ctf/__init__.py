"""LTTng traces (Common Trace Format 1.8) as data frames.

    trace = open_trace("~/lttng-traces/session")
    count_events(trace)                       # {"ros2:callback_start": 4711, …}
    read_events(trace, {"ros2:callback_start"})["ros2:callback_start"]

The format is that of the CTF 1.8 specification (https://diamon.org/ctf/v1.8.3/).
"""

from chainshaper.sources.ctf.errors import CtfError
from chainshaper.sources.ctf.read import Events, count_events, read_events
from chainshaper.sources.ctf.trace import CtfFolder, CtfStream, CtfTrace, open_trace

__all__ = [
    "CtfError",
    "CtfFolder",
    "CtfStream",
    "CtfTrace",
    "Events",
    "count_events",
    "open_trace",
    "read_events",
]
