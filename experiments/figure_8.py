"""Figure 8: a chain that publishes asynchronously, unshaped and shaped (section 5.2).

    python experiments/figure_8.py [--simulated] [--cycles 320] [--keep FOLDER]

A thread of its own publishes the chain's output, and a server holds that thread until its slot
comes: the paper's first design, which needs no further node. Slots are the paper's, [0, 59) for the
chain and [59, 60) ms for the publisher's thread; live also [59, 69) ms, since what a stock kernel
opens late, or a stalled machine, must not close again in the middle of a send.
"""

from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path

import numpy as np
from configurations import Panel, draw_latencies, live, parse_options, simulated
from numpy.typing import NDArray
from results import MS, PICTURES, Line, Run, lines_of, save

from chainshaper import load_application
from chainshaper.planning import Plan, plan_shaping

APPLICATION = Path(__file__).parents[1] / "examples" / "asynchronous_chain.yaml"
PERIOD_NS = 100 * MS
NODES = tuple(f"/node{number}" for number in range(1, 6))
SLOT_MS = 59

UNSHAPED = "SCHED_FIFO"

WHY_TIMES = (
    "execution times of 5 to 12 ms, which the paper's maximum and jitter fit; it says no more than"
    " “similar to section 2.5”"
)
WHY_SLOT = "the output is sent as the slot opens: 59 ms and what waking the thread and sending take"

NOTES = (
    "Maximum and jitter of the shaped chain are those of outputs in their own cycle; an output that"
    " missed its slot, because the chain took longer than 59 ms or its send was not over when the"
    " slot was, is sent in the next cycle's, and counted as late. The latency ends when"
    " the thread has sent the output."
)


def plan_with_slot(latencies_ns: NDArray[np.int64], slot_ms: int) -> Plan:
    """The chain in [0, 59) ms, its publisher's thread in the ``slot_ms`` behind."""
    known = latencies_ns[latencies_ns < SLOT_MS * MS]
    return plan_shaping(
        known,
        PERIOD_NS,
        spec="/t1../t5",
        output="/t5",
        publisher=NODES[-1],
        nodes=NODES,
        epsilon_ns=SLOT_MS * MS - int(known.max()),
        publish_slot_ns=slot_ms * MS,
        publication="asynchronous",
        output_depth=10,
        overrun="wait",
        core=1,
    )


def shaped_name(slot_ms: int) -> str:
    return f"slots [0, {SLOT_MS}) [{SLOT_MS}, {SLOT_MS + slot_ms}) ms"


def lines(runs: Sequence[Run]) -> list[Line]:
    """Maximum, jitter and late outputs: unshaped, with the paper's slot, with a longer one."""
    made = lines_of(UNSHAPED, runs, {"maximum": 58.5, "jitter": 33.0}, why=WHY_TIMES)
    for slot, *paper in ((1, 59.6, "≈ 0.2"), (10, None, None)):
        figures = dict(zip(("maximum", "jitter", "late"), (*paper, None), strict=True))
        name = shaped_name(slot)
        made += lines_of(name, runs, figures, late_from_ns=PERIOD_NS, why=WHY_SLOT)
    return made


def main() -> None:
    described = load_application(APPLICATION)
    with ExitStack() as until:
        options = parse_options(__doc__, cycles=320, until=until)
        cycles = options.simulated_cycles
        runs = [simulated(UNSHAPED, described, cycles=cycles)]
        for slot in (1, 10):
            plan = plan_with_slot(runs[0].undisturbed_ns, slot)
            runs.append(simulated(shaped_name(slot), described, plan, cycles=cycles))
        if options.live:
            unshaped = live(UNSHAPED, described, cycles=options.cycles, folder=options.keep)
            runs.append(unshaped)
            for slot in (1, 10):
                plan, name = plan_with_slot(unshaped.undisturbed_ns, slot), shaped_name(slot)
                runs.append(live(name, described, plan, cycles=options.cycles, folder=options.keep))
    pictures = [
        draw_latencies(
            PICTURES / f"figure_8_{'live' if is_live else 'simulated'}.png",
            [
                Panel(
                    f"{'live' if is_live else 'simulated'}: unshaped, and sent from 59 ms on",
                    [
                        run
                        for run in runs
                        if run.live == is_live and not run.name.endswith("60) ms")
                    ],
                    [(SLOT_MS * MS, (SLOT_MS + 10) * MS)],
                )
            ],
        )
        for is_live in {run.live for run in runs}
    ]
    save(
        "figure_8",
        "Figure 8: a chain that publishes asynchronously",
        lines(runs),
        runs=runs,
        pictures=pictures,
        notes=NOTES,
    )


if __name__ == "__main__":
    main()
