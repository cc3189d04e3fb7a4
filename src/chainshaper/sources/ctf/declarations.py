"""Parsing TSDL type declarations (CTF 1.8, sections 4 and 7.3).

`Parser` walks the tokens of one metadata text; what it understands here are types, aliases and
declarators.  The blocks around them (``trace``, ``stream``, ``event``, …) are read by `tsdl`.
"""

# ruff: noqa: PLR0911 - one branch per kind of type

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import NoReturn

from chainshaper.sources.ctf.tokens import Token
from chainshaper.sources.ctf.types import (
    ArrayType,
    ByteOrder,
    EnumMapping,
    EnumType,
    Field,
    FloatType,
    IntegerType,
    SequenceType,
    StringType,
    StructType,
    Type,
    VariantType,
    alignment,
)

__all__ = ["Parser", "Scope", "TsdlError", "Value"]

Value = int | str
_DEEPEST = 32
_BYTE_ORDERS: dict[str, ByteOrder] = {
    "le": "le",
    "be": "be",
    "network": "be",
    "native": "native",
}
_BASES = {"decimal": 10, "dec": 10, "d": 10, "i": 10, "u": 10, "hexadecimal": 16, "hex": 16}
_BASES |= {"x": 16, "X": 16, "p": 16, "octal": 8, "oct": 8, "o": 8, "binary": 2, "b": 2}


class TsdlError(ValueError):
    """Metadata that is no TSDL; ``args`` are the character offset and the reason."""


@dataclass
class Scope:
    """Type names visible at one place: ``struct x``, ``enum x``, ``variant x`` and aliases."""

    parent: Scope | None = None
    names: dict[str, Type] = field(default_factory=dict)

    def find(self, name: str) -> Type | None:
        """The innermost declaration of ``name``."""
        scope: Scope | None = self
        while scope is not None:
            if name in scope.names:
                return scope.names[name]
            scope = scope.parent
        return None


