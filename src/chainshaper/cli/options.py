"""Options that several verbs share, and those that are wishes for a plan."""

from collections.abc import Callable, Sequence
from dataclasses import fields
from functools import wraps
from inspect import Parameter, Signature, signature
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeAlias, get_args

import typer

import chainshaper as cs
from chainshaper.robot.gate import Late
from chainshaper.values.durations import format_duration, parse_duration
from chainshaper.values.errors import InputError
from chainshaper.values.plan_choices import BANDS, NodeChoice, Wishes

if TYPE_CHECKING:
    from chainshaper.planning import Modes

Source: TypeAlias = Literal["lttng", "preload", "ebpf"]

# Panels of the help, behind that of the common options.
EVIDENCE, TRACING, THREADS = "What is planned from", "Tracing", "Which threads"
IN_FORCE, NODE_PANEL = "While the plan is in force", "The shaping node"

DESCRIPTIONS = (".yaml", ".yml")  # what applications' and plans' files end with


def _duration(text: str) -> int:
    try:
        value = parse_duration(text)
    except InputError as error:
        raise typer.BadParameter(str(error)) from error
    if value < 0:
        raise typer.BadParameter(f"{text} is negative")
    return value


def _positive(text: str) -> int:
    if not (value := _duration(text)):
        raise typer.BadParameter(f"{text} is no time: write more than 0")
    return value


def _bands(text: str) -> int | Literal["auto"]:
    if text == "auto":
        return "auto"
    if not (text.isdecimal() and int(text) > 0):
        raise typer.BadParameter(f"{text!r} is neither a number of bands from 1 on nor auto")
    return int(text)


def _node(text: str) -> NodeChoice:
    if text in ("typed", "component"):
        reason = f"{text} is found out now: write --node cpp, and --type where no recording says it"
        raise typer.BadParameter(reason)
    if text not in get_args(NodeChoice):
        raise typer.BadParameter(f"{text!r} is none of {', '.join(get_args(NodeChoice))}")
    choice: NodeChoice = text  # type: ignore[assignment]
    return choice


def _cores(text: str) -> tuple[int, ...]:
    words = text.split(",")
    if not all(word.strip().isdecimal() for word in words):
        raise typer.BadParameter(f"{text!r} are no cores: write their numbers, such as 0,1")
    return tuple(map(int, words))


def _share(text: str) -> float:
    try:
        value = float(text.removesuffix("%")) / (100 if text.endswith("%") else 1)
    except ValueError:
        value = 0.0
    if not 0 < value <= 1:
        reason = f"{text} is no share: write more than 0, at most 1 or 100%, such as 0.4 or 40%"
        raise typer.BadParameter(reason)
    return value


PARSERS: dict[str, tuple[Callable[[str], Any], Callable[[Any], str]]] = {
    "DURATION": (_duration, format_duration),
    "DURATION>0": (_positive, format_duration),
    "N|auto": (_bands, str),
    "CORES": (_cores, lambda cores: ",".join(map(str, cores))),
    "auto|python|cpp": (_node, str),
    "SHARE": (_share, "{:.0%}".format),
}
"""By metavar: the function that reads a value, and the one that writes a default for the help."""


def option(names: str, help_text: str, default: Any = None, **more: Any) -> Any:
    """Return an option as the default of a verb's parameter.

    ``names`` are its names, and behind them its metavar, if any (:data:`PARSERS`). The default
    ``...`` means that the option must be given.
    """
    words = names.split()
    metavar = None if words[-1].startswith("-") else words.pop()
    parse, write = PARSERS.get(metavar or "", (None, None))
    if write is not None and default not in (None, ...):
        default = write(default)
    return typer.Option(default, *words, help=help_text, metavar=metavar, parser=parse, **more)


def argument(metavar: str, help_text: str, default: Any = None) -> Any:
    """Return an argument as the default of a verb's parameter; ``...``: it must be given."""
    metavar = metavar.strip("[]").rstrip(".…")  # Click adds that it may be left out, or repeated
    return typer.Argument(default, metavar=metavar, help=help_text, show_default=False)


