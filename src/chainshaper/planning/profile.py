"""What was measured of a chain, and how long others can have its core while all of them run.

While a recording is made, every chain runs, at one priority, in whatever order messages come. So
the latency of an instance depends on which others happened to run. For a plan of several chains,
the latency of each is what it takes *alone* (its callbacks, without the time for which the others
had its core), and the longest time for which the others can have it (Joseph and Pandya, The
Computer Journal 29, 1986):

    R = L + Σ ⌈(R + J) / T⌉ · C,

The sum is over all that may run before the chain on its cores, each every T, for C at most, and up
to J later in one cycle than in another:

* the branches that begin with the chain, in any order, behind the fork;
* chains of a better priority, where they run at the same time;
* the shaping nodes of all other chains, which take a message when it comes, and later watch the
  clock before a slot and publish.

The longest latency, and with it the last slot, is behind all of this delay. Bands before the last
are placed by what was measured, as far as it lies between the two.
"""

import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
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
UNKNOWN = -1  # a duration that a recording does not tell
START_UP_NS = 3_000_000_000  # an application takes so long to start, or to end
APART = 1.3  # latencies so many times as long as the next longest are no part of the same tail
FEWEST = 20  # cycles: with fewer, none can be told apart from the others
MOST_ROUNDS = 20  # until the chains' delays, which depend on each other, stay as they are
# A gate wakes up for a message, takes it, wakes up again behind its pause, and logs: that takes so
# long in the simulator (docs/simulator.md), and less in a live one, beside watching and publishing.
GATE_TAKES_NS = 400_000
OFTEN = 0.05  # a callback of others that runs on a chain's threads in more cycles is worth a note


class Interfering(NamedTuple):
    """A callback that is not part of a chain, and runs on one of the chain's threads."""

    label: str
    origins: tuple[str, ...]  # the nodes that trigger it
    share: float  # of the chain's cycles in which it ran
    longest_ns: int  # how long it ran, at most


class Reception(NamedTuple):
    """How an output gets to the nodes that receive it (times in ns)."""

    core: int | None  # of the receivers; None: several, or not known
    # How long a message is on its way, without the time for which others had that core.
    shortest_ns: int
    mean_ns: int
    longest_ns: int
    time_ns: int  # how long the callbacks that receive it take, at most
    beside_ns: int = 0  # how long other callbacks of their executors take in a cycle, at most
    # The sum of the longest execution of each such callback: an output may have to wait for it.
    beside_once_ns: int = 0


