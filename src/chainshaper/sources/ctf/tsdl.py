"""Reading TSDL, the language of a trace's metadata (CTF 1.8, sections 4 and 7, appendix C).

Text becomes tokens; `_Parser` walks them and understands types, aliases and declarators; `_Blocks`
reads the blocks around them (``trace``, ``stream``, ``event``, …) into a `TraceClass`.
"""

from __future__ import annotations

import re
from collections import ChainMap, Counter
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import Literal, NamedTuple, NoReturn, TypeVar

from chainshaper.sources.ctf.types import (
    ArrayType,
    ByteOrder,
    Clock,
    Encoding,
    EnumMapping,
    EnumType,
    EventClass,
    Field,
    FloatType,
    IntegerType,
    SequenceType,
    StreamClass,
    StringType,
    StructType,
    TraceClass,
    Type,
    VariantType,
    alignment,
)


class Token(NamedTuple):
    """A token, its text (strings unescaped) and its character offset in the metadata."""

    kind: Literal["word", "integer", "string", "mark", "end"]
    text: str
    offset: int


class TsdlError(ValueError):
    """Metadata that is no TSDL; ``args`` are the character offset and the reason."""


_TOKEN = re.compile(
    r"""
    (?P<space>\s+|/\*.*?\*/|//[^\n]*)
  | (?P<string>L?"(?:[^"\\]|\\.)*")
  | (?P<character>'(?:[^'\\]|\\.[0-9a-fA-F]*)')
  | (?P<integer>0[xX][0-9a-fA-F]+[uUlL]*|0[bB][01]+|[0-9]+[uUlL]*)
  | (?P<word>[A-Za-z_][A-Za-z0-9_]*)
  | (?P<mark>\.\.\.|:=|->|[{}()\[\]<>;,:=.*+-])
    """,
    re.VERBOSE | re.DOTALL,
)
_NANOSECONDS = 1_000_000_000
_MOST = 4_000_000
"""Tokens that fit into memory; a kernel trace with all its events has some 100,000."""
_ESCAPE = re.compile(r"\\(x[0-9a-fA-F]{1,2}|[0-7]{1,3}|.)", re.DOTALL)
_ESCAPES = {"n": "\n", "t": "\t", "r": "\r", "a": "\a", "b": "\b", "f": "\f", "v": "\v"}


def _tokens(text: str) -> list[Token]:
    """The tokens of ``text`` without white space and comments, closed by one of kind ``end``.

    Raises `TsdlError` at the first character that begins no token.
    """
    tokens: list[Token] = []
    position = 0
    while position < len(text):
        if len(tokens) > _MOST:
            raise TsdlError(position, f"more than {_MOST} tokens")
        matched = _TOKEN.match(text, position)
        if matched is None:
            rest = text[position : position + 2]
            reason = "unterminated comment" if rest == "/*" else "unterminated string"
            if rest != "/*" and rest[0] not in "\"'":
                reason = f"unexpected character {rest[0]!r}"
            raise TsdlError(position, reason)
        kind, found = matched.lastgroup, matched.group()
        match kind:
            case "string":
                tokens.append(Token(kind, _unescape(found[found.index('"') + 1 : -1]), position))
            case "character":
                tokens.append(Token("integer", str(ord(_unescape(found[1:-1])[:1])), position))
            case "integer":
                if len(found) > 80:
                    raise TsdlError(position, "integer out of range")
                tokens.append(Token(kind, str(_integer_of(found)), position))
            case "word" | "mark":
                tokens.append(Token(kind, found, position))
        position = matched.end()
    return [*tokens, Token("end", "", position)]


def _integer_of(text: str) -> int:
    digits = text.rstrip("uUlL") if text[:2].lower() != "0b" else text
    if re.fullmatch("0[0-9]+", digits):
        return int(digits, 10 if set(digits) & {"8", "9"} else 8)
    return int(digits, 0)


def _unescape(text: str) -> str:
    def value(match: re.Match[str]) -> str:
        code = match.group(1)
        if code[0] == "x" and len(code) > 1:
            return chr(int(code[1:], 16))
        if code[0] in "01234567":
            return chr(int(code, 8) & 0xFF)
        return _ESCAPES.get(code, code)

    return _ESCAPE.sub(value, text) if "\\" in text else text


Value = int | str
Attributes = dict[str, tuple[Value, int]]
"""Name → value and its character offset."""

_T = TypeVar("_T")
_BYTE_ORDERS: dict[Value, ByteOrder] = {"le": "le", "be": "be", "network": "be", "native": "native"}
_SIGNED: dict[Value, bool] = {
    **dict.fromkeys((0, "false", "FALSE"), False),
    **dict.fromkeys((1, "true", "TRUE"), True),
}
_BASES = {
    name: name  # how a person would like to see it
    for name in (
        *("decimal", "dec", "d", "i", "u", 10, "hexadecimal", "hex", "x", "X", "p", 16),
        *("octal", "oct", "o", 8, "binary", "b", 2),
    )
}
_ENCODINGS: dict[Value, Encoding] = {"none": "none", "utf8": "utf8", "ascii": "ascii"}


