"""A chain of three short nodes and an actuator, described for the cores of this machine."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from chainshaper.linux.scheduling import available_cores
from chainshaper.planning import ChainPlan, plan_shaping
from chainshaper.workload.description import Application, ExecutionTime, load_application

DDS_CORE = available_cores()[0]
EXECUTOR_CORE = available_cores()[-1]
PERIOD_NS = 50_000_000
NODES = ("first", "second", "third", "actuator")

_TEXT = """\
name: small chain
chain: /t1../t3
seed: 7
scheduling:
  executors: {{core: {executor_core}, priority: 80}}
  dds: {{core: {dds_core}, priority: 90}}
nodes:
  first:
    callbacks:
      - {{timer: 50ms, execution: {{uniform: [1ms, 4ms]}}, publishes: [/t1]}}
  second:
    callbacks:
      - {{subscription: /t1, execution: {{uniform: [1ms, 4ms]}}, publishes: [/t2]}}
  third:
    callbacks:
      - {{subscription: /t2, execution: {{uniform: [1ms, 4ms]}}, publishes: [/t3]}}
  actuator:
    callbacks:
      - {{subscription: /t3, execution: {{constant: 100us}}}}
topics:
  /t3: {{publication: {publication}}}
"""


def small_chain_text(
    *, publication: str = "synchronous", executor_core: int = EXECUTOR_CORE
) -> str:
    """The YAML text of the application; node `third` publishes its output, /t3."""
    return _TEXT.format(publication=publication, executor_core=executor_core, dds_core=DDS_CORE)


def small_chain(folder: Path, *, publication: str = "synchronous") -> Application:
    """The application, by way of a file in ``folder``."""
    path = folder / "small_chain.yaml"
    path.write_text(small_chain_text(publication=publication))
    return load_application(path)


def with_times(application: Application, times: Mapping[str, ExecutionTime]) -> Application:
    """An application in which nodes of one callback take other times."""
    nodes = dict(application.nodes)
    for name, execution in times.items():
        changed = nodes[name].callbacks[0].model_copy(update={"execution": execution})
        nodes[name] = nodes[name].model_copy(update={"callbacks": (changed,)})
    return application.model_copy(update={"nodes": nodes})


def small_chain_plan(shortest_ns: int, longest_ns: int, **wishes: Any) -> ChainPlan:
    """A plan for the chain as if its latencies lay between two; ``wishes`` go to the planner."""
    return plan_shaping(
        np.array([shortest_ns, longest_ns]),
        PERIOD_NS,
        spec="/t1../t3",
        output="/t3",
        publisher="/third",
        nodes=("/first", "/second", "/third"),
        **wishes,
    )
