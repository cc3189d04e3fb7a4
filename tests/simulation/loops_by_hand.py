"""A second simulator, of loops and timers only, each thread of which has a core of its own.

It knows no priorities, no gates and no executors of several threads, and shares nothing with the
engine but the description. Topics are published synchronously; costs are constant.
"""

from collections import defaultdict, deque
from collections.abc import Callable
from heapq import heappop, heappush
from itertools import count
from typing import NamedTuple

from chainshaper.workload.description import Application, CallbackDescription
from chainshaper.workload.timing import Timing


class Instance(NamedTuple):
    """An instance of a loop (ns)."""

    begin: int
    stamp: int  # of what it used
    published: int
    end: int
    until: int  # it sleeps until then


class _Node:
    """A node's executor, which stores messages, and what it has stored: their stamps."""

    def __init__(self, reads: tuple[str, ...]) -> None:
        self.waiting: dict[str, deque[int]] = {topic: deque() for topic in reads}
        self.snapshot: deque[str] = deque()
        self.stored: dict[str, int] = {}
        self.has_news = False
        self.busy = False


class _Simulation:
    def __init__(self, application: Application, timing: Timing) -> None:
        described = application.simulation
        self.wake_up, self.take, self.publish, self.delivery = (
            times.constant_ns or 0
            for times in (described.wake_up, described.take, described.publish, described.delivery)
        )
        self.timing = timing
        self.agenda: list[tuple[int, int, Callable[[int], None]]] = []
        self.order = count()
        self.begun = defaultdict[str, int](int)
        self.nodes: dict[str, _Node] = {}
        self.instances: dict[str, list[Instance]] = {}
        for name, callback in application.callbacks():
            first = timing.start_ns + callback.phase_ns
            if callback.timer_ns is not None:
                self.plan(first, self.expiry(name, callback))
            elif callback.loop_ns is not None:
                self.nodes[name], self.instances[name] = _Node(callback.reads), []
                self.plan(first + self.wake_up, self.instance(name, callback, first))

    def run(self) -> None:
        while self.agenda and self.agenda[0][0] <= self.timing.stop_ns:
            now, _, happens = heappop(self.agenda)
            happens(now)

    def plan(self, time: int, happens: Callable[[int], None]) -> None:
        heappush(self.agenda, (time, next(self.order), happens))

    def execution(self, name: str, callback: CallbackDescription) -> int:
        sequence = callback.execution.sequence_ns or ()
        self.begun[name] += 1
        return sequence[(self.begun[name] - 1) % len(sequence)]

    def expiry(self, name: str, timer: CallbackDescription) -> Callable[[int], None]:
        def expire(now: int) -> None:
            begin = now + self.wake_up
            self.send(timer.publishes[0], begin + self.execution(name, timer), begin)
            if (due := now + (timer.timer_ns or 0)) <= self.timing.last_timer_ns:
                self.plan(due, expire)

        return expire

    def send(self, topic: str, published: int, stamp: int) -> None:
        for node in self.nodes.values():
            if topic in node.waiting:
                self.plan(published + self.delivery, self.arrival(node, topic, stamp))

    def arrival(self, node: _Node, topic: str, stamp: int) -> Callable[[int], None]:
        def arrive(now: int) -> None:
            node.waiting[topic].append(stamp)
            if not node.busy:
                node.busy = True
                self.plan(now + self.wake_up, lambda then: self.look(node, then))

        return arrive

    def look(self, node: _Node, now: int) -> None:
        """Let a node's executor take what is next: of a snapshot, each topic once."""
        if not node.snapshot:
            node.snapshot.extend(topic for topic, stamps in node.waiting.items() if stamps)
        node.busy = bool(node.snapshot)
        if node.busy:
            topic = node.snapshot.popleft()
            self.plan(now + self.take, lambda then: self.store(node, topic, then))

    def store(self, node: _Node, topic: str, now: int) -> None:
        node.stored[topic] = node.waiting[topic].popleft()
        node.has_news = True
        self.look(node, now)

    def instance(self, name: str, loop: CallbackDescription, due: int) -> Callable[[int], None]:
        def begin(now: int) -> None:
            node = self.nodes[name]
            if due > self.timing.last_timer_ns and not node.has_news:
                following = due + (loop.loop_ns or 0)
                while following < now:
                    following += loop.loop_ns or 0
                self.plan(following + self.wake_up, self.instance(name, loop, following))
                return
            node.has_news = False
            stamp = node.stored.get(loop.reads[0], now)
            published = now + self.execution(name, loop)
            end, until = published + self.publish, due + (loop.loop_ns or 0)
            while until < end:
                until += loop.loop_ns or 0
            self.instances[name].append(Instance(now, stamp, published, end, until))
            self.send(loop.publishes[0], published, stamp)
            # Where the sleep is over before it began, nothing has to wake up.
            cost = 0 if until == end else self.wake_up
            self.plan(until + cost, self.instance(name, loop, until))

        return begin


def instances_of(application: Application, timing: Timing) -> dict[str, list[Instance]]:
    """Return the instances of each loop, by its node."""
    simulation = _Simulation(application, timing)
    simulation.run()
    return simulation.instances
