"""Parse a trace's metadata, a text in TSDL (CTF 1.8, sections 4 and 7, appendix C).

`parse_tsdl` returns a `TraceClass`: what the text declares. Names stay as TSDL writes them, with
LTTng's leading underscore; `field_name` returns the name that users see. Sizes and alignments are
in bits.
"""

from __future__ import annotations

import re
from collections import ChainMap, Counter
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, NamedTuple, NoReturn, TypeVar

from chainshaper.values.errors import InputError

_T = TypeVar("_T")


class CtfError(InputError):
    """A trace that cannot be read: which file or folder, where in it (bytes), why, what to do."""

    def __init__(self, path: Path | str, offset: int | None, reason: str, remedy: str = "") -> None:
        self.path, self.offset = Path(path), offset
        place = f"{path}" if offset is None else f"{path}, byte {offset}"
        super().__init__(f"{place}: {reason}" + (f" ({remedy})" if remedy else ""))


class TsdlError(ValueError):
    """Metadata that is no TSDL; ``args`` are the character offset and the reason."""


@dataclass(frozen=True, slots=True)
class IntegerType:
    """``integer { … }`` (section 4.1.5), or ``enum`` (4.1.8)."""

    size: int
    align: int
    signed: bool = False
    byte_order: Literal["native", "le", "be"] = "native"
    encoded: bool = False  # whether it is a character, in UTF-8 or ASCII
    clock: str | None = None  # the name of the clock that it is mapped to
    # Of an enumeration, each label with its range of values (lowest, highest); ranges may overlap.
    # Types that differ in labels only are equal, since their values have the same bits.
    mappings: tuple[tuple[str, int, int], ...] = field(default=(), compare=False)


@dataclass(frozen=True, slots=True)
class StringType:
    """``string`` (section 4.2.5): bytes up to and including the first NUL."""


@dataclass(frozen=True, slots=True)
class ArrayType:
    """``T name[length]``: an array (section 4.2.3), or a sequence (4.2.4)."""

    element: Type
    length: int | str  # of a sequence, the path of the field that has it as written: ``a.b.c``


class Field(NamedTuple):
    """A field of a structure, or an option of a variant."""

    name: str
    type: Type


@dataclass(frozen=True, slots=True)
class StructType:
    """``struct { … } align(n)`` (section 4.2.1).

    ``floating_point`` (4.1.7) is a structure with one integer: neither gets a column.
    """

    fields: tuple[Field, ...] = ()
    align: int = 1  # at least ``n``, and at least that of each field


@dataclass(frozen=True, slots=True)
class VariantType:
    """``variant <tag> { … }`` (section 4.2.2)."""

    tag: str | None  # the path of the field that says which option follows, as written
    options: tuple[Field, ...]


Type = IntegerType | StringType | ArrayType | StructType | VariantType


@dataclass(frozen=True, slots=True)
class Clock:
    """``clock { … }`` (section 8)."""

    name: str
    frequency: int = 1_000_000_000  # Hz
    offset_ns: int = 0  # of its zero from the Epoch
    uuid: str | None = None


@dataclass(frozen=True, slots=True)
class EventClass:
    """``event { … }`` (section 7.2)."""

    id: int
    name: str
    context: StructType | None = None
    fields: StructType | None = None


@dataclass(frozen=True, slots=True)
class StreamClass:
    """``stream { … }`` (section 7.2) with its event classes by id."""

    id: int
    packet_context: StructType | None = None
    event_header: StructType | None = None
    event_context: StructType | None = None
    events: dict[int, EventClass] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class TraceClass:
    """Everything that a file ``metadata`` declares, and the folder that it is in."""

    byte_order: Literal["le", "be"]
    uuid: str | None
    packet_header: StructType | None
    env: Mapping[str, str | int]
    clocks: Mapping[str, Clock]
    streams: Mapping[int, StreamClass]
    referenced: frozenset[str]  # names of the fields that lengths and tags refer to
    path: Path = Path()

    @property
    def clock(self) -> Clock:
        """The first clock that is declared; one of 1 GHz if there is none."""
        return next(iter(self.clocks.values()), Clock("none"))


