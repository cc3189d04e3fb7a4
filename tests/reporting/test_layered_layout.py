"""Where boxes and arrows of a drawing go."""

import random

import pytest

from chainshaper.reporting.graph_drawing import Box, Edge, lay_out


def drawn(seed: int) -> tuple[list[Box], list[Edge]]:
    """A graph with cycles, several parts and boxes of all sizes."""
    chance = random.Random(seed)
    boxes = [Box(chance.uniform(40, 200), chance.uniform(20, 120)) for _ in range(30)]
    edges = []
    for _ in range(40):
        source, target = chance.randrange(30), chance.randrange(28)
        leaves, enters = boxes[source].height / 2, boxes[target].height / 3
        edges.append(Edge(source, target, leaves, enters))
    return boxes, edges


@pytest.mark.parametrize("seed", range(10))
def test_no_two_boxes_overlap(seed: int) -> None:
    boxes, edges = drawn(seed)
    layout = lay_out(boxes, edges)
    for one in range(len(boxes)):
        for other in range(one):
            (x, y), (u, v) = layout.corners[one], layout.corners[other]
            apart = (
                x + boxes[one].width <= u
                or u + boxes[other].width <= x
                or y + boxes[one].height <= v + 1e-6
                or v + boxes[other].height <= y + 1e-6
            )
            assert apart, (one, other)


@pytest.mark.parametrize("seed", range(10))
def test_everything_is_inside_the_picture(seed: int) -> None:
    boxes, edges = drawn(seed)
    layout = lay_out(boxes, edges)
    points = [point for route in layout.routes for point in route]
    points += layout.corners
    points += [
        (x + box.width, y + box.height) for (x, y), box in zip(layout.corners, boxes, strict=True)
    ]
    assert all(-1e-6 <= x <= layout.width + 1e-6 for x, _ in points)
    assert all(-1e-6 <= y <= layout.height + 1e-6 for _, y in points)


def test_arrows_lead_from_box_to_box_and_around_others() -> None:
    boxes = [Box(50, 20)] * 4
    edges = [Edge(0, 1, 10, 10), Edge(1, 2, 10, 10), Edge(2, 3, 10, 10), Edge(0, 3, 5, 15)]
    layout = lay_out(boxes, edges)
    assert [x for x, _ in layout.corners] == sorted(x for x, _ in layout.corners)
    long = layout.routes[3]
    assert long[0] == (layout.corners[0][0] + 50, layout.corners[0][1] + 5)
    assert long[-1] == (layout.corners[3][0], layout.corners[3][1] + 15)
    assert len(long) == 2 + 2 * 2, "in and out of the two columns that it passes"
    for box in (1, 2):
        y = layout.corners[box][1]
        assert all(not y < height < y + 20 for _, height in long[1:-1])


def test_a_cycle_is_drawn_with_one_arrow_backwards() -> None:
    layout = lay_out([Box(50, 20)] * 3, [Edge(0, 1, 1, 1), Edge(1, 2, 1, 1), Edge(2, 0, 1, 1)])
    backwards = [route for route in layout.routes if route[-1][0] < route[0][0]]
    assert len(backwards) == 1


def test_a_box_alone_and_no_box_at_all() -> None:
    alone = lay_out([Box(50, 20)], [])
    assert (alone.corners, alone.width, alone.height) == ([(0.0, 0.0)], 50, 20)
    assert lay_out([], []).corners == []
    loop = lay_out([Box(50, 20)], [Edge(0, 0, 5, 15)])
    assert loop.routes[0] == [(50, 5), (0, 15)]
