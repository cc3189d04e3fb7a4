"""LTTng traces (Common Trace Format 1.8, https://diamon.org/ctf/v1.8.3/) as data frames.

    trace = open_trace("~/lttng-traces/session")
    count_events(trace)                       # {"ros2:callback_start": 4711, …}, what is damaged
    read_events(trace, {"ros2:callback_start"})["ros2:callback_start"]

From a folder to frames: `tsdl` reads the metadata, `layout` hands its types to the decoder in C++
(core/ctf), `trace` lets the decoder find the packets, `copies` leaves out packets that are there
twice, and `read` lets the decoder write the columns.
"""

from chainshaper.sources.ctf.read import Events, count_events, read_events
from chainshaper.sources.ctf.trace import CtfTrace, open_trace
from chainshaper.sources.ctf.tsdl import CtfError

__all__ = ["CtfError", "CtfTrace", "Events", "count_events", "open_trace", "read_events"]
