"""What a user can choose about a plan: for the planner, for sweeps, and as command line options.

This module imports nothing slow, as the planner does, so that `chainshaper plan --help` is quick.
"""

from dataclasses import dataclass
from typing import Annotated, Literal, NamedTuple, TypeAlias, TypedDict

from chainshaper.robot.gate import Anchor, IntoOpenSlot, Messages, Overrun

Policy: TypeAlias = Literal[
    "shaped",
    "one-long-slot",
    "server-per-callback",
    "server-per-chain",
    "let-per-callback",
    "let-per-chain",
    "pipelined",
]
"""How a chain is scheduled: by latency shaping, or as the paper compares with (section 2.5)."""

Fallback: TypeAlias = Literal["bypass", "silence"]  # of an output without its shaping node
STANDBY = "_standby"  # ends the name of the node that stands in for a shaping node

Publication: TypeAlias = Literal["synchronous", "asynchronous", "in-process"]
"""What publishes an output in its slot.

"synchronous": a shaping node. "asynchronous": the publisher's own thread (section 3.2).
"in-process": a gate in the publisher's process.
"""
ShapingThread: TypeAlias = Literal["free", "in-slots"]
"""Whether only its gate times a shaping node's thread, or it runs in its server's slots as well."""
EqualPriorities: TypeAlias = Literal["apart", "round-robin"]
"""What servers of one core and one priority do: their slots are apart, or they take turns."""
SlotEnds: TypeAlias = Literal["open-until-done", "closed"]
"""What a server does at a slot's end while a callback still runs.

"open-until-done": it stays open until the callback is done, as long as the cycle has room.
"closed": it closes, as in the paper.
"""
NodeLanguage: TypeAlias = Literal["python", "cpp"]
NodeChoice: TypeAlias = Literal["auto", "python", "cpp"]
"""The shaping node that a user chooses; :mod:`.splicing.node_kinds` finds out the rest."""
InStep: TypeAlias = Literal["output", "loop"]
"""What is put in step with a loop that reads the output: the output's slot, or the loop itself."""
Solver: TypeAlias = Literal["exact", "pso", "random"]
"""What places latency bands; the paper uses particle swarm optimisation (section 3.3)."""
Goal: TypeAlias = Literal["mean", "jitter", "gap"]
"""What latency bands minimise: the average, the jitter, or the distance between bands (LV)."""


class Option(NamedTuple):
    """How a wish looks on the command line."""

    help: str
    panel: str | None = None  # of the help
    metavar: str | None = None
    least: int | None = None  # value
    flag: str | None = None  # None: the option has the name of the field


BANDS, MARGIN = "Latency bands", "Margin"  # panels of the help
SLOTS, GATE = "Slots and servers", "The gate of the output"
LOOP = "A loop that reads the output"
"""Panels of the help; what has none stands in the first one, with the most common options."""