def field_name(name: str) -> str:
    """Return the name that users see: without one leading underscore, as babeltrace2 shows it."""
    return name.removeprefix("_") or name


def alignment(kind: Type) -> int:
    """Return the alignment of a type in bits (sections 4.1.2, 4.2); a variant has none: 1."""
    match kind:
        case ArrayType(element):
            return alignment(element)
        case IntegerType(align=align) | StructType(align=align):
            return align
    return 8 if isinstance(kind, StringType) else 1


def is_text(kind: Type) -> bool:
    """Whether values are texts: a string, or an array of encoded bytes."""
    match kind:
        case StringType() | ArrayType(IntegerType(8, 8, encoded=True)):
            return True
    return False


# Tokens


class Token(NamedTuple):
    """A piece of the text that belongs together: a word, a number, a string, a mark."""

    kind: str  # "word", "integer", "string", "mark" or "end"
    text: str  # of a string without quotes and escapes; of an integer in decimal digits
    offset: int  # in characters


_TOKEN = re.compile(
    r"""
    (?P<space>\s+|/\*.*?\*/|//[^\n]*)
  | (?P<string>L?"(?:[^"\\]|\\.)*")
  | (?P<character>'(?:[^'\\]|\\.[0-9a-fA-F]*)')
  | (?P<integer>0[xX][0-9a-fA-F]+[uUlL]*|0[bB][01]+|[0-9]+[uUlL]*)
  | (?P<word>[A-Za-z_][A-Za-z0-9_]*)
  | (?P<mark>\.\.\.|:=|->|[{}()\[\]<>;,:=.*+-])
  | (?P<wrong>.)
    """,
    re.VERBOSE | re.DOTALL,
)
_MOST_TOKENS = 4_000_000
"""Tokens that fit into memory; a kernel trace with all its events has some 100,000."""
_ESCAPE = re.compile(r"\\(?:x([0-9a-fA-F]{1,2})|([0-7]{1,3})|(.))", re.DOTALL)
_ESCAPES = {"n": "\n", "t": "\t", "r": "\r", "a": "\a", "b": "\b", "f": "\f", "v": "\v"}


def _tokens(text: str) -> list[Token]:
    """Cut ``text`` into tokens, without white space and comments; the last is of kind ``end``."""
    tokens: list[Token] = []
    for match in _TOKEN.finditer(text):
        kind, piece, offset = str(match.lastgroup), match.group(), match.start()
        if len(tokens) > _MOST_TOKENS:
            raise TsdlError(offset, f"more than {_MOST_TOKENS} tokens")
        match kind:
            case "space":
                continue
            case "wrong":
                reason = f"unexpected character {piece!r}"
                if piece in "\"'":
                    reason = "unterminated string"
                elif text.startswith("/*", offset):
                    reason = "unterminated comment"
                raise TsdlError(offset, reason)
            case "string":
                piece = _unescape(piece[piece.index('"') + 1 : -1])
            case "character":
                kind, piece = "integer", str(ord(_unescape(piece[1:-1])[:1]))
            case "integer":
                if len(piece) > 80:
                    raise TsdlError(offset, "integer out of range")
                digits = piece.rstrip("uUlL")
                octal = digits[0] == "0" and re.fullmatch("0[0-7]+", digits)
                piece = str(int(digits, 8 if octal else 10 if digits.isdecimal() else 0))
        tokens.append(Token(kind, piece, offset))
    return [*tokens, Token("end", "", len(text))]


def _unescape(text: str) -> str:
    """Replace the escape sequences of C in a string or character."""

    def value(match: re.Match[str]) -> str:
        hexadecimal, octal, character = match.groups()
        if character is not None:
            return _ESCAPES.get(character, character)
        return chr(int(hexadecimal, 16) if hexadecimal else int(octal, 8) & 0xFF)

    return _ESCAPE.sub(value, text)


