"""chainshaper: constant end-to-end latency for ROS 2 computation chains.

Everything the command line does is one call away:

    import chainshaper as cs

    application = cs.load_application("examples/synthetic_chain.yaml")
    before = cs.run_application(application, "before")
    plan = cs.plan_recording(before)
    after = cs.shape_application(application, plan, "after")
    cs.compare_recordings([before, after])

Names are imported when they are first used, so that importing the package costs nothing.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from chainshaper.analysis import (
        LatencyAnalysis,
        analyse_latency,
        application_graph,
        callback_statistics,
        data_flow,
        find_chain,
        load_named_paths,
    )
    from chainshaper.analysis.graph import ApplicationDescription
    from chainshaper.enforcement.undoing import end_run, find_runs
    from chainshaper.flow.apply import apply_plan
    from chainshaper.flow.doctor import examine_machine
    from chainshaper.flow.exploration import (
        convert_recording,
        describe_application,
        list_chains,
    )
    from chainshaper.flow.launch_shaping import ShapedLaunch, shape_launch
    from chainshaper.flow.launch_splicing import (
        Splicing,
        ThrottledInput,
        splice_launch_files,
        splice_throttlers,
        undo_splice,
    )
    from chainshaper.flow.plan import (
        plan_recording,
        profile_chains,
        shape_application,
    )
    from chainshaper.flow.profiling import profiling_condition
    from chainshaper.flow.record import Recorded, record_command
    from chainshaper.flow.sweep import sweep
    from chainshaper.flow.threads import find_threads, planned_changes
    from chainshaper.planning import (
        Plan,
        PlanRequest,
        Profile,
        load_plan,
        place_chains,
        plan_chain,
        plan_shaping,
        save_plan,
    )
    from chainshaper.reporting.figures import draw_distribution, draw_latency
    from chainshaper.reporting.graph_drawing import write_picture
    from chainshaper.reporting.page import write_report
    from chainshaper.reporting.perfetto import export_perfetto
    from chainshaper.simulation import simulate, simulate_latencies
    from chainshaper.sources import open_source
    from chainshaper.sources.gate_log import read_gate_log
    from chainshaper.splicing.shaping_process import write_shaping_process, write_throttler
    from chainshaper.values.errors import (
        ChainshaperError,
        InputError,
        OperationError,
        PlatformError,
    )
    from chainshaper.values.recording import Recording, event_counts, open_recording
    from chainshaper.verify.measure import (
        Comparison,
        Measurement,
        compare_recordings,
        hop_breakdown,
        measure_latency,
    )
    from chainshaper.workload.description import Application, load_application
    from chainshaper.workload.live import run_application

_HOMES = {
    "chainshaper.analysis": (
        "LatencyAnalysis",
        "analyse_latency",
        "application_graph",
        "callback_statistics",
        "data_flow",
        "find_chain",
        "load_named_paths",
    ),
    "chainshaper.flow.apply": ("apply_plan",),
    "chainshaper.flow.doctor": ("examine_machine",),
    "chainshaper.enforcement.undoing": ("end_run", "find_runs"),
    "chainshaper.values.errors": (
        "ChainshaperError",
        "InputError",
        "OperationError",
        "PlatformError",
    ),
    "chainshaper.flow.exploration": (
        "convert_recording",
        "describe_application",
        "list_chains",
    ),
    "chainshaper.flow.launch_shaping": ("ShapedLaunch", "shape_launch"),
    "chainshaper.flow.launch_splicing": (
        "Splicing",
        "ThrottledInput",
        "splice_launch_files",
        "splice_throttlers",
        "undo_splice",
    ),
    "chainshaper.planning": (
        "Plan",
        "PlanRequest",
        "Profile",
        "load_plan",
        "place_chains",
        "plan_chain",
        "plan_shaping",
        "save_plan",
    ),
    "chainshaper.flow.profiling": ("profiling_condition",),
    "chainshaper.flow.record": ("Recorded", "record_command"),
    "chainshaper.values.recording": ("Recording", "event_counts", "open_recording"),
    "chainshaper.verify.measure": (
        "hop_breakdown",
        "Comparison",
        "Measurement",
        "compare_recordings",
        "measure_latency",
    ),
    "chainshaper.analysis.graph": ("ApplicationDescription",),
    "chainshaper.reporting.graph_drawing": ("write_picture",),
    "chainshaper.reporting.figures": ("draw_distribution", "draw_latency"),
    "chainshaper.reporting.page": ("write_report",),
    "chainshaper.reporting.perfetto": ("export_perfetto",),
    "chainshaper.simulation": ("simulate", "simulate_latencies"),
    "chainshaper.sources": ("open_source",),
    "chainshaper.sources.gate_log": ("read_gate_log",),
    "chainshaper.splicing.shaping_process": ("write_shaping_process", "write_throttler"),
    "chainshaper.flow.plan": (
        "plan_recording",
        "profile_chains",
        "shape_application",
    ),
    "chainshaper.flow.sweep": ("sweep",),
    "chainshaper.flow.threads": ("find_threads", "planned_changes"),
    "chainshaper.workload.description": ("Application", "load_application"),
    "chainshaper.workload.live": ("run_application",),
}
_HOME_OF = {name: module for module, names in _HOMES.items() for name in names}

__all__ = [
    "Application",
    "ApplicationDescription",
    "ChainshaperError",
    "Comparison",
    "InputError",
    "LatencyAnalysis",
    "Measurement",
    "OperationError",
    "Plan",
    "PlanRequest",
    "PlatformError",
    "Profile",
    "Recorded",
    "Recording",
    "ShapedLaunch",
    "Splicing",
    "ThrottledInput",
    "analyse_latency",
    "application_graph",
    "apply_plan",
    "callback_statistics",
    "compare_recordings",
    "convert_recording",
    "data_flow",
    "describe_application",
    "draw_distribution",
    "draw_latency",
    "end_run",
    "event_counts",
    "examine_machine",
    "export_perfetto",
    "find_chain",
    "find_runs",
    "find_threads",
    "hop_breakdown",
    "list_chains",
    "load_application",
    "load_named_paths",
    "load_plan",
    "measure_latency",
    "open_recording",
    "open_source",
    "place_chains",
    "plan_chain",
    "plan_recording",
    "plan_shaping",
    "planned_changes",
    "profile_chains",
    "profiling_condition",
    "read_gate_log",
    "record_command",
    "run_application",
    "save_plan",
    "shape_application",
    "shape_launch",
    "simulate",
    "simulate_latencies",
    "splice_launch_files",
    "splice_throttlers",
    "sweep",
    "undo_splice",
    "write_picture",
    "write_report",
    "write_shaping_process",
    "write_throttler",
]


def __getattr__(name: str) -> Any:
    if name not in _HOME_OF:
        raise AttributeError(f"module 'chainshaper' has no attribute {name!r}")
    return getattr(importlib.import_module(_HOME_OF[name]), name)
