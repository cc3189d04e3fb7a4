"""What was measured of a chain, and how long others can have its core while all of them run.

While a recording is made every chain runs, at one priority, in whatever order messages come. So
what one instance took is an accident. Planned together, each chain's latencies are what it takes
*alone* (its callbacks, without the time for which the others had its core), and to these is added
the longest time for which the others can have it (Joseph and Pandya, The Computer Journal 29,
1986):

    R = L + Σ ⌈(R + J) / T⌉ · C,

over all that may run before the chain on its cores, each every T, for C at most, and up to J later
in one cycle than in another: the branches that begin with it, in any order, behind the fork; chains
of a better priority, where they run at the same time; the shaping nodes of all other chains, which
take a message when it comes, and later watch the clock before a slot and publish.

The longest latency, and the last slot with it, is behind all of it; bands before that are placed by
what was measured, as far as it is in between.
"""

import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain as joined
from typing import Literal, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from chainshaper.planning.chain_plan import PER_CALLBACK, SHORTEST_SLOT_NS, UNSHAPED
from chainshaper.planning.latencies import check_latencies
from chainshaper.planning.pipeline import finished
from chainshaper.planning.shaping import CallbackTimes
from chainshaper.values.durations import format_duration, milliseconds
from chainshaper.values.errors import InputError
from chainshaper.values.plan_choices import Wishes

_Stage: TypeAlias = tuple[str, str | None]
"""A callback of a graph, by its node and what it publishes."""
UNKNOWN = -1  # of a duration that a recording does not tell
START_UP_NS = 3_000_000_000  # in so long an application starts, or ends
APART = 1.3  # so many times as long as others is no part of their tail
FEWEST = 20  # cycles, to tell one from the others
MOST_ROUNDS = 20  # until the chains' delays, which depend on each other, stay as they are
# A gate wakes up for a message, takes it, wakes up again behind its pause, and takes notes: so long
# in the simulator (docs/simulator.md), and less in a live one, beside watching and publishing.
GATE_TAKES_NS = 400_000
OFTEN = 0.05  # of a chain's cycles: so often a callback of others on its threads is worth a note


class Interfering(NamedTuple):
    """A callback that is not part of a chain, on a thread that is; ``origins`` are the nodes that
    trigger it. It ran in this ``share`` of the chain's cycles, for ``longest_ns`` at most.
    """

    label: str
    origins: tuple[str, ...]
    share: float
    longest_ns: int


class Reception(NamedTuple):
    """How an output gets to those that receive it (ns).

    ``core`` is theirs (None: several, or not known). A message is on its way for ``shortest_ns`` to
    ``longest_ns``, without the time for which others had that core. Its callbacks take ``time_ns``
    at most, and others of their executors ``beside_ns`` in a cycle; ``beside_once_ns`` is the
    sum of the longest execution of each other callback, for which an output may have to wait.
    """

    core: int | None
    shortest_ns: int
    mean_ns: int
    longest_ns: int
    time_ns: int
    beside_ns: int = 0
    beside_once_ns: int = 0


