"""Axes: what is written, what it means, and what is refused before anything is simulated."""

from typing import Any

import pytest
from quick_chain import quick_chain

from chainshaper.flow.sweep import (
    application_at,
    grid_of,
    groups_of,
    is_duration,
    parse_axis,
    plan_at,
    points_of,
    request_at,
)
from chainshaper.planning import Plan, PlanRequest
from chainshaper.values.errors import InputError
from chainshaper.workload.description import Application

MS = 1_000_000


@pytest.mark.parametrize(
    ("text", "name", "values"),
    [
        ("bands=1..3", "bands", (1, 2, 3)),
        ("bands=1..2,8,auto", "bands", (1, 2, 8, "auto")),
        ("epsilon=0,1ms", "epsilon", (0, "1ms")),
        ("overrun_probability=1e-6,null", "overrun_probability", (1e-6, None)),
        ("chain=/t1../t5", "chain", ("/t1../t5",)),
        ("a.uniform=[1ms, 2ms],[3ms, 4ms]", "a.uniform", (["1ms", "2ms"], ["3ms", "4ms"])),
        ("a={constant: 3ms}", "a", ({"constant": "3ms"},)),
    ],
)
def test_an_axis_is_read_as_yaml_has_its_values(text: str, name: str, values: Any) -> None:
    assert parse_axis(text) == (name, values)


@pytest.mark.parametrize("text", ["bands", "bands=", "=1", "a=[1", "a={"])
def test_what_is_no_axis_is_refused(text: str) -> None:
    with pytest.raises(InputError, match="is no axis: write NAME=VALUE"):
        parse_axis(text)


def test_points_count_up_from_the_last_axis() -> None:
    grid = grid_of(quick_chain(), {"bands": (1, 2), "epsilon": ("0ms", "1ms")}, cycles=1)
    counted = [(1, "0ms"), (1, "1ms"), (2, "0ms"), (2, "1ms")]
    assert points_of(grid) == [{"bands": n, "epsilon": time} for n, time in counted]


def _at(values: dict[str, Any], application: Application | None = None) -> Application:
    axes = {name: (value,) for name, value in values.items()}
    return application_at(grid_of(application or quick_chain(), axes, cycles=1), values)


def test_a_path_leads_to_any_value_of_the_description() -> None:
    found = _at(
        {
            "nodes.second.core": 2,
            "nodes.first.callbacks.0.execution": {"uniform": ["1ms", "3ms"]},
            "topics./t1.depth": 3,
            "seed": 9,
        }
    )
    assert found.nodes["second"].core == 2
    assert found.nodes["first"].callbacks[0].execution.uniform_ns == (1 * MS, 3 * MS)
    assert found.topics["/t1"].depth == 3
    assert found.seed == 9


def test_interference_is_a_load_of_half_the_time_to_all_of_it_below_the_chain() -> None:
    node = _at({"interference": "20ms"}).nodes["interference"]
    assert (node.priority, node.callbacks[0].timer_ns) == (1, 50 * MS)
    assert node.callbacks[0].execution.uniform_ns == (10 * MS, 20 * MS)
    # One that is described keeps what else it has.
    described = _at({"interference": "20ms", "nodes.interference.priority": 15})
    phase = {"nodes.interference.callbacks.0.phase": "3ms"}
    described = _at({"interference": "8ms", **phase}, described)
    node = described.nodes["interference"]
    assert (node.priority, node.callbacks[0].phase_ns) == (15, 3 * MS)
    assert node.callbacks[0].execution.uniform_ns == (4 * MS, 8 * MS)
    idle = _at({"interference": 0}, described).nodes["interference"]
    assert idle.callbacks[0].execution.uniform_ns == (0, 0)


