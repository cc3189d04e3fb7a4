"""Result tables: written once as plain rows, rendered for the terminal and for the HTML report.

Names from traces stay literal in both. Rich takes brackets for its markup and hands control
characters on, so on the terminal every text is a `Text`; in HTML every text is escaped.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple, TypeAlias

from rich.cells import cell_len
from rich.console import Console, ConsoleOptions, RenderResult
from rich.measure import Measurement
from rich.table import Table as RichTable
from rich.text import Text

from chainshaper.values.durations import milliseconds
from chainshaper.values.errors import escape, shown

ABSENT = "–"
YES_NO: dict[bool | None, str] = {True: "yes", False: "no"}

Cell: TypeAlias = str | Text


class Column(NamedTuple):
    """A column of a table."""

    title: str
    words: bool = False  # at the left, folded where there is no room; else figures, at the right
    footer: str = ""
    detail: bool = False  # for the report only: a terminal has no room for it


def words(*titles: str) -> list[Column]:
    """Make columns of words."""
    return [Column(title, words=True) for title in titles]


def figures(*titles: str) -> list[Column]:
    """Make columns of figures."""
    return [Column(title) for title in titles]


class _Row(NamedTuple):
    """A row of cells; or the title of a group of rows; or a line between rows."""

    cells: tuple[Cell, ...]  # of a title the single one; of a line none
    detail: bool = False  # for the report only
    title: bool = False


@dataclass
class ResultTable:
    """A table of results, to be printed with Rich or shown as :meth:`html`."""

    title: str
    columns: list[Column]
    caption: str | None = None
    rows: list[_Row] = field(default_factory=list)

    def add(self, *cells: Cell | int | None, detail: bool = False) -> None:
        """Add a row, with a cell per column; None (not known) is shown as a dash."""
        known = (ABSENT if cell is None else cell for cell in cells)
        texts = tuple(cell if isinstance(cell, Text) else str(cell) for cell in known)
        self.rows.append(_Row(texts, detail))

    def group(self, title: str, *, detail: bool = False) -> None:
        """Add a title over the rows that follow."""
        self.rows.append(_Row((title,), detail, title=True))

    def line(self) -> None:
        """Add a line between rows, for the terminal."""
        self.rows.append(_Row(()))

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        """Render for the terminal, without details: as a table, or in lines if it is too narrow."""
        table = self._table()
        least = Measurement.get(console, options.update(max_width=9999), table).minimum
        if least <= options.max_width or all(column.words for column in self.columns):
            yield table
        else:
            yield from self._lines()

    def _lines(self) -> Iterator[Text]:
        """Each row in two lines: its words, then its figures under each other."""
        used = [number for number, column in enumerate(self.columns) if not column.detail]
        names = [number for number in used if self.columns[number].words]
        heads = {n: self.columns[n].title.split("\n") for n in used if n not in names}
        rows = self._with_footer([row for row in self.rows if not row.detail])
        cells = [row.cells for row in rows if not row.title]
        width = {n: max(map(cell_len, [*heads[n], *(str(row[n]) for row in cells)])) for n in heads}

        def line(values: Mapping[int, str], style: str = "") -> Text:
            return plain("    " + "  ".join(values[n].rjust(width[n]) for n in heads), style)  # type: ignore[no-any-return]

        yield plain(self.title, "table.title")
        depth = max(map(len, heads.values()))
        for number in range(depth):
            yield line({n: ([""] * (depth - len(h)) + h)[number] for n, h in heads.items()}, "bold")
        for row in rows:
            text = row.cells[0] if row.title else "  ".join(str(row.cells[n]) for n in names)
            yield plain(str(text), "bold" if row.title else "")
            if not row.title:
                yield line({n: str(row.cells[n]) for n in heads})
        if self.caption:
            yield plain(self.caption, "table.caption")

    def _table(self) -> RichTable:
        """Make Rich's table, without details."""
        used = [number for number, column in enumerate(self.columns) if not column.detail]
        columns = [self.columns[number] for number in used]
        table = RichTable(
            title=plain(self.title, "table.title"),
            caption=plain(self.caption, "table.caption"),
            title_justify="left",
            show_header=any(column.title for column in columns),
            show_footer=any(column.footer for column in columns),
        )
        for title, left, footer, _ in columns:
            justify, overflow = ("left", "fold") if left else ("right", "ellipsis")
            table.add_column(plain(title), plain(footer), justify=justify, overflow=overflow)  # type: ignore[arg-type]
        indent = ""
        for cells, _, title_only in (row for row in self.rows if not row.detail):
            if title_only or not cells:
                table.add_section()
            if title_only:
                indent = "  "
                table.add_row(plain(cells[0], "bold"))
            elif cells:
                first, *further = (plain(cells[number]) for number in used)
                table.add_row(Text(indent) + first, *further)
        return table

    def html(self) -> str:
        """Make an HTML table; its first column has the names of rows.

        On a narrow screen each row of a wide table is a paragraph, with titles beside the cells.
        """
        titles = "".join(
            f'<th scope="col"{_kind(column.words or not number)}>{escape(column.title)}</th>'
            for number, column in enumerate(self.columns)
        )
        body = "\n".join(self._row_html(row) for row in self._with_footer(self.rows))
        return (
            f'<div class="scroll"><table{" class=wide" if self._wide else ""}>\n'
            f"<thead><tr>{titles}</tr></thead>\n"
            f"<tbody>\n{body}\n</tbody></table></div>"
        )

    def _with_footer(self, rows: Sequence[_Row]) -> list[_Row]:
        """The rows without lines, and the footer as the last row if there is one."""
        footer = tuple(column.footer for column in self.columns)
        shown_rows = [row for row in rows if row.cells]
        if any(footer):
            shown_rows.append(_Row(footer))
        return shown_rows

    @property
    def _wide(self) -> bool:
        return len(self.columns) > 4

    def _row_html(self, row: _Row) -> str:
        first, *further = (escape(str(cell)) for cell in row.cells)
        if row.title:
            width = len(self.columns)
            return f'<tr class="group"><th scope="colgroup" colspan="{width}">{first}</th></tr>'
        cells = ""
        for column, cell in zip(self.columns[1:], further, strict=True):
            titled = f' data-title="{escape(column.title)}"' if self._wide else ""
            cells += f"<td{_kind(column.words)}{titled}>{cell}</td>"
        return f'<tr><th scope="row">{first}</th>{cells}</tr>'


