"""A slot for each mode of the system, placed from the mode's own latencies (sections 3.3 and 6).

With L̄ and ε of the cycles that began in a mode, its outputs may leave from L̄ + ε on: eq. 1 for each
mode by itself. R_m, the chain's server, is open until the slot of the slowest.
"""

from collections.abc import Mapping

from chainshaper.planning.bands import with_publish_slots
from chainshaper.planning.plan import Evidence, Modes, Plan, Prediction, Slot
from chainshaper.values.errors import InputError


def place_modes(
    starts_ns: Mapping[str, int], length_ns: int, given: Mapping[str, int] | None = None
) -> tuple[dict[str, int], tuple[Slot, ...]]:
    """The band of each mode, and the slots: each behind the one before, when all outputs of its
    modes may leave. Unless bands are ``given``, slots that would overlap are one.

    Raises InputError: of the bands given, one is no mode's.
    """
    first, band, bands = 0, 0, dict(given or {})
    for mode in () if given else sorted(starts_ns, key=starts_ns.__getitem__):
        if not band or starts_ns[mode] >= first + length_ns:
            first, band = starts_ns[mode], band + 1
        bands[mode] = band
    slots: list[Slot] = []
    for band in range(1, max(bands.values()) + 1):
        if band not in bands.values():
            raise InputError(
                f"no mode has the band {band}, so no latencies say where its slot is: number the"
                " modes' bands from 1 on, or leave out the numbers"
            )
        own = (start for mode, start in starts_ns.items() if bands[mode] == band)
        start = max(*own, slots[-1][1] if slots else 0)
        slots.append((start, start + length_ns))
    return bands, tuple(slots)


def with_modes(
    plan: Plan, modes: Modes, slots: tuple[Slot, ...], measured: Mapping[str, Evidence]
) -> Plan:
    """A shaped plan with slots for modes of which each was measured.

    The prediction of the whole is for modes in force as often as they were measured.
    """
    ends, cycles = [end for _, end in slots], [0] * len(slots)
    alone = {}
    for mode, own in measured.items():
        start, end = slots[(place := modes.bands[mode] - 1)]
        cycles[place] += own.samples
        alone[mode] = Prediction(mean_ns=end, max_ns=end, jitter_ns=end - start, shares=(1.0,))
    shares = tuple(own / sum(cycles) for own in cycles)
    predicted = Prediction(
        mean_ns=round(sum(share * end for share, end in zip(shares, ends, strict=True))),
        max_ns=ends[-1],
        jitter_ns=ends[-1] - slots[0][0],
        shares=shares,
        modes=alone,
    )
    evidence = plan.evidence.model_copy(update={"modes": dict(measured)})
    return with_publish_slots(plan, slots, evidence=evidence, predicted=predicted, modes=modes)
