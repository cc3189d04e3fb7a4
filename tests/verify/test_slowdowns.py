"""Slowdowns: samples of known figures, noise of known kinds, and the commands."""

import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import polars as pl
import pytest
from command_line import called, refused
from hypothesis import given
from hypothesis import strategies as st
from small_chain import small_chain, with_times

from chainshaper import simulate
from chainshaper.values.errors import InputError
from chainshaper.values.events import empty
from chainshaper.values.recording import Recording, write_recording
from chainshaper.verify.slowdowns import (
    FEWEST,
    LEVEL,
    Compared,
    Sample,
    Taken,
    _weighted_median,
    find_slowdowns,
    sample_of,
)
from chainshaper.workload.description import ExecutionTime

MS = 1_000_000
NAMES = [(f"/n{number}", f"/t{number}") for number in range(5)]


def run(
    seed: int,
    *,
    inputs: int | None = 1,
    slower: dict[str, float] | None = None,
    count: int = 400,
    noise: float = 0.005,
    lost: int = 0,
    whole: float = 1.0,
) -> Sample:
    """A run: execution times that input decides (the same for equal ``inputs``; None: constant),
    with noise that lasts for some instances, and of whole processes (a tenth of it)."""
    random, callbacks = np.random.default_rng(seed), {}
    for place, name in enumerate(NAMES):
        work = 10 * MS * np.ones(count)
        if inputs is not None:
            work = np.random.default_rng([inputs, place]).uniform(5 * MS, 15 * MS, count)
        noisy = np.convolve(random.normal(0, noise, count + 4), np.ones(5) / np.sqrt(5), "valid")
        factor = whole * (slower or {}).get(name[0], 1.0) * np.exp(random.normal(0, noise / 10))
        times = work * np.exp(noisy) * factor
        callbacks[name] = Taken(2 * times, np.delete(times, slice(lost, 3 * lost)))
    return Sample(f"run{seed}", callbacks, {"/t0../t4": (50e6 * whole, frozenset(NAMES))})


def slow(samples: list[Sample], before: list[Sample]) -> dict[str, Compared]:
    return {one.node: one for one in find_slowdowns(samples, before)[0] if not one.met}


@pytest.mark.parametrize(
    "wishes",
    [{}, {"inputs": None}, {"lost": 37}, {"whole": 1.05}, {"whole": 0.93}, {"count": 240}],
    ids=str,
)
def test_three_percent_in_one_callback_are_found(wishes: dict[str, Any]) -> None:
    """Also where inputs are constant, messages were lost, and the machine has another clock rate;
    and nothing is found where nothing is slower."""
    before = run(1, inputs=wishes.get("inputs", 1))
    found = slow([run(2, slower={"/n3": 1.03}, **wishes)], [before])
    assert found.keys() == {"/n3"}
    assert found["/n3"].change == pytest.approx(0.03, abs=0.008)
    assert found["/n3"].time == "execution"
    assert not slow([run(3, **wishes)], [before])


def test_as_many_false_alarms_as_are_promised() -> None:
    """Of 200 comparisons of equal runs, some of several recordings a side."""
    alarms = 0
    for number in range(200):
        each, noise = ((1, 0.02), (2, 0.05))[number % 2]
        places = range(4 * number, 4 * number + 2 * each)
        runs = [run(1000 + place, noise=noise, count=240) for place in places]
        alarms += bool(slow(runs[:each], runs[each:]))
    assert alarms <= 1


def test_what_all_callbacks_have_in_common_is_said_and_taken_out() -> None:
    found, notes = find_slowdowns([run(2, whole=1.05)], [run(1)])
    assert all(one.met for one in found)
    assert any(re.match(r"all callbacks took \+[45]\.\d%", note) for note in notes)


def test_no_machine_makes_everything_half_as_slow_again() -> None:
    assert len(slow([run(2, whole=1.5)], [run(1)])) == len(NAMES)


def test_one_run_far_from_the_others_is_no_slowdown() -> None:
    before = [run(seed) for seed in range(10, 15)]
    odd = run(20, slower={"/n1": 1.2})
    assert not slow([run(21), odd, run(22), run(23), run(24)], before)
    later = [run(seed, slower={"/n1": 1.03}) for seed in range(30, 34)]
    assert slow([*later, odd], before).keys() == {"/n1"}


def test_other_inputs_hide_three_percent_and_the_resolution_says_so() -> None:
    (first, *_), notes = find_slowdowns([run(2, inputs=2, slower={"/n3": 1.03})], [run(1)])
    assert first.met
    assert first.resolution > 0.1
    assert "detects slowdowns above " in notes[-1]
    (first, *_), _ = find_slowdowns([run(2)], [run(1)])
    assert first.resolution < 0.03


def test_response_times_are_compared_where_execution_times_lack() -> None:
    def without(sample: Sample) -> Sample:
        callbacks = {
            name: own._replace(execution=own.execution * np.nan)
            for name, own in sample.callbacks.items()
        }
        return replace(sample, callbacks=callbacks)

    found = slow([without(run(2, slower={"/n3": 1.03}))], [run(1)])
    assert found["/n3"].time == "response"


def test_recordings_of_different_applications_are_refused() -> None:
    other = replace(run(2), callbacks={("/x", "/y"): Taken(np.ones(99), np.ones(99))})
    with pytest.raises(InputError, match=r"run2 and run1 have no callback .* same application"):
        find_slowdowns([other], [run(1)])
    with pytest.raises(InputError, match="record longer"):
        find_slowdowns([run(2, count=FEWEST - 1)], [run(1)])