def _checked_alignment(align: int, offset: int) -> int:
    """``align`` in bits, if it is one; else `TsdlError`."""
    if not 0 < align <= 1 << 20 or align & (align - 1):
        raise TsdlError(offset, f"alignment {align} is not a power of two")
    return align


def _integer_type(found: Attributes, offset: int) -> IntegerType:
    """``integer { … }``, which begins at character ``offset``; raises `TsdlError`."""
    size = _number(found, "size", 0)
    if not 0 < size <= 64:
        raise TsdlError(offset, f"integer of {size} bits; 1 to 64 are supported")
    _one_of(_BASES, found, "base", 10)
    return IntegerType(
        size=size,
        align=_checked_alignment(_number(found, "align", 1 if size % 8 else 8), offset),
        signed=_one_of(_SIGNED, found, "signed", 0),
        byte_order=_one_of(_BYTE_ORDERS, found, "byte_order", "native"),
        encoding=_encoding(found, "none"),
        clock=_clock(found),
    )


def _clock(found: Attributes) -> str | None:
    if "map" not in found:
        return None
    target, offset = found["map"]
    parts = str(target).split(".")
    if len(parts) != 3 or parts[0] != "clock" or parts[2] != "value":
        raise TsdlError(offset, f"map must be clock.NAME.value, not {target!r}")
    return parts[1]


def _float_type(found: Attributes, offset: int) -> FloatType:
    """``floating_point { … }``, which begins at character ``offset``; raises `TsdlError`."""
    exponent, mantissa = _number(found, "exp_dig", 0), _number(found, "mant_dig", 0)
    if (exponent, mantissa) not in ((8, 24), (11, 53)):
        raise TsdlError(
            offset, f"floating point of {exponent} + {mantissa} bits; IEEE 32 or 64 supported"
        )
    align = _checked_alignment(_number(found, "align", 8), offset)
    return FloatType(
        exponent + mantissa, align, _one_of(_BYTE_ORDERS, found, "byte_order", "native")
    )


def _string_type(found: Attributes) -> StringType:
    """``string``, with or without attributes; raises `TsdlError`."""
    return StringType(_encoding(found, "utf8"))


def _number(found: Attributes, name: str, default: int) -> int:
    value, offset = found.get(name, (default, 0))
    if not isinstance(value, int):
        raise TsdlError(offset, f"{name} must be an integer, not {value!r}")
    return value


def _one_of(choices: Mapping[Value, _T], found: Attributes, name: str, default: Value) -> _T:
    value, offset = found.get(name, (default, 0))
    if value not in choices:
        known = ", ".join(map(str, choices))
        raise TsdlError(offset, f"unknown {name.replace('_', ' ')} {value!r}: none of {known}")
    return choices[value]


def _encoding(found: Attributes, default: Encoding) -> Encoding:
    plain: Attributes = {
        name: (str(value).lower().replace("-", "").replace("_", ""), offset)
        for name, (value, offset) in found.items()
    }
    return _one_of(_ENCODINGS, plain, "encoding", default)


_DEEPEST = 32


