"""Verbs that run an application: live, simulated, recorded, profiled, shaped; and the demo."""

import sys
import threading
from collections.abc import Sequence
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from chainshaper.cli.options import (
    ApplicationArgument,
    ChainOption,
    CyclesOption,
    JsonOption,
    NodeKind,
    NodeOption,
    RealtimeOption,
    RecordingOutput,
    SeedOption,
    Source,
    SourceOption,
    UsersOption,
    option,
    plan_in_force,
    takes_wishes,
)
from chainshaper.cli.output import (
    late_progress,
    notes,
    print_json,
    progress,
    show,
    show_line,
    stage_lines,
    stop_on_signals,
)
from chainshaper.values.errors import InputError, OperationError

if TYPE_CHECKING:
    from chainshaper.analysis import ChainEnumeration
    from chainshaper.flow.record import Scheduling
    from chainshaper.planning import PlanRequest
    from chainshaper.values.application import ApplicationGraph

MIB = 1 << 20
STDERR = 2
DESCRIPTIONS = (".yaml", ".yml")
SHAPING_DURATION_NS = 60_000_000_000

CommandArgument = Annotated[
    list[str] | None,
    typer.Argument(
        metavar="[-- COMMAND…]",
        help="Starts the application, such as `ros2 launch …`; ended with the recording.",
    ),
]
DurationOption = Annotated[
    int | None,
    option(
        "--duration",
        "How long to record. Default: until the application ends, or Ctrl-C.",
        "DURATION",
    ),
]
BufferOption = Annotated[
    int | None,
    option(
        "--buffer",
        "LTTng's buffer of each core, in MiB, for when events were lost. Default: 4.",
        "MIB",
        min=1,
    ),
]


@takes_wishes("ideal_machine")
def demo(
    output: Annotated[
        Path | None,
        option(
            "--output -o", "Folder for everything. Default: chainshaper-demo-DATE-TIME here.", "DIR"
        ),
    ] = None,
    application: Annotated[
        Path | None,
        option(
            "--application", "Another application than the paper's synthetic chain.", "APP.yaml"
        ),
    ] = None,
    cycles: CyclesOption = 320,
    realtime: RealtimeOption = None,
    *,
    request: "PlanRequest",
    json: JsonOption = False,
) -> None:
    """Measure a live chain, plan, splice the shaping node, measure again, show the gain.

    Runs the paper's synthetic chain as real processes over real DDS topics, for about a minute
    and a half. Needs no ROS 2.
    """
    from chainshaper.flow.demo import run_demo
    from chainshaper.planning import plan_warnings
    from chainshaper.reporting.tables import (
        callback_table,
        comparison_json,
        comparison_table,
        plan_table,
    )

    folder = output or Path(f"chainshaper-demo-{datetime.now():%Y%m%d-%H%M%S}")
    with progress("demo") as report:
        result = run_demo(
            folder,
            application=application,
            cycles=cycles,
            request=request,
            realtime=realtime,
            command=sys.argv,
            planned=lambda plan: notes(plan_warnings(plan)),
            progress=report,
        )
    if json:
        print_json({**comparison_json(result.comparison), "folder": str(folder)})
        return
    show(
        callback_table(result.callbacks),
        plan_table(result.plan),
        comparison_table(result.comparison),
    )
    notes(result.notes)
    show_line(str(folder.absolute()))


def run(
    application: ApplicationArgument,
    output: RecordingOutput,
    cycles: CyclesOption = 320,
    realtime: RealtimeOption = None,
) -> None:
    """Run an application live over DDS and record its events.

    Every node is a process of its own, scheduled as the description says (SCHED_FIFO where it is
    permitted). The recording is a folder of Parquet tables.
    """
    from chainshaper.workload.description import load_application
    from chainshaper.workload.live import run_application

    description = load_application(application)
    with progress(f"running {description.name}") as report:
        recording = run_application(
            description, output, cycles=cycles, realtime=realtime, command=sys.argv, progress=report
        )
    notes(recording.info.notes)
    show_line(str(recording.path))


