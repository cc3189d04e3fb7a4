"""Reading serialized messages (CDR): the origin stamp of a header, and the text of a String."""

import struct


def origin_of(payload: bytes) -> int | None:
    """Return the header stamp of a serialized message in ns of its clock; None: it has none.

    The stamp is an int32 of seconds and a uint32 of nanoseconds behind the encapsulation header; a
    stamp of zero, or a message that is too short, is none.
    """
    if len(payload) < 12:
        return None
    order = "<" if payload[1] & 1 else ">"
    seconds, nanoseconds = struct.unpack_from(f"{order}iI", payload, 4)
    if nanoseconds >= 1_000_000_000:
        return None
    stamp: int = seconds * 1_000_000_000 + nanoseconds
    return stamp or None


def text_of(payload: bytes) -> str | None:
    """Return the text of a serialized ``std_msgs/String``; None: the bytes are none."""
    if len(payload) < 8:
        return None
    length = int.from_bytes(payload[4:8], "little" if payload[1] & 1 else "big")  # with the NUL
    if not 1 <= length <= len(payload) - 8:
        return None
    return payload[8 : 7 + length].decode(errors="replace")
