"""Run by an interpreter that has bt2: pickle every event of a trace to standard output.

    python babeltrace_dump.py FOLDER…

Writes a dict: ``events`` (name, clock cycles or None, packet context, contexts, payload),
``discarded`` and ``lost``.
"""

import pickle
import sys
from typing import Any

import bt2  # type: ignore[import-not-found]


def plain(field: Any) -> Any:
    """A bt2 field as plain Python; a variant as a mapping with its one option."""
    kind = type(field).__name__
    if "Structure" in kind:
        return {name: plain(field[name]) for name in field}
    if "Array" in kind:
        return [plain(item) for item in field]
    if "Variant" in kind:
        names = list(field.cls) if hasattr(field, "cls") else list(field.field_class)
        return {names[field.selected_option_index]: plain(field.selected_option)}
    if "String" in kind:
        return str(field)
    return float(field) if "Real" in kind else int(field)


def fields(of: Any) -> Any:
    return plain(of) if of is not None else {}


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