@dataclass(frozen=True)
class Profile:
    """What was measured of one chain, under a high SCHED_FIFO priority. Times in nanoseconds.

    Every field but the latencies and the period may be unknown: plans from bare latencies have no
    more than these two. What ends up in the plan file is :class:`~.chain_plan.ChainOfPlan` and
    :class:`~.chain_plan.Evidence`, whose fields have the same names here.
    """

    # Latencies and when they were ---------------------------------------------------------------
    # End-to-end latencies of undisturbed cycles, in the order of time (of all, if `all_disturbed`).
    latencies_ns: NDArray[np.int64]
    period_ns: int
    # The latencies of all cycles, in the order of time. None: all cycles were undisturbed.
    every_latency_ns: NDArray[np.int64] | None = None
    # When each cycle of `latencies_ns` began in the recording. None: a period apart.
    starts_ns: NDArray[np.int64] | None = None
    # What each cycle took in the recording, where others may delay it to the latency. None: that.
    measured_ns: NDArray[np.int64] | None = None

    # The chain and the graph around it ----------------------------------------------------------
    spec: str | None = None  # the chain as the user wrote it: /t1../t5
    nodes: tuple[str, ...] = ()  # the node of each callback of the chain
    topics: tuple[str, ...] = ()  # the topic that each callback of the chain publishes
    begins: tuple[int, str] | None = None  # the first callback: its number in the graph, its name
    # Topics that the output waits for: on the chain, on its branches, and before them.
    upstream: frozenset[str] = frozenset()
    # Node → core of its executor, for all nodes that take part, also on branches waited for.
    core_of: Mapping[str, int] = field(default_factory=dict)
    # Node with several executors → those that take part, each by the names of its callbacks.
    executors: Mapping[str, tuple[tuple[str, ...], ...]] = field(default_factory=dict)
    cores: Mapping[str, int] = field(default_factory=dict)  # any node with one core → that core
    every_node: tuple[str, ...] = ()  # all nodes of the recording
    together: tuple[tuple[str, ...], ...] = ()  # nodes that share a process
    receivers: tuple[str, ...] = ()  # nodes that subscribe to the output
    # How the output is received. None: nothing in the recording says it.
    reception: Reception | None = None
    # The callbacks of the chain and of the branches that it waits for, with their servers' times
    # (:func:`~chainshaper.planning.shaping.server_per_callback`).
    callbacks: tuple[CallbackTimes, ...] = ()

    # What each callback took --------------------------------------------------------------------
    # A row for each latency of `latencies_ns`, a column for each callback of the chain.
    steps_ns: NDArray[np.int64] = field(default_factory=lambda: np.zeros((0, 0), np.int64))
    # The same for `every_latency_ns`.
    every_step_ns: NDArray[np.int64] = field(default_factory=lambda: np.zeros((0, 0), np.int64))
    # The same as `steps_ns`, with a column for each of `callbacks`, where some are on branches.
    graph_steps_ns: NDArray[np.int64] = field(default_factory=lambda: np.zeros((0, 0), np.int64))
    # The same for `every_latency_ns`.
    every_graph_step_ns: NDArray[np.int64] = field(
        default_factory=lambda: np.zeros((0, 0), np.int64)
    )
    # Of each of `callbacks` that waits for none: how long after the chain it began, at most;
    # :data:`UNKNOWN` where that varies.
    begins_ns: tuple[int, ...] = ()

    # How it ran and was recorded ----------------------------------------------------------------
    fifo_priority: int = 84  # for the shaping node: above the executor that publishes the output
    output_depth: int | None = None  # history depth of the output's writer
    recording: str | None = None  # the recording's path
    incomplete: int = 0  # traversals without an end
    unpublished: int = 0  # those of them that the application ended without a publication
    disturbed: int = 0  # cycles that the machine disturbed
    realtime: bool | None = None  # whether the chain ran with SCHED_FIFO
    longest_stall_ns: int | None = None  # of the machine, during the recording
    lost_events: int | None = None  # lost by the tracer
    all_disturbed: bool | None = None  # whether at most one cycle was undisturbed
    simulated: tuple[str, ...] = ()  # nodes of the chain that follow /clock
    # What in the recording's events contradicts itself about the chain's callbacks, in words.
    contradictions: tuple[str, ...] = ()

    # What else runs on its cores ----------------------------------------------------------------
    utilisation: float | None = None  # the share of its core that the chain takes, 0 to 1
    interference_ns: int | None = None  # the part of the latencies that is for others
    others_ns: int = 0  # for how long gates of other chains may have its cores in a cycle
    interfering: tuple[Interfering, ...] = ()  # what else the chain's threads run

    # How the output is published ----------------------------------------------------------------
    longest_send_ns: int | None = None  # by the output's asynchronous publisher
    longest_publication_ns: int | None = None  # by its synchronous publisher
    asynchronous: bool | None = None  # whether the writer's process has a thread that publishes
    intra_process: Literal[True] | None = None  # subscribers get the output without DDS

    # Mode → the profile of the cycles in that mode, where modes were recorded.
    of_modes: Mapping[str, "Profile"] = field(default_factory=dict)

    @property
    def name(self) -> str:
        """What the chain is called in messages."""
        return self.spec or "..".join(self.topics)

    @property
    def last(self) -> str | None:
        """The node of the last callback, which publishes the output."""
        return self.nodes[-1] if self.nodes else None

    @property
    def every(self) -> NDArray[np.int64]:
        """The latencies of all cycles."""
        every = self.every_latency_ns
        return check_latencies(self.latencies_ns if every is None else every)

    @property
    def longest_ns(self) -> int:
        """The longest of the latencies that are planned from."""
        return int(check_latencies(self.latencies_ns).max())

    @property
    def measured(self) -> NDArray[np.int64]:
        """What the cycles took in the recording, in which others may have delayed them less."""
        measured = self.latencies_ns if self.measured_ns is None else self.measured_ns
        return np.minimum(measured, self.longest_ns)

    @property
    def starts(self) -> NDArray[np.int64]:
        """When each cycle began, from the beginning of the recording."""
        given = self.starts_ns
        return np.arange(len(self.latencies_ns)) * self.period_ns if given is None else given

    def chosen(self, these: NDArray[np.bool_]) -> "Profile":
        """The profile with the longest latency of these cycles; the others stay in ``every``."""
        steps = self.steps_ns[these] if len(self.steps_ns) == len(these) else self.steps_ns
        of_graph = self.graph_steps_ns
        return replace(
            self,
            graph_steps_ns=of_graph[these] if len(of_graph) == len(these) else of_graph,
            latencies_ns=self.latencies_ns[these],
            starts_ns=self.starts[these],
            measured_ns=None if self.measured_ns is None else self.measured_ns[these],
            steps_ns=steps,
            every_latency_ns=self.every,
        )