# Blocks and basic types

# Attribute → the values that it may have in TSDL → what each means. The first is the default.
_CHOICES: dict[str, dict[int | str, Any]] = {
    "byte_order": {"native": "native", "le": "le", "be": "be", "network": "be"},
    "signed": {0: False, "false": False, "FALSE": False, 1: True, "true": True, "TRUE": True},
    "encoding": {"none": False, "utf8": True, "ascii": True},
}


class _Block(dict[str, tuple[int | str | Type, int]]):
    """``{ name = value; name := type; … }``: name → (value, its offset); and the block's offset.

    The methods return an attribute's value, or a default where the block does not have it. They
    raise TsdlError where the value is of another kind.
    """

    offset = 0

    def typed(self, name: str, wanted: type[_T], kind: str) -> _T | None:
        """Return a value of a type, which messages call ``kind``."""
        value, offset = self.get(name, (None, 0))
        if value is not None and not isinstance(value, wanted):
            given = repr(value) if isinstance(value, int | str) else "a type"
            raise TsdlError(offset, f"{name} must be {kind}, not {given}")
        return value

    def struct(self, name: str) -> StructType | None:
        return self.typed(name, StructType, "a structure")

    def number(self, name: str, default: int = 0) -> int:
        value = self.typed(name, int, "an integer")
        return default if value is None else value

    def identifier(self, name: str, default: int = 0) -> int:
        value = self.number(name, default)
        if not 0 <= value < 1 << 63:
            raise TsdlError(self[name][1], f"{name} must be an unsigned integer, not {value}")
        return value

    def text(self, name: str) -> str | None:
        value = self.get(name, (None, 0))[0]
        return value if isinstance(value, str) else None

    def choice(self, name: str) -> Any:
        """Return what the value of an attribute of :data:`_CHOICES` means."""
        choices = _CHOICES[name]
        value, offset = self.get(name, (next(iter(choices)), 0))
        if isinstance(value, str) and name == "encoding":
            value = re.sub("[-_]", "", value.lower())
        if not isinstance(value, int | str) or value not in choices:
            known = ", ".join(map(str, choices))
            raise TsdlError(offset, f"unknown {name.replace('_', ' ')} {value!r}: none of {known}")
        return choices[value]

    def alignment(self, default: int) -> int:
        return _checked_alignment(self.number("align", default), self.offset)

    def integer_type(self) -> IntegerType:
        """Return the type that this block of ``integer { … }`` describes."""
        size = self.number("size")
        if not 0 < size <= 64:
            raise TsdlError(self.offset, f"integer of {size} bits; 1 to 64 are supported")
        target, place = self.get("map", (None, 0))
        clock = re.fullmatch(r"clock\.([^.]*)\.value", str(target))
        if target is not None and clock is None:
            raise TsdlError(place, f"map must be clock.NAME.value, not {target!r}")
        align, order = self.alignment(1 if size % 8 else 8), self.choice("byte_order")
        signed, encoded = self.choice("signed"), self.choice("encoding")
        return IntegerType(size, align, signed, order, encoded, clock and clock[1])

    def float_type(self) -> StructType:
        """Return the type that this block of ``floating_point { … }`` describes."""
        exponent, mantissa = self.number("exp_dig"), self.number("mant_dig")
        if (exponent, mantissa) not in ((8, 24), (11, 53)):
            given = f"floating point of {exponent} + {mantissa} bits"
            raise TsdlError(self.offset, f"{given}; IEEE 32 or 64 supported")
        self.choice("byte_order")
        align = self.alignment(8)
        return StructType((Field("bits", IntegerType(exponent + mantissa, align)),), align)


def _checked_alignment(align: int, offset: int) -> int:
    if not 0 < align <= 1 << 20 or align & (align - 1):
        raise TsdlError(offset, f"alignment {align} is not a power of two")
    return align


# Grammar

_DEEPEST = 32
"""Blocks inside blocks, and dimensions of arrays: hostile metadata must not exhaust the stack."""
_DECLARING = frozenset(("typealias", "typedef", "struct", "variant", "enum"))


