"""A week of `chainshaper watch` at 10,000 events a second: does its memory grow?

    python benchmarks/watch_week.py [--days 7] [--look 30s] [--rate 10000] [--keep hours.csv]

Feeds the real :class:`~chainshaper.monitor.watch.Watch` with a simulated application, in simulated
time: 6.05e9 events of 604,800 s take an hour or so. Events are records in memories as `preload.c`
lays them out, read by the real :class:`~chainshaper.sources.preload.TracedProcess`; only the clock,
the offset of CLOCK_REALTIME, the search for memories and `/proc` are simulated.

The application: six processes, two chains of five nodes (50 and 20 Hz) with subscribers, a sensor
(100 Hz), and timers that fill up the rate. Records come from a few templates of two seconds with
drawn latencies, shifted in time. In one block of a hundred a message of each chain is lost, so its
cycle is incomplete. Each half hour a process ends, and another with its nodes has a new pid, each
six hours one in the middle of the chains; CLOCK_REALTIME is set forward and back. Reads cut through
cycles that are under way.

The command reads ten times and looks once a second; here a read comes every ten seconds, a look
every thirty: a look costs much the same for few events as for many. Each analyses more events at
once than the command's, and takes more memory.

Prints a row a day, with the resident set from the third hour on (an hour of cycles stays on
purpose): the median and maximum over all looks. `--keep` writes a row an hour, from which the
figures can be computed again. At the end: all events; cycles that were counted, those that no look
counted because the chain was not clear (two processes had its nodes; one that is started again goes
on in the same chain, so it is 0), and those that were generated; the largest resident set, and its
slope from the second day on. Nothing is asserted.
"""

import argparse
import csv
import fcntl
import json
import os
import resource
import time
from collections import Counter
from collections.abc import Collection, Iterator, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple
from unittest.mock import patch

import numpy as np
from numpy.typing import NDArray

from chainshaper.monitor import watch as watch_module
from chainshaper.monitor.watch import Watch
from chainshaper.sources.preload import RECORD, TracedProcess, event_names
from chainshaper.sources.preload.events_header import FORMAT
from chainshaper.sources.preload.memory import HEADER, RING
from chainshaper.values.durations import parse_duration

US, MS, SECOND = 1_000, 1_000_000, 1_000_000_000
HOUR, DAY = 3600 * SECOND, 86_400 * SECOND
BLOCK_NS, CUT_NS = 2 * SECOND, 7 * MS  # a template's length, and where reads cut through it
READ_NS, START_NS = 10 * SECOND, 1000 * SECOND
RINGS, RING_RECORDS, OBJECT_RECORDS = 64, 1 << 14, 1 << 15  # as in preload.c
RESTART_NS = 1800 * SECOND
STEPS = {0.3: 5 * SECOND, 0.7: -37 * MS}  # of CLOCK_REALTIME: the share of the time, and by what
NUMBERS = {name: number for number, name in enumerate(event_names(), 3)}
SHIFTED = [  # whose third value is a time of CLOCK_MONOTONIC (of the thread), of CLOCK_REALTIME
    [NUMBERS[one] for one in names]
    for names in (("callback_start", "callback_end"), ("rmw_publish", "rmw_take"))
]
CHAINS = {"a": (50, 2 * MS), "b": (20, 1 * MS)}  # cycles a second, and where the first begins
NODE, CALLBACK, TIMER, SUBSCRIPTION, RCL, RMW, PUBLISHER, RMW_PUBLISHER, MESSAGE = range(1, 10)


