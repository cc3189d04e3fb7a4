"""Reading the blocks of TSDL metadata into a `TraceClass` (CTF 1.8, section 7)."""

from dataclasses import replace

from chainshaper.sources.ctf.attributes import Value
from chainshaper.sources.ctf.declarations import Parser
from chainshaper.sources.ctf.tokens import TsdlError, tokenize
from chainshaper.sources.ctf.types import (
    Clock,
    EventClass,
    StreamClass,
    StructType,
    TraceClass,
    Type,
)

__all__ = ["parse_tsdl"]

_NANOSECONDS = 1_000_000_000


def parse_tsdl(text: str) -> TraceClass:
    """Parse a whole metadata text.

    Raises `TsdlError` with the character offset and the reason where the text is no TSDL, names
    something undeclared, or declares something twice.
    """
    parser = Parser(tokenize(text))
    reader = _Blocks(parser)
    while parser.token.kind != "end":
        reader.block()
    return reader.finish()


class _Blocks:
    """The blocks read so far; classes are put together at the end, in any order of blocks."""

    def __init__(self, parser: Parser) -> None:
        self.parser = parser
        self.trace: dict[str, Value | Type] | None = None
        self.env: dict[str, str | int] = {}
        self.clocks: dict[str, Clock] = {}
        self.streams: dict[int, StreamClass] = {}
        self.events: dict[tuple[int | None, int | None], tuple[EventClass, int]] = {}

    def block(self) -> None:
        parser = self.parser
        offset = parser.token.offset
        if parser.declaration():
            return
        keyword = parser.take("word")
        match keyword:
            case "trace":
                if self.trace is not None:
                    raise TsdlError(offset, "a second trace block")
                self.trace = self._assignments()
            case "env":
                values = parser.attributes()
                self.env |= {name: value for name, (value, _) in values.items()}
            case "clock":
                self._clock(parser.attributes(), offset)
            case "callsite":
                parser.attributes()
            case "stream":
                self._stream(self._assignments(), offset)
            case "event":
                self._event(self._assignments(), offset)
            case _:
                raise TsdlError(offset, f"unknown block {keyword!r}")
        parser.expect(";")

    def _assignments(self) -> dict[str, Value | Type]:
        """``{ path = value; path := type; … }`` with types declared in between."""
        parser = self.parser
        found: dict[str, Value | Type] = {}
        with parser.block():
            while not parser.at("}"):
                if parser.declaration():
                    continue
                offset = parser.token.offset
                path = parser.path()
                if path in found:
                    raise TsdlError(offset, f"{path} given twice")
                if parser.accept(":="):
                    found[path] = parser.type(declares=False)
                else:
                    parser.expect("=")
                    found[path] = parser.value()
                parser.expect(";")
        return found

    def _clock(self, values: dict[str, tuple[Value, int]], offset: int) -> None:
        def integer(name: str, default: int) -> int:
            value, at = values.get(name, (default, offset))
            if not isinstance(value, int):
                raise TsdlError(at, f"clock {name} must be an integer, not {value!r}")
            return value

        name = values.get("name", (None, 0))[0]
        frequency = integer("freq", _NANOSECONDS)
        if not isinstance(name, str):
            raise TsdlError(offset, "clock without a name")
        if not 0 < frequency <= 10**10:
            raise TsdlError(offset, f"clock frequency of {frequency} Hz; up to 10 GHz supported")
        cycles = integer("offset", 0)
        self.clocks[name] = Clock(
            name=name,
            frequency=frequency,
            offset_ns=integer("offset_s", 0) * _NANOSECONDS + cycles * _NANOSECONDS // frequency,
            uuid=str(values["uuid"][0]) if "uuid" in values else None,
        )

    def _stream(self, values: dict[str, Value | Type], offset: int) -> None:
        identifier = _integer(values, "id", offset) or 0
        if identifier in self.streams:
            raise TsdlError(offset, f"stream {identifier} declared twice")
        self.streams[identifier] = StreamClass(
            id=identifier,
            packet_context=_struct(values, "packet.context", offset),
            event_header=_struct(values, "event.header", offset),
            event_context=_struct(values, "event.context", offset),
        )

    def _event(self, values: dict[str, Value | Type], offset: int) -> None:
        stream_id = _integer(values, "stream_id", offset)
        identifier = _integer(values, "id", offset)
        name = values.get("name")
        if not isinstance(name, str):
            raise TsdlError(offset, "event without a name")
        if (stream_id, identifier) in self.events:
            raise TsdlError(offset, f"event {name!r}: id {identifier} declared twice")
        event = EventClass(
            id=identifier or 0,
            name=name,
            context=_struct(values, "context", offset),
            fields=_struct(values, "fields", offset),
        )
        self.events[stream_id, identifier] = (event, offset)

    def finish(self) -> TraceClass:
        if self.trace is None:
            raise TsdlError(0, "no trace block")
        byte_order = self.trace.get("byte_order")
        if byte_order not in ("le", "be", "network"):
            raise TsdlError(0, f"trace byte_order must be le or be, not {byte_order!r}")
        streams = self.streams or {0: StreamClass(0)}
        only = next(iter(streams)) if len(streams) == 1 else 0
        events: dict[int, dict[int, EventClass]] = {identifier: {} for identifier in streams}
        for (stream_id, _), (event, offset) in self.events.items():
            target = only if stream_id is None else stream_id
            if target not in streams:
                raise TsdlError(offset, f"event {event.name!r} of undeclared stream {target}")
            if event.id in events[target]:
                raise TsdlError(offset, f"event {event.name!r}: id {event.id} declared twice")
            events[target][event.id] = event
        uuid = self.trace.get("uuid")
        return TraceClass(
            byte_order="le" if byte_order == "le" else "be",
            uuid=uuid if isinstance(uuid, str) else None,
            packet_header=_struct(self.trace, "packet.header", 0),
            env=self.env,
            clocks=self.clocks,
            streams={i: replace(stream, events=events[i]) for i, stream in streams.items()},
        )


def _integer(values: dict[str, Value | Type], name: str, offset: int) -> int | None:
    value = values.get(name)
    if value is None:
        return None
    if not isinstance(value, int) or not 0 <= value < 1 << 63:
        raise TsdlError(offset, f"{name} must be an unsigned integer, not {value!r}")
    return value


def _struct(values: dict[str, Value | Type], name: str, offset: int) -> StructType | None:
    value = values.get(name)
    if value is not None and not isinstance(value, StructType):
        raise TsdlError(offset, f"{name} must be a structure")
    return value
