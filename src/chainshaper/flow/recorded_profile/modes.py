"""In which mode each cycle of a recording began."""

import numpy as np
import polars as pl

from chainshaper.analysis import DataFlow
from chainshaper.planning import Modes
from chainshaper.values.recording import Recording
from chainshaper.values.yaml_file import wrong_values_refused
from chainshaper.workload.description import Application, node_name
from chainshaper.workload.timing import timing_of


def modes_in_force(
    recording: Recording, flow: DataFlow, starts: pl.Series, modes: Modes
) -> pl.Series:
    """Return the mode in which each cycle began, by the description of what ran; null if unknown.

    Each of a description's timers that announces modes takes them in turns.
    """
    announcements: list[tuple[int, str]] = []  # instant and mode
    described = recording.info.application
    if described is not None and not any(recording.info.lost.values()):
        with wrong_values_refused(Application, f"{recording.path}: the description that ran: "):
            application = Application.model_validate(described, strict=False)
        warm_up_ns = timing_of(application, 0, 0).record_from_ns
        for name, timer in application.callbacks():
            if timer.timer_ns is None or not timer.announces or modes.topic not in timer.publishes:
                continue
            before = -((timer.phase_ns - warm_up_ns) // timer.timer_ns)
            announced = flow.publications.filter(topic=modes.topic, node=node_name(name))
            times = announced["time"].to_list()
            if before > 0:  # the last one before the recording is in force when it begins
                times = [0, *times]
            announcements += [
                (time, timer.announces[turn % len(timer.announces)])
                for turn, time in enumerate(times, start=max(0, before - 1))
            ]
    if not announcements:
        return pl.Series([None] * len(starts), dtype=pl.String)
    known = sorted((time, mode) for time, mode in announcements if mode in modes.bands)
    place = np.searchsorted([time for time, _ in known], starts.to_numpy(), side="right")
    return pl.Series([modes.default, *(mode for _, mode in known)]).gather(place)
