"""Run by an interpreter that has bt2: pickle every event of a trace to standard output.

    python babeltrace_dump.py FOLDER…

Writes a dict: ``events`` (name, clock cycles or None, packet context, contexts, payload),
``discarded`` and ``lost``.
"""

import pickle
import sys
from typing import Any

import bt2  # type: ignore[import-not-found]


def fields(of: Any) -> Any:
    """The numbers, texts and arrays of bytes of a bt2 structure: what a table has columns for."""
    values: dict[str, Any] = {}
    for name in of or ():
        field, kind = of[name], type(of[name]).__name__
        if "String" in kind:
            values[name] = str(field)
        elif "Integer" in kind or "Enumeration" in kind:
            values[name] = int(field)
        elif "Array" in kind:
            element = field.cls.element_field_class
            if getattr(element, "field_value_range", 0) == 8:
                values[name] = [int(item) for item in field]
    return values


events, discarded, lost = [], 0, 0
for message in bt2.TraceCollectionMessageIterator(sys.argv[1:]):
    if type(message) is bt2._DiscardedEventsMessageConst:
        discarded += message.count or 0
    elif type(message) is bt2._DiscardedPacketsMessageConst:
        lost += message.count or 0
    elif type(message) is bt2._EventMessageConst:
        event = message.event
        context = fields(event.common_context_field) | fields(event.specific_context_field)
        packet, payload = fields(event.packet.context_field), fields(event.payload_field)
        clock = message.default_clock_snapshot.value
        events.append((event.name, clock, packet, context, payload))
pickle.dump({"events": events, "discarded": discarded, "lost": lost}, sys.stdout.buffer)
