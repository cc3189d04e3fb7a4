"""Options that several verbs share, and those that are wishes for a plan.

A wish is declared once, in :class:`chainshaper.values.plan_choices.Wishes`; :func:`takes_wishes`
makes options of them.
"""

from collections.abc import Callable
from dataclasses import fields
from functools import wraps
from inspect import Parameter, Signature, signature
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeAlias, get_args

import typer

from chainshaper.gate.decision import Late
from chainshaper.values.durations import format_duration, parse_duration
from chainshaper.values.errors import InputError
from chainshaper.values.plan_choices import Wishes

if TYPE_CHECKING:
    from chainshaper.planning import Modes, Plan

Source: TypeAlias = Literal["lttng", "ebpf"]

NodeKind: TypeAlias = Literal["python", "cpp", "typed"]
"""How a shaping node is made."""


def _duration(text: str) -> int:
    try:
        value = parse_duration(text)
    except InputError as error:
        raise typer.BadParameter(str(error)) from error
    if value < 0:
        raise typer.BadParameter(f"{text} is negative")
    return value


def _bands(text: str) -> int | Literal["auto"]:
    if text == "auto":
        return "auto"
    if not (text.isdecimal() and int(text) > 0):
        raise typer.BadParameter(f"{text!r} is neither a number of bands from 1 on nor auto")
    return int(text)


def _share(text: str) -> float:
    try:
        value = float(text.removesuffix("%")) / (100 if text.endswith("%") else 1)
    except ValueError as error:
        raise typer.BadParameter(f"{text!r} is no share: write 0.4 or 40%") from error
    if not 0 < value <= 1:
        raise typer.BadParameter(f"{text} is no share: write more than 0, at most 1 or 100%")
    return value


PARSERS: dict[str, Callable[[str], Any]] = {
    "DURATION": _duration,
    "N|auto": _bands,
    "SHARE": _share,
}
"""What is behind a metavar."""

WRITTEN: dict[str, Callable[[Any], str]] = {
    "DURATION": format_duration,
    "N|auto": str,
    "SHARE": "{:.0%}".format,
}
"""How a default is written for these."""


def option(name: str, help_text: str, metavar: str | None = None, **more: Any) -> Any:
    """An option; of a duration (with its unit; in ns), of bands and of a share it is parsed."""
    parser = PARSERS.get(metavar or "")
    return typer.Option(*name.split(" "), help=help_text, metavar=metavar, parser=parser, **more)


JsonOption = Annotated[bool, option("--json", "Print the figures as JSON (integer ns).")]
ChainOption = Annotated[
    str | None,
    option(
        "--chain",
        "The chain, by topics or nodes: /t1../t5. Default: the one the recording names.",
        "FIRST..LAST",
    ),
]
PlanInForceOption = Annotated[
    Path | None,
    option(
        "--plan",
        "The plan that the last recording was made with, where it does not say so.",
        "plan.yaml",
    ),
]
TraceArgument = Annotated[
    list[Path],
    typer.Argument(
        metavar="TRACE...",
        help="An LTTng trace's folder (several of one trace: kernel and user space), or a "
        "recording's.",
    ),
]
ApplicationArgument = Annotated[
    Path, typer.Argument(metavar="APP.yaml", help="The application's description.")
]
RecordingOutput = Annotated[Path, option("--output -o", "Folder to write; must not exist.", "REC")]
CyclesOption = Annotated[int, option("--cycles", "Cycles to record.", min=1)]
SeedOption = Annotated[int | None, option("--seed", "Instead of the description's.", min=0)]
RealtimeOption = Annotated[
    bool | None,
    option("--realtime/--no-realtime", "Use SCHED_FIFO. Default: where it is permitted."),
]
UsersOption = Annotated[
    list[str] | None,
    option(
        "--user",
        "Whose processes are taken for nodes (may be repeated). Default: yours, also behind "
        "sudo, and root's.",
        "NAME",
    ),
]
SourceOption = Annotated[Source, option("--source", "Who records the events.")]
NodeOption = Annotated[
    NodeKind, option("--node", "A script; a package for all types; or one generated for the type.")
]


def plan_in_force(path: Path | None) -> "Plan | None":
    """The plan of a file, if one is named."""
    from chainshaper.planning import load_plan

    return None if path is None else load_plan(path)


_WISHES = {field.name: field for field in fields(Wishes)}
PLAN_WISHES = (*_WISHES, "modes", "late")
"""All that :func:`takes_wishes` knows."""


def wish(name: str, default_text: str = "") -> Any:
    """The option of a wish."""
    described = next(one for one in get_args(_WISHES[name].type) if hasattr(one, "panel"))
    flag = described.flag or "--" + name.removesuffix("_ns").replace("_", "-")
    more = {} if described.least is None else {"min": described.least}
    return option(
        flag,
        described.help + default_text,
        "DURATION" if name.endswith("_ns") else described.metavar,
        rich_help_panel=described.panel,
        **more,
    )


def _parameter(name: str) -> Parameter:
    """A wish as a parameter of a verb; a default that is parsed is written out."""
    field, information = _WISHES[name], wish(name)
    default = field.default
    if default is not None and information.metavar in WRITTEN:
        default = WRITTEN[information.metavar](default)
    kind = str if name == "bands" else get_args(field.type)[0]  # Typer knows no unions
    return Parameter(
        name, Parameter.KEYWORD_ONLY, default=default, annotation=Annotated[kind, information]
    )


ModesOption = Annotated[
    str | None,
    option(
        "--modes",
        "Each mode's band, 1 is the first; the first mode named is in force until the topic"
        " (std_msgs/String) names another. Such as /driving_mode:city=2,highway=1.",
        "TOPIC:MODE=BAND,…",
        rich_help_panel="Latency bands",
    ),
]
LateOption = Annotated[
    Late | None,
    option(
        "--late",
        "With --modes, an output behind its mode's slot: at once, wait for the next cycle's,"
        " discard, or in the cycle's next slot. Default: publish.",
        rich_help_panel="Latency bands",
    ),
]


_MODES = {
    name: Parameter(name, Parameter.KEYWORD_ONLY, default=None, annotation=kind)
    for name, kind in (("modes", ModesOption), ("late", LateOption))
}


def takes_wishes(*names: str) -> Callable[[Callable[..., None]], Any]:
    """Give a verb, in place of its parameter ``request``, an option for each of these wishes.

    ``request`` is the :class:`~chainshaper.planning.PlanRequest` that the options make. Wishes here
    are also ``modes`` and ``late``, which give it the modes of the system.
    """

    def decorate(verb: Callable[..., None]) -> Any:
        @wraps(verb)
        def called(**values: Any) -> None:
            from chainshaper.planning import PlanRequest

            wished = {name: values.pop(name) for name in names}
            modes = modes_of(wished.pop("modes", None), wished.pop("late", None))
            verb(**values, request=PlanRequest(**wished, modes=modes))

        options = [_MODES.get(name) or _parameter(name) for name in names]
        parameters: list[Parameter] = []
        for one in signature(verb).parameters.values():
            own = [one.replace(kind=Parameter.KEYWORD_ONLY)]
            parameters += options if one.name == "request" else own
        called.__signature__ = Signature(parameters)  # type: ignore[attr-defined]
        called.__annotations__ = {one.name: one.annotation for one in parameters}
        return called

    return decorate


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
