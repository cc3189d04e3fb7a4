"""Where events come from: our recordings, traces that other programs write, and tracers.

:func:`open_source` opens all of them as a :class:`~chainshaper.values.recording.Recording`, so no
verb and no analysis needs to know the difference. A :class:`Tracer` is the part of recording that
LTTng, eBPF and the library in front do differently.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Protocol

from chainshaper.values.errors import InputError
from chainshaper.values.events import EventTables
from chainshaper.values.handed_over import Through, parse_through
from chainshaper.values.recording import INFO_FILE, Recording, RecordingInfo, open_recording


def open_source(
    *paths: str | Path,
    progress: Callable[[float, str], None] | None = None,
    through: Sequence[str] = (),
) -> Recording:
    """Open a recording's folder; or an LTTng trace (CTF 1.8), which may have several folders.

    Recordings of several hosts, given one by one or as a folder in which they lie, are opened as
    one (:mod:`~chainshaper.sources.several_hosts`). The first is the reference.

    ``progress`` gets the share that is done, from 0 to 1, and what is being done. ``through``
    declares what no event shows (:func:`~chainshaper.values.handed_over.parse_through`).
    Raises InputError: there is nothing that can be read, or ``through`` declares nothing.
    """
    declared = parse_through(through)
    return with_declared(_opened(paths, progress), declared)


def with_declared(recording: Recording, through: Through) -> Recording:
    """Return a recording with what the user declares of it, beside what it says itself."""
    known = tuple(dict.fromkeys((*recording.info.through, *through)))
    if known == recording.info.through:
        return recording
    return replace(recording, info=recording.info.model_copy(update={"through": known}))


def _opened(
    paths: Sequence[str | Path], progress: Callable[[float, str], None] | None
) -> Recording:
    """Open a recording, a trace, or those of several hosts as one."""
    if not paths:
        raise InputError("no recording given: name a recording's or a trace's folder")
    folders = [Path(path) for path in paths]
    recordings = [folder for folder in folders if (folder / INFO_FILE).exists()]
    if len(folders) == 1 and not recordings:
        of_hosts = sorted(path.parent for path in folders[0].glob(f"*/{INFO_FILE}"))
        if len(of_hosts) > 1:
            folders = recordings = of_hosts
    if len(folders) == 1:
        traced = (path.is_file() for path in folders[0].rglob("metadata"))
        if recordings or not any(traced):
            return open_recording(folders[0])
    # What reads several hosts, and the decoder, are slow to import, and seldom needed.
    if recordings:
        from chainshaper.sources.several_hosts import joint_recording

        joint = joint_recording([_opened([folder], progress) for folder in folders])
        return replace(joint, path=Path(paths[0]))
    from chainshaper.sources.lttng.trace import SeveralClocksError, open_lttng_trace

    try:
        return open_lttng_trace(folders, progress)
    except SeveralClocksError as error:
        from chainshaper.sources.several_hosts import joint_recording

        of_clocks = [open_lttng_trace(of_clock, progress) for of_clock in error.folders]
        return replace(joint_recording(of_clocks), path=Path(paths[0]))


class Tracer(Protocol):
    """A way of recording events; an object is for a single run.

        start() ─► the application runs; failure() is asked now and then ─► stop() ─► remove()
                                                               ─► recording() ─► written()

    Arguments of its constructor:

    * an empty folder on the recording's disk, which becomes its `trace/`
    * the command of the application; empty: the application runs already
    * the processes to attach to; empty: those that the command starts, or, without a command, all
      that run
    """

    def start(self) -> Mapping[str, str]:
        """Begin tracing; return what to add to the application's environment.

        Tracing is on when this returns.

        Raises PlatformError: the machine lacks the tracer or a privilege. OperationError: else.
        """

    def failure(self) -> str | None:
        """Return why nothing is traced any more, as half a sentence; None: tracing goes on.

        To be called every few seconds.
        """

    def stop(self) -> None:
        """End tracing; all events are on disk when this returns. Raises OperationError."""

    def remove(self) -> None:
        """Remove all that `start` has set up, however the run ended. May be called twice."""

    def recording(self) -> tuple[EventTables, RecordingInfo]:
        """Return the event tables, and the recording's description.

        To be called after `stop` and `remove`. Raises OperationError.
        """

    def written(self) -> None:
        """Remove files that the tables make unnecessary: the recording is on disk now."""
