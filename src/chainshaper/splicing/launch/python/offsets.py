"""From the places of Python's syntax tree, lines and bytes, to characters of the text."""

import ast
import io
from dataclasses import dataclass

from chainshaper.splicing.launch.actions import Span

__all__ = ["Offsets"]

_BYTE_ORDER_MARK = "\ufeff"


@dataclass(frozen=True)
class Offsets:
    """A text, its lines with their ends, and the character that each begins with."""

    text: str
    lines: tuple[str, ...]
    starts: tuple[int, ...]

    @classmethod
    def of(cls, text: str) -> "Offsets":
        mark = text.startswith(_BYTE_ORDER_MARK)  # which the syntax tree does not count
        lines = tuple(io.StringIO(text[mark:], newline=""))
        starts = [int(mark)]
        for line in lines:
            starts.append(starts[-1] + len(line))
        return cls(text, lines, tuple(starts))

    def at(self, line: int, byte: int) -> int:
        """The character at a line, counted from 1, and a byte of it."""
        if line > len(self.lines):
            return self.starts[-1]
        return self.starts[line - 1] + len(self.lines[line - 1].encode()[:byte].decode())

    def span(self, node: ast.expr | ast.stmt) -> Span:
        """The characters of a node, without parentheses around it."""
        return Span(
            self.at(node.lineno, node.col_offset),
            self.at(node.end_lineno or node.lineno, node.end_col_offset or 0),
        )

    def written(self, node: ast.expr) -> Span:
        """The characters to replace for another value: those between a plain text's quotes, or
        all of the expression.
        """
        span = self.span(node)
        value = node.value if isinstance(node, ast.Constant) else None
        inner = isinstance(value, str) and self.text[span.start + 1 : span.end - 1] == value
        return Span(span.start + 1, span.end - 1) if inner else span

    def indent(self, position: int) -> str | None:
        """The white space before a position, if there is nothing else on its line."""
        line = self.text[self.text.rfind("\n", 0, position) + 1 : position]
        return line if not line.strip() else None
