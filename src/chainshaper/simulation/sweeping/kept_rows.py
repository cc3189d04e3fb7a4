"""Rows that are finished, beside the file that they will end in, so that a sweep can go on.

One line of JSON a row, behind a first line that says what is swept. Each is on disk before the
next; of what a crash leaves unfinished there is at most half a line, which is removed.
"""

import fcntl
import json
import os
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any, TypeAlias

from chainshaper.values.errors import InputError, OperationError

__all__ = ["Row", "kept_rows", "rows_beside"]

Row: TypeAlias = Mapping[str, Any]


def rows_beside(output: str | Path) -> Path:
    """Where the finished rows of a sweep are kept until it is whole."""
    output = Path(output)
    return output.with_name(output.name + ".rows")


@contextmanager
def kept_rows(
    path: Path, about: Mapping[str, Any]
) -> Iterator[tuple[dict[int, Row], Callable[[int, Row], None]]]:
    """The rows that are finished, by the number of their point, and how to keep one more.

    ``about`` says what is swept, as plain data: rows of anything else are not mixed with it. A
    file without rows is removed.

    Raises:
        InputError: the file is of another sweep; the message names what differs.
        OperationError: another process works on it, or it cannot be read or written.
    """
    about = json.loads(json.dumps(about))
    try:
        with path.open("a+", encoding="utf-8") as file:
            _claim(file, path)
            finished = _read(file, path, about)
            if finished is None:
                _append(file, about)

            rows = dict(finished or {})

            def keep(number: int, row: Row) -> None:
                rows[number] = row  # first: an interruption must not take it for an empty file
                _append(file, {"number": number, "row": row})

            try:
                yield rows, keep
            finally:
                if not rows:
                    path.unlink()
    except OSError as error:
        raise OperationError(
            f"{path}: finished rows cannot be kept ({error.strerror or error}); what is in it"
            " stays, and the same command goes on from there"
        ) from error


def _claim(file: IO[str], path: Path) -> None:
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        raise OperationError(
            f"{path}: another process works on this sweep: wait for it, or name another output"
        ) from error


def _read(file: IO[str], path: Path, about: Mapping[str, Any]) -> dict[int, Row] | None:
    """The rows of whole lines; what is behind them is cut off. None: the file is new."""
    file.seek(0)
    text = file.read()
    whole = text[: text.rfind("\n") + 1]
    if len(whole) < len(text):
        os.truncate(file.fileno(), len(whole.encode()))
    if not whole:
        return None
    try:
        first, *rows = map(json.loads, whole.splitlines())
        finished = {row["number"]: row["row"] for row in rows}
        changed = [name for name in about if first[name] != about[name]]
    except (ValueError, KeyError, TypeError) as error:
        raise InputError(
            f"{path}: these are no rows of a sweep: move the file away, or name another output"
        ) from error
    if changed:
        raise InputError(
            f"{path} has {len(finished)} finished rows of another sweep: {' and '.join(changed)}"
            " changed since. Undo that to go on with them, name another output, or remove the file"
        )
    return finished


def _append(file: IO[str], value: Mapping[str, Any]) -> None:
    file.write(json.dumps(value) + "\n")
    file.flush()
    os.fsync(file.fileno())
