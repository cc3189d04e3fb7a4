"""What public bug reports contain, as small traces of which the right figures are known."""

from pathlib import Path

import pytest
from reference_traces import reference_folder

from chainshaper import open_source
from chainshaper.analysis import (
    LatencyAnalysis,
    analyse_latency,
    callback_statistics,
    data_flow,
)
from chainshaper.flow.plan import profile_chains
from chainshaper.planning.profile import doubts_about

MS = 1_000_000


def field_folder(name: str) -> Path:
    """The folder of a trace from the field; skips the test where it is not."""
    return reference_folder(f"field/{name}")


def latency(name: str, chain: str = "/image../objects") -> LatencyAnalysis:
    return analyse_latency(open_source(field_folder(name)), chain)


def cycles(found: LatencyAnalysis) -> tuple[int, int | None, int | None, int]:
    """Complete cycles, the shortest and longest latency, and incomplete ones."""
    figures = found.statistics
    return figures.count, figures.min_ns, figures.max_ns, figures.incomplete


@pytest.mark.parametrize(
    ("name", "chain"),
    [
        ("intra_process_of_caret/trace", "/image../objects"),
        ("takes_without_events/loan", "/image../objects"),
    ],
)
def test_messages_without_events_of_dds_are_followed(name: str, chain: str) -> None:
    found = latency(name, chain)
    assert cycles(found) == (20, 5 * MS, 5 * MS, 0)
    assert set(found.hops.filter(hop=1)["communication_ns"]) == {510_000}


def test_a_take_tells_whose_callback_an_unknown_address_is() -> None:
    assert cycles(latency("callback_of_unknown_address/generic", "/a../b")) == (
        20,
        5 * MS,
        5 * MS,
        0,
    )


def test_the_executor_s_events_prove_that_a_callback_had_ended() -> None:
    recording = open_source(field_folder("lost_end_and_start/lostpair"))
    found = analyse_latency(recording, "/image../objects")
    assert cycles(found) == (39, 5 * MS, 5 * MS, 1)
    callbacks = callback_statistics(data_flow(recording.events))
    (took,) = callbacks.filter(node="/detector")["response_ns"]
    assert took["max"] == 3_690_000


def test_a_plan_has_the_period_that_a_timer_s_starts_show() -> None:
    recording = open_source(field_folder("timer_of_another_period/perchanged"))
    (profile,) = profile_chains(recording, ["/image../objects"])
    assert profile.period_ns == 50 * MS
    assert any("starts every 50 ms" in doubt for doubt in doubts_about(profile))


def test_a_step_of_the_wall_clock_does_not_mislead_humble_s_links() -> None:
    humble, jazzy = (latency(f"humble_clock_step/ntp_fwd_{name}") for name in ("humble", "jazzy"))
    assert humble.statistics == jazzy.statistics
    assert humble.subscriber == jazzy.subscriber
    figures, received = humble.statistics, humble.subscriber
    assert (figures.count, figures.incomplete) == (40, 0)
    times = (figures.mean_ns, figures.min_ns, figures.max_ns, received and received.mean_ns)
    assert [round((time or 0) / 1e6, 3) for time in times] == [13.065, 9.760, 15.825, 13.437]
    assert any("by +120.000 ms at 3601.1" in note for note in humble.notes)