def test_a_callback_of_some_recordings_only_is_named() -> None:
    callbacks = {name: own for name, own in run(2).callbacks.items() if name[0] != "/n1"}
    found, (note,) = find_slowdowns([replace(run(2), callbacks=callbacks)], [run(1)])
    assert len(found) == len(NAMES) - 1
    assert "/n1 (/t1)" in note


def test_the_line_that_a_review_gets() -> None:
    one = Compared("r", "/filter", "/t2", "execution", 19.9 * MS, 0.0854, 0.0011, 0.02)
    assert one.text == "/filter (/t2): execution 19.9 → 21.6 ms, p = 0.001"
    assert replace(one, chains={"/t1../t5": 1.8 * MS}).text == (
        "+1.8 ms on /t1../t5, from /filter (execution 19.9 → 21.6 ms, p = 0.001)"
    )
    assert not one.met
    assert replace(one, p=LEVEL).met


@given(st.lists(st.floats(-1, 1), min_size=1, max_size=9))
def test_a_median_with_equal_weights_is_the_median(values: list[float]) -> None:
    rows = np.array(values)[:, None]
    found = _weighted_median(rows, np.ones(len(values)))
    assert found == pytest.approx([np.median(values)], abs=1e-9)


def simulated(folder: Path, factor: float = 1.0) -> Recording:
    """The small chain, whose node `second` takes ``factor`` times as long."""
    folder.mkdir()
    times = {"second": ExecutionTime(uniform_ns=(round(factor * MS), round(factor * 4 * MS)))}
    return simulate(with_times(small_chain(folder), times), folder / "recording", cycles=200)


def test_the_command(tmp_path: Path) -> None:
    before, after = simulated(tmp_path / "before").path, simulated(tmp_path / "after", 1.03).path
    junit, markdown = tmp_path / "j.xml", tmp_path / "m.md"
    reports = ("--junit", junit, "--markdown", markdown)
    found = called("check", after, "--baseline", before, *reports)
    assert found.code == 1
    (line,) = found.out.splitlines()
    assert line.startswith("+0.0")
    assert "ms on /t1../t3, from /second (execution 2." in line
    assert "1 of 4 callbacks are slower than before" in found.err
    assert "see whether 3 recordings of each side say the same" in found.err
    (suite,) = ElementTree.parse(junit).getroot()  # noqa: S314 - ours
    assert (suite.get("tests"), suite.get("failures")) == ("4", "1")
    assert line in markdown.read_text()
    rows = json.loads(called("check", after, "--baseline", before, "--json").out)["limits"]
    assert [row["where"] for row in rows if not row["met"]] == ["/second (/t1)"]
    equal = called("check", str(tmp_path / "bef*" / "rec*"), "--baseline", before)
    assert equal.code == 0, equal.err
    assert "none of 4 callbacks is slower" in equal.out
    both = tmp_path / "b.yaml"
    called("budget", before, "-o", both)
    assert called("check", before, "--budget", both, "--baseline", before).code == 0
    broken = tmp_path / "broken"
    broken.mkdir()
    every = ("check", before, broken, "--budget", both, "--baseline", before)
    partly = called(*every, "--junit", tmp_path / "partly.xml")
    assert partly.code == 1, "what cannot be read stands among the limits, the others are compared"
    assert "none of 4 callbacks is slower" in partly.out
    assert (tmp_path / "partly.xml").exists()


def test_wrong_uses_are_refused(tmp_path: Path) -> None:
    recording = simulated(tmp_path / "before").path
    assert "--budget FILE, or --baseline REC" in refused(2, "check", recording)
    assert "no folder has such a name" in refused(2, "check", "x*", "--baseline", recording)
    assert "no such folder" in refused(2, "check", tmp_path / "gone", "--baseline", recording)
    (tmp_path / "empty.yaml").write_text("format: 1\n")
    assert "has no limits" in refused(2, "check", recording, "--budget", tmp_path / "empty.yaml")
    nowhere = ("--baseline", recording, "--scheduler", "nowhere")
    assert "no scheduler's address" in refused(2, "check", recording, *nowhere)
    elsewhere = called("check", recording, "--baseline", recording, "--chain", "/x../y")
    assert elsewhere.code == 0
    assert "/x../y is not in" in elsewhere.err


def test_instances_that_met_a_stall_are_left_out(tmp_path: Path) -> None:
    recording = simulated(tmp_path / "calm")
    start = recording.events["callback_start"].row(8, named=True)
    rows = [(start["time"] + 1, None, None, start["cpu"], MS)]
    stalls = pl.DataFrame(rows, schema=empty("machine_stall").schema, orient="row")
    events = {**recording.events, "machine_stall": stalls}
    hit = write_recording(tmp_path / "hit", events, recording.info)
    gone = {
        name: int(np.isnan(own.execution).sum()) for name, own in sample_of(hit).callbacks.items()
    }
    assert sum(gone.values()) >= 1
    assert not any(np.isnan(own.response).any() for own in sample_of(recording).callbacks.values())


def test_too_few_instances_undisturbed_in_both_say_nothing() -> None:
    """45 of 90 are undisturbed on either side, but not the same: nobody else is slower for that."""
    before, after = run(1, count=90, inputs=None), run(2, count=90, inputs=None)
    for side, hit in ((before, slice(0, 45)), (after, slice(45, 90))):
        for times in side.callbacks[NAMES[2]]:
            times[hit] = np.nan
    compared, notes = find_slowdowns([after], [before])
    assert [one.node for one in compared if not one.met] == []
    assert "/n2" not in {one.node for one in compared}
    assert any("not compared" in note and "/n2" in note for note in notes)
    assert all(np.isfinite(one.p) for one in compared)
