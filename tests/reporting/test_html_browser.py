"""The page in a headless Chromium: it draws without complaint, loads nothing, and can be used.

No assertion depends on how fast the browser is. Where there is none, these tests are skipped.
"""

import io
import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from chromium import Page, opened
from known_run import LATENCY_NS, known_run
from matplotlib import image

from chainshaper import measure_latency, write_report
from chainshaper.values.durations import milliseconds

CHARTS = ("over-time", "histogram", "cdf", "breakdown", "stacked", "timeline", "slots-0")


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run before shaping, known without its plan, and one after it with all that can happen."""
    folder = tmp_path_factory.mktemp("report")
    before = known_run(folder / "before", 8, plan=None)
    evil = "/<script>alert('x')</script>"
    after = known_run(folder / "after", 8, first=evil, untaken=(6,), overran=(5,))
    return write_report([measure_latency(before), measure_latency(after)], folder / "report.html")


@pytest.fixture(scope="module")
def page(report: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Page]:
    with opened(report, tmp_path_factory.mktemp("profile")) as page:
        page.wait_for("document.documentElement.dataset.drawn === 'yes'")
        yield page


@pytest.fixture(autouse=True)
def silence(page: Page) -> Iterator[None]:
    """After every test: nothing was complained about, and nothing but the page asked for."""
    yield
    page.run("scrollTo(0, 0)")
    assert page.complaints == []
    assert len(page.requests) == 1, page.requests


def _open(page: Page, recording: int, cycle: int) -> str:
    """Choose a recording and a cycle with the page's controls; what is said about it."""
    page.run(
        "for (const [control, key, value] of"
        f" [['select', 'selectedIndex', {recording}], ['input', 'value', {cycle}]]) {{"
        " const one = document.querySelector(`#timeline ${control}`); one[key] = value;"
        " one.dispatchEvent(new Event('change')); }"
    )
    return str(page.run("document.querySelector('#timeline .about').innerText"))


def _middle(page: Page, selector: str) -> tuple[float, float]:
    """The middle of an element on the screen, after scrolling there."""
    found = page.run(
        f"(() => {{ const one = document.querySelector('{selector}');"
        " one.scrollIntoView({block: 'center'}); const box = one.getBoundingClientRect();"
        " return [box.x + box.width / 2, box.y + box.height / 2]; })()"
    )
    return found[0], found[1]


@pytest.mark.parametrize("chart", CHARTS)
def test_every_chart_is_drawn(page: Page, chart: str) -> None:
    assert page.run(f"document.querySelectorAll('#{chart} svg').length") == 1
    assert page.run(f"document.querySelectorAll('#{chart} svg :is(rect, path)').length") > 2
    assert page.run(f"document.querySelector('#{chart} .waiting')") is None
    broken = "[...document.querySelectorAll('svg *')].filter((one) => "
    broken += "[...one.attributes].some(({value}) => /NaN|undefined|Infinity/.test(value))).length"
    assert page.run(broken) == 0


def test_a_name_that_looks_like_a_script_is_text(page: Page) -> None:
    assert page.run("document.scripts.length") == 2
    _open(page, 1, 0)
    titles = "[...document.querySelectorAll('#timeline title')].map((one) => one.textContent)"
    assert any("<script>" in title for title in page.run(titles))


def test_arrow_keys_walk_through_the_cycles_and_enter_opens_one(page: Page) -> None:
    page.run("document.querySelector('#over-time .chart').focus()")
    for _ in range(3):
        page.press("ArrowRight")
    said = page.run("document.getElementById('tip').innerText")
    number = re.search(r"cycle (\d+)\n([\d.]+) ms", said)
    assert number is not None, said
    assert number[2] == milliseconds(LATENCY_NS)
    page.press("Enter")
    assert page.run("document.querySelector('#timeline input').value") == number[1]
    about = page.run("document.querySelector('#timeline .about').innerText")
    assert about.startswith(f"Cycle {number[1]}: {number[2]} ms")


def test_pointing_at_a_cycle_shows_its_latency(page: Page) -> None:
    x, y = _middle(page, "#over-time svg")
    for shift in range(0, 200, 10):
        page.point_at(x + shift, y - 60)
        if not page.run("document.getElementById('tip').hidden"):
            break
    assert "cycle" in page.run("document.getElementById('tip').innerText")
    page.point_at(2, 2)
    assert page.run("document.getElementById('tip').hidden")


