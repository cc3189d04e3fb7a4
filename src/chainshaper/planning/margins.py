"""The margin ε of a plan: how far beyond the longest undisturbed latency a chain's slot reaches.

**By default** so far that a stated share of *all* cycles is in time, also of those that the machine
disturbed: an actuator does not care who caused a delay. A sample that is large enough says by
itself how far that is (:mod:`~chainshaper.planning.late_shares`); of a smaller one the tail is
followed (:mod:`~chainshaper.planning.tails`).

A user gives the margin itself (`--epsilon`), the share of outputs that may be late
(`--overrun-probability`), or neither. Whoever sets a margin does it here.
"""

import numpy as np
from numpy.typing import NDArray

from chainshaper.planning.chain_plan import Margin
from chainshaper.planning.late_shares import (
    covered_latency,
    covering_rank,
    cycles_needed,
    independent_cycles,
    late_share,
    most_probable,
)
from chainshaper.planning.latencies import check_latencies
from chainshaper.planning.next_cycle import (
    NextCycle,
    latencies_behind_slot,
    latency_with_fewest_late,
)
from chainshaper.planning.tails import fit_tail
from chainshaper.values.errors import InputError, OperationError
from chainshaper.values.plan_choices import Publication, Wishes

EPSILON_NS = 1_000_000  # the least margin: the way to the shaping node is not in the latencies
HOP_NS = 200_000  # that way takes so long: measured 0.07 to 0.2 ms; a gate in the process has none
OVERRUN_PROBABILITY = 0.01  # the share of all cycles that may be late by default, at most
WELL_COVERED = 0.99  # confidence with which a smaller share than the default one is promised

_Latencies = NDArray[np.int64]


def way_to_gate_ns(publication: Publication) -> int:
    """Return how long an output is on its way to its shaping node, at most."""
    return 0 if publication == "in-process" else HOP_NS


def least_epsilon_ns(publication: Publication) -> int:
    """Return ε for a machine that does not stall, where no other is wished."""
    return EPSILON_NS - (HOP_NS - way_to_gate_ns(publication))


def given_or_least_epsilon_ns(wishes: Wishes) -> int:
    """Return the ε that the wishes give, or else the least one."""
    if wishes.epsilon_ns is not None:
        return wishes.epsilon_ns
    return least_epsilon_ns(wishes.publication)


def allowed_late_share(margin: Margin) -> float:
    """Return the share of outputs that may be late under a plan with this margin.

    A margin that says nothing about it, as one in a plan that was written by hand, allows the
    default share. Verdicts and `apply --adapt` both go by this.
    """
    return margin.overrun_probability or OVERRUN_PROBABILITY


def refuse_contradictory_margin(wishes: Wishes) -> None:
    """Refuse a margin that is given and is to cover a share of cycles as well, or no such share."""
    if wishes.epsilon_ns is not None and wishes.overrun_probability is not None:
        raise InputError("the margin is either given or covers a share: leave out one of both")
    if wishes.overrun_probability is not None:
        _refuse_no_probability(wishes.overrun_probability)


def _refuse_no_probability(probability: float) -> None:
    if not 0 < probability < 1:
        raise InputError(f"an overrun probability of {probability}: write one between 0 and 1")


def covering_latency(
    latencies_ns: _Latencies,
    wishes: Wishes,
    following: NextCycle | None = None,
    longest_ns: int = 0,
) -> int:
    """Return the latency (ns) that covers all cycles of a sample but the share that may be late.

    The publish slot begins the least ε behind it, and ends in the cycle that ``following`` has
    (None: anywhere). Where that slot would leave the next instance no room, the latency is the one
    with which the fewest outputs are late, from ``longest_ns`` on.
    """
    latest, least = None, least_epsilon_ns(wishes.publication)
    if following is not None:
        latest = following.latest_slot_ns - least
    share = wishes.overrun_probability or OVERRUN_PROBABILITY
    covered = covered_latency(latencies_ns, share, latest, independent_cycles(latencies_ns))
    if following is None:
        return covered
    return latency_with_fewest_late(latencies_ns, covered, longest_ns, least, following)


