"""Random applications of several chains: does a plan keep what it promises, and what is refused?

    python experiments/random_applications.py RESULTS.jsonl [--applications 10000] [--cycles 600]

Each application has 2 to 6 chains with harmonic periods or others, on one core or several, with
nodes that chains share, forks and joins. A branch that forks off a chain is one more: 2 to 8 in
all, 4.2 on average. It is simulated without a plan; its chains are planned
together from that recording, by a policy that is drawn as well; and it is simulated with the plan
in force, with other execution times. An output that came behind its slot, or never, is late. A plan
promises that no more than a share of a chain's outputs is late; the promise is broken where so many
late outputs have a probability below a limit, which is 1 % in all over 10,000 applications
(binomial test, 60,000 chains; some 42,000 are drawn). The share itself is an upper bound with 95 %
confidence, by the recording: where it is broken although plan and simulation agree on what runs
when, more cycles in the recording would have shown it.

Every application is known by its number, from which it is drawn. RESULTS.jsonl has a line for each,
as it was done; numbers that are in it already are left out, so that the command goes on where it
was ended. At the end, or with ``--applications 0``, a table is printed.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import re
import shutil
import tempfile
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import yaml

if __name__ == "__main__":  # before Polars is imported: its tables are small
    os.environ.setdefault("POLARS_MAX_THREADS", "1")

from chainshaper import load_application, measure_latency, simulate
from chainshaper.analysis import data_flow
from chainshaper.analysis.flow import DataFlow
from chainshaper.flow.plan import profile_chains
from chainshaper.planning import ChainPlan, PlanRequest, plan_application
from chainshaper.planning.margins import OVERRUN_PROBABILITY, allowed_late_share
from chainshaper.values.errors import InputError, OperationError
from chainshaper.values.recording import Recording
from chainshaper.verify.promises import outputs_due

MS = 1_000_000
HARMONIC_MS = ((20, 40, 80), (25, 50, 100), (50, 100, 200), (100,))
OTHERS_MS = ((20, 30, 50), (30, 40, 60), (40, 50, 100), (25, 40, 60, 100))
LIMIT = 0.01 / 60_000
"""A promise is broken where what was seen has a lower probability."""
PIPELINED = 0.08  # of all applications have a chain that is longer than its period
SEARCHED_S = 0.5  # for offsets; some that there are may not be found in it
RECORDED, SIMULATED = 400, 600


@dataclass(frozen=True)
class Drawn:
    """One random application: its description, its chains, and the wishes for its plan."""

    text: str
    chains: tuple[str, ...]
    request: PlanRequest
    kind: str


def drawn(number: int) -> Drawn:
    """The application of this number."""
    draw = random.Random(number)  # noqa: S311 - no secrets; the same number, the same application
    pipelined = draw.random() < PIPELINED
    count, cores = draw.randint(2, 6), draw.choice((1, 1, 2, 3))
    periods = draw.choice(HARMONIC_MS if draw.random() < 0.5 else OTHERS_MS)
    if pipelined:
        count, cores, periods = 2, 3, (100,)
    load = draw.uniform(0.05, 0.5)  # of each core
    graph = _Graph({}, [], [])
    for chain in range(count):
        period = draw.choice(periods)
        took_ms = load * cores * period / count
        home = draw.randrange(cores)
        if pipelined:  # the first is longer than its period, the second on a core of its own
            took_ms, home = (30.0, 3) if chain else (draw.uniform(90, 140), home)
        _add_chain(draw, graph, (chain, period, home, cores), took_ms)
    policy = draw.choice(("shaped",) * 6 + ("let-per-chain", "let-per-callback"))
    wishes: dict[str, Any] = {"policy": policy, "anchor": draw.choice(("stamp", "stamp", "cycle"))}
    wishes["spin_ns"] = draw.choice((MS, 300_000, 300_000, 0))
    if pipelined:
        wishes = {"policy": "pipelined", "spin_ns": wishes["spin_ns"]}
    elif policy == "shaped":
        wishes["bands"] = draw.choice((1, 1, 2, 3))
        wishes["publish_slot_ns"] = draw.choice((None, None, 2 * MS, 500_000))
        wishes["overrun"] = draw.choice((None, None, "wait", "discard"))
        wishes["shaping_thread"] = draw.choice(("free", "free", "free", "in-slots"))
    graph.nodes["sink"] = {"core": draw.choice((0, 0, 1)), "callbacks": graph.sink}
    described = {
        "name": f"random application {number}",
        "chain": graph.chains[0],
        "seed": number,
        "scheduling": {
            "executors": {"core": 1, "priority": 80},
            "dds": {"core": 0, "priority": 90},
        },
        "simulation": {"wake_up": {"uniform": ["20us", "150us"]}},
        "nodes": graph.nodes,
    }
    anchor = wishes.get("anchor", "stamp")
    several = "bands" if wishes.get("bands", 1) > 1 else "one slot"
    cores_text = "one core" if cores == 1 else "several cores"
    kind = f"{wishes['policy']}, {anchor} anchor, {cores_text}, {several}"
    text = yaml.safe_dump(described, sort_keys=False)
    return Drawn(text, tuple(graph.chains), PlanRequest(**wishes), kind)


class _Graph(NamedTuple):
    """What has been drawn of an application: nodes, chains, and the callbacks that get outputs."""

    nodes: dict[str, dict[str, Any]]
    chains: list[str]
    sink: list[dict[str, Any]]


def _add_chain(
    draw: random.Random, graph: _Graph, which: tuple[int, int, int, int], took_ms: float
) -> None:
    """A chain of 2 to 4 callbacks, which may pass a node of another, fork, or wait for a branch."""
    chain, period, home, cores = which
    length = draw.randint(2, 4)
    weights = [draw.uniform(0.2, 1) for _ in range(length)]
    for place, weight in enumerate(weights):
        name = f"c{chain}_{place}"
        callback = {
            "execution": execution(draw, took_ms * weight / sum(weights)),
            "publishes": [f"/{name}"],
        }
        if place:
            callback["subscription"] = f"/c{chain}_{place - 1}"
        else:
            callback |= {"timer": f"{period}ms", "phase": f"{draw.randrange(period)}ms"}
        core = home if home >= cores or draw.random() < 0.8 else draw.randrange(cores)
        others = [
            node for node in graph.nodes if node[0] == "c" and not node.startswith(f"c{chain}_")
        ]
        if others and place and draw.random() < 0.06:
            graph.nodes[draw.choice(others)]["callbacks"].append(callback)
        else:
            graph.nodes[name] = {"core": 1 + core, "callbacks": [callback]}
    ways = [f"/c{chain}_{place}" for place in range(length)]
    graph.chains.append("..".join(ways))
    graph.sink.append({"subscription": ways[-1], "execution": {"constant": "1ms"}})
    kind, core = draw.random(), 1 + draw.randrange(cores)
    branch = {"subscription": ways[0], "execution": execution(draw, 0.3 * took_ms)}
    if kind < 0.12 and len(graph.chains) < 6:
        graph.nodes[f"fork{chain}"] = {
            "core": core,
            "callbacks": [{**branch, "publishes": [f"/fork{chain}"]}],
        }
        graph.chains.append(f"{ways[0]}../fork{chain}")
        graph.sink.append({"subscription": f"/fork{chain}"})
    elif kind < 0.35 and length > 2:  # a branch that a later callback waits for
        joins = graph.nodes.get(f"c{chain}_{draw.randrange(2, length)}")
        if joins is not None and len(joins["callbacks"]) == 1:
            last = joins["callbacks"][0]
            last["synchronises"] = [last.pop("subscription"), f"/side{chain}"]
            graph.nodes[f"side{chain}"] = {
                "core": core,
                "callbacks": [{**branch, "publishes": [f"/side{chain}"]}],
            }


def execution(draw: random.Random, mean_ms: float) -> dict[str, Any]:
    """Execution times with about this mean."""
    us = max(50, round(1000 * mean_ms))
    shape = draw.choice(("constant", "uniform", "uniform", "normal"))
    if shape == "constant":
        return {"constant": f"{us}us"}
    low, high = round(us * draw.uniform(0.4, 0.95)), round(us * draw.uniform(1.05, 1.6))
    if shape == "uniform":
        return {"uniform": [f"{low}us", f"{high}us"]}
    deviation = max(1, (high - low) // 4)
    return {"normal": [f"{us}us", f"{deviation}us"], "within": [f"{low}us", f"{high}us"]}


def judged(number: int, cycles: int, folder: Path) -> dict[str, Any]:
    """What became of one application: refused, and why, or planned, with each chain's outputs."""
    one = drawn(number)
    row: dict[str, Any] = {"number": number, "kind": one.kind, "chains": len(one.chains)}
    path = folder / "application.yaml"
    path.write_text(one.text)
    application = load_application(path)
    recording = simulate(application, folder / "recorded", cycles=RECORDED)
    try:
        profiles = profile_chains(recording, one.chains)
        plan, remarks = plan_application(profiles, one.request, time_limit_s=SEARCHED_S)
        run = application.model_copy(update={"seed": number + 1_000_000_007})
        shaped = simulate(run, folder / "shaped", plan, cycles=cycles)
    except (InputError, OperationError) as error:
        return {**row, "refused": str(error)}
    row["at_once"] = bool(remarks)
    flow = data_flow(shaped.events, shaped.info.clock_offset_ns)
    row["outputs"] = [outcome(shaped, flow, plan_of) for plan_of in plan.chains]
    return row


