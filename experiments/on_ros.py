"""Configurations of an experiment on ROS 2: generated C++ nodes, shaped by the one command.

An application becomes a colcon package (`chainshaper generate`), which is built once and started by
`ros2 launch`, over one middleware after the other. `chainshaper shape … -- ros2 launch …` measures
it under the paper's profiling condition, plans, splices and proves. Then the application as it was
profiled and as it was shaped take turns, in blocks, as live runs do: each block draws execution
times of its own, which the command's plan has not seen. `chainshaper record` records everything.

    table = [Shaping("1-band", "chain", application, {"1 band": None}, unshaped={"FIFO": None})]
    runs += ros_runs("table_9", table, options)
"""

import os
import shutil
import subprocess
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from configurations import (
    BLOCKS,
    Options,
    first_cycles,
    joined,
    latencies_of,
    output_of,
    taking_turns,
)
from results import ROS, Column, Run, earlier_runs

from chainshaper import generate_package, open_recording, shape_launch
from chainshaper.flow.launch_shaping import plan_in_force
from chainshaper.flow.profiling_condition import chain_nodes, profiled_cores, profiling_condition
from chainshaper.flow.record import record_command
from chainshaper.linux.processes import run_users
from chainshaper.planning import PlanRequest, load_plan
from chainshaper.splicing.spliced_launch import parse_launch_command
from chainshaper.values.errors import ChainshaperError, OperationError
from chainshaper.workload.description import Application, origin_timer

__all__ = ["MIDDLEWARES", "Shaping", "record_shaped", "ros_in_turns", "ros_runs"]

START_NS = 4_000_000_000

MIDDLEWARES: dict[Column, str] = {"ros": "rmw_cyclonedds_cpp", "fast": "rmw_fastrtps_cpp"}


@dataclass(frozen=True)
class Shaping:
    """What `chainshaper shape` is asked to make of an application, in the folder ``name``.

    ``shaped`` are the runs that come of it, with the chain of each (None: the application's); those
    behind the first are further sinks. ``unshaped`` are runs of the application as it is profiled:
    one shaping of each application has them. ``package`` is what the generated package is called.
    ``only`` is the one middleware that the request makes sense for.
    """

    name: str
    package: str
    application: Application
    shaped: Mapping[str, str | None]
    request: PlanRequest = field(default_factory=PlanRequest)
    unshaped: Mapping[str, str | None] = field(default_factory=dict)
    only: Column | None = None

    @property
    def chains(self) -> list[str]:
        """The chain that is shaped, and those to further sinks."""
        return [one or self.application.chain for one in self.shaped.values()]

    @property
    def launch(self) -> list[str]:
        """The command that launches the package."""
        return ["ros2", "launch", self.package, f"{self.package}.launch.py"]

    def lasting_ns(self, cycles: int) -> int:
        """How long to record for so many cycles: nodes wait for each other before the first."""
        return START_NS + cycles * (origin_timer(self.application)[1].period_ns or 0)


def ros_runs(experiment: str, shapings: Sequence[Shaping], options: Options) -> list[Run]:
    """The runs over every middleware that is measured, and those of the last time over others.

    Raises: as :func:`ros_in_turns`.
    """
    runs: list[Run] = []
    if options.ros:
        runs = ros_in_turns(shapings, cycles=options.cycles, folder=options.keep)
    measured = {run.column for run in runs}
    return runs + earlier_runs(experiment, *(one for one in ROS if one not in measured))


def ros_in_turns(
    shapings: Sequence[Shaping], *, cycles: int, folder: Path, blocks: int = BLOCKS
) -> list[Run]:
    """Shape the applications over every middleware that is installed; all runs, in turns.

    Recordings that are in ``folder`` already are used, and not measured again. What the command
    refuses or cannot do is printed, and has no shaped runs.
    Raises: as :func:`chainshaper.flow.record.record_command`; OperationError: a package cannot be
        built.
    """
    runs: list[Run] = []
    for one in shapings:
        _build(one, folder / "ws")
    for column, middleware in MIDDLEWARES.items():
        wanted = [one for one in shapings if one.only in (None, column)]
        if not _installed(middleware):
            print(f"not measured: {middleware} is not installed")
            continue
        with _environment(folder / "ws/install", middleware):
            runs += _over(column, wanted, cycles, folder / column, blocks)
    return runs


def _build(shaping: Shaping, workspace: Path) -> None:
    """Generate the package and build it, if that is not done yet."""
    if (workspace / "install/share" / shaping.package).exists():
        return
    (workspace / "src").mkdir(parents=True, exist_ok=True)
    if not (source := workspace / "src" / shaping.package).exists():
        generate_package(shaping.application, source)
    print(f"building {shaping.package}", flush=True)
    words = ["colcon", "build", "--merge-install", "--packages-select", shaping.package]
    done = subprocess.run(words, cwd=workspace, capture_output=True, text=True, check=False)
    if done.returncode:
        raise OperationError(f"{source}: colcon build failed:\n{done.stdout}{done.stderr}")