def planned_margin(
    latencies_ns: _Latencies,
    every_latency_ns: _Latencies,
    wishes: Wishes,
    *,
    following: NextCycle | None = None,
    decides_slot: bool = True,
) -> Margin:
    """Return the margin of a chain's plan, as the wishes have it.

    ``latencies_ns`` are of the cycles that are planned from, ``every_latency_ns`` of all. The
    publish slot ends in the cycle that ``following`` has (None: anywhere), with room for the next
    instance, or those that it delays count as well. Where the margin does not decide where the slot
    begins, it covers no share of cycles, and only counts those that will be late.

    Raises OperationError: the sample cannot say what the margin is, or more outputs will be late
    than may be.
    """
    longest, least = int(check_latencies(latencies_ns).max()), least_epsilon_ns(wishes.publication)
    independent = independent_cycles(every_latency_ns)
    if wishes.epsilon_ns is not None:
        return _given_margin(longest, every_latency_ns, wishes.epsilon_ns, wishes, independent)
    sample = latencies_ns if wishes.ideal_machine else every_latency_ns
    # With a percentile, the longest cycles are left out on purpose: no margin covers them.
    covers = decides_slot and wishes.percentile is None
    asked = wishes.overrun_probability
    if asked is not None and covers:
        margin = derive_margin(sample, asked, wishes.seed, longest_ns=longest, least_ns=least)
        in_time_ns = longest + margin.epsilon_ns - least
        if not wishes.ideal_machine or not np.any(every_latency_ns > in_time_ns):
            return margin
        # Cycles that the machine disturbed will be late besides the share that was asked for.
        late = late_share(every_latency_ns, in_time_ns, independent)
        return margin.model_copy(update={"overrun_probability": late})
    stalls = 0
    if covers:
        stalls = max(0, covering_latency(sample, wishes, following, longest) - longest)
    covers_all = covers and not wishes.ideal_machine
    if following is not None:
        in_time = longest + stalls
        every_latency_ns = latencies_behind_slot(every_latency_ns, in_time, least, following)
    late = _late_by_default(every_latency_ns, longest, stalls, independent, covers_all=covers_all)
    if asked is not None and late > asked:
        reason = f"up to {late:.2g} of the outputs will be late, more than {asked:g}"
        remedy = "the margin covers no share with --percentile, nor where slots are a policy's own"
        raise OperationError(f"{reason}: {remedy}. Leave out --overrun-probability")
    return Margin(
        epsilon_ns=least + stalls,
        source="measured",
        overrun_probability=late,
        stalls_ns=stalls,
        independent_cycles=_if_clustered(independent, every_latency_ns),
    )


def _if_clustered(independent: int, latencies_ns: _Latencies) -> int | None:
    """Return how many cycles a sample is worth, None: as many as it has."""
    return independent if independent < latencies_ns.size else None


def _given_margin(
    longest: int, every: _Latencies, epsilon_ns: int, wishes: Wishes, independent: int
) -> Margin:
    """Return the margin that a user gives, with the share of all cycles that it leaves late."""
    if epsilon_ns < 0:
        raise InputError("epsilon must be 0 ms or more")
    in_time = longest + max(0, epsilon_ns - way_to_gate_ns(wishes.publication))
    return Margin(
        epsilon_ns=epsilon_ns,
        overrun_probability=late_share(every, in_time, independent),
        independent_cycles=_if_clustered(independent, every),
    )


def _late_by_default(
    every: _Latencies, longest: int, stalls: int, independent: int, *, covers_all: bool
) -> float:
    """Return the share of outputs that will be late with the least margin behind these latencies.

    The share is counted from the latencies themselves. The least margin is for the way to the
    shaping node; how many cycles end within it is an accident of the sample. Where the default
    share is covered, return that, or a smaller one that is certain enough.
    """
    default = OVERRUN_PROBABILITY
    if covers_all and independent >= cycles_needed(default):
        rank = covering_rank(independent, default)  # fixed before the sample was seen
        if longest + stalls >= np.sort(every)[-rank]:
            beyond = rank - 1 if stalls else int(np.count_nonzero(every > longest))
            return min(default, most_probable(beyond, independent, WELL_COVERED))
    return late_share(every, longest + stalls, independent)


def derive_margin(
    latencies_ns: _Latencies,
    probability: float,
    seed: int = 0,
    *,
    longest_ns: int | None = None,
    least_ns: int = EPSILON_NS,
) -> Margin:
    """Return the margin with which a cycle is late with the given probability, at most.

    It counts from ``longest_ns`` (default: the longest of the latencies), and reaches ``least_ns``
    behind the latency that covers all cycles but such a share. Where the sample is large enough,
    that is one of its own latencies, without any assumption
    (:func:`~chainshaper.planning.late_shares.covered_latency`), otherwise the bound on its tail
    (:func:`~chainshaper.planning.tails.fit_tail`). Less risk never gives an earlier slot.

    Raises OperationError: the sample cannot say; the message says how many cycles could.
    """
    latencies = check_latencies(latencies_ns)
    _refuse_no_probability(probability)
    longest = int(latencies.max()) if longest_ns is None else longest_ns
    independent = independent_cycles(latencies)
    clustered = _if_clustered(independent, latencies)
    if independent >= cycles_needed(probability):
        covered = covered_latency(latencies, probability, independent=independent)
        beyond = max(0, covered - longest)
        return Margin(
            epsilon_ns=least_ns + beyond,
            source="measured",
            overrun_probability=probability,
            stalls_ns=beyond,
            independent_cycles=clustered,
        )
    low, high = fit_tail(latencies, probability, seed).interval_ns
    interval = (max(0, low - longest) + least_ns, max(0, high - longest) + least_ns)
    return Margin(
        epsilon_ns=interval[1],
        source="derived",
        overrun_probability=probability,
        confidence_interval_ns=interval,
        independent_cycles=clustered,
    )


def with_part_taken(
    margin: Margin, every_latency_ns: _Latencies, longest_ns: int, taken_ns: int
) -> Margin:
    """Return a margin of which others take ``taken_ns`` in a cycle, with the share it leaves late.

    ``longest_ns`` is the latency that the margin is behind.
    """
    in_time = longest_ns + margin.epsilon_ns - taken_ns
    late = late_share(every_latency_ns, in_time, margin.independent_cycles or 0)
    worse = max(late, margin.overrun_probability or 0.0)
    return margin.model_copy(update={"overrun_probability": worse})