def simulate(
    application: ApplicationArgument,
    output: RecordingOutput,
    plan: Annotated[
        Path | None, typer.Argument(metavar="plan.yaml", help="The plan in force.")
    ] = None,
    cycles: CyclesOption = 320,
    seed: SeedOption = None,
    switches: Annotated[bool, option("--switches", "Record what ran on which core, too.")] = False,
    execution_times: Annotated[
        Path | None,
        option("--execution-times", "Draw execution times from those recorded there.", "REC"),
    ] = None,
    block: Annotated[
        int, option("--block", "So many consecutive ones at a time.", min=1, max=1024)
    ] = 1,
) -> None:
    """Simulate an application, with a plan in force or without, and record its events.

    The recording is like that of a live run: every other verb takes it.
    """
    from chainshaper.simulation import simulate as run_simulation
    from chainshaper.simulation.samples import with_recorded_times
    from chainshaper.workload.description import load_application

    description = load_application(application)
    if execution_times is not None:
        description = with_recorded_times(description, execution_times, block=block)
    with late_progress(f"simulating {description.name}") as report:
        recording = run_simulation(
            description,
            output,
            plan_in_force(plan),
            cycles=cycles,
            seed=seed,
            switches=switches,
            command=sys.argv,
            progress=report,
        )
    show_line(str(recording.path))


def record(
    output: RecordingOutput,
    command: CommandArgument = None,
    source: SourceOption = "lttng",
    duration: DurationOption = None,
    pid: Annotated[
        list[int] | None,
        option(
            "--pid",
            "Attach to this process and what it has started (ebpf; may be repeated). "
            "Default, without a COMMAND: everything of the users that looks like ROS 2.",
        ),
    ] = None,
    user: UsersOption = None,
    buffer: BufferOption = None,
    watch_stalls: Annotated[
        bool,
        option(
            "--watch-stalls",
            "Have a sleeper on every core notice when the machine itself stands still.",
        ),
    ] = False,
    json: JsonOption = False,
) -> None:
    """Record a ROS 2 application: its events, nodes, threads and QoS.

    Starts tracing, then the COMMAND, and ends both with Ctrl-C, after --duration, or when the
    application ends by itself. The application is neither changed nor recompiled.
    """
    if command and pid:
        raise InputError("a COMMAND is started, --pid attaches to what runs: give one of them")
    if not command and source == "lttng":
        raise InputError(
            "no command given: `chainshaper record -o REC -- ros2 launch …`; to attach to what "
            "runs already, add `--source ebpf`"
        )
    _record_and_show(
        *(output, command or [], source, duration, buffer),
        json=json,
        pids=pid or [],
        users=user or [],
        watch_stalls=watch_stalls,
    )


def _record_and_show(
    output: Path,
    command: list[str],
    source: Source,
    duration_ns: int | None,
    buffer_mib: int | None,
    *,
    json: bool,
    pids: Sequence[int] = (),
    users: Sequence[str] = (),
    chain: str | None = None,
    scheduling: "Scheduling | None" = None,
    watch_stalls: bool,
) -> None:
    """Record and say what came of it.

    Raises:
        OperationError: the application failed; what was recorded until then is there.
    """
    from chainshaper.flow.exploration import event_counts, lost_events
    from chainshaper.flow.record import record_command
    from chainshaper.linux.own_processes import end_in_words

    stop = threading.Event()
    with stop_on_signals(stop):
        recorded = record_command(
            output,
            command,
            source=source,
            duration_ns=duration_ns,
            pids=pids,
            users=users,
            buffer=buffer_mib and buffer_mib * MIB,
            chain=chain,
            scheduling=scheduling,
            watch_stalls=watch_stalls,
            command_stdout=STDERR if json else None,  # standard output is ours
            stop=stop,
            progress=stage_lines("record"),
        )
    recording = recorded.recording
    count = int(event_counts(recording)["count"].sum())
    if json:
        print_json(
            {
                "recording": str(recording.path),
                "events": count,
                "lost": recording.info.lost,
                "exit_code": recorded.exit_code,
                "notes": list(recording.info.notes),
            }
        )
    else:
        show_line(str(recording.path))
    notes((*recording.info.notes, f"{count} events; {lost_events(recording.info)}"))
    if recorded.exit_code:
        raise OperationError(
            f"the command {end_in_words(recorded.exit_code)}; what was recorded until then is in "
            f"{recording.path}"
        )