@dataclass
class _Parser:
    """A position in a list of tokens and the type names known there."""

    tokens: list[Token]
    position: int = 0
    scope: ChainMap[str, Type] = field(default_factory=ChainMap)

    @property
    def token(self) -> Token:
        return self.tokens[self.position]

    def fail(self, reason: str) -> NoReturn:
        raise TsdlError(self.token.offset, reason)

    def at(self, text: str) -> bool:
        """Whether the token is the word or mark ``text``."""
        return self.token.text == text and self.token.kind in ("word", "mark")

    def accept(self, text: str) -> bool:
        """Step over ``text`` where it stands here."""
        found = self.at(text)
        self.position += found
        return found

    def expect(self, text: str) -> None:
        if not self.accept(text):
            self.fail(f"expected {text!r}, found {self.token.text!r}")

    def take(self, kind: str) -> str:
        """Step over a token of a kind and return its text, or fail."""
        token = self.token
        if token.kind != kind:
            self.fail(f"expected a {kind}, found {token.text!r}")
        self.position += 1
        return token.text

    @contextmanager
    def block(self) -> Iterator[None]:
        """Braces with a type scope of their own; nesting is bounded against hostile files."""
        self.expect("{")
        if len(self.scope.maps) > _DEEPEST:
            self.fail(f"more than {_DEEPEST} nested blocks")
        self.scope = self.scope.new_child()
        yield
        self.scope = self.scope.parents
        self.expect("}")

    def path(self) -> str:
        """A dotted path such as ``packet.header`` or ``clock.monotonic.value``."""
        parts = [self.take("word")]
        while self.at(".") or self.at("->"):
            self.position += 1
            parts.append(self.take("word"))
        return ".".join(parts)

    def integer(self) -> int:
        negative = False
        while self.at("-") or self.at("+"):
            negative ^= self.at("-")
            self.position += 1
        value = int(self.take("integer"))
        return -value if negative else value

    def value(self) -> Value:
        """The right-hand side of ``name = value``: integer, string or path."""
        if self.token.kind == "string":
            parts = [self.take("string")]
            while self.token.kind == "string":
                parts.append(self.take("string"))
            return "".join(parts)
        if self.token.kind == "word":
            return self.path()
        return self.integer()

    def attributes(self) -> Attributes:
        """``{ name = value; … }`` as a mapping to values and their character offsets."""
        found: Attributes = {}
        with self.block():
            while not self.at("}"):
                name = self.path()
                self.expect("=")
                offset = self.token.offset
                found[name] = (self.value(), offset)
                self.expect(";")
        return found

    def type(self, *, declares: bool) -> Type:
        """A type specifier; ``declares`` says that a declarator's name follows it."""
        while self.accept("const"):
            pass
        if self.token.kind != "word":
            self.fail(f"expected a type, found {self.token.text!r}")
        word, following = self.token.text, self.tokens[self.position + 1].text
        if word == "struct":
            return self._struct()
        if word == "variant":
            return self._variant()
        if word == "enum":
            return self._enum()
        if word == "string":
            self.position += 1
            return _string_type(self.attributes() if self.at("{") else {})
        if following == "{" and word in ("integer", "floating_point"):
            offset = self.token.offset
            self.position += 1
            build = _integer_type if word == "integer" else _float_type
            return build(self.attributes(), offset)
        return self._alias(declares)

    def _alias(self, declares: bool) -> Type:
        start = self.position
        words: list[str] = []
        while self.token.kind == "word" or (self.at("*") and words):
            words.append(self.token.text)
            self.position += 1
        if declares and len(words) > 1:
            words.pop()
            self.position -= 1
        name = " ".join(word for word in words if word != "const")
        found = self.scope.get(name)
        if found is None:
            self.position = start
            self.fail(f"unknown type {name!r}")
        return found

    def _named(self, keyword: str) -> str:
        """The optional name behind ``struct``, ``variant`` or ``enum``."""
        self.expect(keyword)
        named = self.token.kind == "word" and not (keyword == "struct" and self.at("align"))
        return f"{keyword} {self.take('word')}" if named else ""

    def _lookup(self, name: str) -> Type:
        found = self.scope.get(name) if name else None
        if found is None:
            self.fail(f"unknown type {name!r}" if name else "expected '{'")
        return found

    def _struct(self) -> Type:
        name = self._named("struct")
        if not self.at("{"):
            return self._lookup(name)
        fields = self._fields()
        align = 1
        if self.accept("align"):
            self.expect("(")
            align = _checked_alignment(self.integer(), self.token.offset)
            self.expect(")")
        kind = StructType(tuple(fields), max([align, *(alignment(f.type) for f in fields)]))
        if name:
            self.scope[name] = kind
        return kind

    def _variant(self) -> Type:
        name = self._named("variant")
        tag = None
        if self.accept("<"):
            tag = self.path()
            self.expect(">")
        if self.at("{"):
            kind = VariantType(tag, tuple(self._fields()))
            if name:
                self.scope[name] = replace(kind, tag=None)
            return kind
        found = self._lookup(name)
        if not isinstance(found, VariantType):
            self.fail(f"{name!r} is no variant")
        return replace(found, tag=tag)

    def _fields(self) -> list[Field]:
        fields: list[Field] = []
        with self.block():
            while not self.at("}"):
                if not self.declaration():
                    kind = self.type(declares=True)
                    fields.extend(self._declarators(kind))
                    self.expect(";")
                if len(fields) > 10_000:
                    self.fail("more than 10000 fields")
        for name, count in Counter(f.name for f in fields).most_common(1):
            if count > 1:
                self.fail(f"field {name!r} declared twice")
        return fields

    def _declarators(self, kind: Type) -> Iterator[Field]:
        while True:
            name = self.take("word")
            lengths: list[int | str] = []
            while self.accept("["):
                length: int | str
                length = self.path() if self.token.kind == "word" else self.integer()
                if isinstance(length, int) and not 0 <= length <= 1 << 31:
                    self.fail(f"array of {length} elements")
                lengths.append(length)
                self.expect("]")
            if len(lengths) > _DEEPEST:
                self.fail("array of too many dimensions")
            element = kind
            for length in reversed(lengths):
                if isinstance(length, int):
                    element = ArrayType(element, length)
                else:
                    element = SequenceType(element, length)
            yield Field(name, element)
            if not self.accept(","):
                return

    def _enum(self) -> Type:
        name = self._named("enum")
        container: Type | None = None
        if self.accept(":"):
            container = self.type(declares=False)
        if not self.at("{"):
            return self._lookup(name)
        if container is None:
            container = self.scope.get("int")
        if isinstance(container, EnumType):
            container = container.container
        if not isinstance(container, IntegerType):
            self.fail("an enumeration needs an integer type")
        mappings: list[EnumMapping] = []
        following = 0
        self.expect("{")
        while not self.at("}"):
            label = self.take("string" if self.token.kind == "string" else "word")
            low = high = following
            if self.accept("="):
                low = high = self.integer()
                if self.accept("..."):
                    high = self.integer()
            if high < low:
                self.fail(f"range {low} ... {high} of {label!r} is empty")
            mappings.append(EnumMapping(label, low, high))
            following = high + 1
            if not self.accept(","):
                break
        self.expect("}")
        kind = EnumType(container, tuple(mappings))
        if name:
            self.scope[name] = kind
        return kind

    def declaration(self) -> bool:
        """Read ``typealias``, ``typedef`` or a lone named type; False where none stands here."""
        if self.accept("typealias"):
            kind = self.type(declares=False)
            dimensions = list(self._declarators(kind)) if not self.at(":=") else []
            kind = dimensions[0].type if dimensions else kind
            self.expect(":=")
            words: list[str] = []
            while not self.at(";"):
                words.append(self.token.text)
                if self.token.kind == "end":
                    self.fail("expected ';'")
                self.position += 1
            self.scope[" ".join(words)] = kind
        elif self.accept("typedef"):
            kind = self.type(declares=True)
            for declared in self._declarators(kind):
                self.scope[declared.name] = declared.type
        elif self.token.text in ("struct", "variant", "enum") and self.token.kind == "word":
            start = self.position
            self.type(declares=False)
            if not self.at(";"):
                self.position = start
                return False
        else:
            return False
        self.expect(";")
        return True