def _installed(middleware: str) -> bool:
    index = Path("share/ament_index/resource_index/rmw_typesupport") / middleware
    return any((Path(one) / index).exists() for one in os.environ["AMENT_PREFIX_PATH"].split(":"))


@contextmanager
def _environment(install: Path, middleware: str) -> Iterator[None]:
    """What is started here gets our packages, a middleware and a domain of its own."""
    before = dict(os.environ)
    os.environ |= {
        "AMENT_PREFIX_PATH": f"{install}:{before['AMENT_PREFIX_PATH']}",
        "RMW_IMPLEMENTATION": middleware,
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
        "ROS_DOMAIN_ID": str(100 + os.getpid() % 100),
    }
    try:
        yield
    finally:
        os.environ.clear()
        os.environ.update(before)


def _over(
    column: Column, shapings: Sequence[Shaping], cycles: int, folder: Path, blocks: int
) -> list[Run]:
    """The one command for each shaping, and the runs that take turns."""
    folder.mkdir(parents=True, exist_ok=True)
    made = [_shape(column, one, output_of(folder, one.name), cycles) for one in shapings]
    turns = [
        (one, name, chain, runs is one.shaped)
        for one, its_shaped in zip(shapings, made, strict=True)
        for runs in (one.unshaped, one.shaped if its_shaped else {})
        for name, chain in runs.items()
    ]
    in_a_block = -(-cycles // blocks)

    def measure(number: int, block: int) -> tuple[Run, Path]:
        one, name, chain, shaped = turns[number]
        own = output_of(folder, one.name)
        output = own / f"{'shaped' if shaped else 'unshaped'}_{block}"
        if not output.exists():
            print(f"{column}, {one.name}: {output.name}", flush=True)
            words = [*one.launch, f"seed:={one.application.seed + 1 + block}"]
            (_shaped if shaped else _unshaped)(one, own, output, words, in_a_block)
        run = latencies_of(name, open_recording(output), chain, column=column)
        return first_cycles(run, in_a_block), output

    return [joined(*one) for one in taking_turns(len(turns), blocks, measure)]


def _shape(column: Column, one: Shaping, own: Path, cycles: int) -> bool:
    """Whether the one command shapes it, or did before."""
    if (own / "comparison.json").exists():  # which is written last
        return True
    print(f"{column}, {one.name}: chainshaper shape", flush=True)
    shutil.rmtree(own, ignore_errors=True)
    try:
        shape_launch(
            one.launch,
            own,
            chain=one.chains[0],
            sinks=one.chains[1:],
            request=one.request,
            duration_ns=one.lasting_ns(cycles),
        )
    except ChainshaperError as error:
        print(f"{column}, {one.name}: not shaped: {error}", flush=True)
        return False
    return True


def _unshaped(one: Shaping, own: Path, output: Path, words: Sequence[str], cycles: int) -> None:
    """As the command measures before it plans."""
    first = open_recording(own / "first")
    _, core_of = profiled_cores(first, one.chains, one.request)
    cores = {node: core_of[node] for node in chain_nodes(first, *one.chains)}
    record_command(
        output,
        words,
        duration_ns=one.lasting_ns(cycles),
        scheduling=profiling_condition(cores, cores, like=first, policy=one.request.policy),
        chain=one.chains[0],
        watch_stalls=True,
    )


def _shaped(one: Shaping, own: Path, output: Path, words: Sequence[str], cycles: int) -> None:
    record_shaped(own, words, output, chain=one.chains[0], duration_ns=one.lasting_ns(cycles))


def record_shaped(
    shaped: Path,
    words: Sequence[str],
    output: Path,
    *,
    chain: str,
    duration_ns: int,
    command_stdout: int | None = None,
) -> None:
    """Record a `ros2 launch` as `chainshaper shape -o SHAPED -- ros2 launch …` has shaped it.

    The plan is that of the command, and so is the launch file, if it spliced anything. Raises: as
    :func:`chainshaper.shape_launch`.
    """
    first, plan = open_recording(shaped / "first"), load_plan(shaped / "plan.yaml")
    for spliced in (shaped / "launch").glob("*.launch.*"):
        words = parse_launch_command(words).with_file(spliced)
    record_command(
        output,
        words,
        duration_ns=duration_ns,
        scheduling=plan_in_force(plan, "auto", first, run_users(()), []),
        plan=plan,
        gate_logs=sorted((shaped / "launch/logs").glob("*.csv")),
        chain=chain,
        watch_stalls=True,
        command_stdout=command_stdout,
    )