def profile(
    output: RecordingOutput,
    command: CommandArgument = None,
    chain: Annotated[
        str | None,
        option(
            "--chain",
            "The chain whose nodes get the priority; --like tells which those are.",
            "FIRST..LAST",
        ),
    ] = None,
    like: Annotated[
        Path | None,
        option(
            "--like",
            "An earlier recording of the application: it knows the chain's nodes, components "
            "of containers, and executors with several threads.",
            "REC",
        ),
    ] = None,
    node: Annotated[
        list[str] | None,
        option(
            "--node",
            "A node that gets the priority (may be repeated). Default: the chain's, or all.",
            "NAME",
        ),
    ] = None,
    core: Annotated[
        int | None,
        option(
            "--core",
            "Where executors run. Default: the last core. DDS threads run on the others.",
            min=0,
        ),
    ] = None,
    source: SourceOption = "lttng",
    duration: DurationOption = None,
    buffer: BufferOption = None,
    json: JsonOption = False,
) -> None:
    """Record with the chain's threads under SCHED_FIFO, DDS threads on another core.

    This is how the latencies are measured that a plan is computed from. Whatever ends it, all
    threads are as before. What happened before the priorities were in force is left out.
    """
    from chainshaper.flow.profiling import chain_nodes, check_profiling, profiling_condition
    from chainshaper.linux.command_process import check_command
    from chainshaper.sources import open_source
    from chainshaper.values.recording import refuse_existing

    if not command:
        raise InputError("no command given: `chainshaper profile -o REC -- ros2 launch …`")
    if chain is not None and like is None and not node:
        raise InputError(
            f"which nodes {chain} has, an earlier recording knows: name it with --like REC "
            "(`chainshaper record`), or name the nodes with --node"
        )
    refuse_existing(output)
    check_command(command)
    core = check_profiling(core)
    names = [f"/{name.strip('/')}" for name in node or ()]
    earlier = None if like is None else open_source(like)
    if earlier is not None and chain is not None:
        names += chain_nodes(earlier, chain)
    _record_and_show(
        *(output, command, source, duration, buffer),
        json=json,
        chain=chain,
        scheduling=profiling_condition(names, core, like=earlier),
        watch_stalls=True,
    )


