"""Budgets: proposed, edited, met, broken; recordings of known latencies."""

import json
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import polars as pl
import pytest
from command_line import called, json_of
from small_chain import small_chain, with_times

from chainshaper import simulate
from chainshaper.monitor.budgets import (
    Budget,
    ChainBudget,
    Judged,
    check_budget,
    check_budgets,
    junit_report,
    load_budget,
    markdown_report,
    propose_budget,
    save_budget,
)
from chainshaper.values.errors import InputError
from chainshaper.values.events import empty
from chainshaper.values.recording import Recording, write_recording
from chainshaper.verify.measure import hop_breakdown, measure_latency
from chainshaper.workload.description import ExecutionTime

MS = 1_000_000


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    folder = tmp_path_factory.mktemp("budgets")
    return simulate(small_chain(folder), folder / "recording", cycles=200)


@pytest.fixture(scope="module")
def slowed(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    """The same application, whose node `second` computes for 3 ms longer."""
    folder = tmp_path_factory.mktemp("slowed")
    longer = {"second": ExecutionTime(uniform_ns=(4 * MS, 7 * MS))}
    return simulate(with_times(small_chain(folder), longer), folder / "slowed", cycles=200)


def test_a_recording_keeps_the_budget_that_was_proposed_from_it(
    recording: Recording, tmp_path: Path
) -> None:
    budget = propose_budget(recording)
    measured = measure_latency(recording).analysis
    (chain,) = budget.chains
    assert chain.chain == "/t1../t3"
    longest = measured.statistics.max_ns or 0
    assert chain.maximum_ns == -(-longest * 11 // (10 * 10_000)) * 10_000
    assert [hop.topic for hop in chain.hops] == ["/t1", "/t2", "/t3"]
    assert chain.hops[0].communication_ns is None, "a chain begins with its first callback"
    worst = hop_breakdown(measured)["computation_ns"].struct.field("max").to_list()
    for hop, most in zip(chain.hops, worst, strict=True):
        assert most * 1.1 <= (hop.computation_ns or 0) <= most * 1.1 + 10_000
    assert {(one.node, one.starts) for one in budget.callbacks} == {
        *(("/first", "every 50ms"), ("/second", "/t1"), ("/third", "/t2"), ("/actuator", "/t3"))
    }
    save_budget(budget, tmp_path / "budget.yaml")
    assert load_budget(tmp_path / "budget.yaml") == budget
    judged = check_budget(recording, budget)
    assert all(one.met for one in judged)
    # maximum, p50, p99, jitter, missing; five parts of hops; two of each callback
    assert len(judged) == 5 + 5 + 8


def test_a_slower_callback_breaks_limits_and_is_named(
    recording: Recording, slowed: Recording
) -> None:
    broken = [one for one in check_budget(slowed, propose_budget(recording)) if not one.met]
    found = {(limit.where, limit.figure) for limit in broken}
    assert {("/t1../t3", "maximum"), ("/t1../t3", "p50"), ("/t1../t3", "p99")} <= found
    assert ("/t1../t3", "computation of /t2") in found
    assert {("/second (/t1)", "response"), ("/second (/t1)", "execution")} <= found
    assert not any("/third" in where or "/first" in where for where, _ in found)
    (maximum,) = (limit for limit in broken if limit.figure == "maximum")
    assert maximum.measured == measure_latency(slowed).analysis.statistics.max_ns
    assert "from computation of /t2" in (maximum.because or "")
    assert maximum.text.startswith("/t1../t3: maximum ")


def test_what_is_missing_in_a_recording_breaks_its_limits(recording: Recording) -> None:
    budget = Budget(chains=(ChainBudget(chain="/t1../nothing", maximum_ns=MS, missing=0.5),))
    judged = check_budget(recording, budget)
    assert [one.met for one in judged] == [False, False]
    assert all("/nothing" in (one.because or "") for one in judged)


def without_takes(recording: Recording, place: Path, after: int, every: int = 1) -> Recording:
    """The last node of the chain takes no message of each such cycle behind so many, and so does
    not run; if it takes none, its callback ran once nevertheless."""
    hops = measure_latency(recording).analysis.hops.filter(hop=2).sort("start")
    gone = hops[after:].gather_every(every)
    left = dict(recording.events)
    for name, column, times in (
        ("rmw_take", "source_timestamp", "source_timestamp"),
        ("callback_start", "time", "start"),
        ("rmw_publish", "time", "publish"),
        ("callback_end", "time", "end"),
    ):
        table = recording.events[name]
        values = gone[times] if after or name == "rmw_take" else gone[times][1:]
        own = pl.col(column).is_in(values.implode())
        left[name] = table.filter(~own)
    return write_recording(place, left, recording.info)


def test_missing_counts_late_outputs_and_those_that_never_came(
    recording: Recording, tmp_path: Path
) -> None:
    """Every tenth message of /t2 is not taken; the last is under way and does not count."""
    budget = Budget(chains=(ChainBudget(chain="/t1../t3", missing=0.05),))
    (judged,) = check_budget(without_takes(recording, tmp_path / "holes", 0, 10), budget)
    assert judged.measured == pytest.approx(0.1, abs=0.006)
    assert not judged.met
    assert "missing 10" in judged.text


def test_a_limit_that_only_disturbed_cycles_break_says_so(recording: Recording) -> None:
    analysis = measure_latency(recording).analysis
    longest = analysis.traversals.sort("latency_ns").row(-1, named=True)
    cores = recording.events["callback_start"]["cpu"].unique().to_list()
    rows = [(longest["start"] + MS, None, None, core, 3 * MS) for core in cores]
    stalls = pl.DataFrame(rows, schema=empty("machine_stall").schema, orient="row")
    hit = replace(recording, events={**recording.events, "machine_stall": stalls})
    limit = longest["latency_ns"] - 1
    budget = Budget(chains=(ChainBudget(chain="/t1../t3", maximum_ns=limit),))
    (judged,) = check_budget(hit, budget)
    assert not judged.met
    assert (judged.undisturbed or limit + 1) <= limit
    assert "where the machine disturbed nothing" in judged.text


def test_the_commands(recording: Recording, slowed: Recording, tmp_path: Path) -> None:
    file, junit, markdown = (tmp_path / name for name in ("b.yaml", "j.xml", "m.md"))
    assert called("budget", recording.path, "-o", file).code == 0
    again = called("budget", recording.path, "-o", file)
    assert again.code == 2, "nothing is overwritten"
    met = called("check", recording.path, "--budget", file)
    assert met.code == 0, met.err
    assert "limits of" in met.out
    words = ("--budget", file, "--junit", junit, "--markdown", markdown)
    broken = called("check", recording.path, slowed.path, *words)
    assert broken.code == 1
    assert "computation of /t2" in broken.out
    suites = ElementTree.parse(junit).getroot()  # noqa: S314 - ours
    assert [one.get("failures") for one in suites] == ["0", str(len(list(suites.iter("failure"))))]
    assert "limits are broken**" in markdown.read_text()
    assert f"| {slowed.path} | /t1../t3: maximum" in markdown.read_text()
    values = json.loads(called("check", slowed.path, "--budget", file, "--json").out)
    assert any(not one["met"] for one in values["limits"])
    assert json_of("check", recording.path, "--budget", file)["limits"][0]["met"]


def test_a_fleet_is_judged_side_by_side(
    recording: Recording, slowed: Recording, tmp_path: Path
) -> None:
    """As one by one; what cannot be read is named, and the others are judged all the same."""
    file = save_budget(propose_budget(recording), tmp_path / "b.yaml")
    paths = [recording.path, slowed.path, tmp_path / "gone", recording.path]
    found = check_budgets(paths, load_budget(file))
    assert [[replace(one, recording="") for one in own] for own in (found[0], found[3])] == [
        [replace(one, recording="") for one in check_budget(recording, load_budget(file))]
    ] * 2
    assert [sum(not one.met for one in own) > 0 for own in found] == [False, True, True, False]
    (gone,) = found[2]
    assert "its events could not be measured" in gone.text
    shown = called("check", *paths, "--budget", file)
    assert shown.code == 1
    assert "Recordings against the budget" in shown.out


def test_hostile_names_stay_text() -> None:
    one = Judged("rec|\x1b[31m", "/a../b", "maximum", 1, 2, because="<&>")
    report = junit_report([one])
    assert "\x1b" not in report
    assert 'testsuite name="rec|\\x1b[31m"' in report
    assert "rec\\|\\x1b[31m" in markdown_report([one])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("chains: [{chain: /a../b, maximum: 80}]", "write a number and a unit"),
        ("chains: [{chain: /a../b, percentiles: {'98': 1ms}}]", "98"),
        ("chains: [{chain: /a../b, missing: 200%}]", "less than or equal to 1"),
        ("chains: [{chain: /a../b, missing: much%}]", "is no share"),
        ("chains: [{chain: /a../b, longest: 1ms}]", "longest"),
    ],
)
def test_wrong_budgets_are_refused_with_their_line(tmp_path: Path, text: str, message: str) -> None:
    file = tmp_path / "budget.yaml"
    file.write_text(f"format: 1\n{text}\n")
    with pytest.raises(InputError, match=message) as refused:
        load_budget(file)
    assert f"{file}:2" in str(refused.value)