def up_to(profile: Profile, percentile: float) -> Profile:
    """The profile up to a percentile of its latencies: what takes longer is taken to be late."""
    if not 0 < percentile <= 100:
        raise InputError(f"--percentile {percentile:g}: write more than 0, at most 100")
    latencies = check_latencies(profile.latencies_ns)
    fit = max(2, math.ceil(percentile / 100 * latencies.size - 1e-6))
    of_modes = {mode: up_to(one, percentile) for mode, one in profile.of_modes.items()}
    return replace(profile.chosen(latencies <= np.sort(latencies)[fit - 1]), of_modes=of_modes)


def doubts_about(profile: Profile) -> list[str]:
    """What else than the chain decides its latencies, and what in the evidence contradicts itself,
    one sentence each."""
    doubts = (other_beginnings(profile), interfering_callback(profile), *profile.contradictions)
    return [*filter(None, doubts)]


def other_beginnings(profile: Profile) -> str | None:
    """Which nodes begin what the chain waits for, beside its first callback; None: no others."""
    first = (*profile.nodes[:1], *profile.topics[:1])
    begin = dict.fromkeys(one.node for one in profile.callbacks if not one.after)
    own = {one.node for one in profile.callbacks if (one.node, one.publishes) == first}
    if not own or not (others := [node for node in begin if node not in own]):
        return None
    begin_apart = ", ".join((profile.nodes[0], *others[:-1]))
    return (
        f"{begin_apart} and {others[-1]} start at a new offset to each other at each launch, which"
        f" changes the latency of {profile.name}. Record several launches, or use --adapt"
    )


