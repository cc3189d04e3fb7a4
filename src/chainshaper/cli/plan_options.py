"""The options of `chainshaper plan`, and what they are worth in Python."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from chainshaper.cli.options import duration_option
from chainshaper.gate.decision import Late, Messages, Overrun
from chainshaper.values.errors import InputError
from chainshaper.values.plan_choices import Fallback

if TYPE_CHECKING:
    from chainshaper.planning import Modes

__all__ = [
    "BandsOption",
    "ChainsOption",
    "CurveOption",
    "DepthOption",
    "EpsilonOption",
    "FallbackOption",
    "FirstSlotOption",
    "GridOption",
    "IdealMachineOption",
    "LatenciesOption",
    "LeastGainOption",
    "MaxGapOption",
    "MaxShareOption",
    "MeanAtMostOption",
    "MessagesOption",
    "ModesOption",
    "OverrunOption",
    "PeriodOption",
    "PlanOutput",
    "ProbabilityOption",
    "ReceiversOption",
    "SeedOption",
    "SinksOption",
    "SlotStartOption",
    "modes_of",
]


def modes_of(text: str | None, late: Late | None) -> "Modes | None":
    """The modes that `--modes` names, such as ``/mode:city=2,highway=1``; the first is the default.

    An output behind its mode's slot leaves at once unless ``late`` says otherwise.

    Raises:
        InputError: it is not of this form, or names what no mode or topic may be called.
    """
    if text is None:
        if late is not None:
            raise InputError(f"--late {late} goes with modes: add --modes, or leave it out")
        return None
    from chainshaper.planning import Modes
    from chainshaper.planning.plan import wrong_values_refused

    topic, _, listed = text.partition(":")
    pairs = [pair.partition("=") for pair in listed.split(",")]
    bands = {mode: int(band) for mode, _, band in pairs if band.isdecimal()}
    if len(bands) != len(pairs):
        raise InputError(
            f"--modes {text}: write the topic, and a band for each mode once, such as"
            " /driving_mode:city=2,highway=1"
        )
    with wrong_values_refused(Modes):
        return Modes(topic=topic, default=pairs[0][0], bands=bands, late=late or "publish")


def _bands(text: str) -> str:
    if text != "auto" and not (text.isdecimal() and int(text) > 0):
        raise typer.BadParameter(f"{text!r} is neither a number of bands from 1 on nor auto")
    return text


def _share(text: str) -> float:
    try:
        value = float(text.removesuffix("%")) / (100 if text.endswith("%") else 1)
    except ValueError as error:
        raise typer.BadParameter(f"{text!r} is no share: write 0.4 or 40%") from error
    if not 0 < value <= 1:
        raise typer.BadParameter(f"{text} is no share: write more than 0, at most 1 or 100%")
    return value


_BANDS, _MARGIN, _MORE = "Latency bands", "Margin", "More of the graph"

ChainsOption = Annotated[
    list[str] | None,
    typer.Option(
        "--chain",
        metavar="FIRST..LAST",
        help="The chain, by topics or nodes: /t1../t5. Default: the one the recording names."
        " Give several to plan chains that share cores: their offsets are found.",
    ),
]
PlanOutput = Annotated[
    Path | None,
    typer.Option(
        "--output",
        "-o",
        metavar="plan.yaml",
        help="File to write; for several chains a folder, which must not exist.",
    ),
]
LatenciesOption = Annotated[
    Path | None,
    typer.Option(
        "--latencies",
        metavar="FILE",
        help="Instead of a recording: a duration a line, or .npy in ns.",
    ),
]
PeriodOption = Annotated[
    int | None,
    duration_option("--period", "Period, with --latencies or a chain that no timer starts."),
]
EpsilonOption = Annotated[
    int | None,
    duration_option(
        "--epsilon",
        "A given margin behind the longest undisturbed latency. Default: 1ms behind the latency"
        " that all cycles but 1 % stay below.",
        panel=_MARGIN,
    ),
]
IdealMachineOption = Annotated[
    bool,
    typer.Option(
        "--ideal-machine",
        help="Leave out cycles that the machine disturbed: for one that does not stall.",
        rich_help_panel=_MARGIN,
    ),
]
OverrunOption = Annotated[
    Overrun | None,
    typer.Option(
        help="An output that missed its slot: at once; or in slots only: wait for the next, or"
        " discard. Default: publish.",
        show_default=False,
    ),
]
ProbabilityOption = Annotated[
    float | None,
    typer.Option(
        "--overrun-probability",
        metavar="P",
        help="Share of all cycles that may be late, such as 0.01; below 0.001 it is derived from"
        " the tail of the latencies.",
        rich_help_panel=_MARGIN,
    ),
]
BandsOption = Annotated[
    str,
    typer.Option(
        "--bands",
        metavar="N|auto",
        parser=_bands,
        help="Number of bands; auto: as many as are worth it.",
        rich_help_panel=_BANDS,
    ),
]
ModesOption = Annotated[
    str | None,
    typer.Option(
        "--modes",
        metavar="TOPIC:MODE=BAND,…",
        help="Each mode's band, 1 is the first; the first mode named is in force until the topic"
        " (std_msgs/String) names another. Such as /driving_mode:city=2,highway=1.",
        rich_help_panel=_BANDS,
    ),
]
MessagesOption = Annotated[
    Messages, typer.Option(help="Which of several outputs in one cycle leave.")
]
DepthOption = Annotated[
    int | None,
    typer.Option(
        min=1,
        help="How many outputs may wait in the gate. Default: as many as the history of its"
        " publisher has room for, 10 at least.",
        show_default=False,
    ),
]
ReceiversOption = Annotated[
    bool,
    typer.Option(
        "--receivers/--no-receivers",
        help="Give nodes that subscribe to the shaped output SCHED_FIFO below all servers, while"
        " the plan is in force.",
    ),
]
FallbackOption = Annotated[
    Fallback | None,
    typer.Option(
        help="While the shaping node is not there: outputs go around it, or none is published."
        " Default: bypass, or what the plan says."
    ),
]
MaxGapOption = Annotated[
    int | None,
    duration_option("--max-gap", "Longest distance of neighbouring bands (LV).", panel=_BANDS),
]
MaxShareOption = Annotated[
    float | None,
    typer.Option(
        "--max-share",
        metavar="SHARE",
        parser=_share,
        help="Most cycles in one band: 0.4 or 40%.",
        rich_help_panel=_BANDS,
    ),
]
GridOption = Annotated[
    int, duration_option("--grid", "Slots end at multiples of this.", panel=_BANDS)
]
MeanAtMostOption = Annotated[
    int | None,
    duration_option("--mean-at-most", "The average that --minimise may cost.", panel=_BANDS),
]
LeastGainOption = Annotated[
    float,
    typer.Option(
        "--least-gain",
        metavar="SHARE",
        parser=_share,
        help="With --bands auto: what another band must take off the average.",
        rich_help_panel=_BANDS,
    ),
]
CurveOption = Annotated[
    Path | None,
    typer.Option(
        "--curve",
        metavar="FILE.png",
        help="With --bands auto: draw the average over the number of bands.",
        rich_help_panel=_BANDS,
    ),
]
SeedOption = Annotated[
    int, typer.Option("--seed", min=0, help="For pso, random and the derived margin.")
]
SlotStartOption = Annotated[
    int | None, duration_option("--slot-start", "Where the slot of one-long-slot starts.")
]
FirstSlotOption = Annotated[
    int | None,
    duration_option(
        "--first-slot", "A server of its own for the chain's first node, this long.", panel=_MORE
    ),
]
SinksOption = Annotated[
    list[str] | None,
    typer.Option(
        "--sink",
        metavar="FIRST..LAST",
        help="A chain to a further output of the same graph, to be shaped too.",
        rich_help_panel=_MORE,
    ),
]