def outcome(shaped: Recording, flow: DataFlow, plan: ChainPlan) -> dict[str, Any]:
    """A chain's outputs: how many, how many late, never published, promised, and how likely."""
    from scipy.stats import binom

    measured = measure_latency(shaped, plan.chain.spec, flow=flow)
    outputs, promised = outputs_due(measured.analysis, plan), allowed_late_share(plan.margin)
    missed = outputs.missed
    likely = float(binom.sf(missed - 1, outputs.due, promised)) if missed else 1.0
    found = {
        "chain": plan.chain.spec,
        "cycles": outputs.due,
        "late": outputs.late,
        "never": sum(outputs.absent.values()),
        "promised": promised,
        "likely": likely,
    }
    judged = measured.prediction.receivers if measured.prediction else None
    if judged is not None:
        share = max(OVERRUN_PROBABILITY, promised)
        behind = float(binom.sf(judged.behind - 1, judged.count, share)) if judged.behind else 1.0
        found |= {"received": judged.count, "behind": judged.behind, "likely_behind": behind}
        likely = min(likely, behind)
    return {**found, "broken": likely < LIMIT}


def refusal(text: str) -> str:
    """A refusal without its names and numbers, so that equal ones are counted together."""
    text = re.sub(r"/[\w/.]+", "/…", text)
    text = re.sub(r"\d+(\.\d+)?( ms|%)?", "N", text)
    return re.sub(r"(/…(, | and )?)+", "/… ", text)[:110]


