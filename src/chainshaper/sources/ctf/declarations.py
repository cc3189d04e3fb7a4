"""Parsing TSDL type declarations (CTF 1.8, sections 4 and 7.3).

`Parser` walks the tokens of one metadata text; what it understands here are types, aliases and
declarators.  The blocks around them (``trace``, ``stream``, ``event``, …) are read by `tsdl`.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import NoReturn

from chainshaper.sources.ctf.attributes import (
    Attributes,
    Value,
    checked_alignment,
    float_type,
    integer_type,
    string_type,
)
from chainshaper.sources.ctf.tokens import Token, TsdlError
from chainshaper.sources.ctf.types import (
    ArrayType,
    EnumMapping,
    EnumType,
    Field,
    IntegerType,
    SequenceType,
    StructType,
    Type,
    VariantType,
    alignment,
)

__all__ = ["Parser", "Scope"]

_DEEPEST = 32


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

    # Types

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
            return string_type(self.attributes() if self.at("{") else {})
        if following == "{" and word in ("integer", "floating_point"):
            offset = self.token.offset
            self.position += 1
            build = integer_type if word == "integer" else float_type
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
        found = self.scope.find(name)
        if found is None:
            self.position = start
            self.fail(f"unknown type {name!r}")
        return found

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
            align = checked_alignment(self.integer(), self.token.offset)
            self.expect(")")
        kind = StructType(tuple(fields), max([align, *(alignment(f.type) for f in fields)]))
        if name:
            self.scope.names[name] = kind
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
            ordered = sorted(names)
            twice = next(a for a, b in pairwise(ordered) if a == b)
            self.fail(f"field {twice!r} declared twice")
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
