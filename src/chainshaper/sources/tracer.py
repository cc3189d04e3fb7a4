"""What a tracer does for a recording: the part that differs between LTTng and eBPF.

    start() ─► the application runs; failure() is asked now and then ─► stop() ─► remove()
                                                                            ─► recording()

A tracer is made for one run and gets a folder of its own, empty and on the disk of the recording:
what it leaves in there is kept with the recording as `trace/`. There are two,
:class:`.lttng_session.LttngSession` and ``EbpfTracer`` in :mod:`.ebpf`, made as
``EbpfTracer(folder, command, pids)``: the application's command (empty: it runs already), and the
processes to attach to (empty: those that the command starts; both empty: all that run).

Everything that concerns the application itself (starting and ending it, its threads, its QoS) is
:mod:`chainshaper.flow.record`'s.
"""

from collections.abc import Mapping
from typing import Protocol

from chainshaper.values.events import EventTables
from chainshaper.values.recording import RecordingInfo

__all__ = ["Tracer"]


class Tracer(Protocol):
    """A way of recording events, once."""

    def start(self) -> Mapping[str, str]:
        """Begin; tracing is on when this returns. What to add to the application's environment.

        Raises:
            PlatformError: the machine lacks the tracer or a privilege; names the remedy.
            OperationError: it does not start.
        """
        ...

    def failure(self) -> str | None:
        """Why nothing is traced any more, as half a sentence; None while all is well.

        Asked every few seconds while the application runs, so also the place to look after
        losses. A failure ends the run; what was traced until then is recorded with it as a note.
        """
        ...

    def stop(self) -> None:
        """End tracing; everything is on disk when this returns.

        Raises:
            OperationError: it cannot be ended in order; `remove` is still called.
        """
        ...

    def remove(self) -> None:
        """Leave nothing of ours behind: sessions, daemons, processes.

        Called however the run ends, also when `start` failed halfway, and perhaps twice.
        """
        ...

    def recording(self) -> tuple[EventTables, RecordingInfo]:
        """The events, and what they tell, from the folder; called after `stop` and `remove`.

        In ``RecordingInfo`` a tracer fills in what it knows: ``source``, ``clock_offset_ns``,
        ``distribution``, ``rmw``, ``processes``, ``lost``, ``notes``, ``trace_events``. Command,
        threads, endpoints and scheduling are added to that.

        Raises:
            OperationError: what was traced cannot be read.
        """
        ...