# fmt: off
@dataclass(frozen=True)
class Wishes:
    """The wishes for a plan, all but the modes of the system. Times in nanoseconds.

    * ``publish_slot_ns`` is Δ of eq. 2 and 4.
    * Without ``epsilon_ns`` the margin covers all cycles, also disturbed ones, except a share of
      ``overrun_probability`` (None: 1 %, or as few as the sample can show).
    * ``bands`` to ``seed`` are for the policy ``shaped``, see
      :func:`~chainshaper.planning.bands.with_bands`; ``slot_start_ns`` is for ``one-long-slot``.
    """

    policy: Annotated[Policy, Option("Scheduling policy.")] = "shaped"
    publication: Annotated[Publication, Option(
        "By a shaping node; by the asynchronous publisher's own thread; or in-process: by a gate"
        " that is loaded into the publisher's process, without another node.", GATE,
    )] = "synchronous"
    publish_slot_ns: Annotated[int | None, Option(
        "Length of the publish slot. Default: the longest publication measured, at least 1ms.",
        SLOTS)] = None
    slot_start_ns: Annotated[int | None, Option(
        "Where the slot of one-long-slot starts.", SLOTS)] = None
    epsilon_ns: Annotated[int | None, Option(
        "A given margin behind the longest undisturbed latency. Default: 1ms behind the latency"
        " that all cycles but 1 % stay below.", MARGIN)] = None
    percentile: Annotated[float | None, Option(
        "Plan from latencies up to this percentile, such as 99.5; longer ones will be late."
        " Default: all.", MARGIN, "P")] = None
    overrun_probability: Annotated[float | None, Option(
        "Share of outputs that may be late, such as 0.01; where the sample is too small to show"
        " it, a bound on the tail of the latencies is planned.", MARGIN, "P")] = None
    ideal_machine: Annotated[bool, Option(
        "Leave out cycles that the machine disturbed: for one that does not stall.", MARGIN,
    )] = False
    bands: Annotated[int | Literal["auto"], Option(
        "Number of latency bands; auto: as many as are worth it.", metavar="N|auto")] = 1
    solver: Annotated[Solver, Option("Band solver.", BANDS)] = "exact"
    grid_ns: Annotated[int, Option("Slots end at multiples of this.", BANDS)] = 1_000
    max_gap_ns: Annotated[int | None, Option(
        "Longest distance of neighbouring bands (LV).", BANDS)] = None
    max_share: Annotated[float | None, Option(
        "Most cycles in one band: 0.4 or 40%.", BANDS, "SHARE")] = None
    minimise: Annotated[Goal, Option("Objective.", BANDS)] = "mean"
    mean_at_most_ns: Annotated[int | None, Option(
        "Accept no average above this.", BANDS)] = None
    plant: Annotated[str | None, Option(
        "Instead, minimise the cost of this control loop (docs/control.md): one slot, bands, or one"
        " long slot, and where.", BANDS, "PLANT.yaml")] = None
    redesign: Annotated[bool, Option(
        "With --plant: the controller may be designed anew for the constant delay of one slot.",
        BANDS)] = False
    least_gain: Annotated[float, Option(
        "With --bands auto: what another band must take off the average.", BANDS, "SHARE")] = 0.02
    seed: Annotated[int, Option("For pso, random and the derived margin.", BANDS, least=0)] = 0
    cores: Annotated[tuple[int, ...] | None, Option(
        "Distribute the executors, or the stages of a pipeline, over these cores, such as 0,1:"
        " branches that run at the same time, and chains whose slots would collide, get a core of"
        " their own. Default: those on which it was recorded.",
        "More of the graph", "CORES")] = None
    first_slot_ns: Annotated[int | None, Option(
        "Reserve this long for the chain's first node alone.", "More of the graph")] = None
    anchor: Annotated[Anchor, Option(
        "What slots count from: the message's stamp, or the cycle.", SLOTS)] = "stamp"
    overrun: Annotated[Overrun | None, Option(
        "An output that missed its slot: at once; or in slots only: wait for the next, or"
        " discard. Default: publish.", GATE)] = None
    into_open_slot: Annotated[IntoOpenSlot, Option(
        "An output that comes when its slot is open: at once; or in the next slot, so that a band"
        " has no jitter.", BANDS)] = "at-once"
    messages: Annotated[Messages, Option(
        "Which of several outputs in one cycle leave.", GATE)] = "all-in-order"
    depth: Annotated[int | None, Option(
        "How many outputs may wait in the gate. Default: as many as the history of its"
        " publisher has room for, 10 at least.", GATE, least=1)] = None
    shaping_thread: Annotated[ShapingThread, Option(
        "The shaping node's thread: its gate alone times it; or back ends keep it in its server's"
        " slots as well.", GATE)] = "free"
    fallback: Annotated[Fallback, Option(
        "While the shaping node is not there: outputs go around it, or none is published."
        " Default: bypass, or what the plan says.", GATE)] = "bypass"
    spin_ns: Annotated[int, Option(
        "How long the gate watches the clock before its slot.", GATE)] = 1_000_000
    pause_ns: Annotated[int | None, Option(
        "How long the gate rests after publishing. Default: 2ms, a twentieth of the cycle at"
        " most.", GATE)] = None
    delivery_ns: Annotated[int | None, Option(
        "Hand the output to its subscribers' callbacks at this constant time behind its"
        " publication, such as 500us, whatever the transport takes; their executors wait"
        " meanwhile. Default: as it comes.", GATE, least=1)] = None
    equal_priorities: Annotated[EqualPriorities, Option(
        "apart: slots of servers of one priority on a core never overlap; round-robin: all servers"
        " share one priority and alternate (eq. 3).", SLOTS)] = "apart"
    slot_ends: Annotated[SlotEnds, Option(
        "A server whose slot ends while a callback runs: it stays open until that is done; or it"
        " closes, as the paper's time-driven servers do, and the callback goes on in its next"
        " slot.", SLOTS)] = "open-until-done"
    best_effort: Annotated[tuple[str, ...], Option(
        "A node outside the chain that runs when none of its servers does, in a server that is"
        " open all the time (may be repeated).", "More of the graph", "NODE")] = ()
    with_receivers: Annotated[bool, Option(
        "Give nodes that subscribe to the shaped output SCHED_FIFO, in the place that the plan"
        " has for them, while it is in force.", GATE, flag="--receivers/--no-receivers")] = True
    in_step: Annotated[bool, Option(
        "Put the output's slot so long before the loop's next instance that the age of its data is"
        " constant, at each start anew.", LOOP)] = False
    move_loop: Annotated[bool, Option(
        "Instead, leave the slot where the latency is shortest, and move the loop: its thread's"
        " sleep is made longer, once.", LOOP)] = False
# fmt: on


class WishKeywords(TypedDict, total=False):
    """The fields of :class:`Wishes` as keyword arguments, for type checkers and editors."""

    policy: Policy
    publication: Publication
    publish_slot_ns: int | None
    slot_start_ns: int | None
    epsilon_ns: int | None
    percentile: float | None
    overrun_probability: float | None
    ideal_machine: bool
    bands: int | Literal["auto"]
    solver: Solver
    grid_ns: int
    max_gap_ns: int | None
    max_share: float | None
    minimise: Goal
    mean_at_most_ns: int | None
    plant: str | None
    redesign: bool
    least_gain: float
    seed: int
    cores: tuple[int, ...] | None
    first_slot_ns: int | None
    anchor: Anchor
    overrun: Overrun | None
    into_open_slot: IntoOpenSlot
    messages: Messages
    depth: int | None
    shaping_thread: ShapingThread
    fallback: Fallback
    spin_ns: int
    pause_ns: int | None
    delivery_ns: int | None
    equal_priorities: EqualPriorities
    slot_ends: SlotEnds
    best_effort: tuple[str, ...]
    with_receivers: bool
    in_step: bool
    move_loop: bool