SINK: list[str] | None = option(
    "--sink FIRST..LAST",
    "A chain to a further output of the same graph, to be shaped too.",
    rich_help_panel="More of the graph",
)
JSON: bool = option("--json", "Print the figures as JSON (integer ns).", False)
CHAIN: str | None = option(
    "--chain FIRST..LAST",
    "The chain, by topics or nodes: /t1../t5. Default: the one the recording names, or the only"
    " one in it.",
)
CHAINS: list[str] | None = option(
    "--chain FIRST..LAST",
    "A chain (may be repeated). Default: the one the recording names, or the only one in it.",
)
THROUGH: list[str] | None = option(
    "--through /IN=/OUT",
    "Messages of topic /IN go into those of /OUT (or NODE:end, NODE:write) in a process, though"
    " nothing shows it: the newest before each counts (may be repeated).",
    rich_help_panel="What no event shows",
)
STRICT: bool = option("--strict", "Exit code 1 unless the plan's promise is met.", False)
PLAN_IN_FORCE: Path | None = option(
    "--plan plan.yaml", "The plan that the last recording was made with, where it does not say so."
)
CALLBACK_GROUPS: Path | None = option(
    "--callback-groups FILE.yaml",
    "The configuration of callback_isolated_executor that was in force: class and cores of each"
    " callback group's thread. What the kernel showed while it ran counts before it.",
    rich_help_panel="What no event shows",
)
SCHEDULER: str | None = option(
    "--scheduler ADDRESS",
    "Compute on the Dask cluster whose scheduler is there, such as tcp://host:8786.",
)
TRACE: list[Path] = argument(
    "TRACE...",
    "An LTTng trace's folder (several of one trace: kernel and user space), or a recording's.",
    ...,
)
APPLICATION: Path = argument("APP.yaml", "The application's description.", ...)
RECORDING_OUTPUT: Path = option("--output -o REC", "Folder to write; must not exist.", ...)
SINCE: int = option(
    "--skip --from DURATION",
    "Leave out what the recording begins with, such as 2s of start-up.",
    0,
    rich_help_panel=EVIDENCE,
)
UNTIL: int | None = option(
    "--to DURATION",
    "Leave out what happened this long after it began.",
    rich_help_panel=EVIDENCE,
)
CYCLES: int = option("--cycles", "Cycles to record.", 320, min=1)
SEED: int | None = option("--seed", "Random seed; overrides the file's.", min=0)
REALTIME: bool | None = option(
    "--realtime/--no-realtime", "Use SCHED_FIFO. Default: where it is permitted."
)
USERS: list[str] | None = option(
    "--user NAME",
    "Whose processes are taken for nodes (may be repeated). Default: yours, also behind sudo, and"
    " root's.",
)
ADAPT: bool = option(
    "--adapt",
    "Slots follow the latencies: later when the plan's promise does not hold any more, earlier when"
    " latency can be given back.",
    False,
    rich_help_panel=IN_FORCE,
)
MAX_LATENCY: int | None = option(
    "--max-latency DURATION",
    "With --adapt: no slot ends later. Default: as the plan says.",
    rich_help_panel=IN_FORCE,
)
SOURCE: Source | None = option(
    "--source",
    "Tracer. Default: preload, or lttng where that cannot be had.",
    rich_help_panel=TRACING,
)
LOOPS: list[str] | None = option(
    "--loop NAME",
    "A loop that is no callback, by its node (/name) or its thread's name (preload; may be "
    "repeated). For threads that publish nothing, as those that write to hardware.",
    rich_help_panel=TRACING,
)
NODE: NodeChoice = option(
    "--node auto|python|cpp",
    "The shaping node in Python, which needs no building, or in C++. auto: in C++ where it is built"
    " and can be. What kind of node in C++, for all types or for the output's own, in a process or"
    " in the publisher's container, is found out.",
    "auto",
    rich_help_panel=NODE_PANEL,
)


def plan_in_force(path: Path | None) -> "cs.Plan | None":
    """Read the plan of a file, if a file is named."""
    return None if path is None else cs.load_plan(path)


_WISHES = {field.name: field for field in fields(Wishes)}
PLAN_WISHES = (*_WISHES, "modes", "late")  # all that :func:`takes_wishes` knows


def wish(name: str, **more: Any) -> Any:
    """Return the option of a wish; ``more`` may give it another ``default``."""
    _, described = get_args(_WISHES[name].type)
    names = described.flag or "--" + name.removesuffix("_ns").replace("_", "-")
    metavar = "DURATION" if name.endswith("_ns") else described.metavar or ""
    if described.least is not None:
        more["min"] = described.least
    default = more.pop("default", _WISHES[name].default)
    more.setdefault("rich_help_panel", described.panel)
    return option(f"{names} {metavar}", described.help, default, **more)


MODE_PROFILE: list[str] | None = option(
    "--mode-profile MODE=REC",
    "With --modes: what was measured in one mode alone, a recording or a file of latencies"
    " (may be repeated). Default: the cycles of the recording that began in it.",
    rich_help_panel=BANDS,
)
_MODES = option(
    "--modes TOPIC:MODE[=BAND],…",
    "Each mode's band, 1 is the first, found where none has a number; the first mode named is in"
    " force until the topic (std_msgs/String) names another. Such as /driving_mode:city,highway.",
    rich_help_panel=BANDS,
)
_LATE = option(
    "--late",
    "With --modes, an output behind its mode's slot: at once, wait for the next cycle's, discard,"
    " or in the cycle's next slot. Default: publish.",
    rich_help_panel=BANDS,
)
# The type and the option of each wish whose own type Typer cannot read, and of the modes.
_AS_TEXT: dict[str, tuple[Any, Any]] = {
    "modes": (str | None, _MODES),
    "late": (Late | None, _LATE),
    "bands": (str, wish("bands")),  # Typer knows no unions
    "cores": (str | None, wish("cores")),  # nor tuples of any length
    "best_effort": (list[str], wish("best_effort", default=[])),
}


