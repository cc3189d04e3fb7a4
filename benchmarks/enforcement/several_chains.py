"""Is a chain as constant together with others as alone? Live, with servers of the freezer in force.

    python benchmarks/enforcement/several_chains.py [--cycles 300] [--epsilon 1ms] [--keep DIR]

As root. Three applications over DDS: two chains of 100 and 40 ms that share a core, three on two
cores, and a graph with three sinks. Each chain is measured, planned and shaped in an application of
its own (alone), then all of an application by one plan (together). Prints how far apart the outputs
left, over all of them, and how many were late; recordings stay in DIR. Nothing is asserted.
"""

import argparse
import json
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

import chainshaper as cs
from chainshaper.splicing.application import splice_application
from chainshaper.workload.description import application_as_written

CHAINSHAPER = (sys.executable, "-m", "chainshaper")
SHORT, LONG = {"uniform": ["500us", "1ms"]}, {"uniform": ["1ms", "3ms"]}


def _node(source: str, topic: str, execution: Any = SHORT, core: int = 1) -> dict[str, Any]:
    kind, name = source.split()
    callback = {kind: name, "execution": execution, "publishes": [topic]}
    return {"core": core, "callbacks": [callback]}


def _chain(name: str, period: str, core: int = 1) -> dict[str, Any]:
    """Three nodes: a timer and two subscribers."""
    return {
        f"{name}1": _node(f"timer {period}", f"/{name}1", core=core),
        f"{name}2": _node(f"subscription /{name}1", f"/{name}2", LONG, core),
        f"{name}3": _node(f"subscription /{name}2", f"/{name}3", core=core),
    }


_SOURCE = {"s": _node("timer 100ms", "/s")}
_SINKS = {f"s{n}": _node("subscription /s", f"/s{n}", LONG) for n in (1, 2, 3)}
APPLICATIONS: dict[str, dict[str, dict[str, Any]]] = {  # of each chain its nodes
    "100 and 40 ms, one core": {
        "/a1../a3": _chain("a", "100ms"),
        "/b1../b3": _chain("b", "40ms"),
    },
    "100, 40 and 80 ms, two cores": {
        "/a1../a3": _chain("a", "100ms"),
        "/b1../b3": _chain("b", "40ms"),
        "/c1../c3": _chain("c", "80ms", core=0),
    },
    "a graph with three sinks": {
        f"/s../{sink}": {**_SOURCE, sink: node} for sink, node in _SINKS.items()
    },
}


def run(*arguments: str | Path) -> None:
    subprocess.run([*CHAINSHAPER, *map(str, arguments)], stdout=subprocess.DEVNULL, check=True)


def shaped(
    folder: Path, chains: dict[str, dict[str, Any]], cycles: int, epsilon: str
) -> dict[str, tuple[int, int, float]]:
    """Of each output how many left, how many of them late, and p99.5 - p0.5 of where (ms)."""
    folder.mkdir(parents=True)
    outputs = [chain.rpartition("..")[2] for chain in chains]
    nodes = {name: node for own in chains.values() for name, node in own.items()}
    sink = {"core": 0, "priority": 70, "callbacks": [{"subscription": one} for one in outputs]}
    described = {
        "name": "several chains",
        "chain": next(iter(chains)),
        "scheduling": {
            "executors": {"core": 1, "priority": 80},
            "dds": {"core": 0, "priority": 90},
        },
        "nodes": {**nodes, "sink": sink},
    }
    application, plan = folder / "app.yaml", folder / "plan.yaml"
    application.write_text(json.dumps(described))  # which is YAML, without aliases
    run("run", application, "-o", folder / "before", "--cycles", str(cycles))
    wanted = [word for chain in chains for word in ("--chain", chain)]
    run("plan", folder / "before", *wanted, "--epsilon", epsilon, "-o", plan)
    spliced = splice_application(cs.load_application(application), cs.load_plan(plan))
    (folder / "spliced.yaml").write_text(json.dumps(application_as_written(spliced)))
    command = (*CHAINSHAPER, "run", folder / "spliced.yaml", "-o", folder / "after")
    run("apply", plan, "--", *command, "--cycles", str(cycles))
    recording = cs.open_recording(folder / "after")
    releases = recording.events["gate_release"]
    found = {}
    for pid, node in recording.info.processes.items():
        own = releases.filter(pid=pid)
        if own.height:
            place = (own["time"] - own["origin"]).to_numpy() / 1e6
            low, high = np.percentile(place, [0.5, 99.5])
            late = own.height - own["overrun"].null_count()
            found[node.removeprefix("/chainshaper_")] = own.height, late, float(high - low)
    return found


def _shown(figures: Sequence[tuple[int, int, float]]) -> tuple[str, str]:
    spreads = ", ".join(f"{spread:.3f}" for _, _, spread in figures)
    return spreads, f"{sum(late for _, late, _ in figures)} of {sum(n for n, _, _ in figures)}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cycles", type=int, default=300)
    parser.add_argument("--epsilon", default="1ms", help="what is added to the longest latency")
    parser.add_argument("--keep", type=Path, help="a new folder for recordings and plans")
    given = parser.parse_args()
    folder = given.keep or Path(tempfile.mkdtemp())
    table = Table(title="p0.5–p99.5 at publication in ms, over all outputs")
    for name in ("chains", "alone", "late", "together", "late"):
        table.add_column(name)
    for number, (name, chains) in enumerate(APPLICATIONS.items()):
        place, asked = folder / str(number), (given.cycles, given.epsilon)
        alone = [
            figures
            for chain, nodes in chains.items()
            for figures in shaped(
                place / chain.replace("/", "_").strip("_"), {chain: nodes}, *asked
            ).values()
        ]
        together = list(shaped(place / "together", chains, *asked).values())
        table.add_row(name, *_shown(alone), *_shown(together))
    Console(width=140).print(table)
    print(f"see {folder}")


if __name__ == "__main__":
    main()
