"""What can be wrong with a trace, said so that a person can act on it."""

from pathlib import Path

from chainshaper.values.errors import InputError

__all__ = ["CtfError"]


class CtfError(InputError):
    """A trace that cannot be read.

    Attributes: ``path`` (the file or folder), ``offset`` (byte offset in it, ``None`` where it
    concerns the whole file), ``reason`` (what is wrong there), ``remedy`` (what to do, may be
    empty).  ``str()`` holds all four.
    """

    def __init__(self, path: Path | str, offset: int | None, reason: str, remedy: str = "") -> None:
        self.path = Path(path)
        self.offset = offset
        self.reason = reason
        self.remedy = remedy
        place = f"{path}" if offset is None else f"{path}, byte {offset}"
        super().__init__(f"{place}: {reason}" + (f" ({remedy})" if remedy else ""))
