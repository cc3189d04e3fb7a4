"""Rich's tables for texts of others: they are shown as they are, and nothing more.

Rich takes brackets in texts for its markup, and hands control characters on. Here texts are never
markup; what is to be bold or coloured is a `Text` with a style.
"""

from typing import Any

from rich.console import RenderableType
from rich.table import Table
from rich.text import Text

from chainshaper.values.safe_text import shown

__all__ = ["PlainTable", "plain"]


class PlainTable(Table):
    """A table whose title, caption, headers and cells are what they say."""

    def __setattr__(self, name: str, value: Any) -> None:
        if name in ("title", "caption"):
            value = plain(value, f"table.{name}")
        super().__setattr__(name, value)

    def add_column(
        self, header: RenderableType = "", footer: RenderableType = "", **options: Any
    ) -> None:
        super().add_column(plain(header), plain(footer), **options)

    def add_row(self, *cells: RenderableType | None, **options: Any) -> None:
        super().add_row(*map(plain, cells), **options)


def plain(text: Any, style: str = "") -> Any:
    """A text for Rich that is shown as it is; what is no text stays."""
    return Text(shown(text, but="\n"), style) if isinstance(text, str) else text