@dataclass
class _Parser:
    """Reads a list of tokens from front to back: a method for each thing of the grammar."""

    tokens: list[Token]
    position: int = 0  # of the next token
    scope: ChainMap[str, Type] = field(default_factory=ChainMap)  # types with a name, by name
    referenced: set[str] = field(default_factory=set)  # names of fields in lengths and tags

    @property
    def token(self) -> Token:
        """The next token."""
        return self.tokens[self.position]

    def fail(self, reason: str) -> NoReturn:
        raise TsdlError(self.token.offset, reason)

    def at(self, text: str) -> bool:
        """Whether the next token is the word or mark ``text``."""
        return self.token.text == text and self.token.kind in ("word", "mark")

    def accept(self, text: str) -> bool:
        """Go over the word or mark ``text`` if it is the next token; whether it is."""
        if not self.at(text):
            return False
        self.position += 1
        return True

    def expect(self, text: str) -> None:
        """Go over the word or mark ``text``, which must be the next token."""
        if not self.accept(text):
            self.fail(f"expected {text!r}, found {self.token.text!r}")

    def take(self, kind: str) -> str:
        """Go over the next token, which must be of a kind; return its text."""
        token = self.token
        if token.kind != kind:
            self.fail(f"expected a {kind}, found {token.text!r}")
        self.position += 1
        return token.text

    @contextmanager
    def braces(self) -> Iterator[None]:
        """Go over braces, in which names of types may be declared that end with them."""
        self.expect("{")
        if len(self.scope.maps) > _DEEPEST:
            self.fail(f"more than {_DEEPEST} nested blocks")
        self.scope = self.scope.new_child()
        yield
        self.scope = self.scope.parents
        self.expect("}")

    def path(self) -> str:
        """Read ``a.b->c``; return it with dots."""
        parts = [self.take("word")]
        while self.accept(".") or self.accept("->"):
            parts.append(self.take("word"))
        return ".".join(parts)

    def reference(self) -> str:
        """Read the path of a field that a length or tag refers to."""
        path = self.path()
        self.referenced.add(path.rpartition(".")[2])
        return path

    def integer(self) -> int:
        sign = 1
        while self.at("-") or self.at("+"):
            sign = -sign if self.at("-") else sign
            self.position += 1
        return sign * int(self.take("integer"))

    def value(self) -> int | str:
        """Read what stands behind ``=``: strings in a row, which are one; a path; an integer."""
        text = ""
        if self.token.kind == "string":
            while self.token.kind == "string":
                text += self.take("string")
            return text
        return self.path() if self.token.kind == "word" else self.integer()

    def block(self) -> _Block:
        """Read ``{ name = value; name := type; … }``, in which types may be declared too."""
        block = _Block()
        block.offset = self.tokens[self.position - 1].offset
        with self.braces():
            while not self.at("}"):
                if self.declaration():
                    continue
                offset, name = self.token.offset, self.path()
                if name in block:
                    raise TsdlError(offset, f"{name} given twice")
                typed = self.accept(":=")
                if not typed:
                    self.expect("=")
                offset = self.token.offset
                block[name] = (self.type(declares=False) if typed else self.value(), offset)
                self.expect(";")
        return block

    def type(self, *, declares: bool) -> Type:
        """Read a type; ``declares``: the name of what has this type follows, and is not read."""
        while self.accept("const"):
            pass
        if self.token.kind != "word":
            self.fail(f"expected a type, found {self.token.text!r}")
        start, word = self.position, self.token.text
        self.position += 1
        match word:
            case "struct" | "variant" | "enum":
                return self._compound(word)
            case "string":
                if self.at("{"):
                    self.block().choice("encoding")
                return StringType()
            case "integer" if self.at("{"):
                return self.block().integer_type()
            case "floating_point" if self.at("{"):
                return self.block().float_type()
        words = [word]
        while self.token.kind == "word" or self.at("*"):
            words.append(self.token.text)
            self.position += 1
        if declares and len(words) > 1:
            words.pop()
            self.position -= 1
        name = " ".join(word for word in words if word != "const")
        if name not in self.scope:
            self.position = start
            self.fail(f"unknown type {name!r}")
        return self.scope[name]

    def _compound(self, keyword: str) -> Type:
        """Read what follows ``struct``, ``variant`` or ``enum``: a name, a body, or both."""
        name, tag, container = "", None, self.scope.get("int")
        if self.token.kind == "word" and not (keyword == "struct" and self.at("align")):
            name = f"{keyword} {self.take('word')}"
        if keyword == "variant" and self.accept("<"):
            tag = self.reference()
            self.expect(">")
        if keyword == "enum" and self.accept(":"):
            container = self.type(declares=False)
        kind: Type
        if not self.at("{"):
            if name not in self.scope:
                self.fail(f"unknown type {name!r}" if name else "expected '{'")
            kind = self.scope[name]
        else:
            if keyword == "struct":
                kind = self._struct()
            elif keyword == "variant":
                kind = VariantType(None, self._fields())
            else:
                kind = self._enum(container)
            if name:
                self.scope[name] = kind
        return replace(kind, tag=tag) if isinstance(kind, VariantType) else kind

    def _struct(self) -> StructType:
        fields, align = self._fields(), 1
        if self.accept("align"):
            self.expect("(")
            align = _checked_alignment(self.integer(), self.token.offset)
            self.expect(")")
        return StructType(fields, max([align, *(alignment(f.type) for f in fields)]))

    def _fields(self) -> tuple[Field, ...]:
        fields: list[Field] = []
        with self.braces():
            while not self.at("}"):
                if not self.declaration():
                    fields.extend(self._declarators(self.type(declares=True)))
                    self.expect(";")
                if len(fields) > 10_000:
                    self.fail("more than 10000 fields")
        for name, count in Counter(f.name for f in fields).most_common(1):
            if count > 1:
                self.fail(f"field {name!r} declared twice")
        return tuple(fields)

    def _declarators(self, kind: Type) -> Iterator[Field]:
        """Read ``name``, ``name[length]`` …, with commas between them."""
        more = True
        while more:
            name = self.take("word")
            lengths: list[int | str] = []
            while self.accept("["):
                length = self.reference() if self.token.kind == "word" else self.integer()
                if isinstance(length, int) and not 0 <= length <= 1 << 31:
                    self.fail(f"array of {length} elements")
                lengths.append(length)
                self.expect("]")
            if len(lengths) > _DEEPEST:
                self.fail("array of too many dimensions")
            element = kind
            for length in reversed(lengths):
                element = ArrayType(element, length)
            yield Field(name, element)
            more = self.accept(",")

    def _enum(self, container: Type | None) -> IntegerType:
        if not isinstance(container, IntegerType):
            self.fail("an enumeration needs an integer type")
        mappings: list[tuple[str, int, int]] = []
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
            mappings.append((label, low, high))
            following = high + 1
            if not self.accept(","):
                break
        self.expect("}")
        return replace(container, mappings=tuple(mappings))

    def declaration(self) -> bool:
        """Read ``typealias``, ``typedef`` or a lone named type; False where none stands here."""
        start = self.position
        if self.token.text not in _DECLARING or self.token.kind != "word":
            return False
        if self.accept("typealias"):
            kind = self.type(declares=False)
            if not self.at(":="):
                kind = next(self._declarators(kind)).type
            self.expect(":=")
            words: list[str] = []
            while not self.at(";"):
                words.append(self.token.text)
                if self.token.kind == "end":
                    self.fail("expected ';'")
                self.position += 1
            self.scope[" ".join(words)] = kind
        elif self.accept("typedef"):
            for declared in self._declarators(self.type(declares=True)):
                self.scope[declared.name] = declared.type
        else:
            self.type(declares=False)
            if not self.at(";"):
                self.position = start
                return False
        self.expect(";")
        return True