def parse_tsdl(text: str) -> TraceClass:
    """Parse a whole metadata text.

    Raises `TsdlError` with the character offset and the reason where the text is no TSDL, names
    something undeclared, or declares something twice.
    """
    parser = _Parser(_tokens(text))
    blocks = _Blocks(parser)
    while parser.token.kind != "end":
        blocks.read()
    return blocks.finish()


class _Blocks:
    """The blocks read so far; classes are put together at the end, in any order of blocks."""

    def __init__(self, parser: _Parser) -> None:
        self.parser = parser
        self.trace: dict[str, Value | Type] | None = None
        self.env: dict[str, str | int] = {}
        self.clocks: dict[str, Clock] = {}
        self.streams: dict[int, StreamClass] = {}
        self.events: dict[tuple[int | None, int | None], tuple[EventClass, int]] = {}

    def read(self) -> None:
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

    def _clock(self, values: Attributes, offset: int) -> None:
        name = values.get("name", (None, 0))[0]
        frequency = _number(values, "freq", _NANOSECONDS)
        if not isinstance(name, str):
            raise TsdlError(offset, "clock without a name")
        if not 0 < frequency <= 10**10:
            raise TsdlError(offset, f"clock frequency of {frequency} Hz; up to 10 GHz supported")
        seconds, cycles = _number(values, "offset_s", 0), _number(values, "offset", 0)
        self.clocks[name] = Clock(
            name=name,
            frequency=frequency,
            offset_ns=seconds * _NANOSECONDS + cycles * _NANOSECONDS // frequency,
            uuid=str(values["uuid"][0]) if "uuid" in values else None,
        )

    def _stream(self, values: dict[str, Value | Type], offset: int) -> None:
        identifier = _integer(values, "id", offset) or 0
        if identifier in self.streams:
            raise TsdlError(offset, f"stream {identifier} declared twice")
        scopes = ("packet.context", "event.header", "event.context")
        packet, header, context = (_struct(values, scope, offset) for scope in scopes)
        self.streams[identifier] = StreamClass(identifier, packet, header, context)

    def _event(self, values: dict[str, Value | Type], offset: int) -> None:
        stream_id = _integer(values, "stream_id", offset)
        identifier = _integer(values, "id", offset)
        name = values.get("name")
        if not isinstance(name, str):
            raise TsdlError(offset, "event without a name")
        if (stream_id, identifier) in self.events:
            raise TsdlError(offset, f"event {name!r}: id {identifier} declared twice")
        context, fields = (_struct(values, scope, offset) for scope in ("context", "fields"))
        event = EventClass(identifier or 0, name, context, fields)
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
