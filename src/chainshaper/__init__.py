"""chainshaper: constant end-to-end latency for ROS 2 computation chains.

Everything the command line does is one call away:

    import chainshaper as cs

    application = cs.load_application("examples/synthetic_chain.yaml")
    before = cs.run_application(application, "before")
    plan = cs.plan_recording(before)
    after = cs.shape_application(application, plan, "after")
    cs.compare_recordings([before, after])

A name is imported when it is first used, so that importing the package costs nothing. The imports
below are for type checkers; at run time they are the table of what is public, and where it is.
"""

from __future__ import annotations

from functools import cache

# Nothing slower is imported here: until chainshaper.__main__ begins, Ctrl-C shows a traceback.
TYPE_CHECKING = False
if TYPE_CHECKING:
    from typing import Any

    from chainshaper.analysis import LatencyAnalysis as LatencyAnalysis
    from chainshaper.analysis import analyse_latency as analyse_latency
    from chainshaper.analysis import application_graph as application_graph
    from chainshaper.analysis import callback_statistics as callback_statistics
    from chainshaper.analysis import data_flow as data_flow
    from chainshaper.analysis import find_chain as find_chain
    from chainshaper.analysis import load_named_paths as load_named_paths
    from chainshaper.analysis.graph import ApplicationDescription as ApplicationDescription
    from chainshaper.control.costs import cost_over as cost_over
    from chainshaper.control.design import design_controller as design_controller
    from chainshaper.control.loop import Controller as Controller
    from chainshaper.control.loop import Loop as Loop
    from chainshaper.control.loop import Plant as Plant
    from chainshaper.control.loop import Problem as Problem
    from chainshaper.control.loop import plant_of as plant_of
    from chainshaper.control.plant_file import load_loop as load_loop
    from chainshaper.control.steady_state import LatencyCosts as LatencyCosts
    from chainshaper.control.steady_state import cost_of_constant as cost_of_constant
    from chainshaper.control.steady_state import stable_latencies as stable_latencies
    from chainshaper.enforcement.undoing import end_run as end_run
    from chainshaper.enforcement.undoing import find_runs as find_runs
    from chainshaper.flow.apply import apply_plan as apply_plan
    from chainshaper.flow.callback_groups import export_callback_groups as export_callback_groups
    from chainshaper.flow.callback_groups import with_callback_groups as with_callback_groups
    from chainshaper.flow.described import shape_application as shape_application
    from chainshaper.flow.doctor import examine_machine as examine_machine
    from chainshaper.flow.exploration import convert_recording as convert_recording
    from chainshaper.flow.exploration import describe_application as describe_application
    from chainshaper.flow.exploration import list_chains as list_chains
    from chainshaper.flow.launch_shaping import ShapedLaunch as ShapedLaunch
    from chainshaper.flow.launch_shaping import shape_launch as shape_launch
    from chainshaper.flow.launch_splicing import Splicing as Splicing
    from chainshaper.flow.launch_splicing import ThrottledInput as ThrottledInput
    from chainshaper.flow.launch_splicing import splice_launch_files as splice_launch_files
    from chainshaper.flow.launch_splicing import splice_throttlers as splice_throttlers
    from chainshaper.flow.plan import plan_recording as plan_recording
    from chainshaper.flow.plan import profile_chains as profile_chains
    from chainshaper.flow.planned_changes import planned_changes as planned_changes
    from chainshaper.flow.profiling_condition import profiling_condition as profiling_condition
    from chainshaper.flow.record import Recorded as Recorded
    from chainshaper.flow.record import record_command as record_command
    from chainshaper.flow.sweep import sweep as sweep
    from chainshaper.flow.threads import find_threads as find_threads
    from chainshaper.planning import ChainPlan as ChainPlan
    from chainshaper.planning import Plan as Plan
    from chainshaper.planning import PlanRequest as PlanRequest
    from chainshaper.planning import Profile as Profile
    from chainshaper.planning import convert_plan as convert_plan
    from chainshaper.planning import load_plan as load_plan
    from chainshaper.planning import place_chains as place_chains
    from chainshaper.planning import plan_application as plan_application
    from chainshaper.planning import plan_chain as plan_chain
    from chainshaper.planning import plan_shaping as plan_shaping
    from chainshaper.planning import save_plan as save_plan
    from chainshaper.reporting.figures import draw_distribution as draw_distribution
    from chainshaper.reporting.figures import draw_hops as draw_hops
    from chainshaper.reporting.figures import draw_latency as draw_latency
    from chainshaper.reporting.foxglove import export_mcap as export_mcap
    from chainshaper.reporting.graph_drawing import write_picture as write_picture
    from chainshaper.reporting.notebook import html_of as html_of
    from chainshaper.reporting.page import write_report as write_report
    from chainshaper.reporting.perfetto import export_perfetto as export_perfetto
    from chainshaper.robot.serialized import origin_of as origin_of
    from chainshaper.simulation import simulate as simulate
    from chainshaper.simulation import simulate_latencies as simulate_latencies
    from chainshaper.sources import open_source as open_source
    from chainshaper.sources.gate_log import read_gate_log as read_gate_log
    from chainshaper.splicing.shaping_process import write_shaping_process as write_shaping_process
    from chainshaper.splicing.shaping_process import write_throttler as write_throttler
    from chainshaper.splicing.spliced_launch import undo_splice as undo_splice
    from chainshaper.values.errors import ChainshaperError as ChainshaperError
    from chainshaper.values.errors import InputError as InputError
    from chainshaper.values.errors import OperationError as OperationError
    from chainshaper.values.errors import PlatformError as PlatformError
    from chainshaper.values.recording import Recording as Recording
    from chainshaper.values.recording import event_counts as event_counts
    from chainshaper.values.recording import open_recording as open_recording
    from chainshaper.verify.control import ControlCosts as ControlCosts
    from chainshaper.verify.control import control_costs as control_costs
    from chainshaper.verify.control import (
        control_costs_of_latencies as control_costs_of_latencies,
    )
    from chainshaper.verify.measure import Comparison as Comparison
    from chainshaper.verify.measure import Measurement as Measurement
    from chainshaper.verify.measure import compare_chains as compare_chains
    from chainshaper.verify.measure import compare_recordings as compare_recordings
    from chainshaper.verify.measure import cycle_parts as cycle_parts
    from chainshaper.verify.measure import hop_breakdown as hop_breakdown
    from chainshaper.verify.measure import measure_latency as measure_latency
    from chainshaper.workload.description import Application as Application
    from chainshaper.workload.description import load_application as load_application
    from chainshaper.workload.live import run_application as run_application
    from chainshaper.workload.ros_package import generate_package as generate_package


@cache
def _homes() -> dict[str, str | None]:
    """Public name → its module, by the imports above."""
    import ast
    from pathlib import Path

    imports = ast.walk(ast.parse(Path(__file__).read_text(encoding="utf-8")))
    found = [node for node in imports if isinstance(node, ast.ImportFrom)]
    return {one.asname: node.module for node in found for one in node.names if one.asname}


def __getattr__(name: str) -> Any:
    if name == "__all__":
        return sorted(_homes())
    from importlib import import_module

    from chainshaper.vendored_packages import use_vendored

    home = _homes().get(name)
    if home is None:
        raise AttributeError(f"module 'chainshaper' has no attribute {name!r}")
    use_vendored()
    return getattr(import_module(home), name)


def __dir__() -> list[str]:
    """List the public names, for `dir` and completion, although they are not imported yet."""
    return sorted({*globals(), *_homes()} - {"annotations", "cache"})