@dataclass(frozen=True)
class RecordedLoop:
    """A loop that a chain ends in, or goes through, as it was measured. Times in nanoseconds.

    For its fields see :class:`~.chain_plan.PlannedLoop`; further:

    * ``chain``: as the user wrote it, through the loop.
    * ``stored_ns``: from the publication of what the loop reads until the callback that stores it
      begins, and until it ends: the shortest of the first, and of the second the longest of 99.5 %
      and of all.
    * ``storing_ns``: how long that callback takes, all but 0.5 % of its instances.
    * ``takes_itself``: whether the loop's thread takes the messages, so that no event says when
      they could have been taken.
    * ``core``: where its thread has to run; None: several, or not known.
    * ``time_ns``, ``once_ns``: how long its instances take in a cycle of the chain, and how long
      one takes, at most.
    * ``inferred``: whether no event tells of its sleeps, so that each of its instances starts with
      its publication.
    * ``before_ns``: so much sooner, in step, the output has to leave, since outputs of other chains
      leave then for the same loop.
    """

    chain: str
    node: str
    topic: str
    samples: int
    stored_ns: tuple[int, int, int]
    storing_ns: int = 0
    thread: str | None = None
    period_ns: int | None = None
    intervals_ns: tuple[int, int, int] | None = None
    phase_ns: int = 0
    jitter_ns: int = 0
    drift_ppm: float = 0.0
    takes_itself: bool = False
    core: int | None = None
    realtime_priority: int | None = None
    time_ns: int = 0
    once_ns: int = 0
    inferred: bool = False
    before_ns: int = 0


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
    # Those of them that run one callback group → its id, as callback_isolated_executor names it.
    callback_groups: Mapping[tuple[str, tuple[str, ...]], str] = field(default_factory=dict)
    cores: Mapping[str, int] = field(default_factory=dict)  # any node with one core → that core
    every_node: tuple[str, ...] = ()  # all nodes of the recording
    together: tuple[tuple[str, ...], ...] = ()  # nodes that share a process
    receivers: tuple[str, ...] = ()  # nodes that subscribe to the output
    # How the output is received. None: nothing in the recording says it.
    reception: Reception | None = None
    # The loop that reads the output. None: the chain goes through none.
    loop: RecordedLoop | None = None
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
    through: tuple[str, ...] = ()  # what the user has declared: /in=/out
    recording: str | None = None  # the recording's path
    incomplete: int = 0  # traversals without an end
    unpublished: int = 0  # those of them that the application ended without a publication
    disturbed: int = 0  # cycles that the machine disturbed
    realtime: bool | None = None  # whether the chain ran with SCHED_FIFO
    hosts: tuple[str, ...] | None = None  # those that a chain across several went over
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
        """The name of the chain in messages."""
        return self.spec or "..".join(self.topics)

    @property
    def last(self) -> str | None:
        """The node of the last callback, which publishes the output."""
        return self.nodes[-1] if self.nodes else None

    @cached_property
    def every(self) -> NDArray[np.int64]:
        """The latencies of all cycles. Nobody writes into it: it is checked once."""
        every = self.every_latency_ns
        checked = check_latencies(self.latencies_ns if every is None else every)
        checked.flags.writeable = False
        return checked

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
    def planned_steps_ns(self) -> NDArray[np.int64]:
        """``graph_steps_ns`` where some callbacks are on branches, else ``steps_ns``."""
        return self.graph_steps_ns if self.graph_steps_ns.size else self.steps_ns

    @property
    def every_planned_step_ns(self) -> NDArray[np.int64]:
        """The same of all cycles; columns as those of ``planned_steps_ns``."""
        return self.every_graph_step_ns if self.graph_steps_ns.size else self.every_step_ns

    @property
    def starts(self) -> NDArray[np.int64]:
        """When each cycle began, from the beginning of the recording."""
        given = self.starts_ns
        return np.arange(len(self.latencies_ns)) * self.period_ns if given is None else given

    def chosen(self, cycles: NDArray[np.bool_]) -> "Profile":
        """Return the profile with the latencies of these cycles; all of them stay in ``every``."""
        steps, graph_steps = self.steps_ns, self.graph_steps_ns
        return replace(
            self,
            latencies_ns=self.latencies_ns[cycles],
            starts_ns=self.starts[cycles],
            measured_ns=None if self.measured_ns is None else self.measured_ns[cycles],
            steps_ns=steps[cycles] if len(steps) == len(cycles) else steps,
            graph_steps_ns=graph_steps[cycles] if len(graph_steps) == len(cycles) else graph_steps,
            every_latency_ns=self.every,
        )


def up_to(profile: Profile, percentile: float) -> Profile:
    """Return the profile up to a percentile of its latencies; longer ones are taken to be late."""
    if not 0 < percentile <= 100:
        raise InputError(f"--percentile {percentile:g}: write more than 0, at most 100")
    latencies = check_latencies(profile.latencies_ns)
    count = max(2, math.ceil(percentile / 100 * latencies.size - 1e-6))
    shorter = profile.chosen(latencies <= np.sort(latencies)[count - 1])
    of_modes = {mode: up_to(of_mode, percentile) for mode, of_mode in profile.of_modes.items()}
    return replace(shorter, of_modes=of_modes)


