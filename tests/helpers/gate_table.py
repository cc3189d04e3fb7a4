"""What gates do with messages: the table, and the Python gate walking through one of its cases."""

from collections import deque
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, TypeAlias

import yaml

from chainshaper.robot.decision import Release, missed
from chainshaper.robot.gate import Gate, GateModes
from chainshaper.robot.waiting import Queue

MS = 1_000_000
PUBLISHING_NS = MS // 8


ChangeKind: TypeAlias = Literal["mode", "moved", "phase"]


@dataclass(frozen=True)
class Change:
    """What changes in a gate's schedule from when on (ns): its mode, slots or phase."""

    from_ns: int
    kind: ChangeKind
    value: int | str

    def put_into(self, queue: Queue) -> None:
        """Change the schedule of a gate."""
        if isinstance(self.value, str):
            assert queue.switch(self.value, self.from_ns)
        elif self.kind == "moved":
            queue.move_slots(self.value, self.from_ns)
        else:
            queue.set_phase(self.value, self.from_ns)


@dataclass(frozen=True)
class Case:
    """Messages that come to a gate, each with its arrival and stamp (ns)."""

    gate: Gate
    arrivals: tuple[tuple[int, int | None], ...]
    changes: tuple[Change, ...] = ()
    steps: tuple[int, ...] = ()  # of the wall clock, which the first message behind it shows
    name: str = ""
    leave: tuple[int | str, ...] = ()
    late_ns: int = 0  # a thread that slept wakes up so late

    def changes_of(self, kind: ChangeKind) -> list[Change]:
        """Those of one kind."""
        return [change for change in self.changes if change.kind == kind]


@dataclass(frozen=True)
class Outcome:
    """When a message left (None: never), and what was decided about it."""

    left_ns: int | None
    release: Release

    @property
    def leave(self) -> int | str:
        """As the table has it."""
        return self.release.dropped or self.left_ns or 0


def cases() -> list[Case]:
    """The cases of the table."""
    text = (Path(__file__).parents[1] / "robot/gate_conformance.yaml").read_text()
    return [_case(entry) for entry in yaml.safe_load(text)]


def _ns(time: float) -> int:
    return round(time * MS)


def _case(entry: dict[str, Any]) -> Case:
    known = dict(entry["gate"])
    slots = tuple((_ns(start), _ns(end)) for start, end in known.pop("slots"))
    modes = GateModes(**known.pop("modes")) if "modes" in known else None
    gate = Gate(slots=slots, cycle_ns=_ns(known.pop("cycle")), modes=modes, **known)
    both = [come if isinstance(come, list) else [come, come] for come in entry["arrivals"]]
    return Case(
        gate=gate,
        arrivals=tuple((_ns(arrival), _ns(stamp)) for arrival, stamp in both),
        changes=tuple(
            Change(_ns(time), kind, value if isinstance(value, str) else _ns(value))
            for time, change in entry.get("changes", ())
            for kind, value in change.items()
        ),
        steps=tuple(_ns(time) for time in entry.get("steps", ())),
        name=entry["name"],
        leave=tuple(
            instant if isinstance(instant, str) else _ns(instant) for instant in entry["leave"]
        ),
    )


def walk(case: Case, publishing_ns: int = PUBLISHING_NS) -> list[Outcome]:
    """What the Python gate does, without a clock; in the order in which messages come."""
    queue, now = Queue(case.gate), 0
    for change in case.changes:
        change.put_into(queue)
    outcomes: dict[int, Outcome] = {}
    coming, steps = deque(enumerate(case.arrivals)), deque(case.steps)

    def come_until(time: int) -> None:
        while coming and coming[0][1][0] <= time:
            number, (arrival, stamp) = coming.popleft()
            if steps and steps[0] <= arrival:
                steps.popleft()
                queue.doubt_stamps(arrival)
            if (full := queue.arrive(b"", arrival, stamp, number)) is not None:
                outcomes[full.message.about] = Outcome(None, full.release)

    while coming or queue.waiting:
        if not queue.waiting:
            now = max(now, coming[0][1][0])
            come_until(now)
        oldest = queue.waiting[0]
        release = queue.decide()
        if release.at_ns is not None:
            slept = release.at_ns > now
            now = max(now, release.at_ns)
            come_until(now)
            if queue.waiting[0] is not oldest:
                continue
            now += case.late_ns * slept
            if queue.replaced(release, now):
                release = release.dropping("replaced")
            elif case.gate.policy == "discard" and missed(case.gate, release, now):
                release = replace(release.dropping("discarded"), overrun="discard")
        outcomes[oldest.about] = Outcome(None if release.dropped else now, release)
        queue.leave(release, now)
        now += 0 if release.dropped else publishing_ns
        queue.free_ns = now
        come_until(now)
    return [outcomes[number] for number in range(len(case.arrivals))]
