"""`chainshaper plan`: from measured latencies to reservation servers and slots."""

from enum import Enum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from chainshaper.cli.options import ChainOption, JsonOption, duration_option
from chainshaper.errors import InputError

if TYPE_CHECKING:
    from chainshaper.planning import Plan

__all__ = ["plan"]


class Anchor(str, Enum):
    """What starts a cycle for the shaping node."""

    STAMP = "stamp"
    CYCLE = "cycle"


def plan(
    recording: Annotated[
        Path | None,
        typer.Argument(metavar="[REC]", help="A recording's folder.", show_default=False),
    ] = None,
    chain: ChainOption = None,
    output: Annotated[
        Path | None,
        typer.Option(
            "--output", "-o", metavar="plan.yaml", help="File to write.", show_default=False
        ),
    ] = None,
    latencies: Annotated[
        Path | None,
        typer.Option(
            "--latencies",
            metavar="FILE",
            help="Instead of a recording: a duration a line, or .npy in ns.",
            show_default=False,
        ),
    ] = None,
    period: Annotated[
        int | None, duration_option("--period", "Period of the chain, with --latencies.")
    ] = None,
    epsilon: Annotated[
        int, duration_option("--epsilon", "Margin behind the longest latency.")
    ] = "1ms",  # type: ignore[assignment]
    publish_slot: Annotated[
        int, duration_option("--publish-slot", "Length of the publish slot.")
    ] = "1ms",  # type: ignore[assignment]
    anchor: Annotated[
        Anchor, typer.Option(help="What slots count from: the message's stamp, or the cycle.")
    ] = Anchor.STAMP,
    spin: Annotated[
        int, duration_option("--spin", "How long the gate watches the clock before its slot.")
    ] = "300us",  # type: ignore[assignment]
    pause: Annotated[
        int, duration_option("--pause", "How long the gate rests after publishing.")
    ] = "500us",  # type: ignore[assignment]
    json: JsonOption = False,
) -> None:
    """Plan single-band latency shaping: one publish slot behind the longest latency.

    From a recording, or from bare latencies with their period.
    """
    from chainshaper.cli.output import notes, print_json, show, show_line
    from chainshaper.planning import plan_json, plan_warnings, save_plan
    from chainshaper.reporting.tables import plan_table
    from chainshaper.steps import plan_recording

    if (recording is None) == (latencies is None):
        raise InputError("give either a recording or --latencies FILE --period DURATION")
    if recording is not None:
        if period is not None:
            raise InputError("--period goes with --latencies: a recording knows its chain's period")
        planned = plan_recording(
            recording,
            chain,
            epsilon_ns=epsilon,
            publish_slot_ns=publish_slot,
            anchor=anchor.value,
            spin_ns=spin,
            pause_ns=pause,
        )
    else:
        planned = _plan_latencies(latencies, period, chain, epsilon, publish_slot, anchor)
    if output is not None:
        save_plan(planned, output)
    if json:
        print_json(plan_json(planned))
        return
    show(plan_table(planned))
    notes(plan_warnings(planned))
    if output is not None:
        show_line(str(output))


def _plan_latencies(
    latencies: Path | None,
    period: int | None,
    chain: str | None,
    epsilon: int,
    publish_slot: int,
    anchor: Anchor,
) -> "Plan":
    from chainshaper.planning import plan_shaping, read_latencies

    if latencies is None or period is None:
        raise InputError("--latencies needs the chain's period: add --period, such as 100ms")
    return plan_shaping(
        read_latencies(latencies),
        period,
        spec=chain,
        epsilon_ns=epsilon,
        publish_slot_ns=publish_slot,
        anchor=anchor.value,
    )
