"""What no plan governed is left out of figures, and no late output is."""

from pathlib import Path

import pytest
from command_line import called, json_of
from known_run import LATENCY_NS, MS, PERIOD_NS, known_run

from chainshaper import measure_latency, open_recording
from chainshaper.values.recording import InForceInfo


@pytest.mark.parametrize(
    ("since", "until", "starts", "text"),
    [
        (0, None, [0, 1, 2, 3], None),
        (PERIOD_NS, None, [1, 2, 3], "the first 99ms, before the plan came into force"),
        (PERIOD_NS, 3 * PERIOD_NS, [1, 2], "the first 99ms, before the plan came into "),
        (0, 3 * PERIOD_NS, [0, 1, 2], "the last "),
        (9_000 * MS, None, [], "the first "),
    ],
)
def test_what_no_plan_governed_is_left_out(
    since: int, until: int | None, starts: list[int], text: str | None, tmp_path: Path
) -> None:
    in_force = InForceInfo(since_ns=since, until_ns=until)
    recording = known_run(tmp_path / "known", cycles=4, overran=(0,), in_force=in_force)
    measured = measure_latency(recording)
    cycles = measured.analysis.traversals
    assert cycles["start"].to_list() == [cycle * PERIOD_NS + MS for cycle in starts]
    overruns = {"publish": 1} if 0 in starts else {}
    assert (measured.overruns, measured.analysis.statistics.late) == (overruns, len(overruns))
    shown, values = called("latency", recording.path), json_of("latency", recording.path)
    assert values["in_force"] == {"since_ns": since, "until_ns": until}
    assert values["count"] == len(starts)
    if text is None:
        assert "left out" not in shown.out
    else:
        assert (measured.left_out.text or "").startswith("left out: ")
        assert text in (measured.left_out.text or "")
        words = " ".join(called("compare", recording.path, recording.path).out.split())
        assert "left out" in " ".join(shown.out.split())
        assert "known: left out" in words


def test_over_all_cycles_late_outputs_maximum_and_jitter_are_shown(tmp_path: Path) -> None:
    """The last output arrives at the end of its slot, and leaves at once."""
    recording = known_run(tmp_path / "known", cycles=2, overran=(1,))
    longest = 31 * MS
    values = json_of("latency", recording.path)
    assert (values["late"], values["max_all_ns"]) == (1, longest)
    assert values["jitter_all_ns"] == longest - LATENCY_NS
    assert values["undisturbed"]["late"] == 1
    shown = called("compare", recording.path, recording.path).out
    assert "came late" in shown
    assert "1 of 2" in shown
    assert json_of("compare", recording.path, recording.path)["recordings"][0]["late"] == 1


def test_a_recording_from_before_says_nothing_and_is_read_whole(tmp_path: Path) -> None:
    recording = known_run(tmp_path / "known")
    file = recording.path / "recording.json"
    file.write_text(file.read_text().replace('"in_force": null', '"was_not_there": null'))
    measured = measure_latency(open_recording(recording.path))
    assert measured.analysis.statistics.count == 3
    assert measured.left_out.text is None
