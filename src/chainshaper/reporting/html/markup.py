"""The few pieces of HTML that the report's tables are made of; every text is escaped here."""

from collections.abc import Sequence

from chainshaper.values.safe_text import escape

__all__ = ["Group", "details", "listed", "paragraph", "section", "table"]


class Group(str):
    """A row that heads the rows below it."""


Row = Group | Sequence[str]


def section(identifier: str, title: str, *contents: str) -> str:
    """A titled part of the page."""
    body = "\n".join(content for content in contents if content)
    return f'<section id="{identifier}">\n<h2>{escape(title)}</h2>\n{body}\n</section>'


def paragraph(text: str, kind: str = "about") -> str:
    """A paragraph; none for an empty text."""
    return f'<p class="{kind}">{escape(text)}</p>' if text else ""


def listed(texts: Sequence[str]) -> str:
    """A list; none of nothing."""
    items = "".join(f"<li>{escape(text)}</li>" for text in texts)
    return f'<ul class="notes">{items}</ul>' if texts else ""


def details(summary: str, content: str, *, unfolded: bool = False) -> str:
    """Content that a reader folds and unfolds."""
    state = " open" if unfolded else ""
    return f"<details{state}><summary>{escape(summary)}</summary>\n{content}\n</details>"


def table(head: Sequence[str], rows: Sequence[Row], *, words: Sequence[int] = ()) -> str:
    """A table; its first column names the rows, ``words`` are columns that hold no numbers."""
    titles = "".join(
        f'<th scope="col"{"" if number and number not in words else _WORDS}>{escape(title)}</th>'
        for number, title in enumerate(head)
    )
    body = "\n".join(_row(row, len(head), words) for row in rows)
    return (
        f'<div class="scroll"><table>\n<thead><tr>{titles}</tr></thead>\n'
        f"<tbody>\n{body}\n</tbody></table></div>"
    )


_WORDS = ' class="words"'


def _row(row: Row, width: int, words: Sequence[int]) -> str:
    if isinstance(row, Group):
        return f'<tr class="group"><th scope="colgroup" colspan="{width}">{escape(row)}</th></tr>'
    first, *others = row
    cells = "".join(
        f"<td{_WORDS if number in words else ''}>{escape(value)}</td>"
        for number, value in enumerate(others, start=1)
    )
    return f'<tr><th scope="row">{escape(first)}</th>{cells}</tr>'
