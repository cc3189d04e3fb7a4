"""Result tables: written once as plain rows, rendered for the terminal and for the HTML report.

Texts of others (names in traces) stay literal in both: Rich takes brackets for its markup and hands
control characters on, so on the terminal every text is a `Text`; in HTML every text is escaped.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, NamedTuple, TypeAlias

from rich.table import Table as RichTable
from rich.text import Text

from chainshaper.planning.plan import Server
from chainshaper.values.durations import format_duration, milliseconds
from chainshaper.values.safe_text import escape, shown

__all__ = ["ABSENT", "Column", "ResultTable", "figures", "plain", "words"]

ABSENT = "–"
YES_NO: dict[bool | None, str] = {True: "yes", False: "no"}

Cell: TypeAlias = str | Text


class Column(NamedTuple):
    """``words`` stand at the left and are folded where there is no room, figures at the right.

    A ``detail`` is for the report only: a terminal has no room for it.
    """

    title: str
    words: bool = False
    footer: str = ""
    detail: bool = False


def words(*titles: str) -> list[Column]:
    """Columns of words."""
    return [Column(title, words=True) for title in titles]


def figures(*titles: str) -> list[Column]:
    """Columns of figures."""
    return [Column(title) for title in titles]


class _Row(NamedTuple):
    kind: Literal["row", "group", "line"]
    cells: tuple[Cell, ...]
    detail: bool


@dataclass
class ResultTable:
    """A table of results; print it with Rich, or take its :meth:`html`."""

    title: str
    columns: list[Column]
    caption: str | None = None
    rows: list[_Row] = field(default_factory=list)

    def add(self, *cells: Cell, detail: bool = False) -> None:
        """A row: a cell per column."""
        self.rows.append(_Row("row", cells, detail))

    def group(self, title: str, *, detail: bool = False) -> None:
        """A title over the rows that follow."""
        self.rows.append(_Row("group", (title,), detail))

    def line(self) -> None:
        """A line between the rows before and behind it, on the terminal."""
        self.rows.append(_Row("line", (), False))

    def __rich__(self) -> RichTable:
        """The table for the terminal, without details."""
        used = [number for number, column in enumerate(self.columns) if not column.detail]
        table = RichTable(
            title=plain(self.title, "table.title"),
            caption=plain(self.caption, "table.caption"),
            title_justify="left",
            show_header=any(column.title for column in self.columns),
            show_footer=any(column.footer for column in self.columns),
        )
        for title, left, footer, _ in (self.columns[number] for number in used):
            table.add_column(
                plain(title),
                plain(footer),
                justify="left" if left else "right",
                overflow="fold" if left else "ellipsis",
            )
        indent = ""
        for kind, cells, detail in self.rows:
            if kind == "line" or (kind == "group" and not detail):
                table.add_section()
            if kind == "group" and not detail:
                indent = "  "
                table.add_row(plain(str(cells[0]), "bold"))
            elif kind == "row" and not detail:
                first, *others = (plain(cells[number]) for number in used)
                table.add_row(Text(indent) + first, *others)
        return table

    def html(self) -> str:
        """The rows as an HTML table, whose first column names them."""
        titles = "".join(
            f'<th scope="col"{_kind(left or not number)}>{escape(title)}</th>'
            for number, (title, left, *_) in enumerate(self.columns)
        )
        rows = [self._row_html(row) for row in self.rows if row.kind != "line"]
        if any(column.footer for column in self.columns):
            footers = tuple(column.footer for column in self.columns)
            rows.append(self._row_html(_Row("row", footers, False)))
        body = "\n".join(rows)
        return (
            f'<div class="scroll"><table>\n<thead><tr>{titles}</tr></thead>\n'
            f"<tbody>\n{body}\n</tbody></table></div>"
        )

    def _row_html(self, row: _Row) -> str:
        first, *others = (escape(str(cell)) for cell in row.cells)
        if row.kind == "group":
            width = len(self.columns)
            return f'<tr class="group"><th scope="colgroup" colspan="{width}">{first}</th></tr>'
        cells = "".join(
            f"<td{_kind(column.words)}>{cell}</td>"
            for column, cell in zip(self.columns[1:], others, strict=True)
        )
        return f'<tr><th scope="row">{first}</th>{cells}</tr>'


def _kind(words: bool) -> str:
    return ' class="words"' if words else ""


def plain(text: Any, style: str = "") -> Any:
    """A text for Rich that is shown as it is; what is no text stays."""
    return Text(shown(text, but="\n"), style) if isinstance(text, str) else text


def ms(nanoseconds: float | None) -> str:
    """Milliseconds, where there are any."""
    return ABSENT if nanoseconds is None else milliseconds(nanoseconds)


def count(number: int | None, absent: str = ABSENT) -> str:
    """A number, where it is known."""
    return absent if number is None else str(number)


def counts(by_kind: Mapping[str, int] | None, absent: str = ABSENT) -> str:
    """How many there are, and of which kinds: ``3 (2 discard, 1 wait)``."""
    if by_kind is None:
        return absent
    kinds = ", ".join(f"{number} {kind}" for kind, number in by_kind.items())
    return f"{sum(by_kind.values())}{f' ({kinds})' if kinds else ''}"


def min_mean_max(times: Mapping[str, float] | None) -> list[str]:
    """Three cells of a struct of times, where there is one."""
    return [ms(None if times is None else times[name]) for name in ("min", "mean", "max")]


def percent(share: float | None) -> str:
    """A share of one, where there is any."""
    return ABSENT if share is None else f"{share:.1%}"


def slots_ms(*slots: tuple[int, int]) -> str:
    """``[64.213, 65.213)``, or several of them."""
    return " ".join(f"[{milliseconds(start)}, {milliseconds(end)})" for start, end in slots)


def thread_nodes(server: Server) -> str:
    """Whose threads a server lets run."""
    return ", ".join(
        thread.node + (" (publisher)" if thread.role == "publisher" else "")
        for thread in server.threads
    )


def scheduling_text(policy: str, priority: int) -> str:
    """``FIFO 80``; of a class without priorities its name alone."""
    name = policy.removeprefix("SCHED_")
    return f"{name} {priority}" if priority else name


def core_ranges(cores: Sequence[int]) -> str:
    """Cores as the kernel writes them: ``0-3,7``."""
    runs: list[list[int]] = []
    for core in cores:
        if runs and core == runs[-1][-1] + 1:
            runs[-1][1:] = [core]
        else:
            runs.append([core])
    return ",".join("-".join(map(str, run)) for run in runs)


def trigger(callback: Mapping[str, Any]) -> str:
    """What starts a callback, of a row of callback statistics: ``timer every 100ms``."""
    period = callback["period_ns"]
    what = callback["topic"] if period is None else f"every {format_duration(period)}"
    return f"{callback['kind']} {what or ''}".rstrip()