def table(rows: Sequence[dict[str, Any]]) -> Iterator[str]:
    """What is printed."""
    planned = [row for row in rows if "outputs" in row]
    broken = [row for row in planned if any(output["broken"] for output in row["outputs"])]
    outputs = [output for row in planned for output in row["outputs"]]
    yield f"{len(rows)} applications: {len(planned)} planned, {len(rows) - len(planned)} refused"
    yield f"{len(outputs)} chains, {sum(output['cycles'] for output in outputs)} cycles simulated,"
    late = sum((output["late"] or 0) + output["never"] for output in outputs)
    promised = sum(output["cycles"] * output["promised"] for output in outputs)
    yield f"{late} outputs late or never published; up to {promised:.0f} were promised"
    received = [output for output in outputs if "received" in output]
    behind = sum(output["behind"] for output in received)
    yield f"{len(received)} chains with a place for receivers: {behind} outputs of"
    yield f"{sum(output['received'] for output in received)} received later than promised (1 % may)"
    yield f"{len(broken)} applications with a broken promise: {[row['number'] for row in broken]}"
    yield ""
    yield f"{'kind':<55} {'drawn':>6} {'refused':>8} {'at once':>8} {'broken':>7}"
    for kind in sorted({row["kind"] for row in rows}):
        own = [row for row in rows if row["kind"] == kind]
        counts = (
            len(own),
            sum("refused" in row for row in own),
            sum(bool(row.get("at_once")) for row in own),
            sum(row in broken for row in own),
        )
        yield f"{kind:<55} {counts[0]:>6} {counts[1]:>8} {counts[2]:>8} {counts[3]:>7}"
    yield ""
    yield "refused because"
    reasons = Counter(refusal(row["refused"]) for row in rows if "refused" in row)
    for reason, times in reasons.most_common():
        yield f"{times:>6}  {reason}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("results", type=Path)
    parser.add_argument("--applications", type=int, default=10_000)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--cycles", type=int, default=SIMULATED)
    given = parser.parse_args()
    lines = given.results.read_text(encoding="utf-8").splitlines() if given.results.exists() else []
    rows = [json.loads(line) for line in lines]
    known = {row["number"] for row in rows}
    begun = time.monotonic()
    with given.results.open("a", encoding="utf-8") as results:
        for number in range(given.first, given.first + given.applications):
            if number in known:
                continue
            folder = Path(tempfile.mkdtemp(prefix="random-application-"))
            try:
                rows.append(judged(number, given.cycles, folder))
            finally:
                shutil.rmtree(folder)
            results.write(json.dumps(rows[-1]) + "\n")
            results.flush()
            if len(rows) % 100 == 0:
                print(f"{len(rows)} after {time.monotonic() - begun:.0f} s", flush=True)
    print("\n".join(table(rows)))


if __name__ == "__main__":
    main()
