"""A chain into a loop, described and planned in step: a sensor every 50 ms, and a loop every 10."""

from typing import Literal

import numpy as np
from small_chain import DDS_CORE, EXECUTOR_CORE

from chainshaper.planning import ChainPlan, plan_shaping
from chainshaper.planning.chain_plan import LoopAge, PlannedLoop, publish_slots, revised
from chainshaper.workload.launcher import LOOP_NAME

MS = 1_000_000
SENSOR, LOOP, LEAD = 50 * MS, 10 * MS, 2 * MS


def chain_in_step_text(priority: int = 80) -> str:
    """The description; the loop's thread has this priority, the executors have 80."""
    return f"""\
name: in step
chain: /scan../command
scheduling:
  executors: {{core: {EXECUTOR_CORE}, priority: 80}}
  dds: {{core: {DDS_CORE}, priority: 90}}
nodes:
  sensor: {{callbacks: [{{timer: 50ms, execution: {{uniform: [1ms, 3ms]}}, publishes: [/scan]}}]}}
  controller:
    callbacks:
      - loop: 10ms
        phase: 1ms
        priority: {priority}
        reads: [/scan]
        execution: {{constant: 500us}}
        publishes: [/command]
  driver: {{callbacks: [{{subscription: /command, execution: {{constant: 10us}}}}]}}
"""


def chain_in_step_plan(moves: Literal["output", "loop"], move_ns: int = 0) -> ChainPlan:
    """Its plan; ``move_ns``: by how much the loop was to be moved in a recording."""
    chain = plan_shaping(
        np.array([3 * MS, 20 * MS]),
        SENSOR,
        spec="/scan..",
        output="/scan",
        publisher="/sensor",
        nodes=("/sensor",),
    )
    start = publish_slots(chain)[0][0]
    loop = PlannedLoop(
        node="/controller",
        thread=LOOP_NAME,
        topic="/scan",
        period_ns=LOOP,
        samples=1,
        delivery_ns=(0, MS, MS),
        lead_ns=LEAD,
        in_step=moves,
        starts_ns=(start, start + 15 * MS) if moves == "output" else None,
        move_ns=move_ns if moves == "loop" else None,
        age=LoopAge(first_ns=(0, 0), every_ns=(0, 0), constant=True, uses=(5, 5)),
    )
    return revised(chain, loop=loop)