def interfering_callback(profile: Profile) -> str | None:
    """Which callback that is not part of a chain delays it most on its own threads, and what keeps
    it away; None: none does in more than :data:`OFTEN` of its cycles.
    """
    often = [one for one in profile.interfering if one.share > OFTEN]
    if not often:
        return None
    worst = max(often, key=lambda one: one.share * one.longest_ns)
    remedy = "give it a callback group and an executor of its own"
    if worst.origins and not set(worst.origins) & {*profile.core_of}:
        nodes = " and ".join(f"--best-effort {node}" for node in worst.origins)
        remedy = f"with {nodes} what triggers it runs only when the chain does not"
    said = f"{profile.name}: in {worst.share:.0%} of its cycles one of its threads also runs"
    said += f" {worst.label}, which is not part of it, for up to"
    return f"{said} {milliseconds(worst.longest_ns, 1)} ms: {remedy}"


def deciding_cycles(profile: Profile) -> str | None:
    """Which few cycles, 1 % at most and :data:`APART` times as long as the next longest, decide the
    longest latency, the likely cause, and what leaves them out.
    """
    latencies, starts = profile.latencies_ns, profile.starts
    order = np.argsort(latencies, kind="stable")[::-1]
    most = max(1, latencies.size // 100)
    if latencies.size < FEWEST or latencies[order[most]] == 0:
        return None
    apart = latencies[order[:most]] / latencies[order[1 : most + 1]]
    number = 1 + int(np.argmax(apart))
    if apart[number - 1] < APART:
        return None
    few, next_longest = order[:number], int(latencies[order[number]])
    first, last = int(starts[few].min()), int(starts[few].max())
    where = ""
    if len(profile.steps_ns) == latencies.size and profile.nodes:
        longer = profile.steps_ns[few[0]] - np.median(profile.steps_ns, axis=0)
        more, node = milliseconds(longer.max(), 1), profile.nodes[int(np.argmax(longer))]
        where = f", {more} ms of it more than usual at {node}"
    if last < START_UP_NS:
        cause = "it is the start-up (first instances, discovery)"
        remedy = f"--skip {format_duration((last // 1_000_000_000 + 1) * 1_000_000_000)}"
    elif first > int(starts.max()) - START_UP_NS:
        cause, remedy = "the application was ending", f"--to {format_duration(first)}"
    else:
        watched = profile.longest_stall_ns is not None
        cause = "the application's own" if watched else "a stall of the machine (not watched)"
        remedy = f"--percentile {math.floor(1000 * (1 - number / latencies.size)) / 10:g}"
    cycles = ", ".join(f"{start / 1e9:.1f} s" for start in starts[few[:3]])
    longest, beyond = milliseconds(int(latencies[few[0]]), 1), milliseconds(next_longest, 1)
    said = f"{number} of {latencies.size} cycles decide{'s' * (number == 1)} the longest latency,"
    said += f" at {cycles}{', …' * (number > 3)}: {longest} ms{where}; the next longest takes"
    return f"{said} {beyond} ms. Likely {cause}: leave it out with {remedy}"


class Rival(NamedTuple):
    """What runs before a chain: every ``period_ns`` for ``cost_ns``, up to ``jitter_ns`` later."""

    period_ns: int
    cost_ns: int
    jitter_ns: int = 0


def interference(own_ns: int, rivals: Sequence[Rival], limit_ns: int) -> int:
    """How long rivals can delay what takes ``own_ns`` alone, as far as ``limit_ns`` (ns).

    >>> interference(5, [Rival(10, 2), Rival(7, 1)], 100)  # both once more in 5 + 2 + 1 > 7
    4
    """
    delay = 0
    while own_ns + delay < limit_ns:
        busy = own_ns + delay
        longer = sum(-(-(busy + one.jitter_ns) // one.period_ns) * one.cost_ns for one in rivals)
        if longer == delay:
            break
        delay = longer
    return delay


def with_interference(
    profiles: Sequence[Profile],
    groups: Sequence[Sequence[int]],
    wishes: Wishes,
    *,
    at_once: bool,
    shifting: bool = False,
) -> list[Profile]:
    """The profiles with the latencies that the chains can have while all of them run.

    ``groups`` are the places of chains that begin together. With ``at_once`` groups do not take
    turns: those of a shorter period run at a better priority, and, with ``shifting``, one may have
    to wait before it takes its stamp, from which its slots count. Where every callback has slots of
    its own nothing is added to the latency: ``others_ns`` is what each slot has to have room for.
    """
    if len(profiles) == 1:
        return list(profiles)
    if wishes.policy in PER_CALLBACK:
        return [
            replace(one, others_ns=_of_gates_beside(k, profiles, wishes))
            for k, one in enumerate(profiles)
        ]
    undelayed = [alone(profile) for profile in profiles]
    delays = [0] * len(profiles)
    for _ in range(MOST_ROUNDS):
        before = delays
        delays = _delays(undelayed, groups, wishes, before, (at_once, shifting))
        if delays == before:
            break
    measured = (profile.latencies_ns for profile in profiles)
    return list(map(_later, undelayed, delays, measured))


def _of_gates_beside(k: int, profiles: Sequence[Profile], wishes: Wishes) -> int:
    """For how long the gates of other chains may have the cores of a chain in one of its cycles."""
    if wishes.policy in UNSHAPED or wishes.publication == "asynchronous":
        return 0
    own, cores = profiles[k], {*profiles[k].core_of.values()}
    return sum(
        (1 + -(-own.period_ns // one.period_ns)) * one.cost_ns
        for place, other in enumerate(profiles)
        if place != k and other.core_of.get(other.last or "") in cores
        for one in _of_gate(other, wishes, 0, False)
    )


def _delays(
    profiles: Sequence[Profile],
    groups: Sequence[Sequence[int]],
    wishes: Wishes,
    before_ns: Sequence[int],
    together: tuple[bool, bool],
) -> list[int]:
    """How long each chain may be delayed, where the others come up to ``before_ns`` later, by
    whether they run at once, and stamps shift.
    """
    at_once, shifting = together
    delays, better = [0] * len(profiles), list[Sequence[int]]()
    gates = wishes.policy not in UNSHAPED and wishes.publication != "asynchronous"
    for group in sorted(groups, key=lambda one: (profiles[one[0]].period_ns, one[0])):
        for k in group:
            one, siblings = profiles[k], [profiles[j] for j in group if j != k]
            forked = {*_stages([one])} - {*_stages(siblings)}  # none of these before the fork
            rivals = [Rival(one.period_ns, _demand(one, siblings, forked))]
            for places in better if at_once else ():  # what waits elsewhere comes late
                chains = [profiles[j] for j in places]
                cost = _demand(one, chains, _stages([one]))
                latest = max(_longest_in_time(profiles[j], delays[j]) for j in places)
                rivals.append(Rival(chains[0].period_ns, cost, max(0, latest - cost)))
            for place, other in enumerate(profiles):
                cores = _cores(one, forked if place in group else _stages([one]))
                if gates and place != k and other.core_of.get(other.last or "") in cores:
                    rivals += _of_gate(other, wishes, before_ns[place], shifting)
                    rivals += _of_receivers(other, profiles, before_ns[place])
            delays[k] = interference(_longest_in_time(one), rivals, one.period_ns)
        better.append(group)
    return delays


def _of_gate(other: Profile, wishes: Wishes, delay_ns: int, shifting: bool) -> Iterator[Rival]:
    """For how long the gate of another chain, which may be delayed by so much, has its core: for
    each message when it comes, and when it leaves.
    """
    apart = max(0, _longest_in_time(other) - int(other.every.min()))
    yield Rival(other.period_ns, GATE_TAKES_NS, apart + delay_ns)
    longest = other.longest_publication_ns
    cost = wishes.spin_ns + (SHORTEST_SLOT_NS if longest is None else longest)
    shift = delay_ns if shifting and wishes.anchor == "stamp" else 0
    yield Rival(other.period_ns, cost, shift + (0 if wishes.bands == 1 else apart + delay_ns))


def _of_receivers(other: Profile, profiles: Sequence[Profile], delay_ns: int) -> Iterator[Rival]:
    """For how long those have the core that receive another chain's output, if they are on it."""
    one = other.reception
    if one is not None and one.core in (None, *planned_cores(profiles)):
        apart = max(0, _longest_in_time(other) - int(other.every.min()))
        yield Rival(other.period_ns, one.time_ns + one.beside_ns, apart + delay_ns)


def planned_cores(profiles: Sequence[Profile]) -> set[int]:
    """The cores on which servers run these chains."""
    return {core for one in profiles for core in one.core_of.values()}


def alone(profile: Profile) -> Profile:
    """The profile with what its callbacks took when nothing else ran; bare latencies as they are.

    That is their sum, or, where branches join, the longest way through them, with what branches
    that share a core with it run on that core: a callback of another chain that delayed this one
    while it would have waited for its branch anyway has cost it nothing. Where a branch begins by
    itself, at any time, nothing says what it would have waited for: then what was measured stands.
    """
    if not profile.steps_ns.size or UNKNOWN in profile.begins_ns:
        return profile
    return replace(
        profile,
        latencies_ns=_without_others(profile, profile.steps_ns, profile.graph_steps_ns),
        every_latency_ns=_without_others(
            profile, profile.every_step_ns, profile.every_graph_step_ns
        ),
        of_modes={mode: alone(one) for mode, one in profile.of_modes.items()},
    )


def _without_others(
    profile: Profile, steps_ns: NDArray[np.int64], graph_steps_ns: NDArray[np.int64]
) -> NDArray[np.int64]:
    """When the output is done in each cycle, from what each callback took (a row per cycle)."""
    if graph_steps_ns.size:
        after = [callback.after for callback in profile.callbacks]
        cores = [callback.core for callback in profile.callbacks]
        return finished(after, graph_steps_ns, profile.begins_ns, cores)[:, -1]
    along: NDArray[np.int64] = steps_ns.sum(axis=1)
    return along


def _later(profile: Profile, delay_ns: int, measured_ns: NDArray[np.int64]) -> Profile:
    of_modes = profile.of_modes.items()
    return replace(
        profile,
        latencies_ns=profile.latencies_ns + delay_ns,
        every_latency_ns=profile.every + delay_ns,
        measured_ns=np.clip(measured_ns, profile.latencies_ns, profile.latencies_ns + delay_ns),
        interference_ns=delay_ns,
        of_modes={mode: _later(one, delay_ns, one.latencies_ns) for mode, one in of_modes},
    )


def _longest_in_time(profile: Profile, delay_ns: int = 0) -> int:
    """The longest of all cycles that fit into the period when all are so much later: one that does
    not is late anyway.
    """
    every = profile.every + delay_ns
    return int(every[every < profile.period_ns].max(initial=0))


def _stages(profiles: Sequence[Profile]) -> dict[_Stage, CallbackTimes]:
    callbacks = joined.from_iterable(profile.callbacks for profile in profiles)
    return {(one.node, one.publishes): one for one in callbacks}


def _cores(profile: Profile, stages: Collection[_Stage]) -> set[int]:
    return {one.core for stage, one in _stages([profile]).items() if stage in stages}


def _demand(profile: Profile, others: Sequence[Profile], stages: Collection[_Stage]) -> int:
    """For how long callbacks of others have, in one cycle, the cores of these stages of a chain."""
    own, cores = _stages([profile]), _cores(profile, stages)
    theirs = (one for stage, one in _stages(others).items() if stage not in own)
    return sum(one.max_response_ns for one in theirs if one.core in cores)
