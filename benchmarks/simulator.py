"""The simulator's speed, alone and against SimPy and SimSo on the same task set.

    python benchmarks/simulator.py [--cycles 200000] [--peers PYTHON...]

The five-node chain of examples/synthetic_chain.yaml on one core, with every event written and with
latencies only: chain instances per second of the process's CPU time, and of wall-clock time.

Against the engine before, compiled by Numba, medians of runs in turns: without events 1.35 times
as many instances per second of CPU time (1,670,000 instead of 1,240,000). With events, in fresh
processes in turns beside other work (7 each, 200,000 cycles): seconds, in brackets the ratio to the
old engine:

    =====================================  ===========  ===========
    tables written by                      wall         CPU
    =====================================  ===========  ===========
    Numba's engine, Polars                 2.84         1.52
    this engine, Polars                    1.62 (1.75)  1.60 (0.95)
    this engine, packed (values/parquet)   1.11 (2.57)  0.90 (1.69)
    =====================================  ===========  ===========

Threads write while the engine goes on. The packed files are 9 % larger.

Peers run in interpreters of their own, such as those of throwaway virtual environments, since SimSo
wants an old SimPy:

    python -m venv /tmp/simpy && /tmp/simpy/bin/pip install "simpy>=4,<5"
    python -m venv /tmp/simso && /tmp/simso/bin/pip install simso
    python benchmarks/simulator.py --peers /tmp/simpy/bin/python /tmp/simso/bin/python

The same task set is: five callbacks that trigger each other, their subscriber, and a timer that
interferes, fixed priorities with pre-emption on one core. SimSo knows no such chain: there it is
seven periodic tasks of the same demand. It needs `imp`, so a Python before 3.12.
"""

import argparse
import resource
import subprocess
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from chainshaper import load_application, simulate, simulate_latencies

EXAMPLE = Path(__file__).parents[1] / "examples/synthetic_chain.yaml"
PEER_CYCLES = 2000

SIMPY = """
import random, simpy, time
def work(env, core, priority, duration):
    left = duration
    while left > 0:
        with core.request(priority=priority) as turn:
            yield turn
            began = env.now
            try:
                yield env.timeout(left)
                left = 0
            except simpy.Interrupt:
                left -= env.now - began
def stage(env, core, source, target, low, high):
    while True:
        start = yield source.get()
        yield env.process(work(env, core, 1, random.uniform(low, high)))
        if target is not None:
            target.put(start)
def source(env, target):
    while True:
        target.put(env.now)
        yield env.timeout(100)
def interference(env, core):
    yield env.timeout(5)
    while True:
        env.process(work(env, core, 2, random.uniform(10, 20)))
        yield env.timeout(100)
env = simpy.Environment()
core = simpy.PreemptiveResource(env, capacity=1)
topics = [simpy.Store(env) for _ in range(6)]
env.process(source(env, topics[0]))
for place in range(5):
    env.process(stage(env, core, topics[place], topics[place + 1], 5, 15))
env.process(stage(env, core, topics[5], None, 0.1, 0.1))
env.process(interference(env, core))
began = time.process_time()
env.run(until=100 * CYCLES)
print("SimPy", simpy.__version__, CYCLES / (time.process_time() - began), sep=";")
"""

SIMSO = """
import time
from simso.configuration import Configuration
from simso.core import Model
config = Configuration()
config.duration = 100 * CYCLES * config.cycles_per_ms
for place, wcet in enumerate([10, 10, 10, 10, 10, 0.1, 15]):
    config.add_task(name=f"T{place}", identifier=place + 1, period=100,
                    activation_date=5 if place == 6 else 0, wcet=wcet, deadline=100)
config.add_processor(name="core", identifier=1)
config.scheduler_info.clas = "simso.schedulers.FP"
for place, task in enumerate(config.task_info_list):
    task.data["priority"] = 7 - place
config.check_all()
model = Model(config)
began = time.process_time()
model.run_model()
import importlib.metadata
version = importlib.metadata.version("simso")
print("SimSo", version, CYCLES / (time.process_time() - began), sep=";")
"""


def rates(run: Callable[[int], object], cycles: int) -> tuple[float, float]:
    """Chain instances per second of CPU time, and of wall-clock time.

    A short run before the measured one imports what is needed.
    """
    run(10)
    began, began_cpu = time.monotonic(), time.process_time()
    run(cycles)
    return cycles / (time.process_time() - began_cpu), cycles / (time.monotonic() - began)


def peer(python: str) -> tuple[str, float] | None:
    """What a peer in another interpreter reaches: its name and version, and its rate."""
    for program in (SIMPY, SIMSO):
        code = f"CYCLES = {PEER_CYCLES}\n{program}"
        result = subprocess.run(
            [python, "-c", code], capture_output=True, text=True, check=False, timeout=600
        )
        if result.returncode == 0:
            name, version, reached = result.stdout.strip().split("\n")[-1].split(";")
            return f"{name} {version}", float(reached)
        print(f"({python}: {result.stderr.strip().splitlines()[-1]})")
    return None


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--cycles", type=int, default=200_000)
    parser.add_argument("--peers", nargs="*", default=[])
    options = parser.parse_args()
    application = load_application(EXAMPLE)
    with tempfile.TemporaryDirectory() as folder:

        def recorded(cycles: int) -> None:
            simulate(application, Path(folder) / str(cycles), cycles=cycles)

        with_events, with_events_wall = rates(recorded, options.cycles)
        events_memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    latencies, latencies_wall = rates(
        lambda cycles: simulate_latencies(application, cycles=cycles), options.cycles
    )
    print(f"{'chain instances':<24}{'per CPU s':>14}{'ratio':>8}{'per s':>14}")
    print(
        f"{'every event written':<24}{with_events:>14,.0f}{1:>8}{with_events_wall:>14,.0f}"
        f"   ({events_memory:.0f} MB)"
    )
    print(
        f"{'latencies only':<24}{latencies:>14,.0f}{latencies / with_events:>8.1f}"
        f"{latencies_wall:>14,.0f}"
    )
    for python in options.peers:
        if (result := peer(python)) is not None:
            name, reached = result
            print(
                f"{name:<24}{reached:>14,.0f}"
                f"   ours, with events and without: {with_events / reached:.0f},"
                f" {latencies / reached:.0f} times as fast"
            )


if __name__ == "__main__":
    main()
