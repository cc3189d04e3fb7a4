"""`chainshaper convert`: a trace as a recording of ours."""

from chainshaper.cli.options import RecordingOutput, TraceArgument

__all__ = ["convert"]


def convert(trace: TraceArgument, output: RecordingOutput) -> None:
    """Write a trace as a recording: one Parquet file per event table."""
    from chainshaper.cli.output import late_progress, notes, show_line
    from chainshaper.flow.exploration import convert_recording, lost_events
    from chainshaper.sources import open_source
    from chainshaper.values.recording import refuse_existing

    refuse_existing(output)
    with late_progress("convert") as report:
        opened = open_source(*trace, progress=report)
        written = convert_recording(opened, output)
    show_line(str(written.path.absolute()))
    notes((*written.info.notes, lost_events(written.info)))
