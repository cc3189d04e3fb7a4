"""Real traces of ROS 2 applications with ground truth that others computed, where they are."""

import json
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import pytest

from chainshaper.sources import open_source
from chainshaper.sources.ctf import open_trace, read_events
from chainshaper.values import events

DATA = Path(__file__).resolve().parents[3] / "shared" / "data"
TRACES = (
    "jazzy_chain_cyclonedds",
    "jazzy_chain_fastrtps_async",
    "jazzy_avp_cyclonedds",
    "humble_sync",
    "galactic_caret_end_to_end",
)
CHAINS = (
    ("jazzy_chain_cyclonedds", "/t1../t5"),
    ("jazzy_chain_fastrtps_async", "/t1../t5"),
    ("jazzy_avp_cyclonedds", "/lidar_rear/points_raw../points_fused../localization/ndt_pose"),
)
"""Traces whose truth has a chain, and how it is written."""


@dataclass(frozen=True)
class ReferenceTrace:
    tables: events.EventTables
    clock_offset_ns: int
    truth: dict[str, Any]
    others: dict[str, list[dict[str, Any]]]  # events that are not ROS 2's, row by row


def reference_folder(name: str) -> Path:
    """The folder of a trace; skips the test where it is not."""
    folder = DATA / name
    if not folder.is_dir():
        pytest.skip(f"the reference traces are not here ({folder})")
    return folder


@cache
def reference_trace(name: str) -> ReferenceTrace:
    """A trace and its ground truth; skips the test where they are not."""
    folder = reference_folder(name)
    recording = open_source(folder / "trace")
    trace = open_trace(folder / "trace")
    others = [event for event in trace.event_names if not event.startswith("ros2")]
    return ReferenceTrace(
        tables=recording.events,
        clock_offset_ns=recording.info.clock_offset_ns,
        truth=json.loads((folder / "truth.json").read_text()),
        others={event: frame.to_dicts() for event, frame in read_events(trace, others).items()},
    )
