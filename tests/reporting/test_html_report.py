"""The page says what the library computes, carries everything it needs, and trusts no recording."""

import json
import re
import shutil
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import pytest
from command_line import called, json_of, refused
from known_run import LATENCY_NS, MS, PERIOD_NS, known_plan, known_run
from small_chain import small_chain

from chainshaper import (
    compare_recordings,
    hop_breakdown,
    measure_latency,
    plan_recording,
    save_plan,
    simulate,
    write_report,
)
from chainshaper.planning import publish_slots
from chainshaper.reporting.page import distinct_names, report_page
from chainshaper.values.durations import milliseconds
from chainshaper.values.errors import OperationError
from chainshaper.values.recording import Recording
from chainshaper.verify.measure import Measurement


class _Reader(HTMLParser):
    """Sections with the rows of their tables, the scripts, and every address of the page."""

    def __init__(self) -> None:
        super().__init__()
        self.rows: dict[str, list[list[str]]] = {}
        self.scripts: list[str] = []
        self.addresses: list[str] = []
        self.text: list[str] = []
        self._section, self._cell, self._script = "header", False, False

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        about = dict(attrs)
        self.addresses += [
            value or "" for name, value in attrs if name in ("src", "href", "action")
        ]
        assert not [name for name in about if name.startswith("on")], "a handler as an attribute"
        if tag == "section":
            self._section = about["id"] or ""
        elif tag == "tr":
            self.rows.setdefault(self._section, []).append([])
        elif tag in ("td", "th"):
            self._cell = True
            self.rows[self._section][-1].append("")
        elif tag == "script":
            self._script = True
            self.scripts.append("")

    def handle_endtag(self, tag: str) -> None:
        if tag in ("td", "th"):
            self._cell = False
        elif tag == "script":
            self._script = False

    def handle_data(self, data: str) -> None:
        if self._script:
            self.scripts[-1] += data
        elif self._cell:
            self.rows[self._section][-1][-1] += data
        else:
            self.text.append(data)


def _read(page: str) -> _Reader:
    reader = _Reader()
    reader.feed(page)
    return reader


def _report(*measurements: Measurement) -> _Reader:
    return _read(report_page(measurements))


def _data(reader: _Reader) -> Any:
    return json.loads(reader.scripts[0])


def test_figures_of_a_run_known_by_hand(tmp_path: Path) -> None:
    page = _report(measure_latency(known_run(tmp_path / "known")))
    assert ["known", "0.000", "30.020", "30.020", "3", "30.020", "0"] in page.rows["header"]
    figures = page.rows["figures"]
    assert ["average", "30.020"] in figures
    assert ["disturbed by the machine", "0"] in figures
    assert ["longest stall of the machine [ms]", "2.000"] in figures
    first, second, gate, _ = [row[1:] for row in page.rows["hops"][1:]]
    assert first == ["3", "–", "–", "–", "–", "4.000", "4.000", "4.000", "13.3%"]
    assert second[:5] == ["3", "1.000", "1.000", "1.000", "3.3%"]
    assert gate[5:8] == ["14.020", "14.020", "14.020"]
    assert ["core 1", "1", "2.000", "2.000", "30"] in page.rows["stalls"]
    assert ["/second", "subscription /t1", "", "2", "3", "10.001", "10.001", "10.001"] in (
        page.rows["callbacks"]
    )


def test_every_figure_before_and_after_is_the_librarys(
    unshaped: Recording, shaped: Recording
) -> None:
    compared = compare_recordings([unshaped, shaped])
    page = _read(report_page(compared.measurements))
    analyses = [measurement.analysis for measurement in compared.measurements]
    groups: dict[str, dict[str, list[str]]] = {}
    for row in page.rows["figures"][1:]:
        if len(row) == 1:
            latest = groups.setdefault(row[0], {})
        elif len(row) == 3:
            latest.setdefault(row[0], row[1:])
    names = {
        "average": "mean_ns",
        "minimum": "min_ns",
        "maximum": "max_ns",
        "jitter (max − min)": "jitter_ns",
        "spread p0.5–p99.5": "spread_ns",
    }
    for place, field in (("publication", ""), ("the subscriber's callback", "subscriber")):
        calm = [getattr(a, f"{field}_undisturbed".strip("_")) for a in analyses]
        every = [getattr(a, field or "statistics") for a in analyses]
        for kind, found in (("undisturbed", calm), ("all complete", every)):
            rows = groups[f"at {place}, {kind} cycles [ms]"]
            assert rows["cycles"] == [str(one.count) for one in found]
            for title, name in names.items():
                assert rows[title] == [
                    "–" if getattr(one, name) is None else milliseconds(getattr(one, name))
                    for one in found
                ], (place, kind, title)
    assert groups["cycles"]["incomplete"][0].startswith(str(analyses[0].statistics.incomplete))