@dataclass
class Parser:
    """A position in a list of tokens and the type names known there."""

    tokens: list[Token]
    position: int = 0
    scope: Scope = field(default_factory=Scope)
    depth: int = 0

    # Tokens

    @property
    def token(self) -> Token:
        """The token at the position."""
        return self.tokens[self.position]

    def fail(self, reason: str) -> NoReturn:
        """Raise `TsdlError` at the position."""
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
        """Step over ``text``, or fail."""
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
        if self.depth >= _DEEPEST:
            self.fail(f"more than {_DEEPEST} nested blocks")
        self.depth += 1
        outer, self.scope = self.scope, Scope(self.scope)
        yield
        self.scope = outer
        self.depth -= 1
        self.expect("}")

    # Values and attributes

    def path(self) -> str:
        """A dotted path such as ``packet.header`` or ``clock.monotonic.value``."""
        parts = [self.take("word")]
        while self.at(".") or self.at("->"):
            self.position += 1
            parts.append(self.take("word"))
        return ".".join(parts)

    def integer(self) -> int:
        """An integer with its sign."""
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

    def attributes(self) -> dict[str, tuple[Value, int]]:
        """``{ name = value; … }`` as a mapping to values and their character offsets."""
        found: dict[str, tuple[Value, int]] = {}
        with self.block():
            while not self.at("}"):
                name = self.path()
                self.expect("=")
                offset = self.token.offset
                found[name] = (self.value(), offset)
                self.expect(";")
        return found

    # Types

    def type(self, *, declares: bool) -> Type:
        """A type specifier; ``declares`` says that a declarator's name follows it."""
        if self.accept("const"):
            return self.type(declares=declares)
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
            return self._string()
        if following == "{" and word == "integer":
            return self._integer()
        if following == "{" and word == "floating_point":
            return self._float()
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
        found = self.scope.find(name)
        if found is None:
            self.position = start
            self.fail(f"unknown type {name!r}")
        return found

    def _attribute(self, found: dict[str, tuple[Value, int]], name: str, default: int) -> int:
        value, offset = found.get(name, (default, 0))
        if not isinstance(value, int):
            raise TsdlError(offset, f"{name} must be an integer, not {value!r}")
        return value

    def _align(self, found: dict[str, tuple[Value, int]], default: int, offset: int) -> int:
        align = self._attribute(found, "align", default)
        if not 0 < align <= 1 << 20 or align & (align - 1):
            raise TsdlError(offset, f"alignment {align} is not a power of two")
        return align

    def _byte_order(self, found: dict[str, tuple[Value, int]]) -> ByteOrder:
        value, offset = found.get("byte_order", ("native", 0))
        if value not in _BYTE_ORDERS:
            raise TsdlError(offset, f"unknown byte order {value!r}")
        return _BYTE_ORDERS[str(value)]

    def _encoding(self, found: dict[str, tuple[Value, int]]) -> str:
        value, offset = found.get("encoding", ("none", 0))
        encoding = str(value).lower().replace("-", "").replace("_", "")
        if encoding not in ("none", "utf8", "ascii"):
            raise TsdlError(offset, f"unknown encoding {value!r}")
        return encoding

    def _integer(self) -> IntegerType:
        offset = self.token.offset
        self.expect("integer")
        found = self.attributes()
        size = self._attribute(found, "size", 0)
        if not 0 < size <= 64:
            raise TsdlError(offset, f"integer of {size} bits; 1 to 64 are supported")
        signed, signed_at = found.get("signed", (0, 0))
        if signed not in (0, 1, "true", "false", "TRUE", "FALSE"):
            raise TsdlError(signed_at, f"signed must be true or false, not {signed!r}")
        base, base_at = found.get("base", (10, 0))
        base = _BASES.get(base, base) if isinstance(base, str) else base
        if base not in (2, 8, 10, 16):
            raise TsdlError(base_at, f"unknown base {base!r}")
        clock = None
        if "map" in found:
            target, target_at = found["map"]
            parts = str(target).split(".")
            if len(parts) != 3 or parts[0] != "clock" or parts[2] != "value":
                raise TsdlError(target_at, f"map must be clock.NAME.value, not {target!r}")
            clock = parts[1]
        return IntegerType(
            size=size,
            align=self._align(found, 1 if size % 8 else 8, offset),
            signed=signed in (1, "true", "TRUE"),
            byte_order=self._byte_order(found),
            base=int(base),
            encoding=self._encoding(found),  # type: ignore[arg-type]
            clock=clock,
        )

    def _float(self) -> FloatType:
        offset = self.token.offset
        self.expect("floating_point")
        found = self.attributes()
        exponent = self._attribute(found, "exp_dig", 0)
        mantissa = self._attribute(found, "mant_dig", 0)
        if (exponent, mantissa) not in ((8, 24), (11, 53)):
            raise TsdlError(
                offset, f"floating point of {exponent} + {mantissa} bits; IEEE 32 or 64 supported"
            )
        size = exponent + mantissa
        return FloatType(size, self._align(found, 8, offset), self._byte_order(found))

    def _string(self) -> StringType:
        self.expect("string")
        found = self.attributes() if self.at("{") else {}
        encoding = self._encoding(found) if "encoding" in found else "utf8"
        return StringType(encoding)  # type: ignore[arg-type]

    def _named(self, keyword: str) -> str:
        """The optional name behind ``struct``, ``variant`` or ``enum``."""
        self.expect(keyword)
        return f"{keyword} {self.take('word')}" if self.token.kind == "word" else ""

    def _lookup(self, name: str) -> Type:
        found = self.scope.find(name) if name else None
        if found is None:
            self.fail(f"unknown type {name!r}" if name else "expected '{'")
        return found

    def _struct(self) -> Type:
        if self.tokens[self.position + 1].text == "align":
            name = ""
            self.expect("struct")
        else:
            name = self._named("struct")
        if not self.at("{"):
            return self._lookup(name)
        fields = self._fields()
        align = 1
        if self.accept("align"):
            self.expect("(")
            align = self.integer()
            if not 0 < align <= 1 << 20 or align & (align - 1):
                self.fail(f"alignment {align} is not a power of two")
            self.expect(")")
        kind = StructType(tuple(fields), align)
        if name:
            self.scope.names[name] = kind
        return replace(kind, align=alignment(kind))

    def _variant(self) -> Type:
        name = self._named("variant")
        tag = None
        if self.accept("<"):
            tag = self.path()
            self.expect(">")
        if self.at("{"):
            kind = VariantType(tag, tuple(self._fields()))
            if name:
                self.scope.names[name] = replace(kind, tag=None)
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
        names = [f.name for f in fields]
        if len(set(names)) != len(names):
            self.fail(f"field {next(n for n in names if names.count(n) > 1)!r} declared twice")
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
            container = self.scope.find("int")
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
            self.scope.names[name] = kind
        return kind

    # Declarations without a field

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
            self.scope.names[" ".join(words)] = kind
        elif self.accept("typedef"):
            kind = self.type(declares=True)
            for declared in self._declarators(kind):
                self.scope.names[declared.name] = declared.type
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
