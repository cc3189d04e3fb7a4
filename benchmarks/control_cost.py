"""How long costs of control loops take: 10⁶ cycles of a plant of order 4, and a plan of 3 bands.

    python benchmarks/control_cost.py [CYCLES]

CPU time of this process, so that what runs beside it does not count.
"""

import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from chainshaper.control.costs import cost_over
from chainshaper.control.design import design_controller
from chainshaper.control.flows import Flows
from chainshaper.control.loop import Loop, Problem, plant_of_transfer_function
from chainshaper.planning import PlanRequest, Profile, plan_chain

MS = 1_000_000
PLANT = """
format: 1
plant: {transfer_function: {numerator: [1], denominator: [1, 2, 5, 3, 2]}}
noise: {process: 1, measurement: 0.01}
cost: {output: 1, input: 0.01}
controller: {design: lqg, delay: 20ms}
"""


def main(cycles: int) -> None:
    random = np.random.default_rng(1)
    plant = plant_of_transfer_function([1], [1, 2, 5, 3, 2])
    cost = np.zeros((5, 5))
    cost[:4, :4], cost[4, 4] = plant.c.T @ plant.c, 0.01
    problem = Problem(plant, plant.b @ plant.b.T, np.array([[0.01]]), cost, 0.1)
    loop = Loop(problem, design_controller(problem, 0.02))
    latencies = random.integers(30 * MS, 85 * MS, cycles)
    samples = np.arange(cycles) * 100 * MS
    flows = Flows(problem)
    began = time.process_time()
    flows.table  # noqa: B018 - it is computed once
    tabled = time.process_time()
    result = cost_over(loop, samples, latencies, flows=flows)
    took = time.process_time() - tabled
    print(
        f"{cycles:,} cycles of order 4: {took:.2f} s, and {tabled - began:.2f} s for the table;"
        f" cost {result.cost:.6g} ± {result.margin:.2g}"
    )
    sample = random.triangular(33, 68, 85, 100_000) * MS
    profile = Profile(sample.astype(np.int64), 100 * MS)
    with tempfile.TemporaryDirectory() as folder:
        plant_file = Path(folder) / "plant.yaml"
        plant_file.write_text(PLANT)
        began = time.process_time()
        plan = plan_chain(profile, PlanRequest(bands=3, plant=str(plant_file)))
        took = time.process_time() - began
        print(f"three bands over 100,000 latencies: {took:.2f} s; {plan.control}")


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 1_000_000)