def doubts_about(profile: Profile) -> list[str]:
    """Say what beside the chain decides its latencies, and what contradicts itself in the evidence.

    Each doubt is a sentence.
    """
    doubts = (other_beginnings(profile), interfering_callback(profile), *profile.contradictions)
    return [*filter(None, doubts)]


def other_beginnings(profile: Profile) -> str | None:
    """Say which nodes beside the chain's first begin what the chain waits for; None: no others."""
    first = (*profile.nodes[:1], *profile.topics[:1])
    begin = dict.fromkeys(callback.node for callback in profile.callbacks if not callback.after)
    of_chain = {
        callback.node
        for callback in profile.callbacks
        if (callback.node, callback.publishes) == first
    }
    beside = [node for node in begin if node not in of_chain]
    if not of_chain or not beside:
        return None
    begin_apart = ", ".join((profile.nodes[0], *beside[:-1]))
    return (
        f"{begin_apart} and {beside[-1]} start at a new offset to each other at each launch, which"
        f" changes the latency of {profile.name}. Record several launches, or use --adapt"
    )


def interfering_callback(profile: Profile) -> str | None:
    """Say which callback beside a chain delays it most on the chain's threads, and what helps.

    None: none does in more than :data:`OFTEN` of the chain's cycles.
    """
    often = [callback for callback in profile.interfering if callback.share > OFTEN]
    if not often:
        return None
    worst = max(often, key=lambda callback: callback.share * callback.longest_ns)
    remedy = "give it a callback group and an executor of its own"
    if worst.origins and not set(worst.origins) & {*profile.core_of}:
        nodes = " and ".join(f"--best-effort {node}" for node in worst.origins)
        remedy = f"with {nodes} what triggers it runs only when the chain does not"
    doubt = f"{profile.name}: in {worst.share:.0%} of its cycles one of its threads also runs"
    doubt += f" {worst.label}, which is not part of it, for up to"
    return f"{doubt} {milliseconds(worst.longest_ns, 1)} ms: {remedy}"


