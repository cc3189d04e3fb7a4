"""The latency of every cycle as the sum of its parts, and times along the graph's edges."""

import xml.etree.ElementTree as ET
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest
from command_line import called
from known_run import LATENCY_NS, MS, known_run
from matplotlib import image
from story import Story

from chainshaper import analyse_latency, cycle_parts, draw_latency, measure_latency
from chainshaper.analysis import data_flow, graph_of, recorded_flow
from chainshaper.analysis.edge_times import edge_times
from chainshaper.reporting import figures
from chainshaper.reporting.cycle_parts import drawn_cycles, stacked_cycles
from chainshaper.reporting.graph_drawing import png_of, timed_graph_svg
from chainshaper.verify.measure import PARTS, hop_names


def test_parts_of_every_cycle_by_hand(tmp_path: Path) -> None:
    """Cycle 1 is as planned, cycle 2 has no output, cycle 3 overran: its output left at once."""
    run = known_run(tmp_path / "known", 4, untaken=(2,), overran=(3,))
    analysis = measure_latency(run).analysis
    assert cycle_parts(analysis).rows() == [
        (0, 0, 0, 4 * MS, 0),
        (0, 1, MS, 10 * MS, 0),
        (0, 2, MS, 0, 14 * MS + 20_000),
        (1, 0, 0, 4 * MS, 0),
        (1, 1, MS, 10 * MS, 0),
        (1, 2, MS, 0, 14 * MS + 20_000),
        (3, 0, 0, 4 * MS, 0),
        (3, 1, MS, 25 * MS, 0),
        (3, 2, MS, 0, 0),
    ]
    stacked = stacked_cycles(analysis, 100)
    assert stacked.cycles.tolist() == [0, 1, 3]
    assert stacked.latency_ns.tolist() == [LATENCY_NS, LATENCY_NS, 31 * MS]
    assert hop_names(analysis) == ["/first", "/second", "/chainshaper_t2"]


def stored_for_a_timer() -> Story:
    """/camera's image is stored by /planner, whose timer publishes it 20 after the callback ended.

    The image leaves after 4, arrives 5 later, is stored for 3; the timer computes for 4.
    """
    story = Story()
    source, image_out = story.source("/camera", 1, "/image", period=100)
    planner = story.node("/planner", 2)
    store, timer = story.subscription(planner, "/image"), story.timer(planner, period=100)
    plan = story.publisher(planner, "/plan")
    for begin in range(1_000, 2_000, 100):
        story.runs(source, begin, begin + 6, writes=((image_out, begin + 4),))
        story.runs(store, begin + 9, begin + 12, reads=begin + 4)
        story.runs(timer, begin + 32, begin + 38, writes=((plan, begin + 36),))
    return story


def test_what_waits_for_a_timer_of_its_node_is_a_part_of_its_own() -> None:
    analysis = analyse_latency(stored_for_a_timer().tables(), "/image../plan")
    parts = cycle_parts(analysis)
    assert parts.filter(hop=1).select(f"{part}_ns" for part in PARTS).rows() == [(5, 7, 20)] * 10
    sums = parts.group_by("traversal", maintain_order=True).agg(
        total=pl.sum_horizontal(f"{part}_ns" for part in PARTS).sum()
    )
    assert sums["total"].to_list() == analysis.traversals["latency_ns"].to_list() == [36] * 10


def test_of_many_cycles_the_extremes_and_a_sample_are_drawn() -> None:
    latency = np.full(10_000, 50)
    latency[[17, 5_003]] = 99, 1
    traversals = pl.DataFrame({"latency_ns": latency, "disturbed": False, "complete": True})
    drawn = drawn_cycles(traversals.with_row_index("traversal"), 400)
    assert {17, 5_003} <= {*drawn["traversal"]}
    assert 200 <= drawn.height <= 400
    assert drawn["traversal"].is_sorted()