def test_shares_of_the_hops_are_the_breakdowns(shaped: Recording) -> None:
    measured = measure_latency(shaped)
    page = _report(measured)
    expected = hop_breakdown(measured.analysis)
    rows = page.rows["hops"][1:-1]
    for row, (count, share) in zip(
        rows, expected.select("count", "computation_share").iter_rows(), strict=True
    ):
        assert (row[1], row[-1]) == (str(count), f"{share:.1%}")


def test_a_prediction_stands_beside_the_measurement(tmp_path: Path) -> None:
    page = _report(measure_latency(known_run(tmp_path / "known")))
    rows = page.rows["figures"]
    assert ["maximum", "30.000 … 31.000", "30.020", "as predicted", "", "", ""] in rows
    band = ["band 1", "[30.000, 31.000)", "30.020", "3 of 3 inside", "0.000", "100.0%", "100.0%"]
    assert band in rows


def test_the_plan_is_there_in_rows_in_yaml_and_drawn(tmp_path: Path) -> None:
    page = _report(measure_latency(known_run(tmp_path / "known")))
    assert ["output", "1", "1", "[30.000, 31.000)", "/chainshaper_t2"] in page.rows["plan-0"]
    assert "shaping_node:" in "".join(page.text)
    drawn = _data(page)["bars"]["slots-0"]
    assert drawn["length"] == PERIOD_NS
    blue = [bar[:2] for _, bars in drawn["rows"] for bar in bars if bar[2] == "series-1"]
    assert blue == [[30 * MS, 31 * MS]]


def test_a_plan_that_several_recordings_share_is_shown_once(tmp_path: Path) -> None:
    one, two = known_run(tmp_path / "one"), known_run(tmp_path / "two")
    page = _report(measure_latency(one), measure_latency(two))
    assert "plan-1" not in page.rows
    assert "The plan of one, two" in "".join(page.text)


def test_how_it_was_recorded_is_said(tmp_path: Path) -> None:
    known = known_run(
        tmp_path / "known",
        command=("ros2", "launch", "robot"),
        rmw="rmw_cyclonedds_cpp",
        lost={"discarded_events": 7},
        notes=("the first 5 cycles warmed up",),
    )
    page = _report(measure_latency(known))
    said = {row[0]: row[1] for row in page.rows["conditions"] if len(row) == 2}
    assert said["host"] == "robot"
    assert said["RMW"] == "rmw_cyclonedds_cpp"
    assert said["command"] == "ros2 launch robot"
    assert said["events lost"] == "7 discarded events"
    assert said["first cycle"] == "1970-01-01 00:00:00 UTC, 3 cycles in 0.2 s"
    assert said["scheduling in force"] == "executor: SCHED_FIFO 80, core 1 (1)"
    assert said["plan in force"] == "shaped, for /t1../t2"
    assert "known: the first 5 cycles warmed up" in page.text
    assert ["/second", "second", "executor", "2", "2", "SCHED_FIFO 80", "1"] in (
        page.rows["conditions"]
    )


def test_incomplete_cycles_and_overruns_have_numbers_and_reasons(tmp_path: Path) -> None:
    page = _report(measure_latency(known_run(tmp_path / "known", 6, untaken=(2, 3), overran=(4,))))
    rows = page.rows["overruns"]
    assert ["4", "31.000", "publish", "31.000"] in rows
    (lost,) = [row for row in rows if row[0] == "known"]
    assert lost[1].startswith("lost: published, but never taken")
    assert lost[2:] == ["/t1", "2", "2, 3"]
    assert ["incomplete", "2 (2 lost)"] in page.rows["figures"]
    assert ["too late for their slot", "1 (1 publish)"] in page.rows["figures"]
    assert ["came when it was open", "0"] in page.rows["figures"]


def test_where_nobody_watched_no_cycle_is_called_undisturbed(tmp_path: Path) -> None:
    page = _report(measure_latency(known_run(tmp_path / "known", stall_meter=None, plan=None)))
    titles = [row[0] for row in page.rows["figures"] if len(row) == 1]
    assert not [title for title in titles if "undisturbed" in title]
    assert "known: no meter watched, so its stalls are unknown." in page.text
    assert "known (2 complete cycles)" in page.text


