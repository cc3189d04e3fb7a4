"""A slot for each mode of the system, placed from the mode's own latencies (sections 3.3 and 6).

With L̄ and ε of the cycles that began in a mode, its outputs may leave from L̄ + ε on: eq. 1 for each
mode by itself. R_m, the chain's server, is open until the slot of the slowest.
"""

from collections.abc import Mapping

from chainshaper.planning.bands import with_publish_slots
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
    """A slot for each band, behind the one before, when all outputs of its modes may leave.

    Raises InputError: no mode has one of the bands.
    """
    slots: list[Slot] = []
    for band in range(1, max(bands.values()) + 1):
        if band not in bands.values():
            raise InputError(
                f"no mode has the band {band}, so no latencies say where its slot is: number the"
                " modes' bands from 1 on, or leave out the numbers"
            )
        own = (starts_ns[mode] for mode in bands if bands[mode] == band)
        start = max(*own, slots[-1][1] if slots else 0)
        slots.append((start, start + length_ns))
    return tuple(slots)


def with_modes(
    plan: Plan, modes: Modes, slots: tuple[Slot, ...], measured: Mapping[str, Evidence]
) -> Plan:
    """A shaped plan with slots for modes of which each was measured.

    The prediction of the whole is for modes in force as often as they were measured.
    """
    own = {mode: slots[band - 1] for mode, band in modes.bands.items()}
    weights = [
        sum(one.samples for mode, one in measured.items() if own[mode] == slot) for slot in slots
    ]
    ends = [end for _, end in slots]
    predicted = Prediction(
        mean_ns=round(sum(w * end for w, end in zip(weights, ends, strict=True)) / sum(weights)),
        max_ns=ends[-1],
        jitter_ns=ends[-1] - slots[0][0],
        shares=tuple(weight / sum(weights) for weight in weights),
        modes={
            mode: Prediction(mean_ns=end, max_ns=end, jitter_ns=end - start, shares=(1.0,))
            for mode, (start, end) in own.items()
        },
    )
    evidence = plan.evidence.model_copy(update={"modes": dict(measured)})
    return with_publish_slots(plan, slots, evidence=evidence, predicted=predicted, modes=modes)