def test_a_cycle_is_chosen_by_number_and_its_hops_are_the_librarys(page: Page) -> None:
    _open(page, 1, 2)
    cells = "[...document.querySelectorAll('#timeline tbody tr')]"
    cells += ".map((row) => [...row.children].slice(1).map((one) => one.textContent))"
    assert page.run(cells) == [
        ["–", "0.000", "4.000", "–", "4.000"],
        ["5.000", "5.000", "15.000", "1.000", "10.000"],
        ["16.000", "16.000", "30.020", "1.000", "14.020"],
    ]


def test_another_recording_and_an_incomplete_cycle_can_be_chosen(page: Page) -> None:
    labels = "[...document.querySelectorAll('#timeline svg .label')].map((one) => one.textContent)"
    assert _open(page, 0, 6).startswith("Cycle 6: 30.020 ms; 31.020 ms at the subscriber")
    assert not [label for label in page.run(labels) if "server" in label], "no plan was in force"
    assert _open(page, 1, 6).startswith("Cycle 6: incomplete: lost (/t1)")
    assert [label for label in page.run(labels) if "server output" in label]


def test_the_cycle_for_which_a_recording_was_written_is_open(tmp_path: Path) -> None:
    run = known_run(tmp_path / "flight", 8)
    starts = measure_latency(run).analysis.traversals["start"]
    written = replace(run, info=run.info.model_copy(update={"worst_ns": (starts[3],)}))
    report = write_report([measure_latency(written)], tmp_path / "report.html")
    with opened(report, tmp_path / "profile") as page:
        page.wait_for("document.documentElement.dataset.drawn === 'yes'")
        assert page.run("document.querySelector('#timeline input').value") == "3"


def _ticks(page: Page, chart: str) -> list[float]:
    texts = page.run(
        f"[...document.querySelectorAll('#{chart} text[text-anchor=middle]')]"
        ".map((one) => one.textContent)"
    )
    return [float(text) for text in texts if re.fullmatch(r"[\d.]+", text)]


def test_dragging_zooms_and_escape_goes_back(page: Page) -> None:
    before = _ticks(page, "cdf")
    x, y = _middle(page, "#cdf svg")
    page.drag((x - 100, y), (x + 100, y))
    zoomed = _ticks(page, "cdf")
    assert max(zoomed) - min(zoomed) < max(before) - min(before)
    page.run("document.querySelector('#cdf .chart').focus()")
    page.press("Escape")
    assert _ticks(page, "cdf") == before


def test_moving_and_zooming_the_timeline_redraws_it(page: Page) -> None:
    page.run("[...document.querySelectorAll('#timeline button')].at(-1).click()")
    whole = _ticks(page, "timeline")
    page.run("document.querySelector('#timeline button[title=\"zoom in\"]').click()")
    zoomed = _ticks(page, "timeline")
    assert max(zoomed) - min(zoomed) < max(whole) - min(whole)
    page.run("document.querySelector('#timeline .chart').focus()")
    page.press("ArrowRight")
    assert min(_ticks(page, "timeline")) > min(zoomed)
    page.press("Escape")
    assert _ticks(page, "timeline") == whole


@pytest.mark.parametrize("width", [360, 1200, 2000])
def test_the_page_never_needs_to_be_scrolled_sideways(page: Page, width: int) -> None:
    page.look(width, 900)
    needed = "document.documentElement.scrollWidth <= document.documentElement.clientWidth"
    page.wait_for(needed)
    page.look(1200, 900)


def test_light_and_dark_and_paper_look_as_they_should(page: Page) -> None:
    def brightness() -> tuple[float, float]:
        shot = image.imread(io.BytesIO(page.picture()))[..., :3]
        return float(np.median(shot)), float(shot.std())

    light, contrast = brightness()
    page.look(1200, 900, dark=True)
    dark, dark_contrast = brightness()
    page.look(1200, 900)
    assert light > 0.95
    assert dark < 0.15
    assert min(contrast, dark_contrast) > 0.05, "something is on it"
    page.ask("Emulation.setEmulatedMedia", media="print")
    assert page.run("getComputedStyle(document.querySelector('.controls')).display") == "none"
    assert page.ask("Page.printToPDF")["data"].startswith("JVBERi0"), "a PDF"
    page.ask("Emulation.setEmulatedMedia", media="")


def test_the_page_begins_with_a_sentence_then_pictures_then_tables(page: Page) -> None:
    said = str(page.run("document.querySelector('header .verdict').innerText"))
    assert re.match(r"Jitter [\d.]+ ms \(.*before\) → [\d.]+ ms \(.*after\); average ", said)
    assert re.search(r"as predicted|differs from the prediction", said)
    order = page.run(
        "[...document.querySelectorAll('main .chart, main section table')]"
        ".filter(one => !one.closest('#timeline, [id^=plan]'))"
        ".map(one => one.tagName === 'TABLE' ? 't' : 'p').join('')"
    )
    assert re.fullmatch("p+t+", order)


