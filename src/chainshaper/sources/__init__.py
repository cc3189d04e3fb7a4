"""Where events come from: recordings of our own, the traces that others write, and tracers.

:func:`open_source` is the one door: whatever it opens is a
:class:`~chainshaper.values.recording.Recording`, so no verb and no analysis needs to know the
difference. A :class:`Tracer` is the part of recording that differs between LTTng and eBPF.
"""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Protocol

from chainshaper.values.errors import InputError
from chainshaper.values.events import EventTables
from chainshaper.values.recording import INFO_FILE, Recording, RecordingInfo, open_recording


def open_source(
    *paths: str | Path, progress: Callable[[float, str], None] | None = None
) -> Recording:
    """Open a recording folder, or an LTTng trace (CTF 1.8): one folder, or several of one trace.

    ``progress`` gets the share that is done, from 0 to 1, and what is being done.
    Raises InputError: there is nothing that can be read.
    """
    if not paths:
        raise InputError("no recording given: name a recording's or a trace's folder")
    folders = [Path(path) for path in paths]
    recordings = [folder for folder in folders if (folder / INFO_FILE).exists()]
    if len(folders) == 1:
        traced = (path.is_file() for path in folders[0].rglob("metadata"))
        if recordings or not any(traced):
            return open_recording(folders[0])
    elif recordings:
        raise InputError(f"{recordings[0]} is a recording, which cannot be opened beside others")
    # The decoder is slow to import: only who opens a trace pays for it.
    from chainshaper.sources.lttng.trace import open_lttng_trace

    return open_lttng_trace(folders, progress)


class Tracer(Protocol):
    """A way of recording events, made for one run.

        start() ─► the application runs; failure() is asked now and then ─► stop() ─► remove()
                                                               ─► recording() ─► written()

    It gets an empty folder on the disk of the recording, which becomes its `trace/`; the
    application's command (empty: it runs already), and the processes to attach to (empty: those
    that the command starts; both empty: all that run).
    """

    def start(self) -> Mapping[str, str]:
        """Begin; tracing is on when this returns. What to add to the application's environment.

        Raises PlatformError: the machine lacks the tracer or a privilege. OperationError: else.
        """

    def failure(self) -> str | None:
        """Why nothing is traced any more, as half a sentence. Asked every few seconds."""

    def stop(self) -> None:
        """End tracing; everything is on disk when this returns. Raises OperationError."""

    def remove(self) -> None:
        """Leave nothing of ours behind, however the run ended; perhaps called twice."""

    def recording(self) -> tuple[EventTables, RecordingInfo]:
        """The events, and what they tell, after `stop` and `remove`. Raises OperationError."""

    def written(self) -> None:
        """The recording is on disk: remove what says no more than its tables do."""