def test_times_of_edges_by_hand(tmp_path: Path) -> None:
    """Every message takes 1 ms; that on /t1 of cycle 2 is not taken."""
    flow = recorded_flow(known_run(tmp_path / "known", 4, untaken=(2,)))
    came = {row["topic"]: row for row in edge_times(flow).iter_rows(named=True)}
    assert {topic: row["count"] for topic, row in came.items()} == {
        "/t1": 3,
        "/t2_tmp": 3,
        "/t2": 3,
    }
    assert all(
        row["communication_ns"] == {"min": MS, "mean": MS, "max": MS} for row in came.values()
    )


def test_the_graph_has_times_beside_arrows_and_callbacks(tmp_path: Path) -> None:
    run = known_run(tmp_path / "known", 4)
    flow, analysis = recorded_flow(run), measure_latency(run).analysis
    svg = timed_graph_svg(flow, analysis.graph, analysis.chain)
    drawing = ET.fromstring(svg)  # noqa: S314 - our own text
    texts = [text.text for text in drawing.iter("{http://www.w3.org/2000/svg}text")]
    assert texts.count("1.000 ms") == texts.count("max 1.000") == 3
    assert "4.001 ms, max 4.001" in texts, "/first ends 1 µs behind its publication"
    assert svg.count('class="arrow chain"') == 5, "of the last topic only its publication"
    plain = timed_graph_svg(flow, analysis.graph)
    assert "arrow chain" not in plain
    assert png_of(svg).startswith(b"\x89PNG")


def test_of_a_large_application_the_nodes_of_the_chain_alone_are_drawn_one_by_one() -> None:
    story = Story()
    timer, out = story.source("/first", 1, "/a")
    reader, _ = story.relay("/second", 2, "/a", "/b")
    for number in range(50):
        story.node(f"/beside{number}", 100 + number)
    story.runs(timer, 10, 20, writes=((out, 15),))
    story.runs(reader, 30, 40, reads=15)
    flow = data_flow(story.tables())
    analysis = analyse_latency(story.tables(), "/a")
    svg = timed_graph_svg(flow, graph_of(flow), analysis.chain)
    assert ">/first</text>" in svg
    assert ">/beside0</text>" not in svg
    assert ">51 nodes, 1 callback</text>" in svg  # /second is in that box as well


def test_pictures_of_a_chain_are_written_and_nothing_is_overwritten(tmp_path: Path) -> None:
    run = known_run(tmp_path / "known", 4)
    folder = tmp_path / "pictures"
    said = called("latency", run.path, "--figures", folder)
    names = ("latency.png", "hops.png", "distribution.png", "graph.png")
    assert [str(folder / name) in said.out for name in names] == [True] * 4
    for name in names:
        assert np.asarray(image.imread(folder / name)).std() > 0.01, f"{name} is blank"
    refused = called("latency", run.path, "--figures", folder)
    assert refused.code == 2
    assert "exists already and is not overwritten" in refused.err
    graph = tmp_path / "graph.png"
    called("graph", run.path, "-o", graph)
    assert np.asarray(image.imread(graph)).std() > 0.01


def test_cycles_beyond_the_axis_are_marked_at_its_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Cycle 3 took 31 ms; were all others 20 ms, the axis would end at 23 ms."""
    drawn: list[Any] = []
    monkeypatch.setattr(figures, "save_figure", lambda figure, _: drawn.append(figure))
    measured = measure_latency(known_run(tmp_path / "known", 4, overran=(3,)))
    draw_latency([measured], "")
    assert "beyond" not in drawn[0].axes[0].get_xlabel()
    monkeypatch.setattr(figures, "_limit_ms", lambda _: 30.5)
    draw_latency([measured], "")
    axes = drawn[1].axes[0]
    (beyond,) = [line for line in axes.lines if line.get_marker() == "^"]
    assert (list(beyond.get_xdata()), list(beyond.get_ydata())) == ([3], [30.5])
    assert "triangles: beyond the axis" in axes.get_xlabel()