def parse_tsdl(text: str) -> TraceClass:
    """Parse a whole metadata text; blocks may come in any order.

    Raises `TsdlError` with the character offset and the reason where the text is no TSDL, names
    something undeclared, or declares something twice.
    """
    parser = _Parser(_tokens(text))
    kinds = ("trace", "env", "clock", "callsite", "stream", "event")
    blocks: dict[str, list[_Block]] = {kind: [] for kind in kinds}
    while parser.token.kind != "end":
        if parser.declaration():
            continue
        offset, keyword = parser.token.offset, parser.take("word")
        if keyword not in blocks:
            raise TsdlError(offset, f"unknown block {keyword!r}")
        blocks[keyword].append(parser.block())
        parser.expect(";")
    if not blocks["trace"]:
        raise TsdlError(0, "no trace block")
    trace, *further = blocks["trace"]
    if further:
        raise TsdlError(further[0].offset, "a second trace block")
    order = trace.text("byte_order")
    if order not in ("le", "be", "network"):
        raise TsdlError(0, f"trace byte_order must be le or be, not {order!r}")
    environment = {name: value for block in blocks["env"] for name, (value, _) in block.items()}
    clocks = map(_clock, blocks["clock"])
    return TraceClass(
        byte_order="le" if order == "le" else "be",
        uuid=trace.text("uuid"),
        packet_header=trace.struct("packet.header"),
        env={name: value for name, value in environment.items() if isinstance(value, int | str)},
        clocks={clock.name: clock for clock in clocks},
        streams=_streams(blocks["stream"], blocks["event"]),
        referenced=frozenset(parser.referenced),
    )


