"""Events that contradict each other: a note that names it, and nothing is planned from them."""

from collections.abc import Callable
from pathlib import Path

import pytest
from command_line import called, json_of, refused
from ctf_writing import write_lttng_trace
from story import OFFSET, Callback, Node, Publisher, Story

from chainshaper.analysis import data_flow

MS = 1_000_000
BEGIN, CYCLES = 1000 * MS, 30


def chain(
    *, starts_every: int = 50, executes: Callable[[Story, Callback, Publisher, int], None]
) -> Story:
    """/camera's timer of 50 ms publishes /image; ``executes`` says what /detector does with each
    image, from its publication on: it publishes /objects."""
    story = Story()
    source, image = story.source("/camera", 100, "/image", 50 * MS)
    reader, objects = story.relay("/detector", 200, "/image", "/objects")
    for cycle in range(CYCLES):
        start = BEGIN + cycle * starts_every * MS
        story.runs(source, start, start + 2 * MS, writes=((image, start + MS),))
        executes(story, reader, objects, start + MS)
    return story


def as_it_should(story: Story, reader: Callback, objects: Publisher, sent: int) -> None:
    start = sent + MS
    story.runs(reader, start, start + 5 * MS, reads=sent, writes=((objects, start + 4 * MS),))


def taken_too_early(story: Story, reader: Callback, objects: Publisher, sent: int) -> None:
    story.take(reader, sent - 3 * MS, sent=sent)
    story.runs(reader, sent - 2 * MS, sent + MS, writes=((objects, sent),))


def without_takes(story: Story, reader: Callback, objects: Publisher, sent: int) -> None:
    """Two callbacks for each publication: which is whose cannot be known."""
    for start in (sent + MS, sent + 20 * MS):
        story.runs(reader, start, start + 5 * MS, writes=((objects, start + 4 * MS),))


def waits_inside(story: Story, reader: Callback, objects: Publisher, sent: int) -> None:
    """In one of thirty cycles the executor waited for work inside the callback."""
    start = sent + MS
    long = start == BEGIN + 10 * 50 * MS + 2 * MS
    end = start + (40 if long else 5) * MS
    if long:
        story.event("rclcpp_executor_wait_for_work", start + 10 * MS, 200, timeout=-1)
    story.runs(reader, start, end, reads=sent, writes=((objects, end - MS),))


def inside_itself(story: Story, reader: Callback, objects: Publisher, sent: int) -> None:
    start = sent + MS
    story.take(reader, start - 1, sent=sent)
    story.start(reader, start)
    if start == BEGIN + 10 * 50 * MS + 2 * MS:
        story.runs(reader, start + MS, start + 2 * MS)
    story.publish(objects, start + 4 * MS)
    story.end(reader, start + 5 * MS)


REFUSED = {
    "taken before published": (
        taken_too_early,
        1,
        "/detector took messages on /image up to 3 ms before they were published (30 of them, the"
        " first at 0.998000 s of the trace's clock in thread 200)",
    ),
    "no takes": (
        without_takes,
        1,
        "the callback of /detector for /image ran without any event of a take (instances: 60, the"
        " first at 1.002000 s of the trace's clock in thread 200",
    ),
    "its executor waited": (
        waits_inside,
        1,
        "the subscription callback of /detector for /image seems to last on although its thread"
        " looked for other work, or did some (instances: 1, the first at 1.502000 s of the trace's"
        " clock in thread 200)",
    ),
    "inside itself": (
        inside_itself,
        0,
        "the subscription callback of /detector for /image ran inside itself in one thread"
        " (instances: 1, the first at 1.502000 s of the trace's clock in thread 200)",
    ),
}


def trace(folder: Path, story: Story, lost: int = 1) -> Path:
    """As LTTng writes it, which says that events were lost."""
    tables = story.tables()
    return write_lttng_trace(
        folder / "trace", tables, clock_offset_ns=OFFSET, discarded_events=lost
    )