def _kind(words: bool) -> str:
    return ' class="words"' if words else ""


def plain(text: Any, style: str = "") -> Any:
    """Make a text that Rich shows literally; what is no text stays as it is."""
    return Text(shown(text, but="\n"), style) if isinstance(text, str) else text


def ms(nanoseconds: float | None) -> str:
    """A time in milliseconds, or a dash."""
    return ABSENT if nanoseconds is None else milliseconds(nanoseconds)


def interval_ms(interval: tuple[int, int]) -> str:
    """Return an interval of ns in milliseconds: ``53.100 ± 0.200``; what is shown covers it."""
    low, high = interval
    middle = round((low + high) / 2, -3)
    half = -(-max(high - middle, middle - low) // 1000) * 1000
    return f"{milliseconds(middle)} ± {milliseconds(half)}"


def cost_text(cost: float | None) -> str:
    """Return a cost with four figures: ``1.413``; ``unstable``; a dash for None."""
    if cost is None:
        return ABSENT
    return f"{cost:.4g}" if math.isfinite(cost) else "unstable"


def counted(number: int, noun: str) -> str:
    """``1 cycle``, ``2 cycles``."""
    return f"{number:,} {noun}{'' if number == 1 else 's'}"


def counts(by_kind: Mapping[str, int] | None, absent: str = ABSENT) -> str:
    """A number and its parts by kind: ``3 (2 discard, 1 wait)``."""
    if by_kind is None:
        return absent
    kinds = ", ".join(f"{number} {kind}" for kind, number in by_kind.items())
    return f"{sum(by_kind.values())}{f' ({kinds})' if kinds else ''}"


def min_mean_max(times: Mapping[str, float] | None) -> list[str]:
    """Three cells of a struct of times, or three dashes."""
    return [ms(None if times is None else times[name]) for name in ("min", "mean", "max")]


def percent(share: float | None) -> str:
    """A share (of 1) in percent, or a dash."""
    return ABSENT if share is None else f"{share:.1%}"


def slots_ms(*slots: tuple[int, int]) -> str:
    """``[64.213, 65.213)``, or several of them."""
    return " ".join(f"[{milliseconds(start)}, {milliseconds(end)})" for start, end in slots)


def scheduling_text(policy: str, priority: int) -> str:
    """``FIFO 80``; of a class without priorities its name alone."""
    name = policy.removeprefix("SCHED_")
    return f"{name} {priority}" if priority else name


def listed(numbers: Sequence[int]) -> str:
    """``0, 1, 3``."""
    return ", ".join(map(str, numbers))