_LARGEST_OFFSET_NS = 1 << 62
"""So that a time and its offset, added, are still a number of 64 bits."""


def _clock(block: _Block) -> Clock:
    name, frequency = block.text("name"), block.number("freq", 1_000_000_000)
    if name is None:
        raise TsdlError(block.offset, "clock without a name")
    if not 0 < frequency <= 10**10:
        raise TsdlError(block.offset, f"clock frequency of {frequency} Hz; up to 10 GHz supported")
    seconds, cycles = block.number("offset_s"), block.number("offset")
    offset_ns = seconds * 1_000_000_000 + cycles * 1_000_000_000 // frequency
    if abs(offset_ns) > _LARGEST_OFFSET_NS:
        years = f"{abs(offset_ns) // (365 * 86_400 * 1_000_000_000)} years"
        raise TsdlError(
            block.offset, f"clock offset of {years} from the Epoch; up to 146 supported"
        )
    return Clock(name, frequency, offset_ns, block.text("uuid"))


def _streams(blocks: list[_Block], events: list[_Block]) -> dict[int, StreamClass]:
    """Return the stream classes by id, each with its event classes.

    An event that names no stream is of the only one, or of stream 0.
    """
    streams: dict[int, StreamClass] = {}
    for block in blocks:
        identifier = block.identifier("id")
        if identifier in streams:
            raise TsdlError(block.offset, f"stream {identifier} declared twice")
        names = ("packet.context", "event.header", "event.context")
        packet, header, context = map(block.struct, names)
        streams[identifier] = StreamClass(identifier, packet, header, context)
    streams = streams or {0: StreamClass(0)}
    only = next(iter(streams)) if len(streams) == 1 else 0
    for block in events:
        name, identifier = block.text("name"), block.identifier("id")
        if name is None:
            raise TsdlError(block.offset, "event without a name")
        stream = streams.get(block.identifier("stream_id", only))
        if stream is None:
            undeclared = f"of undeclared stream {block.identifier('stream_id', only)}"
            raise TsdlError(block.offset, f"event {name!r} {undeclared}")
        if identifier in stream.events:
            raise TsdlError(block.offset, f"event {name!r}: id {identifier} declared twice")
        context, fields = block.struct("context"), block.struct("fields")
        stream.events[identifier] = EventClass(identifier, name, context, fields)
    return streams