def test_wishes_for_the_plan_are_called_as_options_or_as_in_python() -> None:
    values = {"publish-slot": ("2ms",), "epsilon_ns": (0,), "bands": (3,)}
    grid = grid_of(quick_chain(), {**values, "policy": ("shaped", "none")}, cycles=1)
    shaped, unplanned = points_of(grid)
    wished = PlanRequest(publish_slot_ns=2 * MS, epsilon_ns=0, bands=3, seed=7)
    assert request_at(grid, shaped) == wished
    assert request_at(grid, unplanned) is None
    assert application_at(grid, shaped) == grid.application


def test_a_given_plan_is_varied_by_paths_of_its_own(plan: Plan) -> None:
    axes = {"plan.overrun": ("wait", "discard"), "plan.servers.1.slots.0.1": ("25ms",)}
    grid = grid_of(quick_chain(), axes, plan, cycles=1)
    with pytest.raises(InputError, match="axis bands is a wish for a plan, but a plan is given"):
        grid_of(quick_chain(), {"bands": (1,)}, plan, cycles=1)
    found = [plan_at(grid, point) for point in points_of(grid)]
    assert [one.overrun for one in found if one] == ["wait", "discard"]
    assert all(one and one.servers[1].slots == ((21 * MS, 25 * MS),) for one in found)


def test_points_that_differ_in_the_plan_only_share_a_profile() -> None:
    axes = {
        "bands": (1, 2, 3),
        "seed": (1, 2),
        "policy": ("none", "shaped", "server-per-chain", "server-per-callback"),
    }
    grid = grid_of(quick_chain(), axes, cycles=1)
    found = {
        (values["seed"], frozenset(str(values["policy"]) for _, values in group)): (
            profiled,
            len(group),
        )
        for profiled, group in groups_of(grid, enumerate(points_of(grid)))
        for _, values in group[:1]
    }
    # Callbacks planned one by one need more of a recording.
    sizes = {
        frozenset({"none"}): (False, 3),
        frozenset({"shaped", "server-per-chain"}): (True, 6),
        frozenset({"server-per-callback"}): (True, 3),
    }
    assert found == {(seed, names): size for seed in (1, 2) for names, size in sizes.items()}


@pytest.mark.parametrize(
    ("axes", "said"),
    [
        ({"band": (1,)}, "axis band: no such thing, did you mean bands?"),
        ({"nods.first.core": (1,)}, "did you mean nodes?"),
        ({"bands": ()}, "axis bands: give at least one value"),
        ({"bands": (1, 1)}, "none of them twice"),
        ({"bands": (1,), "bands_ns": (2,)}, "an axis is given twice"),
        ({"bands": ("many",)}, "axis bands: 'many' is no value of it"),
        ({"policy": ("shape",)}, "axis policy: 'shape' is no value of it"),
        ({"epsilon": (1,)}, "axis epsilon: 1 has no unit"),
        ({"epsilon": ("1m",)}, "'1m' is not a duration"),
        ({"interference": (20,)}, "axis interference: 20 has no unit"),
        ({"nodes.third.core": (1,)}, "nodes.third.core=1: nodes.third.callbacks: is missing"),
        ({"nodes.first.core": (-1,)}, "nodes.first.core=-1: nodes.first.core:"),
        ({"nodes.first.callbacks.5.timer": ("1ms",)}, "nodes.first.callbacks.5.timer=1ms: "),
        ({"plan.overrun": ("wait",)}, "axis plan.overrun is a value of a plan's file: give the"),
    ],
)
def test_mistakes_are_named_before_anything_is_simulated(
    axes: dict[str, tuple[Any, ...]], said: str
) -> None:
    with pytest.raises(InputError) as refused:
        grid_of(quick_chain(), axes, cycles=1)
    assert said in str(refused.value)


@pytest.mark.parametrize(
    ("name", "values", "durations"),
    [
        ("epsilon", (0,), True),
        ("nodes.a.callbacks.0.phase", ("0ms", "5ms"), True),
        ("bands", (1, 2), False),
        ("policy", ("none", "shaped"), False),
    ],
)
def test_durations_are_told_from_other_values(name: str, values: Any, durations: bool) -> None:
    assert is_duration(name, values) is durations