@takes_wishes(
    *("bands", "modes", "epsilon_ns", "ideal_machine", "overrun", "messages", "depth"),
    *("with_receivers", "fallback"),
)
def shape(
    words: Annotated[
        list[str],
        typer.Argument(
            metavar="APP.yaml plan.yaml | -- ros2 launch ...",
            help="A described application and the plan in force; or what launches a real one, "
            "which is then measured and planned first.",
        ),
    ],
    output: Annotated[
        Path,
        option(
            "--output -o",
            "Folder for the recording; of a launched application, for everything.",
            "REC",
        ),
    ],
    cycles: CyclesOption = 320,
    realtime: RealtimeOption = None,
    chain: ChainOption = None,
    duration: Annotated[
        int | None,
        option("--duration", "How long to measure, before and after. Default: 60s.", "DURATION"),
    ] = None,
    source: SourceOption = "lttng",
    node: NodeOption = "python",
    backend: Annotated[str, option("--backend", "As for `chainshaper apply`.", "NAME")] = "auto",
    *,
    request: "PlanRequest",
    user: UsersOption = None,
    json: JsonOption = False,
) -> None:
    """Run an application with its output shaped as planned, and record it.

    The publisher's output topic is remapped, and the shaping node republishes it in its slots.
    Behind `--`, `ros2 launch` does the whole flow: record, choose a chain, profile, plan, splice,
    apply, record again, compare. Every file in between stays; --chain, --duration, --source,
    --node, --backend, --bands, --modes, --epsilon, --ideal-machine, --overrun, --messages, --depth,
    --no-receivers, --fallback and --user are for this, and mean what they mean for
    `chainshaper plan` and `apply`.
    """
    if len(words) == 2 and words[0].endswith(DESCRIPTIONS):
        _shape_described(Path(words[0]), Path(words[1]), output, cycles, realtime)
        return
    if Path(words[0]).suffix in DESCRIPTIONS:
        raise InputError(
            "a described application is shaped with its plan, and nothing else: `chainshaper shape "
            "APP.yaml plan.yaml -o REC`"
        )
    _shape_launched(
        words,
        output,
        chain=chain,
        duration_ns=duration or SHAPING_DURATION_NS,
        source=source,
        node=node,
        back_end=backend,
        request=request,
        users=user or (),
        json=json,
    )


def _shape_described(
    application: Path, plan: Path, output: Path, cycles: int, realtime: bool | None
) -> None:
    from chainshaper.flow.steps import shape_application
    from chainshaper.planning import load_plan, plan_warnings
    from chainshaper.verify.overruns import dropped_in, dropped_text, overruns_in, overruns_text
    from chainshaper.workload.description import load_application

    description, planned = load_application(application), load_plan(plan)
    notes(plan_warnings(planned))
    with progress(f"shaping {description.name}") as report:
        recording = shape_application(
            description,
            planned,
            output,
            cycles=cycles,
            realtime=realtime,
            command=sys.argv,
            progress=report,
        )
    if overruns := overruns_in(recording, planned):
        notes([overruns_text(overruns)])
    if dropped := dropped_in(recording):
        notes([dropped_text(dropped)])
    notes(recording.info.notes)
    show_line(str(recording.path))


def _shape_launched(
    command: list[str],
    folder: Path,
    *,
    chain: str | None,
    duration_ns: int,
    source: Source,
    node: NodeKind,
    back_end: str,
    request: "PlanRequest",
    users: Sequence[str],
    json: bool,
) -> None:
    from chainshaper.flow.launch_shaping import shape_launch
    from chainshaper.planning import plan_warnings
    from chainshaper.reporting.predictions import prediction_table
    from chainshaper.reporting.tables import comparison_json, comparison_table

    stop = threading.Event()
    with stop_on_signals(stop):
        shaped = shape_launch(
            command,
            folder,
            chain=chain,
            choose=_ask if sys.stdin.isatty() and not json else None,
            request=request,
            duration_ns=duration_ns,
            source=source,
            node=node,
            back_end=back_end,
            users=users,
            stop=stop,
            planned=lambda plan: notes(plan_warnings(plan)),
            progress=stage_lines("shape"),
        )
    if json:
        print_json(comparison_json(shaped.comparison) | {"folder": str(shaped.folder)})
        return
    held = [one.held for one in shaped.comparison.measurements]
    tables = [prediction_table(one) for one in held if one is not None]
    show(comparison_table(shaped.comparison), *tables)
    notes(shaped.notes)
    show_line(str(shaped.folder))


def _ask(graph: "ApplicationGraph", found: "ChainEnumeration") -> str:
    from chainshaper.reporting.chain_list import chain_table
    from chainshaper.values.safe_text import shown

    show(chain_table(graph, found))
    default = (found.heaviest or found.chains[0]).spec
    question = f"Which chain, FIRST..LAST? [{shown(default)}]"
    return str(typer.prompt(question, default=default, show_default=False, err=True))
