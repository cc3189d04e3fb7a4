"""A described application as real ROS 2 nodes in Python: run, recorded, and shaped by a plan.

The ROS 2 is the one whose environment this process has. The nodes are recorded by the library in
front of ROS 2, and shaped as those of any other application: by a gate in the publisher's process,
or by a shaping node that republishes the output.
"""

import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path

from chainshaper.flow.record import record_command
from chainshaper.linux.child_processes import tool_environment
from chainshaper.linux.processes import RunningProcess
from chainshaper.linux.scheduling import check_cores
from chainshaper.planning import Plan
from chainshaper.planning.chain_plan import ChainPlan, ShapingNode, shaping_nodes
from chainshaper.sources.preload.in_front import ANY_ORDER, SANITIZER
from chainshaper.splicing import gate_settings
from chainshaper.splicing.application import nothing_to_splice, placed_application
from chainshaper.splicing.shaped_outputs import remove_abandoned_pages
from chainshaper.splicing.shaping_process import write_shaping_process
from chainshaper.values.errors import OperationError, PlatformError
from chainshaper.values.files import write_whole
from chainshaper.values.progress import Progress
from chainshaper.values.recording import Recording, refuse_existing
from chainshaper.workload.description import Application, origin_timer
from chainshaper.workload.launcher import LOOP_NAME
from chainshaper.workload.live import fifo_permitted
from chainshaper.workload.rclpy_nodes import WrittenNodes, write_rclpy_nodes
from chainshaper.workload.timing import WARM_UP_CYCLES

_NEEDED = "import rclpy, sensor_msgs.msg, std_msgs.msg"
_LINES_SHOWN = 5  # of what nodes printed, in an error


def check_ros() -> None:
    """See that this environment has a ROS 2 for Python. Raises PlatformError: it has none."""
    command, lacking = ["env", "python3", "-c", _NEEDED], "python3 is not on the PATH"
    run = subprocess.run(command, env=tool_environment(), capture_output=True, check=False)
    if run.returncode:
        lacking = run.stderr.decode(errors="replace").strip().rpartition("\n")[2] or lacking
        raise PlatformError(
            f"there is no ROS 2 for Python in this environment ({lacking}): source its setup.bash;"
            " from a clone `make demo-ros` brings one from PyPI"
        )


def run_in_ros(
    application: Application,
    output: str | Path,
    *,
    plan: Plan | None = None,
    cycles: int = 320,
    realtime: bool | None = None,
    progress: Progress = lambda *_: None,
) -> Recording:
    """Run an application as ROS 2 nodes for about ``cycles`` of its chain, and record it.

    With a ``plan`` its shaping nodes are spliced in, or gates put into publishers' processes. With
    ``realtime`` None, SCHED_FIFO is used where it is permitted; with False it is not used. A few
    cycles warm the caches first.

    Raises InputError: ``output`` exists, or the nodes do not do what is described or planned.
    PlatformError: there is no ROS 2, a core is missing, or SCHED_FIFO is wanted and not permitted.
    OperationError: a node ended, nothing was traced, or the recording cannot be written.
    """
    output = refuse_existing(output)
    check_ros()
    check_cores(application.cores())
    permitted = fifo_permitted(realtime)
    realtime = permitted if realtime is None else realtime
    period_ns = origin_timer(application)[1].period_ns or 0
    with tempfile.TemporaryDirectory(prefix=f".{output.name}.nodes-", dir=output.parent) as place:
        if plan is not None:
            application = placed_application(application, plan)
        gates = _Gates() if plan is None else _gates_of(plan, Path(place))
        nodes = write_rclpy_nodes(
            application,
            Path(place),
            realtime=realtime,
            remaps=gates.remaps,
            beside=gates.processes,
            environment=gates.environment,
        )
        try:
            done = record_command(
                output,
                nodes.command,
                source="preload",
                duration_ns=cycles * period_ns,
                chain=application.chain,
                loops=(LOOP_NAME,) if any(node.loop for node in application.nodes.values()) else (),
                scheduling=_warmed_up(nodes.ready, WARM_UP_CYCLES * period_ns),
                plan=plan,
                gate_logs=gates.logs,
                watch_stalls=realtime,
                ask_qos=False,  # the description says them
                progress=progress,
            )
        except OperationError as error:
            raise OperationError(f"{error}{_said(nodes)}") from error
        finally:
            remove_abandoned_pages()  # of the gates, which have ended
        if done.exit_code is not None:
            raise OperationError(f"a node ended before its time{_said(nodes)}")
    info = done.recording.info.model_copy(update={"realtime": realtime})
    return replace(done.recording, info=info)


@dataclass
class _Gates:
    """What a plan adds to an application that runs as ROS 2 nodes.

    * ``remaps``: topics that a node finds elsewhere, by its full name.
    * ``processes``: commands of shaping nodes.
    * ``environment``: loads gates into the nodes' processes.
    * ``logs``: of shaping nodes and gates.
    """

    remaps: dict[str, dict[str, str]] = field(default_factory=dict)
    processes: list[list[str]] = field(default_factory=list)
    environment: dict[str, str] = field(default_factory=dict)
    logs: list[Path] = field(default_factory=list)


def _gates_of(plan: Plan, folder: Path) -> _Gates:
    """Write the gates of a plan into a folder; shaping nodes have no standby here.

    Raises InputError: the plan shapes nothing.
    """
    gates, settings = _Gates(), list[str]()
    for chain in plan.chains:
        if chain.shaping_node is None:
            raise nothing_to_splice(chain)
        for node in shaping_nodes(chain):
            log = folder / f"{node.name}.csv"
            gates.logs.append(log)
            publisher = _publisher(chain, node)
            if node.in_process:
                settings.append(gate_settings.gate_settings(chain, node, publisher, log))
            else:
                process = write_shaping_process(chain, node, "python", folder, log=log)
                gates.processes.append(process.command_line)
                gates.remaps.setdefault(publisher, {})[node.output] = node.input
            settings.append(gate_settings.delivery_settings(node))
    if any(settings):
        file = folder / "gates"
        write_whole(file, ["".join(settings).encode()])
        gates.environment = {
            "LD_PRELOAD": str(gate_settings.gate_library()),
            SANITIZER: ANY_ORDER,
            gate_settings.GATES: str(file),
        }
    return gates


def _publisher(chain: ChainPlan, node: ShapingNode) -> str:
    """Return the full name of the node whose output a shaping node holds."""
    publisher = chain.chain.publisher if node is chain.shaping_node else node.publisher
    return publisher or ""


@contextmanager
def _warmed_up(
    ready: Sequence[Path], warm_up_ns: int
) -> Iterator[Callable[[Sequence[RunningProcess]], bool]]:
    """Yield a function that says whether all nodes have been ready for so long."""
    since_ns = list[int]()

    def warm(_: Sequence[RunningProcess]) -> bool:
        if not since_ns and all(file.exists() for file in ready):
            since_ns.append(time.monotonic_ns())
        return bool(since_ns) and time.monotonic_ns() - since_ns[0] >= warm_up_ns

    yield warm


def _said(nodes: WrittenNodes) -> str:
    """Return the last lines that nodes printed, for an error; "": they printed nothing."""
    if not nodes.said.exists():
        return ""
    lines = nodes.said.read_text(errors="replace").splitlines()[-_LINES_SHOWN:]
    return f"; its nodes said last: {' | '.join(lines)}" if lines else ""
