"""Where events come from: recordings of our own, and the traces that others write.

:func:`open_source` is the one door: whatever it opens is a
:class:`~chainshaper.values.recording.Recording`, so no verb and no analysis needs to know the
difference.
"""

from collections.abc import Callable
from pathlib import Path

from chainshaper.values.errors import InputError
from chainshaper.values.recording import INFO_FILE, Recording, open_recording

__all__ = ["open_source"]


def open_source(
    *paths: str | Path,
    progress: Callable[[float, str], None] | None = None,
    overview: bool = False,
) -> Recording:
    """Open a recording folder, or an LTTng trace (CTF 1.8): one folder, or several of one trace.

    ``overview`` is for who wants to know what is in it only: a trace's callbacks and messages are
    then not decoded before they are used. ``progress`` is told the share that is done, from 0 to
    1, and what is being done.

    Raises:
        InputError: there is nothing that can be read.
    """
    if not paths:
        raise InputError("no recording given: name a recording's or a trace's folder")
    folders = [Path(path) for path in paths]
    if len(folders) == 1 and not _is_trace(folders[0]):
        return open_recording(folders[0])
    for folder in folders:
        if (folder / INFO_FILE).is_file():
            raise InputError(f"{folder} is a recording, which cannot be opened beside others")
    # The decoder is slow to import: only who opens a trace pays for it.
    from chainshaper.sources.lttng.trace import open_lttng_trace

    return open_lttng_trace(folders, progress, overview=overview)


def _is_trace(folder: Path) -> bool:
    """Whether there are CTF metadata in the folder or below it, and no recording in it."""
    if (folder / INFO_FILE).exists() or not folder.is_dir():
        return False
    return any(path.is_file() for path in folder.rglob("metadata"))