@pytest.mark.parametrize(("executes", "lost", "note"), REFUSED.values(), ids=REFUSED)
def test_a_contradiction_is_said_and_nothing_is_planned_from_it(
    tmp_path: Path,
    executes: Callable[[Story, Callback, Publisher, int], None],
    lost: int,
    note: str,
) -> None:
    folder = trace(tmp_path, chain(executes=executes), lost)
    of_chain = (folder, "--chain", "/image../objects")
    assert any(note in one for one in json_of("latency", *of_chain)["notes"])
    assert note in called("callbacks", folder).err
    assert note in called("callbacks", folder, "--json").err
    assert note in called("info", folder).err
    (about,) = json_of("info", folder)["contradictions"]
    assert note in about["note"]
    assert about["refused"]
    output = tmp_path / "budget.yaml"
    assert note in refused(2, "plan", *of_chain)
    assert note in refused(2, "budget", *of_chain, "-o", output)
    assert not output.exists()


def test_a_trace_without_contradictions_has_no_note(tmp_path: Path) -> None:
    story = chain(executes=as_it_should)
    assert data_flow(story.tables(), OFFSET).contradictions == ()
    folder = trace(tmp_path, story)
    plan = json_of("plan", folder, "--chain", "/image../objects")
    assert plan["cycle_ns"] == 50 * MS
    assert json_of("info", folder)["contradictions"] == []


def test_where_nothing_was_lost_a_callback_spins_an_executor_itself(tmp_path: Path) -> None:
    folder = trace(tmp_path, chain(executes=waits_inside), lost=0)
    found = json_of("latency", folder, "--chain", "/image../objects")
    assert any("it spins an executor itself now and then" in one for one in found["notes"])
    plan = json_of("plan", folder, "--chain", "/image../objects")
    assert plan["predicted"]["max_ns"] >= 41 * MS


@pytest.mark.parametrize("every", [25, 40, 100])
def test_a_plan_has_the_period_that_starts_show(tmp_path: Path, every: int) -> None:
    folder = trace(tmp_path, chain(starts_every=every, executes=as_it_should))
    plan = json_of("plan", folder, "--chain", "/image../objects")
    assert plan["cycle_ns"] == every * MS
    said = f"created with a period of 50 ms, but its callback starts every {every} ms"
    assert any(said in one for one in plan["warnings"])
    for verb in ("callbacks", "info"):
        assert said in called(verb, folder).err
    (about,) = json_of("info", folder)["contradictions"]
    assert not about["refused"]
    assert refused(2, "plan", folder, "--chain", "/image../objects", "--period", "50ms")


def timer_alone(starts: list[int], lasts: int = MS) -> Story:
    story = Story()
    timer, _ = story.source("/t", 1, "/x", 50 * MS)
    for start in starts:
        story.runs(timer, start, start + lasts)
    return story


def periods(story: Story) -> list[tuple[int | None, bool]]:
    return [(one.period_ns, one.refused) for one in data_flow(story.tables()).contradictions]


def test_a_period_that_changes_halfway_is_not_known() -> None:
    starts = [n * 50 * MS for n in range(20)] + [1000 * MS + n * 20 * MS for n in range(20)]
    assert periods(timer_alone(starts)) == [(None, True)]


@pytest.mark.parametrize(
    ("starts", "lasts"),
    [
        ([n * 50 * MS + (n % 2) * 20 * MS for n in range(30)], MS),  # late every other time
        ([n * 100 * MS for n in range(30)], 99 * MS),  # its callback takes longer than the period
        ([n * 50 * MS for n in range(60) if not 20 < n < 40], MS),  # it was cancelled for a while
        ([n * 50_010_000 for n in range(400)], MS),  # its clock is slow by 200 ppm
        ([n * n * 50 * MS for n in range(12)], MS),  # it is reset again and again
        ([n * 25 * MS for n in range(6)], MS),  # too few to say anything
    ],
)
def test_starts_that_are_rare_or_late_for_another_reason_are_no_contradiction(
    starts: list[int], lasts: int
) -> None:
    assert periods(timer_alone(starts, lasts)) == []


def test_a_timer_that_follows_a_replayed_clock_has_its_pace() -> None:
    story = timer_alone([n * 25 * MS for n in range(30)])
    clock = story.publisher(story.node("/player", 2), "/clock")
    (node,) = (row["node_handle"] for row in story.rows["rcl_node_init"] if row["pid"] == 1)
    reader = story.subscription(Node(1, node), "/clock")
    story.publish(clock, 10)
    story.take(reader, 20, sent=10)
    assert [one for one in data_flow(story.tables()).contradictions if one.period_ns] == []
