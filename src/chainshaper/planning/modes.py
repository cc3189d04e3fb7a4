"""A slot for each mode of the system, placed from the mode's own latencies (sections 3.3 and 6).

With L̄ and ε of the cycles that began in a mode, its outputs may leave from L̄ + ε on: eq. 1 for each
mode by itself. R_m, the chain's server, is open until the slot of the slowest.
"""

from collections.abc import Iterator, Mapping

from chainshaper.planning.bands import with_publish_slots
from chainshaper.planning.margins import OVERRUN_PROBABILITY, cycles_needed
from chainshaper.planning.plan import Evidence, Modes, Plan, Prediction, Slot
from chainshaper.values.errors import InputError


def bands_of_modes(starts_ns: Mapping[str, int], length_ns: int) -> dict[str, int]:
    """A band for each mode, by when its outputs may leave; slots that would overlap are one."""
    first, band, bands = 0, 0, dict.fromkeys(starts_ns, 0)
    for mode in sorted(starts_ns, key=starts_ns.__getitem__):
        if not band or starts_ns[mode] >= first + length_ns:
            first, band = starts_ns[mode], band + 1
        bands[mode] = band
    return bands


def slots_of_modes(
    starts_ns: Mapping[str, int], bands: Mapping[str, int], length_ns: int
) -> tuple[Slot, ...]:
    """A slot for each band, behind the one before: it begins when all of its modes' outputs may
    leave.

    Raises InputError: no mode has one of the bands.
    """
    slots: list[Slot] = []
    for band in range(1, max(bands.values()) + 1):
        own = [starts_ns[mode] for mode in bands if bands[mode] == band]
        if not own:
            raise InputError(
                f"no mode has the band {band}, so no latencies say where its slot is: number the"
                " modes' bands from 1 on, or leave out the numbers"
            )
        start = max(*own, slots[-1][1] if slots else 0)
        slots.append((start, start + length_ns))
    return tuple(slots)


def with_modes(
    plan: Plan,
    modes: Modes,
    slots: tuple[Slot, ...],
    measured: Mapping[str, tuple[Evidence, float]],
) -> Plan:
    """A shaped plan with the modes' slots. ``measured`` has what each mode's was placed from, and
    the share of its cycles that are in time for it.

    The prediction of the whole is for modes in force as often as they were measured.
    """
    promised, shares = {}, [0.0] * len(slots)
    every = sum(own.samples for own, _ in measured.values())
    for mode, (own, in_time) in measured.items():
        start, end = slots[modes.bands[mode] - 1]
        shares[modes.bands[mode] - 1] += own.samples / every
        promised[mode] = Prediction(
            mean_ns=end, max_ns=end, jitter_ns=end - start, shares=(in_time,)
        )
    predicted = Prediction(
        mean_ns=round(sum(share * end for share, (_, end) in zip(shares, slots, strict=True))),
        max_ns=slots[-1][1],
        jitter_ns=slots[-1][1] - slots[0][0],
        shares=tuple(min(1.0, share) for share in shares),
        modes=promised,
    )
    of_modes = {mode: own for mode, (own, _) in measured.items()}
    evidence = plan.evidence.model_copy(update={"modes": of_modes})
    return with_publish_slots(plan, slots, evidence=evidence, predicted=predicted, modes=modes)


def mode_warnings(plan: Plan) -> Iterator[str]:
    """What is doubtful about the modes' slots, one sentence each."""
    needed = cycles_needed(OVERRUN_PROBABILITY)
    if plan.modes is not None and plan.evidence.modes is None:
        yield (
            "nothing says which mode was in force in which cycle: the slots of the modes are placed"
            " from all latencies together, and a mode that takes longer than its slot will be late."
            " Give each mode's own profile (--mode-profile MODE=REC)."
        )
    for mode, own in (plan.evidence.modes or {}).items():
        if (cycles := max(own.samples, own.disturbed)) < needed:
            yield (
                f"the sample of mode {mode} is small: {cycles} cycles are too few to say how late"
                f" one of its outputs in a hundred will be. Record {needed} of its cycles or more."
            )