def deciding_cycles(profile: Profile) -> str | None:
    """Say which few cycles decide the longest latency, the likely cause, and what leaves them out.

    They are 1 % of all at most, and :data:`APART` times as long as the next longest. None: no such
    cycles are there.
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
    if number > 3:
        cycles += ", …"
    longest, shorter = milliseconds(int(latencies[few[0]]), 1), milliseconds(next_longest, 1)
    verb = "decides" if number == 1 else "decide"
    doubt = f"{number} of {latencies.size} cycles {verb} the longest latency,"
    doubt += f" at {cycles}: {longest} ms{where}; the next longest takes"
    return f"{doubt} {shorter} ms. Likely {cause}: leave it out with {remedy}"


class Rival(NamedTuple):
    """Something that runs before a chain on its cores (T, C and J above)."""

    period_ns: int  # from one run to the next
    cost_ns: int  # of a run, at most
    jitter_ns: int = 0  # how much later it comes in one cycle than in another, at most


def interference(alone_ns: int, rivals: Sequence[Rival], limit_ns: int) -> int:
    """Return how long (ns) rivals can delay what takes ``alone_ns``, as far as ``limit_ns``.

    >>> interference(5, [Rival(10, 2), Rival(7, 1)], 100)  # the second runs twice in 5 + 2 + 1 > 7
    4
    """
    delay = 0
    while alone_ns + delay < limit_ns:
        busy = alone_ns + delay
        longer = sum(
            -(-(busy + rival.jitter_ns) // rival.period_ns) * rival.cost_ns for rival in rivals
        )
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
    """Return the profiles with the latencies that the chains can have while all of them run.

    ``groups`` are the places of chains that begin together. With ``at_once`` groups do not take
    turns: those of a shorter period run at a better priority. With ``shifting`` one of a worse
    priority may have to wait before it takes its stamp, from which its slots count. Where every
    callback has slots of its own, nothing is added to the latency: each slot has to have room for
    ``others_ns``.
    """
    if len(profiles) == 1:
        return list(profiles)
    if wishes.policy in PER_CALLBACK:
        return [
            replace(profile, others_ns=_of_gates_beside(place, profiles, wishes))
            for place, profile in enumerate(profiles)
        ]
    undelayed = [alone(profile) for profile in profiles]
    delays = [0] * len(profiles)
    for _ in range(MOST_ROUNDS):
        before = delays
        delays = _delays(
            undelayed, groups, wishes, before_ns=before, at_once=at_once, shifting=shifting
        )
        if delays == before:
            break
    measured = (profile.latencies_ns for profile in profiles)
    return list(map(_later, undelayed, delays, measured))


def _of_gates_beside(place: int, profiles: Sequence[Profile], wishes: Wishes) -> int:
    """Return how long gates of other chains may have the cores of a chain in one of its cycles."""
    if wishes.policy in UNSHAPED or wishes.publication == "asynchronous":
        return 0
    profile, cores = profiles[place], {*profiles[place].core_of.values()}
    return sum(
        (1 + -(-profile.period_ns // rival.period_ns)) * rival.cost_ns
        for place_beside, beside in enumerate(profiles)
        if place_beside != place and beside.core_of.get(beside.last or "") in cores
        for rival in _of_gate(beside, wishes, 0, shifting=False)
    )


def _delays(
    profiles: Sequence[Profile],
    groups: Sequence[Sequence[int]],
    wishes: Wishes,
    *,
    before_ns: Sequence[int],
    at_once: bool,
    shifting: bool,
) -> list[int]:
    """Return how long each chain may be delayed (ns), as :func:`with_interference` has it.

    ``before_ns`` has how much later each chain comes by what is known so far.
    """
    delays, better = [0] * len(profiles), list[Sequence[int]]()
    gates = wishes.policy not in UNSHAPED and wishes.publication != "asynchronous"
    for group in sorted(groups, key=lambda places: (profiles[places[0]].period_ns, places[0])):
        for place in group:
            profile = profiles[place]
            siblings = [profiles[sibling] for sibling in group if sibling != place]
            # Before the fork, siblings are the same callbacks, and delay nothing.
            forked = {*_stages([profile])} - {*_stages(siblings)}
            rivals = [Rival(profile.period_ns, _demand(profile, siblings, forked))]
            for better_group in better if at_once else ():
                chains = [profiles[above] for above in better_group]
                cost = _demand(profile, chains, _stages([profile]))
                # A callback that waits for others elsewhere may come late.
                latest = max(
                    _longest_in_time(profiles[above], delays[above]) for above in better_group
                )
                rivals.append(Rival(chains[0].period_ns, cost, max(0, latest - cost)))
            for place_beside, beside in enumerate(profiles):
                cores = _cores(profile, forked if place_beside in group else _stages([profile]))
                is_beside = place_beside != place and beside.core_of.get(beside.last or "") in cores
                if gates and is_beside:
                    rivals += _of_gate(beside, wishes, before_ns[place_beside], shifting=shifting)
                    rivals += _of_receivers(beside, profiles, before_ns[place_beside])
            delays[place] = interference(_longest_in_time(profile), rivals, profile.period_ns)
        better.append(group)
    return delays


def _of_gate(profile: Profile, wishes: Wishes, delay_ns: int, *, shifting: bool) -> Iterator[Rival]:
    """Yield how long the gate of a chain has its core: when a message comes, and when it leaves.

    The chain may be delayed by ``delay_ns``.
    """
    apart = max(0, _longest_in_time(profile) - int(profile.every.min()))
    yield Rival(profile.period_ns, GATE_TAKES_NS, apart + delay_ns)
    longest = profile.longest_publication_ns
    cost = wishes.spin_ns + (SHORTEST_SLOT_NS if longest is None else longest)
    shift = delay_ns if shifting and wishes.anchor == "stamp" else 0
    yield Rival(profile.period_ns, cost, shift + (0 if wishes.bands == 1 else apart + delay_ns))


def _of_receivers(profile: Profile, profiles: Sequence[Profile], delay_ns: int) -> Iterator[Rival]:
    """Yield how long receivers of a chain's output have its core, if they are on it."""
    reception = profile.reception
    if reception is not None and reception.core in (None, *planned_cores(profiles)):
        apart = max(0, _longest_in_time(profile) - int(profile.every.min()))
        cost = reception.time_ns + reception.beside_ns
        yield Rival(profile.period_ns, cost, apart + delay_ns)