@pytest.mark.parametrize("width", [1280, 400])
def test_no_column_is_cut_off(page: Page, width: int) -> None:
    """On a laptop, and on a telephone, where the rows of wide tables are paragraphs."""
    page.look(width, 900)
    page.run("for (const one of document.querySelectorAll('details')) one.open = true")
    cut = page.run(
        "[...document.querySelectorAll('main .scroll')]"
        ".filter(one => one.scrollWidth > one.clientWidth)"
        ".map(one => [one.closest('section')?.id, one.scrollWidth, one.clientWidth].join(' '))"
        ".join('; ')"
    )
    page.look(1280, 900)
    assert cut == ""


@pytest.mark.parametrize("width", [1280, 400])
def test_no_heading_breaks_inside_a_word(page: Page, width: int) -> None:
    page.look(width, 900)
    broken = page.run(
        "[...document.querySelectorAll('main thead th')].flatMap((head) => {"
        " const text = document.createTreeWalker(head, NodeFilter.SHOW_TEXT), broken = [];"
        " while (text.nextNode()) for (const {index, 0: word} of"
        " text.currentNode.data.matchAll(/\\S+/g)) { const range = document.createRange();"
        " range.setStart(text.currentNode, index);"
        " range.setEnd(text.currentNode, index + word.length);"
        " if (range.getClientRects().length > 1) broken.push(word); } return broken; })"
    )
    page.look(1280, 900)
    assert broken == []


def test_hops_are_named_by_their_nodes_where_the_time_goes(page: Page) -> None:
    labels = "[...document.querySelectorAll('#breakdown svg .label')].map((one) => "
    labels += "one.firstChild.data)"
    named = page.run(labels)
    assert named[:3] == ["before: /first, 4.000 ms", "before: /second, 11.000 ms", named[2]]
    assert named[2].startswith("before: /chainshaper_t2, 15.020 ms")
    assert len(named) == 6


def test_the_stacked_parts_of_a_cycle_are_told_and_open_it_below(page: Page) -> None:
    page.run("document.querySelector('#stacked .chart').focus()")
    for _ in range(2):
        page.press("ArrowRight")
    told = page.run("document.getElementById('tip').innerText")
    assert told.splitlines()[0] == "cycle 1: 30.020 ms"
    assert told.splitlines()[2:] == [
        "/second: communication 1.000, computation 10.000",
        "/chainshaper_t2: communication 1.000, waiting 14.020",
    ]
    page.press("Enter")
    about = page.run("document.querySelector('#timeline .about').innerText")
    assert about.startswith("Cycle 1: 30.020 ms")


def test_the_graphs_of_a_report_leave_its_own_texts_alone(page: Page) -> None:
    """Their rules and ids would hold for the whole page."""
    assert page.run("document.querySelectorAll('svg.graph').length") == 2
    assert page.run("document.getElementById('tip').tagName") == "DIV"
    family = "getComputedStyle(document.querySelector('#over-time svg text')).fontFamily"
    assert "system-ui" in page.run(family)


def test_a_node_is_searched_in_the_folded_graph(
    page: Page, tmp_path_factory: pytest.TempPathFactory
) -> None:
    """Of 46 nodes 45 are folded; a search opens their namespace, and what matches stands out."""
    folder = tmp_path_factory.mktemp("folded")
    nodes = [f"/tools/tool{number}" for number in range(42)]
    run = known_run(folder / "run", 3, beside=nodes)
    large = write_report([measure_latency(run)], folder / "report.html")
    with opened(large, folder / "profile") as folded:
        folded.wait_for("document.documentElement.dataset.drawn === 'yes'")
        ask = "document.querySelectorAll('.folded {}').length".format
        assert folded.run(ask("details.fold")) == 2  # /tools, and the nodes without a namespace
        assert folded.run(ask("details.fold[open]")) == 0
        search = (
            "{{ const field = document.querySelector('.folded input'); field.value = '{}';"
            " field.dispatchEvent(new Event('input')); }}"
        ).format
        folded.run(search("TOOL17"))
        assert folded.run(ask("details.fold[open]")) == 1
        assert folded.run("document.querySelector('.folded output').value") == "1 nodes and topics"
        assert folded.run(ask(".match")) == 2  # in the picture of all it is within a box
        assert folded.run(ask(".dim")) > 40
        folded.run(search(""))
        assert folded.run(ask("details.fold[open], .match, .dim")) == 0
        assert folded.complaints == []