class Callback(NamedTuple):
    """The callback of a node: of a timer, where it subscribes to nothing."""

    number: int
    process: int
    ring: int
    node: str
    topic: str = ""
    publishes: str = ""
    period_ns: int = SECOND

    def handle(self, kind: int) -> int:
        return 0x5500_0000_0000 + (self.number << 8) + (kind << 4)

    def objects(self) -> Iterator[tuple[str, list[int], dict[int, str]]]:
        """Its events of creation: names, values, texts by their place."""
        node, callback, timer, own, rcl, rmw, publisher, rmw_publisher, _ = map(
            self.handle, range(1, 10)
        )
        yield "rcl_node_init", [node, node + 8], {2: self.node, 3: "/"}
        if self.publishes:
            yield "rcl_publisher_init", [publisher, node, rmw_publisher, 0, 10], {3: self.publishes}
        if self.topic:
            yield "rcl_subscription_init", [rcl, node, rmw, 0, 10], {3: self.topic}
            yield "rclcpp_subscription_init", [rcl, own], {}
            yield "rclcpp_subscription_callback_added", [own, callback], {}
        else:
            yield "rcl_timer_init", [timer, self.period_ns], {}
            yield "rclcpp_timer_callback_added", [timer, callback], {}
            yield "rclcpp_timer_link_node", [timer, node], {}
        yield "rclcpp_callback_register", [callback], {1: f"void ({self.node})"}

    def runs(self, at: int, stamp: int, takes_ns: int) -> Iterator[tuple[int, str, list[int]]]:
        """The events of an instance that begins at an instant: times, names, values."""
        message = self.handle(MESSAGE)
        yield at, "rclcpp_executor_execute", [self.handle(RCL if self.topic else TIMER)]
        if self.topic:
            yield at + 2 * US, "rmw_take", [self.handle(RMW), message, stamp, 1]
            yield at + 3 * US, "rcl_take", [message]
            yield at + 4 * US, "rclcpp_take", [message]
        else:
            yield at + 2 * US, "rcl_timer_call", [self.handle(TIMER)]
        yield at + 5 * US, "callback_start", [self.handle(CALLBACK), 0, at + 5 * US]
        done = at + 5 * US + takes_ns
        if self.publishes:
            yield done, "rclcpp_publish", [0, message]
            yield done + 1 * US, "rcl_publish", [self.handle(PUBLISHER), message]
            sent = [self.handle(RMW_PUBLISHER), message, done + 2 * US]
            yield done + 2 * US, "rmw_publish", sent
        yield done + 5 * US, "callback_end", [self.handle(CALLBACK), 0, done + 5 * US]


def _record(when: int, tid: int, event: int, values: Sequence[int]) -> tuple[Any, ...]:
    return when, tid, 0, event, (*values, *[0] * (6 - len(values)))


class Part(NamedTuple):
    """Records of a ring, and by which shift the third value of each is moved (0: by none)."""

    records: NDArray[Any]
    shifts: NDArray[np.int64]


Template = dict[tuple[int, int], tuple[Part, Part]]  # (process, ring): before and behind the cut


class Process:
    """The memory of a process, as the library in front of ROS 2 writes it."""

    def __init__(self, pid: int, callbacks: Collection[Callback], created_ns: int) -> None:
        self.pid, self.written = pid, [0] * RINGS
        self.file = os.memfd_create("watch-week", os.MFD_ALLOW_SEALING)
        self._of_objects = HEADER.itemsize + RINGS * RING.itemsize
        records = OBJECT_RECORDS + RINGS * RING_RECORDS
        os.ftruncate(self.file, self._of_objects + records * RECORD.itemsize)
        fcntl.fcntl(self.file, fcntl.F_ADD_SEALS, fcntl.F_SEAL_SHRINK)
        objects = []
        for name, values, texts in (made for one in callbacks for made in one.objects()):
            created_ns += US
            objects.append(_record(created_ns, pid, NUMBERS[name], values))
            for place, text in texts.items():
                words = np.frombuffer(text.encode().ljust(40, b"\0"), np.uint64).tolist()
                objects.append(_record(created_ns, pid, 1, [16 * len(text) + place, *words]))
        sizes = (RINGS, RING_RECORDS, OBJECT_RECORDS)
        header = np.array([(0x63687368, FORMAT, pid, *sizes, len(objects), 0, 0, [0] * 2)], HEADER)
        os.pwrite(self.file, np.array(objects, RECORD).tobytes(), self._of_objects)
        os.pwrite(self.file, header.tobytes(), 0)

    def write(self, ring: int, part: Part, shifts: NDArray[np.int64]) -> None:
        """Write records over the ring's oldest, later by ``shifts``: none, of each clock."""
        records = part.records.copy()
        records["time"] += shifts[1]
        records["tid"] = self.pid + ring
        records["values"][:, 2] += shifts.astype(np.uint64)[part.shifts]
        place = self.written[ring] % RING_RECORDS
        left = RING_RECORDS - place  # behind it the ring begins anew
        for at, own in ((place, records[:left]), (0, records[left:])):
            start = OBJECT_RECORDS + ring * RING_RECORDS + at
            if own.size:
                os.pwrite(self.file, own.data, self._of_objects + start * RECORD.itemsize)
        self.written[ring] += records.size
        count = self.written[ring].to_bytes(8, "little")
        os.pwrite(self.file, count, HEADER.itemsize + ring * RING.itemsize)


