"""What a process tells its launcher arrives whole."""

import io
import json
import sys

import pytest

from chainshaper.workload.event_log import send_events


class _Interrupted(io.RawIOBase):
    """A pipe whose writer is stopped again and again: each write takes a part only."""

    def __init__(self) -> None:
        self.received = b""

    def writable(self) -> bool:
        return True

    def write(self, data: object) -> int:
        part = bytes(data)[:7]  # type: ignore[call-overload]
        self.received += part
        return len(part)


class _Unbuffered:
    """Standard output as PYTHONUNBUFFERED makes it: text goes through, bytes have no buffer."""

    def __init__(self, pipe: _Interrupted) -> None:
        self.buffer = pipe

    def write(self, text: str) -> None:
        self.buffer.received += text.encode()

    def flush(self) -> None:
        self.buffer.flush()


def test_events_arrive_whole_when_the_writer_is_frozen_in_the_middle(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    pipe, events = _Interrupted(), bytes(range(256)) * 3
    monkeypatch.setattr(sys, "stdout", _Unbuffered(pipe))
    send_events(events, objects=[])
    line, _, rest = pipe.received.partition(b"\n")
    assert json.loads(line) == {"bytes": len(events), "objects": []}
    assert rest == events