def takes_wishes(*names: str) -> Callable[[Callable[..., None]], Any]:
    """Give a verb options for these wishes, and `--modes`, in place of its PlanRequest."""

    def decorate(verb: Callable[..., None]) -> Any:
        @wraps(verb)
        def called(**values: Any) -> None:
            wished = {name: values.pop(name) for name in names}
            text = wished.pop("modes", None)
            modes = modes_of(text, wished.pop("late", None))
            if modes is not None and "=" not in text:
                wished["bands_of_modes"] = "found"
            if "best_effort" in wished:
                wished["best_effort"] = tuple(wished["best_effort"])
            verb(**values, request=cs.PlanRequest(**wished, modes=modes))

        parameters: list[Parameter] = []
        for parameter in signature(verb).parameters.values():
            if parameter.name != "request":
                parameters.append(parameter.replace(kind=Parameter.KEYWORD_ONLY))
                continue
            for name in names:
                if name in _AS_TEXT:
                    annotation, default = _AS_TEXT[name]
                else:
                    annotation, default = get_args(_WISHES[name].type)[0], wish(name)
                parameters.append(
                    Parameter(name, Parameter.KEYWORD_ONLY, default=default, annotation=annotation)
                )
        called.__signature__ = Signature(parameters)  # type: ignore[attr-defined]
        called.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
        return called

    return decorate


def mode_profiles(given: list[str] | None, request: "cs.PlanRequest") -> dict[str, str]:
    """Return the recording or file that `--mode-profile` names for each mode.

    Raises InputError: a text is not of the form MODE=REC, or there are no modes.
    """
    pairs = [text.partition("=") for text in given or ()]
    if not all(request.modes is not None and place for _, _, place in pairs):
        raise InputError("--mode-profile goes with --modes, as MODE=REC: correct one of the two")
    return {mode: place for mode, _, place in pairs}


def modes_of(text: str | None, late: Late | None) -> "Modes | None":
    """Return the modes that `--modes` names, such as ``/mode:city=2,highway=1``.

    The first mode is the default. Without numbers the bands are numbered in the order of the modes.

    Raises InputError: the text is not of this form, or a name in it no mode or topic may have.
    """
    if text is None:
        if late is not None:
            raise InputError(f"--late {late} goes with modes: add --modes, or leave it out")
        return None
    from chainshaper.planning import Modes
    from chainshaper.values.yaml_file import wrong_values_refused

    topic, colon, listed = text.partition(":")
    if not colon and text.startswith("/"):
        raise InputError(
            f"--modes {text}: which modes does it announce? Write each mode once behind it, such as"
            f" {text}:city,highway"
        )
    if not colon:
        raise InputError(
            f"--modes {text}: which topic announces the modes? Write it in front of them, such as"
            f" /driving_mode:{text}"
        )
    pairs = [pair.partition("=") for pair in listed.split(",")]
    bands = {mode: int(band) for mode, _, band in pairs if band.isdecimal()}
    if listed and "=" not in listed:
        bands = {mode: number for number, (mode, _, _) in enumerate(pairs, start=1)}
    if len(bands) != len(pairs):
        raise InputError(f"--modes {text}: write each mode once, all with a band or none")
    with wrong_values_refused(Modes):
        return Modes(topic=topic, default=pairs[0][0], bands=bands, late=late or "publish")


def recording_of(
    named: Path | None, plan: "cs.Plan | None" = None, through: Sequence[str] = ()
) -> "cs.Recording | None":
    """Open the recording that an option names, or else one that the plan was made from.

    ``through`` is what the user declares that no event shows.

    Of several chains it is the first recording that is still there. None: there is none.
    """
    for chain_plan in () if plan is None else plan.chains:
        recorded = chain_plan.evidence.recording
        if named is None and recorded is not None and Path(recorded).is_dir():
            named = Path(recorded)
    return None if named is None else cs.open_source(named, through=through)


def refuse_bound_alone(max_latency_ns: int | None, adapt: bool) -> None:
    """Refuse a bound for slots that do not follow the latencies. Raises InputError."""
    if max_latency_ns is not None and not adapt:
        raise InputError("--max-latency bounds slots that follow the latencies: add --adapt")