class Application:
    """What runs, block by block. ``cycles`` are those that began, by outcome."""

    def __init__(self, rate: int) -> None:
        self.random, self.pid = np.random.default_rng(0), 1000
        self.now, self.offset = START_NS, 1_790_000_000 * SECOND
        self.events, self.cycles = 0, Counter[str]()
        self._nodes: dict[str, Callback] = {}
        for ring, name in enumerate(CHAINS):
            for hop in range(6):
                topic, publishes = f"/{name}{hop}" if hop else "", f"/{name}{hop + 1}"
                self._add(hop, ring, f"{name}_{hop}", topic, publishes if hop < 5 else "")
        self._add(5, 2, "sensor", publishes="/scan", period_ns=SECOND // 100)
        self._add(0, 3, "filter", topic="/scan")
        self._ticks = 0
        others = sum(map(len, self._rows(lost=False).values()))
        self._ticks = max(round((rate * BLOCK_NS // SECOND - others) / 4 / 5), 3)
        for number in range(15):
            self._add(number % 5, 2, f"timer_{number}", period_ns=3 * BLOCK_NS // self._ticks)
        self._templates = [self._template(lost=number == 0) for number in range(7)]
        self._last: tuple[Template, NDArray[np.int64]] = ({}, np.zeros(3, np.int64))
        self.running = [self._process(number) for number in range(6)]

    def _add(self, process: int, ring: int, node: str, *topics: Any, **more: Any) -> None:
        self._nodes[node] = Callback(len(self._nodes), process, ring, node, *topics, **more)

    def _process(self, number: int) -> Process:
        self.pid += 100
        own = [one for one in self._nodes.values() if one.process == number]
        return Process(self.pid, own, self.now - SECOND // 10)

    def _rows(self, lost: bool) -> dict[tuple[int, int], list[tuple[Any, ...]]]:
        """A block's records by process and ring."""
        rows: dict[tuple[int, int], list[tuple[Any, ...]]] = {}

        def run(node: str, at: int, stamp: int, takes_us: float) -> int:
            one = self._nodes[node]
            own = rows.setdefault((one.process, one.ring), [])
            for when, name, values in one.runs(at, stamp, int(takes_us * US)):
                own.append(_record(when, 0, NUMBERS[name], values))
            return at + int(takes_us * US) + 7 * US  # when it was published

        paths = [(*own, [f"{name}_{hop}" for hop in range(6)]) for name, own in CHAINS.items()]
        for rate, phase, path in (*paths, (100, 0, ["sensor", "filter"])):
            for cycle in range(rate * BLOCK_NS // SECOND):
                at, sent = cycle * SECOND // rate + phase, 0
                for node in path[: 3 if lost and cycle == 7 and len(path) > 3 else None]:
                    sent = run(node, at, sent, self.random.uniform(200, 1800))
                    at = sent + int(self.random.uniform(50, 400) * US)
        for number in range(5 * self._ticks):
            tick, process = divmod(number, 5)
            node, at = f"timer_{5 * (tick % 3) + process}", tick * BLOCK_NS // self._ticks
            run(node, at, 0, self.random.uniform(10, 100))
        return rows

    def _template(self, lost: bool) -> Template:
        """A block's records; ``lost``: a message of each chain has never come."""
        template: Template = {}
        for key, rows in self._rows(lost).items():
            records = np.sort(np.array(rows, RECORD), order="time", kind="stable")
            shifts = np.select([np.isin(records["event"], own) for own in SHIFTED], [1, 2])
            cut = int(np.searchsorted(records["time"], CUT_NS))
            before = Part(records[:cut], shifts[:cut])
            template[key] = before, Part(records[cut:], shifts[cut:])
        return template

    def advance(self, passed_ns: int, total_ns: int) -> None:
        """Write the rest of the block before, and this one up to the cut; at the end nothing."""
        self._write(1)
        self.now = START_NS + passed_ns
        if passed_ns == total_ns:
            self.now += CUT_NS
            return
        if passed_ns and passed_ns % RESTART_NS == 0:
            place = 2 if passed_ns % (12 * RESTART_NS) == 0 else 5
            os.close(self.running[place].file)
            self.running[place] = self._process(place)
        for share, step in STEPS.items():
            if passed_ns - BLOCK_NS < share * total_ns <= passed_ns:
                self.offset += step
        which = 0 if self.random.random() < 0.01 else int(self.random.integers(1, 7))
        self._last = self._templates[which], np.array([0, self.now, self.now + self.offset])
        self._write(0)
        self.now += CUT_NS
        self.cycles["incomplete"] += len(CHAINS) * (which == 0)
        self.cycles["complete"] += sum(map(in_a_block, CHAINS)) - len(CHAINS) * (which == 0)

    def _write(self, which: int) -> None:
        template, shifts = self._last
        for (process, ring), parts in template.items():
            if parts[which].records.size:
                self.running[process].write(ring, parts[which], shifts)
                self.events += parts[which].records.size

    def memories(
        self, _: object, known: Collection[int], _refused: object = None
    ) -> Iterator[tuple[int, TracedProcess]]:
        for one in self.running:
            if one.pid not in known:
                yield one.pid, TracedProcess(one.file, one.pid)

    def path(self, text: str) -> SimpleNamespace:
        """``/proc/PID``."""
        running = any(text == f"/proc/{one.pid}" for one in self.running)
        return SimpleNamespace(exists=lambda: running)


def in_a_block(chain: str) -> int:
    return CHAINS[chain][0] * BLOCK_NS // SECOND


def resident_mb() -> float:
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * resource.getpagesize() / 1e6


def run(application: Application, total_ns: int, look_ns: int, file: Path | None) -> None:
    """Watch the application for so long, and print what there was to be seen."""
    watch = Watch([f"/{name}1../{name}5" for name in CHAINS], users=[os.geteuid()])
    began, resident, unclear, over_ns = time.monotonic(), list[float](), 0, 0
    hours: list[list[float]] = []
    writer = None if file is None else csv.writer(file.open("w", buffering=1))
    names = ["hour", "events", "generated", "complete", "incomplete", "chain_unclear"]
    names += ["lost", "rss_median_mb", "rss_max_mb", "seconds"]
    if writer:
        writer.writerow(names)
    print("".join(f"{name:>14}" for name in ("day", *names[1:])))
    for passed_ns in range(0, total_ns + 1, BLOCK_NS):
        application.advance(passed_ns, total_ns)
        if passed_ns % look_ns and passed_ns < total_ns:
            if passed_ns % READ_NS == 0:
                watch.read()
            continue
        seen = watch.look()
        if passed_ns == total_ns:  # the last cycles are over
            application.now += 2 * watch.longest_ns
            seen = watch.look()
        json.dumps(seen.as_json())
        for chain, name in zip(seen.chains, CHAINS, strict=True):
            unclear += (passed_ns - over_ns) // BLOCK_NS * in_a_block(name) * bool(chain.problem)
        over_ns = passed_ns
        resident.append(resident_mb())
        if passed_ns and (passed_ns % HOUR == 0 or passed_ns == total_ns):
            counted = Counter[str]()
            for chain in seen.chains:
                counted.update(chain.counted)
            row = [passed_ns / HOUR, application.events, application.cycles.total()]
            row += [counted["complete"], counted["incomplete"], unclear, seen.lost]
            row += [float(np.median(resident)), max(resident), time.monotonic() - began]
            resident = []
            hours.append(row)
            if writer:
                writer.writerow([round(figure, 3) for figure in row])
            if passed_ns % DAY == 0 or passed_ns == total_ns:
                own = [one for one in hours if one[0] > 2 and one[0] > row[0] - 24] or [row]
                row = [row[0] / 24, *row[1:7], float(np.median([one[7] for one in own]))]
                row += [max(one[8] for one in own), time.monotonic() - began]
                print("".join(f"{figure:>14,.10g}" for figure in row), flush=True)
    later = [one for one in hours if one[0] > 24] or hours
    days, sizes = [one[0] / 24 for one in later], [one[7] for one in later]
    slope = np.polyfit(days, sizes, 1)[0] if len(later) > 2 else float("nan")
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e6
    print(f"{application.events:,} events, {application.events / hours[-1][-1]:,.0f} a second")
    print(f"generated: {dict(application.cycles)}, counted: {dict(counted)}, unclear: {unclear}")
    print(
        f"largest resident set: {max(one[8] for one in hours):.1f} MB at a look, {peak:.1f} in all"
    )
    print(f"slope: {slope:+.3f} MB a day")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--days", type=float, default=7)
    parser.add_argument("--look", type=parse_duration, default=30 * SECOND)
    parser.add_argument("--rate", type=int, default=10_000)
    parser.add_argument("--keep", type=Path)
    given = parser.parse_args()
    look_ns = max(given.look // BLOCK_NS, 1) * BLOCK_NS
    application = Application(given.rate)
    with patch.multiple(
        watch_module,
        time=SimpleNamespace(monotonic_ns=lambda: application.now),
        clock_offset=lambda: application.offset,
        memories=application.memories,
        Path=application.path,
    ):
        run(application, int(given.days * DAY) // BLOCK_NS * BLOCK_NS, look_ns, given.keep)


if __name__ == "__main__":
    main()
