"""A loop in a thread of its own, as events show it: it wakes up, publishes, and sleeps again."""

from story import Publisher, Story

from chainshaper.values.event_declarations import SLEEPING_CALLS

NANOSLEEP, RMW_WAIT = (SLEEPING_CALLS.index(name) for name in ("clock_nanosleep", "rmw_wait"))
PID, LOOP = 20, 22


def turn(
    story: Story,
    woke: int,
    sleeps: int,
    until: int,
    *,
    tid: int = LOOP,
    pid: int = PID,
    call: int = NANOSLEEP,
    writes: tuple[tuple[Publisher, int], ...] = (),
) -> None:
    """What lies between two sleeps; the thread uses 60 % of the time between them."""
    used = woke * 10
    story.event("thread_wake", woke, pid, tid, call=call, thread_time=used)
    for publisher, time in writes:
        story.publish(publisher, time, tid)
    later = {"until": until, "call": call, "thread_time": used + (sleeps - woke) * 6 // 10}
    story.event("thread_sleep", sleeps, pid, tid, **later)


def first_sleep(story: Story, time: int, until: int, tid: int = LOOP, pid: int = PID) -> None:
    story.event("thread_sleep", time, pid, tid, until=until, call=NANOSLEEP)


def loop_behind(inputs: tuple[int, ...], wakes: tuple[int, ...], *, unit: int = 1) -> Story:
    """/sensor sends /a at these times; a loop of /actor stores it and publishes /cmd.

    The subscription runs 10 behind the sending, on another thread than the loop. A turn lasts 50,
    publishes 30 after its beginning, and was due 1 before it. All are in ``unit`` ns.
    """
    story = Story()
    timer, sensor = story.source("/sensor", 10, "/a")
    node = story.node("/actor", PID)
    reader, cmd = story.subscription(node, "/a"), story.publisher(node, "/cmd")
    for at in (unit * time for time in inputs):
        sent = at + unit
        story.runs(timer, at, at + 2 * unit, writes=((sensor, sent),))
        story.runs(reader, at + 10 * unit, at + 12 * unit, reads=sent, tid=21)
    first_sleep(story, unit * (wakes[0] - 60), unit * (wakes[0] - 1))
    for woke, following in zip(wakes, (*wakes[1:], wakes[-1] + 100), strict=True):
        at, due = unit * woke, unit * (following - 1)
        turn(story, at, at + 50 * unit, due, writes=((cmd, at + 30 * unit),))
    return story
