"""A timer that starts at another period than it was declared with: every verb shows the period of
its starts, and the declared one beside it."""

import json
from pathlib import Path

import pytest
from command_line import called
from field_traces import MS, chain_tables, write_chain

from chainshaper import open_source
from chainshaper.analysis import data_flow, executors, graph_of, recorded_flow
from chainshaper.monitor.budgets import check_budget, load_budget, propose_budget
from chainshaper.verify.slowdowns import sample_of, slowdowns_in

CHAIN = ("--chain", "/image../objects")
BOTH = "every 50ms (declared 100ms)"


@pytest.fixture(scope="module")
def faster(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """/camera was declared with 100 ms, and starts every 50 ms exactly."""
    folder = tmp_path_factory.mktemp("faster") / "trace"
    return write_chain(folder, chain_tables(60, 50 * MS, declared=100 * MS))


@pytest.fixture(scope="module")
def as_declared(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """/camera was declared with 100 ms, and starts every 100 ms."""
    folder = tmp_path_factory.mktemp("declared") / "trace"
    return write_chain(folder, chain_tables(60, 100 * MS))


def shown(*arguments: str | Path) -> str:
    """What a verb prints, on one line."""
    finished = called(*arguments)
    assert finished.code == 0, finished
    return " ".join(finished.out.split())


@pytest.mark.parametrize("verb", ["latency", "chains", "callbacks"])
def test_tables_show_both_periods(verb: str, faster: Path) -> None:
    chain = CHAIN if verb == "latency" else ()
    assert BOTH in shown(verb, faster, *chain)


def test_json_has_both_periods(faster: Path, as_declared: Path) -> None:
    for folder, period in ((faster, 50 * MS), (as_declared, 100 * MS)):
        timer = json.loads(shown("callbacks", folder, "--json"))[0]
        assert (timer["period_ns"], timer["declared_ns"]) == (period, 100 * MS)
        timer = json.loads(shown("graph", folder, "--json"))["callbacks"][0]
        assert (timer["period_ns"], timer["declared_ns"]) == (period, 100 * MS)
    hops = json.loads(shown("latency", faster, *CHAIN, "--json"))["hops"]
    assert hops[0]["callback"] == f"/camera {BOTH}"


def test_pictures_and_pages_show_both_periods(faster: Path, tmp_path: Path) -> None:
    assert "timer 50ms (declared 100ms)" in shown("graph", faster)
    shown("graph", faster, "-o", tmp_path / "graph.dot")
    assert "timer 50ms (declared 100ms)" in (tmp_path / "graph.dot").read_text()
    shown("report", faster, *CHAIN, "-o", tmp_path / "page.html")
    assert f"/camera {BOTH}" in (tmp_path / "page.html").read_text()
    shown("export", faster, "--perfetto", "-o", tmp_path / "trace.pftrace")
    assert f"/camera {BOTH}".encode() in (tmp_path / "trace.pftrace").read_bytes()


def test_a_description_has_the_period_of_the_starts(faster: Path, tmp_path: Path) -> None:
    shown("describe", faster, *CHAIN, "-o", tmp_path / "app.yaml")
    text = " ".join((tmp_path / "app.yaml").read_text().replace("#", " ").split())
    assert "timer: 50ms" in text
    assert "declared with a period of 100 ms and started every 50 ms" in text


def test_names_of_callbacks_are_the_same_in_every_run(
    faster: Path, as_declared: Path, tmp_path: Path
) -> None:
    """A budget, a plan and a comparison know the callback again, whichever period it shows."""
    names = [
        [name for one in executors(recorded_flow(open_source(folder))) for name in one.names]
        for folder in (faster, as_declared)
    ]
    assert names[0] == names[1]
    assert ("/camera", "every 100ms") in names[0]
    (of_timer, *_) = propose_budget(open_source(as_declared)).callbacks
    assert of_timer.starts == "every 100ms"
    budget = tmp_path / "budget.yaml"
    budget.write_text(
        "format: 1\ncallbacks: [{node: /camera, starts: every 100ms, response: 1ms}]\n"
    )
    limits = load_budget(budget)
    found = [check_budget(open_source(one), limits)[0] for one in (as_declared, faster)]
    assert [one.where for one in found] == ["/camera (every 100ms)", f"/camera ({BOTH})"]
    assert [verdict.measured for verdict in found] == [2 * MS, 2 * MS]
    samples = [sample_of(open_source(one)) for one in (as_declared, faster)]
    assert samples[0].callbacks.keys() == samples[1].callbacks.keys()
    compared, _ = slowdowns_in([faster], [as_declared])
    assert f"/camera ({BOTH})" in [one.where for one in compared]


def test_a_declared_period_that_is_kept_stands_alone(as_declared: Path) -> None:
    assert "declared" not in shown("latency", as_declared, *CHAIN)
    graph = graph_of(data_flow(open_source(as_declared).events))
    assert graph.callbacks[0].label == "/camera every 100ms"
