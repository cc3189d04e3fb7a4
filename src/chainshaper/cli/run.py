"""`chainshaper run`: run a described application live and record it."""

import sys

from chainshaper.cli.options import (
    ApplicationArgument,
    CyclesOption,
    RealtimeOption,
    RecordingOutput,
)

__all__ = ["run"]


def run(
    application: ApplicationArgument,
    output: RecordingOutput,
    cycles: CyclesOption = 320,
    realtime: RealtimeOption = None,
) -> None:
    """Run an application live over DDS and record its events.

    Every node is a process of its own, scheduled as the description says (SCHED_FIFO where it is
    permitted). The recording is a folder of Parquet tables.
    """
    from chainshaper.cli.output import notes, progress, show_line
    from chainshaper.workload.description import load_application
    from chainshaper.workload.live import run_application

    description = load_application(application)
    with progress(f"running {description.name}") as report:
        recording = run_application(
            description, output, cycles=cycles, realtime=realtime, command=sys.argv, progress=report
        )
    notes(recording.info.notes)
    show_line(str(recording.path))
