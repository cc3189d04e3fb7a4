"""The page says what the library computes, carries everything it needs, and trusts no recording."""

import json
import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest
from command_line import called, json_of, refused
from hypothesis import given
from hypothesis import strategies as st
from known import known as known_value
from known_run import LATENCY_NS, MS, PERIOD_NS, known_plan, known_run

from chainshaper import (
    compare_recordings,
    draw_distribution,
    draw_latency,
    export_perfetto,
    hop_breakdown,
    measure_latency,
    save_plan,
    write_report,
)
from chainshaper.planning import Plan
from chainshaper.reporting.latency import headline, verdict
from chainshaper.reporting.page import (
    distinct_names,
    latency_histogram,
    latency_points,
    report_page,
)
from chainshaper.values.durations import milliseconds
from chainshaper.values.errors import OperationError
from chainshaper.values.recording import Recording
from chainshaper.verify.measure import Measurement
from chainshaper.verify.promises import OutputsDue


class _Reader(HTMLParser):
    """Sections with the rows of their tables, the scripts, and every address of the page."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.rows: dict[str, list[list[str]]] = {}
        self.scripts: list[str] = []
        self.addresses: list[str] = []
        self.text: list[str] = []
        self._section = "header"
        self._into: list[str] | None = None  # whose last text goes on
        self.feed(page)

    @property
    def data(self) -> Any:
        return json.loads(self.scripts[0])[0]

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        about = dict(attrs)
        self.addresses += [about[name] or "" for name in ("src", "href", "action") if name in about]
        assert not [name for name in about if name.startswith("on")], "a handler as an attribute"
        if tag == "section":
            self._section = about["id"] or ""
        elif tag == "tr":
            self.rows.setdefault(self._section, []).append([])
        elif tag in ("td", "th", "script"):
            self._into = self.scripts if tag == "script" else self.rows[self._section][-1]
            self._into.append("")

    def handle_endtag(self, tag: str) -> None:
        if tag in ("td", "th", "script"):
            self._into = None

    def handle_data(self, data: str) -> None:
        if self._into is None:
            self.text.append(data)
        else:
            self._into[-1] += data


def _report(*measurements: Measurement) -> _Reader:
    return _Reader(report_page(measurements))


@pytest.fixture(scope="module")
def known(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    """A run known by hand, with everything that a recording says about itself."""
    return known_run(
        tmp_path_factory.mktemp("page") / "known",
        command=("ros2", "launch", "robot"),
        rmw="rmw_cyclonedds_cpp",
        lost={"discarded_events": 7},
        notes=("the first 5 cycles warmed up",),
    )


@pytest.fixture(scope="module")
def page(known: Recording) -> _Reader:
    return _report(measure_latency(known))


@pytest.mark.parametrize(
    ("section", "row"),
    [
        ("figures", ["average", "30.020"]),
        ("figures", ["disturbed by the machine", "0"]),
        ("figures", ["longest stall of the machine [ms]", "2.000"]),
        ("figures", ["maximum", "30.000 … 31.000", "30.020", "as predicted", "", "", ""]),
        (
            "figures",
            ["band 1", "[30.000, 31.000)", "30.020", "3 of 3 inside", "0.000", "100.0%", "100.0%"],
        ),
        ("stalls", ["core 1", "1", "2.000", "2.000", "30"]),
        ("callbacks", ["/second", "subscription /t1", "", "2", "3", "10.001", "10.001", "10.001"]),
        ("plan-0", ["output", "1", "1", "[30.000, 31.000)", "/chainshaper_t2"]),
        ("conditions", ["host", "robot"]),
        ("conditions", ["RMW", "rmw_cyclonedds_cpp"]),
        ("conditions", ["command", "ros2 launch robot"]),
        ("conditions", ["events lost", "7 discarded events"]),
        ("conditions", ["first cycle", "1970-01-01 00:00:00 UTC, 3 cycles in 0.2 s"]),
        ("conditions", ["scheduling in force", "executor: SCHED_FIFO 80, core 1 (1)"]),
        ("conditions", ["plan in force", "shaped, for /t1../t2"]),
        ("conditions", ["/second", "second", "executor", "2", "2", "SCHED_FIFO 80", "1"]),
    ],
)
def test_figures_of_a_run_known_by_hand(page: _Reader, section: str, row: list[str]) -> None:
    assert row in page.rows[section]


def test_hops_plan_and_notes_of_a_run_known_by_hand(page: _Reader) -> None:
    first, second, gate, _ = [row[1:] for row in page.rows["hops"][1:]]
    waited = ["0.000", "0.000", "0.000", "0.0%"]
    assert first == ["3", "–", "–", "–", "–", "4.000", "4.000", "4.000", "13.3%", *waited]
    assert second[:5] == ["3", "1.000", "1.000", "1.000", "3.3%"]
    assert gate[5:8] == ["0.000", "0.000", "0.000"], "the gate computes nothing,"
    assert gate[9:12] == ["14.020", "14.020", "14.020"], "it waits for the slot"
    assert "shaping_node:" in "".join(page.text), "the plan as YAML"
    assert "known: the first 5 cycles warmed up" in page.text
    drawn = page.data["bars"]["slots-0"]
    blue = [bar[:2] for _, bars in drawn["rows"] for bar in bars if bar[2] == "series-1"]
    assert (drawn["length"], blue) == (PERIOD_NS, [[30 * MS, 31 * MS]])
    assert page.data["recordings"][0]["points"]["latency"] == [LATENCY_NS] * 3


def test_every_figure_before_and_after_is_the_librarys(
    unshaped: Recording, shaped: Recording
) -> None:
    measurements = compare_recordings([unshaped, shaped]).measurements
    page = _report(*measurements)
    groups: dict[str, dict[str, list[str]]] = {}
    for row in page.rows["figures"][1:]:
        if len(row) == 1:
            latest = groups.setdefault(row[0], {})
        elif len(row) == 3:
            latest.setdefault(row[0], row[1:])
    titles = ("average", "minimum", "maximum", "jitter (max − min)", "spread p0.5–p99.5")
    fields = ("mean_ns", "min_ns", "max_ns", "jitter_ns", "spread_ns")
    for place, kind, name in (
        ("publication", "undisturbed", "undisturbed"),
        ("publication", "all complete", "statistics"),
        ("the subscriber's callback", "undisturbed", "subscriber_undisturbed"),
        ("the subscriber's callback", "all complete", "subscriber"),
    ):
        found = [getattr(one.analysis, name) for one in measurements]
        # The title of undisturbed cycles ends with how many the machine disturbed, if any.
        (rows,) = (rows for title, rows in groups.items() if f"at {place}, {kind} " in title)
        assert rows["cycles"] == [str(one.count) for one in found]
        for title, field in zip(titles, fields, strict=True):
            times = [getattr(one, field) for one in found]
            expected = ["–" if time is None else milliseconds(time) for time in times]
            assert rows[title] == expected, (place, kind, title)
    hops = hop_breakdown(measurements[1].analysis).select("count", "waiting_share")
    shares = [(str(count), f"{share:.1%}") for count, share in hops.iter_rows()]
    assert [(row[1], row[-1]) for row in page.rows["hops"]][-len(shares) - 1 : -1] == shares


def test_a_plan_that_several_recordings_share_is_shown_once(tmp_path: Path) -> None:
    one, two = known_run(tmp_path / "one"), known_run(tmp_path / "two")
    page = _report(measure_latency(one), measure_latency(two))
    assert "plan-1" not in page.rows
    assert "The plan of one, two" in "".join(page.text)


def test_incomplete_cycles_and_overruns_have_numbers_and_reasons(tmp_path: Path) -> None:
    page = _report(measure_latency(known_run(tmp_path / "known", 6, untaken=(2, 3), overran=(4,))))
    rows = page.rows["overruns"]
    assert ["4", "31.000", "publish", "31.000"] in rows
    assert ["publish", "1", "0", "0 of 1"] in rows
    (lost,) = [row for row in rows if row[0] == "known"]
    assert lost[1].startswith("lost: published, but never taken")
    assert lost[2:] == ["/t1", "2", "2, 3"]
    for title, cell in (
        ("incomplete", "2 (2 lost)"),
        ("too late for their slot", "1 (1 publish)"),
        ("next cycle hit", "0 of 1"),
        ("arrived during their slot", "0"),
    ):
        assert [title, cell] in page.rows["figures"]


def test_the_chart_over_time_reaches_to_incomplete_cycles_at_the_end(tmp_path: Path) -> None:
    """Of six cycles, 100 ms apart, the last two have no output."""
    page = _report(measure_latency(known_run(tmp_path / "known", 6, untaken=(4, 5))))
    points = page.data["recordings"][0]["points"]
    assert points["time"][-1] == 3 * PERIOD_NS
    assert points["incomplete"] == [4 * PERIOD_NS, 5 * PERIOD_NS]
    assert page.data["longest"] == 5 * PERIOD_NS


def test_the_headline_says_as_predicted_only_of_what_was_judged_and_broke_no_promise(
    known: Recording,
) -> None:
    measured = measure_latency(known)
    judged = known_value(measured.prediction)
    figures = ("mean", "max", "jitter")
    said = "Jitter 0.000 ms (known); average 30.020 ms (known)"
    for changes, judgement in (
        ({}, "as predicted, 0 of 3 outputs late"),
        (
            {name: replace(getattr(judged, name), holds=None) for name in figures},
            "not judged, 0 of 3 outputs late",
        ),
        (
            {"outputs": OutputsDue(320, 12, promised=0.0)},
            "differs from the prediction: 12 of 320 outputs late, none expected",
        ),
    ):
        one = replace(measured, prediction=replace(judged, **changes))
        stall = "Stalls of the machine, 2 ms at most, disturbed no cycle."
        assert headline(["known"], [one]) == f"{said}; {judgement}. {stall}"


@pytest.mark.parametrize(
    ("overran", "late_at_all"),
    [((1,), "1 of 4 outputs late, none expected"), ((), None)],
)
def test_one_line_says_what_a_stall_did_and_what_remains_without_it(
    overran: tuple[int, ...], late_at_all: str | None, tmp_path: Path
) -> None:
    """Core 1 stands for 21.5 ms while /second computes in cycle 1, whose output is let go at once
    as it comes, 31 ms behind the start: 0.98 ms behind all others. Of 4 latencies, of which one
    differs by d, p99.5 is 0.985 d above the others (linear between the two nearest).
    """
    known = known_run(tmp_path / "known", 4, overran=overran)
    (stall,) = known.events["machine_stall"].to_dicts()
    stalls = pl.DataFrame([stall | {"duration": 21_500_000}], known.events["machine_stall"].schema)
    measured = measure_latency(replace(known, events={**known.events, "machine_stall": stalls}))
    what = "stalls of the machine, 21.5 ms at most, disturbed 1 of 4 cycles"
    remains = "without them jitter 0.000 ms, spread 0.000 ms, 0 late"
    met, said = verdict(measured)
    if late_at_all is None:
        hit = "with these jitter 0.000 ms, spread 0.000 ms, 0 late"
        assert met
        assert said.startswith("known: promise met: jitter 0.000 ms")
    else:
        hit = "with these jitter 0.980 ms, spread 0.965 ms, 1 late"
        assert not met
        assert said.startswith(f"known: promise broken: {late_at_all}")
    assert said.endswith(f"; {what}: {hit}; {remains}")
    assert "\n" not in said
    assert headline(["known"], [measured]).endswith(f" S{what[1:]}: {hit}; {remains}.")


def test_where_no_stall_was_looked_for_none_is_named(tmp_path: Path) -> None:
    unwatched = measure_latency(known_run(tmp_path / "known", stall_meter=None))
    assert "stall" not in verdict(unwatched)[1]


def test_where_the_machine_was_not_watched_no_cycle_is_called_undisturbed(tmp_path: Path) -> None:
    page = _report(measure_latency(known_run(tmp_path / "known", stall_meter=None, plan=None)))
    titles = [row[0] for row in page.rows["figures"] if len(row) == 1]
    assert not [title for title in titles if "undisturbed" in title]
    assert "known: no meter watched, so its stalls are unknown." in page.text
    assert "known (2 complete cycles)" in page.text


def test_a_chain_without_any_complete_cycle_makes_a_page_all_the_same(tmp_path: Path) -> None:
    known = known_run(tmp_path / "known", 3, untaken=(0, 1), plan=None)
    tables = dict(known.events)
    sent = known.events["rmw_publish"].filter(pl.col("pid") != 3)
    late = sent.filter(pl.col("pid") == 2)["time"].max()
    ends = tables["callback_end"].filter(pl.col("time") < late)
    tables |= {"rmw_publish": sent, "callback_end": ends}
    measured = measure_latency(Recording(known.path, known.info, tables), "/t1../t2_tmp")
    assert _report(measured).rows["figures"]


def test_nothing_that_a_recording_says_becomes_markup(tmp_path: Path) -> None:
    evil = "/<script>alert('x')</script><img src=x onerror=alert(2)>&amp;\"'"
    known = known_run(
        tmp_path / "<b>known",
        first=evil,
        command=("</script><script>alert(3)</script>",),
        host="<h1>host</h1>",
        notes=("<!-- ", "</pre><iframe>"),
        processes={1: "<u>"},
    )
    text = report_page([measure_latency(known)])
    page = _Reader(text)
    assert len(page.scripts) == 2, "the data, and the page's own script"
    assert not re.search(r"<(img|iframe|h1>host|u>|b>|!-- )", text)
    assert evil in [row[0] for row in page.rows["callbacks"]]
    assert page.data["recordings"][0]["timeline"]["rows"][1][0] == evil
    assert ["host", "<h1>host</h1>"] in page.rows["conditions"]
    assert page.addresses == []
    assert "default-src 'none'" in text
    foreign = re.findall(r"(?:https?:)?//[\w.]+\.\w+|url\((?!#)|@import|fetch\(|import\(", text)
    assert set(foreign) <= {"http://www.w3.org"}, "the name of SVG, which no browser loads"


def test_recordings_of_one_name_are_told_apart() -> None:
    paths = [Path("/data/one/trace"), Path("/data/two/trace")]
    assert distinct_names(paths) == ["one/trace", "two/trace"]
    assert distinct_names([Path("before"), Path("after")]) == ["before", "after"]
    assert distinct_names([Path("/a"), Path("/a")]) == ["/a (1)", "/a (2)"]


def test_the_command_writes_the_report_and_never_over_another(
    known: Recording, tmp_path: Path
) -> None:
    file = tmp_path / "report.html"
    finished = called("report", known.path, "-o", file)
    assert (finished.code, finished.out) == (0, f"{file}\n")
    written = file.read_text()
    assert written == report_page([measure_latency(known)])
    for output, options, said in (
        ("report.html", [], "exists already and is not overwritten"),
        ("report.pdf", [], "ends in .html or .htm"),
        ("r.html", ["--cycle", "3"], "no cycle 3: the recordings have 3 at most, numbered from 0"),
        ("r.html", ["--chain", "/t9../t2"], "/t9"),
    ):
        assert said in refused(2, "report", known.path, "-o", tmp_path / output, *options)
    assert [entry.name for entry in tmp_path.iterdir()] == ["report.html"]
    assert file.read_text() == written
    printed = json_of("report", known.path, known.path, "-o", tmp_path / "two.html")
    assert printed.pop("report") == str(tmp_path / "two.html")
    assert printed == json_of("compare", known.path, known.path)
    # A plan can be named for a recording that does not know it.
    bare, plan = known_run(tmp_path / "known", plan=None), tmp_path / "plan.yaml"
    save_plan(Plan.of(known_plan()), plan)
    assert called("report", bare.path, "-o", tmp_path / "r.html", "--plan", plan).code == 0
    data = _Reader((tmp_path / "r.html").read_text()).data
    assert data["recordings"][0]["slots"] == [[30 * MS, 31 * MS]]


@pytest.mark.parametrize(
    ("name", "write"),
    [
        *(("report.html", write_report), ("latency.png", draw_latency)),
        *(
            ("cdf.png", draw_distribution),
            ("t.pftrace", lambda one, at: export_perfetto(one[0], at)),
        ),
    ],
)
def test_a_file_on_a_full_disk_leaves_nothing(
    name: str, write: Callable[[list[Measurement], Path], Path], known: Recording, full_disk: Path
) -> None:
    path = full_disk / name
    with pytest.raises(OperationError, match=f"{path}: the file cannot be written.*No space"):
        write([measure_latency(known)], path)
    assert [file.name for file in full_disk.iterdir()] == ["filling"]


def _traversals(latencies: Sequence[int | None], disturbed: Sequence[bool]) -> pl.DataFrame:
    rows = {
        "traversal": range(len(latencies)),
        "start": [n * PERIOD_NS for n in range(len(latencies))],
        "latency_ns": latencies,
        "complete": [one is not None for one in latencies],
        "disturbed": disturbed,
    }
    types = (pl.UInt32, pl.Int64, pl.Int64, pl.Boolean, pl.Boolean)
    return pl.DataFrame(rows, dict(zip(rows, types, strict=True)))


cycles = st.lists(
    st.tuples(st.one_of(st.none(), st.integers(0, 10**9)), st.booleans()), max_size=200
)


@given(cycles, st.integers(16, 64))
def test_points_keep_every_extreme_and_are_few(
    rows: list[tuple[int | None, bool]], limit: int
) -> None:
    frame = _traversals([one for one, _ in rows], [hit and one is not None for one, hit in rows])
    points = latency_points(frame, 0, limit)
    complete = frame.filter("complete")
    assert points["of"] == complete.height
    assert len(points["cycle"]) <= limit + 8
    if complete.height <= limit:
        assert points["cycle"] == complete["traversal"].to_list()
    drawn = frame[points["cycle"]] if points["cycle"] else frame.clear()
    assert points["latency"] == drawn["latency_ns"].to_list()
    assert points["time"] == drawn["start"].to_list() == sorted(points["time"])
    assert points["disturbed"] == [place for place, one in enumerate(drawn["disturbed"]) if one]
    for kind in (True, False):
        every = complete.filter(pl.col("disturbed") == kind)["latency_ns"]
        shown = drawn.filter(pl.col("disturbed") == kind)["latency_ns"]
        assert (every.min(), every.max()) == (shown.min(), shown.max())
    broken = frame.filter(~pl.col("complete"))["start"].to_list()
    assert set(points["incomplete"]) <= set(broken)
    assert points["incomplete"][-1:] == broken[-1:]


@given(st.lists(st.integers(0, 10**9), max_size=100), st.integers(2, 50))
def test_a_histogram_counts_every_undisturbed_cycle_once_in_its_bin(
    latencies: list[int], bins: int
) -> None:
    frame = _traversals([*latencies, 5, None], [*(False for _ in latencies), True, False])
    found = latency_histogram(frame, bins)
    width = found["width"]
    assert str(width).strip("0") == "1", "a power of ten"
    numbers, counts = np.unique(np.array(latencies, dtype=np.int64) // width, return_counts=True)
    assert (found["bin"], found["count"]) == (numbers.tolist(), counts.tolist())
    assert max(found["bin"], default=0) - min(found["bin"], default=0) < bins


def test_a_hundred_thousand_cycles_fit_a_page() -> None:
    rng = np.random.default_rng(1)
    latencies = rng.integers(30 * MS, 90 * MS, 100_000).tolist()
    frame = _traversals(latencies, (rng.random(100_000) < 0.01).tolist())
    points, histogram = latency_points(frame, 0), latency_histogram(frame)
    assert len(points["cycle"]) <= 4_100
    assert {min(latencies), max(latencies)} <= set(points["latency"])
    assert len(str(points)) + len(str(histogram)) < 400_000
    # The middle is where most cycles are, and where most of them are drawn.
    middle = [50 * MS < latency < 70 * MS for latency in points["latency"]]
    assert 0.1 < np.mean(middle) < 0.5