def planned_cores(profiles: Sequence[Profile]) -> set[int]:
    """Return the cores on which servers run these chains."""
    return {core for profile in profiles for core in profile.core_of.values()}


def alone(profile: Profile) -> Profile:
    """Return the profile with what its callbacks took as if nothing else ran.

    That is their sum, or, where branches join, the longest way through them. On a core that
    branches share with this way, what they run there is added. A callback of another chain that
    delayed this one while it would have waited for its branch anyway has cost it nothing. Where a
    branch begins by itself, at any time, nothing says what the chain would have waited for: then
    the latencies stay as they were measured. So do bare latencies.
    """
    if not profile.steps_ns.size or UNKNOWN in profile.begins_ns:
        return profile
    return replace(
        profile,
        latencies_ns=_without_others(profile, profile.steps_ns, profile.graph_steps_ns),
        every_latency_ns=_without_others(
            profile, profile.every_step_ns, profile.every_graph_step_ns
        ),
        of_modes={mode: alone(of_mode) for mode, of_mode in profile.of_modes.items()},
    )


def _without_others(
    profile: Profile, steps_ns: NDArray[np.int64], graph_steps_ns: NDArray[np.int64]
) -> NDArray[np.int64]:
    """Return when the output is done in each cycle, from what each callback took (a row each)."""
    if graph_steps_ns.size:
        after = [callback.after for callback in profile.callbacks]
        cores = [callback.core for callback in profile.callbacks]
        return finished(after, graph_steps_ns, profile.begins_ns, cores)[:, -1]
    along: NDArray[np.int64] = steps_ns.sum(axis=1)
    return along


def _later(profile: Profile, delay_ns: int, measured_ns: NDArray[np.int64]) -> Profile:
    """Return the profile with all latencies so much later."""
    return replace(
        profile,
        latencies_ns=profile.latencies_ns + delay_ns,
        every_latency_ns=profile.every + delay_ns,
        measured_ns=np.clip(measured_ns, profile.latencies_ns, profile.latencies_ns + delay_ns),
        interference_ns=delay_ns,
        of_modes={
            mode: _later(of_mode, delay_ns, of_mode.latencies_ns)
            for mode, of_mode in profile.of_modes.items()
        },
    )


def _longest_in_time(profile: Profile, delay_ns: int = 0) -> int:
    """Return the longest latency of all cycles that fit into the period if all are so much later.

    A cycle that does not fit is late anyway.
    """
    every = profile.every + delay_ns
    return int(every[every < profile.period_ns].max(initial=0))


def _stages(profiles: Sequence[Profile]) -> dict[_Stage, CallbackTimes]:
    """Return the callbacks of chains, each once."""
    return {
        (callback.node, callback.publishes): callback
        for profile in profiles
        for callback in profile.callbacks
    }


def _cores(profile: Profile, stages: Collection[_Stage]) -> set[int]:
    """Return the cores of these stages of a chain."""
    return {callback.core for stage, callback in _stages([profile]).items() if stage in stages}


def _demand(profile: Profile, beside: Sequence[Profile], stages: Collection[_Stage]) -> int:
    """Return how long callbacks of chains beside it have the cores of these stages in a cycle."""
    of_chain, cores = _stages([profile]), _cores(profile, stages)
    return sum(
        callback.max_response_ns
        for stage, callback in _stages(beside).items()
        if stage not in of_chain and callback.core in cores
    )