@pytest.mark.parametrize(("after", "missing"), [(50, 0.75), (0, 1.0)])
def test_outputs_are_missing_of_a_chain_whose_last_node_died(
    recording: Recording, tmp_path: Path, after: int, missing: float
) -> None:
    budget = Budget(chains=(ChainBudget(chain="/t1../t3", maximum_ns=MS, missing=0.01),))
    longest, gone = check_budget(without_takes(recording, tmp_path / "ending", after), budget)
    assert gone.measured == pytest.approx(missing, abs=0.006)
    assert not (longest.met or gone.met)
    assert ("no cycle was complete" in longest.text) == (after == 0)


def test_of_callbacks_with_one_name_the_longest_counts(recording: Recording) -> None:
    """A node that was started again goes on as another process, whose callbacks are slower."""
    again = {
        name: table.with_columns(pl.col("pid", "tid") + 50_000, pl.col("time") + 10_000 * MS)
        for name, table in recording.events.items()
        if "pid" in table.columns
    }
    again["callback_end"] = again["callback_end"].with_columns(pl.col("time") + 2 * MS)
    both = {name: pl.concat([recording.events[name], table]) for name, table in again.items()}
    whole = replace(recording, events={**recording.events, **both})
    budget = propose_budget(recording, room=0.1)
    judged = {(limit.where, limit.figure): limit for limit in check_budget(whole, budget)}
    limit = judged["/second (/t1)", "response"]
    assert limit.measured == pytest.approx(limit.limit / 1.1 + 2 * MS, abs=20_000)
