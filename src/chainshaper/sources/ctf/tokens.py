"""Splitting TSDL text into tokens (CTF 1.8, appendix C)."""

import re
from typing import Literal, NamedTuple

__all__ = ["Token", "TsdlError", "tokenize"]


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
_MOST = 4_000_000
"""Tokens that fit into memory; a kernel trace with all its events has some 100,000."""
_ESCAPE = re.compile(r"\\(x[0-9a-fA-F]{1,2}|[0-7]{1,3}|.)", re.DOTALL)
_ESCAPES = {"n": "\n", "t": "\t", "r": "\r", "a": "\a", "b": "\b", "f": "\f", "v": "\v"}


def tokenize(text: str) -> list[Token]:
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
                found = _unescape(found[found.index('"') + 1 : -1])
                tokens.append(Token("string", found, position))
            case "character":
                tokens.append(Token("integer", str(ord(_unescape(found[1:-1])[:1])), position))
            case "integer":
                if len(found) > 80:
                    raise TsdlError(position, "integer out of range")
                tokens.append(Token("integer", str(_integer(found)), position))
            case "word" | "mark":
                tokens.append(Token(kind, found, position))
        position = matched.end()
    tokens.append(Token("end", "", position))
    return tokens


def _integer(text: str) -> int:
    digits = text.rstrip("uUlL") if text[:2].lower() != "0b" else text
    if len(digits) > 1 and digits[0] == "0" and digits[1].isdigit():
        try:
            return int(digits, 8)
        except ValueError:
            return int(digits, 10)
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