def test_a_chain_without_any_complete_cycle_makes_a_page_all_the_same(tmp_path: Path) -> None:
    known = known_run(tmp_path / "known", 3, untaken=(0, 1), plan=None)
    tables = dict(known.events)
    tables["rmw_publish"] = known.events["rmw_publish"].filter(
        known.events["rmw_publish"]["pid"] != 3
    )
    late = tables["rmw_publish"].filter(tables["rmw_publish"]["pid"] == 2)["time"].max()
    tables["callback_end"] = tables["callback_end"].filter(tables["callback_end"]["time"] < late)
    measured = measure_latency(Recording(known.path, known.info, tables), "/t1../t2_tmp")
    page = _report(measured)
    assert page.rows["figures"]
    assert measure_latency(known, "/t1../t2_tmp").analysis.statistics.count == 1


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
    page = _read(text)
    assert len(page.scripts) == 2, "the data, and the page's own script"
    assert page.addresses == []
    assert not re.search(r"<(img|iframe|h1>host|u>|b>|!-- )", text)
    assert evil in [row[0] for row in page.rows["callbacks"]]
    assert _data(page)["recordings"][0]["timeline"]["rows"][1][0] == evil
    assert ["host", "<h1>host</h1>"] in page.rows["conditions"]


def test_the_page_asks_for_nothing(tmp_path: Path) -> None:
    text = report_page([measure_latency(known_run(tmp_path / "known"))])
    assert _read(text).addresses == []
    assert "default-src 'none'" in text
    foreign = re.findall(r"(?:https?:)?//[\w.]+\.\w+|url\((?!#)|@import|fetch\(|import\(", text)
    assert set(foreign) <= {"http://www.w3.org"}, "the name of SVG, which nobody loads"


def test_recordings_of_one_name_are_told_apart() -> None:
    paths = [Path("/data/one/trace"), Path("/data/two/trace")]
    assert distinct_names(paths) == ["one/trace", "two/trace"]
    assert distinct_names([Path("before"), Path("after")]) == ["before", "after"]
    assert distinct_names([Path("/a"), Path("/a")]) == ["/a (1)", "/a (2)"]


def test_the_command_writes_the_report_and_never_over_another(tmp_path: Path) -> None:
    known = known_run(tmp_path / "known")
    file = tmp_path / "report.html"
    finished = called("report", known.path, "-o", file)
    assert (finished.code, finished.out) == (0, f"{file}\n")
    written = file.read_text()
    assert written == report_page([measure_latency(known)])
    again = refused(2, "report", known.path, "-o", file)
    assert "exists already and is not overwritten" in again
    assert file.read_text() == written
    wrong = refused(2, "report", known.path, "-o", tmp_path / "report.pdf")
    assert "ends in .html or .htm" in wrong
    absent = refused(2, "report", known.path, "-o", tmp_path / "r.html", "--cycle", "3")
    assert "there is no cycle 3: the recordings have 3 at most, numbered from 0" in absent
    assert not (tmp_path / "r.html").exists()
    chain = refused(2, "report", known.path, "-o", tmp_path / "r.html", "--chain", "/t9../t2")
    assert "/t9" in chain


def test_the_command_prints_the_figures_as_compare_has_them(tmp_path: Path) -> None:
    known = known_run(tmp_path / "known")
    file = tmp_path / "report.html"
    printed = json_of("report", known.path, known.path, "-o", file)
    assert printed.pop("report") == str(file)
    assert file.exists()
    assert printed == json_of("compare", known.path, known.path)


def test_a_simulated_recording_has_a_report(tmp_path: Path) -> None:
    described = small_chain(tmp_path)
    profile = simulate(described, tmp_path / "profile", cycles=20)
    plan = plan_recording(profile)
    shaped = simulate(described, tmp_path / "shaped", plan, cycles=20)
    data = _data(_read(report_page([measure_latency(profile), measure_latency(shaped)])))
    before, after = data["recordings"]
    assert (before["slots"], after["slots"]) == ([], [list(slot) for slot in publish_slots(plan)])


def test_a_plan_can_be_named_for_a_recording_that_does_not_know_it(tmp_path: Path) -> None:
    known = known_run(tmp_path / "known", plan=None)
    save_plan(known_plan(), tmp_path / "plan.yaml")
    file = tmp_path / "r.html"
    assert called("report", known.path, "-o", file, "--plan", tmp_path / "plan.yaml").code == 0
    assert _data(_read(file.read_text()))["recordings"][0]["slots"] == [[30 * MS, 31 * MS]]


def test_a_copied_recording_makes_the_same_figures(tmp_path: Path) -> None:
    known = known_run(tmp_path / "known")
    shutil.copytree(known.path, tmp_path / "copy" / "known")
    one, two = (
        _data(_read(report_page([measure_latency(path)])))
        for path in (known.path, tmp_path / "copy" / "known")
    )
    assert one == two
    assert one["recordings"][0]["points"]["latency"] == [LATENCY_NS] * 3


def test_a_report_on_a_full_disk_leaves_nothing(tmp_path: Path, full_disk: Path) -> None:
    path = full_disk / "report.html"
    with pytest.raises(OperationError, match=f"{path}: the file cannot be written.*No space"):
        write_report([measure_latency(known_run(tmp_path / "known"))], path)
    assert not [file for file in full_disk.iterdir() if "report" in file.name]
