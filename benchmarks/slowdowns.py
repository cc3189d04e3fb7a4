"""How often `check --baseline` finds a callback that is 3 % slower, and one that is not.

    python benchmarks/slowdowns.py FOLDER [--rounds 20] [--seconds 200]

Runs a live chain over DDS again and again, as it is (A), with one callback that spends 3 % more CPU
time (B) and with one that does 3 % more work (C), in turns A B C A B C, for so many rounds or until
the seconds are over, and records it as `chainshaper run` does. Recordings stay in FOLDER; called
again, it goes on. Then it compares: of runs one after the other as many as a row says with as many,
and prints how often a callback was found slower, with Wilson's interval of 95 %.

Two nodes spend CPU time drawn from a distribution (and a constant one); three do a drawn amount of
work, whose CPU time is what the machine makes of it. Equal runs are compared in both directions,
slower ones with those as they are of the same rounds. Comparisons of a row share no runs but for
the direction.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from scipy import stats

import chainshaper as cs
from chainshaper.values.recording import INFO_FILE
from chainshaper.verify.slowdowns import Sample, find_slowdowns, sample_of

SLOWER = 1.03
CYCLES = 400
WORK = f"""
import random

_drawn = random.Random(7).uniform  # the same in each run


def _spent(times):
    total = 0
    for number in range(int(times)):
        total += number * number & 255


def work(message):
    _spent(_drawn(8_000, 20_000))
    return message


def longer(message):
    _spent({SLOWER} * _drawn(8_000, 20_000))
    return message
"""
CHAIN = """
name: slowdowns
chain: /t1../t5
scheduling:
  executors: {{core: 1, priority: 80}}
  dds: {{core: 0, priority: 90}}
nodes:
  node1: {{callbacks: [{{timer: 10ms, execution: {{uniform: [1ms, 2ms]}}, publishes: [/t1]}}]}}
  node2: {{callbacks: [{{subscription: /t1, execution: {{uniform: {spent}}}, publishes: [/t2]}}]}}
  node3: {{callbacks: [{{subscription: /t2, computes: "slowdowns_work:work", publishes: [/t3]}}]}}
  node4: {{callbacks: [{{subscription: /t3, computes: "slowdowns_work:{work}", publishes: [/t4]}}]}}
  node5: {{callbacks: [{{subscription: /t4, computes: "slowdowns_work:work", publishes: [/t5]}}]}}
  actuator: {{callbacks: [{{subscription: /t5, execution: {{constant: 100us}}}}]}}
"""
SPENT = ("[1ms, 2ms]", f"[{SLOWER * 1000:.0f}us, {SLOWER * 2000:.0f}us]")
VARIANTS = {"A": (SPENT[0], "work"), "B": (SPENT[1], "work"), "C": (SPENT[0], "longer")}
SLOWED = {"B": "/node2", "C": "/node4"}
SPENDING = {"/node1", "/node2", "/actuator"}


def run(folder: Path, rounds: int, until: float) -> None:
    """Run all variants in turns, where their recordings are not there yet."""
    os.chdir(folder)  # where nodes look for what they compute
    Path("slowdowns_work.py").write_text(WORK)
    for number in range(rounds):
        for variant, (spent, work) in VARIANTS.items():
            recording = folder / f"{variant}{number:03}"
            if (recording / INFO_FILE).exists() or time.monotonic() > until:
                continue
            description = folder / f"{variant}.yaml"
            description.write_text(CHAIN.format(spent=spent, work=work))
            cs.run_application(cs.load_application(description), recording, cycles=CYCLES)


def found(samples: Sequence[Sample], before: Sequence[Sample]) -> set[str]:
    """The nodes with a callback that is found slower."""
    return {one.node for one in find_slowdowns(samples, before)[0] if not one.met}


def share(hits: Sequence[bool]) -> str:
    """``3 of 200 (0.5 to 4.3 %)``"""
    if not hits:
        return "-"
    limits = stats.binomtest(sum(hits), len(hits)).proportion_ci(method="wilson")
    return f"{sum(hits)} of {len(hits)} ({100 * limits.low:.1f} to {100 * limits.high:.1f} %)"


def row(samples: dict[str, list[Sample]], each: int) -> tuple[str, ...]:
    """The counts for so many recordings on each side."""
    equal: list[set[str]] = []
    for own in samples.values():
        for start in range(0, len(own) - 2 * each + 1, 2 * each):
            sides = [own[start + side : start + 2 * each : 2] for side in (0, 1)]
            equal += [found(*sides), found(*sides[::-1])]
    slower, others = {}, list[bool]()
    for variant, node in SLOWED.items():
        blocks = [slice(n, n + each) for n in range(0, len(samples["A"]) - each + 1, each)]
        hits = [found(samples[variant][own], samples["A"][own]) for own in blocks]
        slower[variant] = share([node in one for one in hits])
        others += [bool(one - {node}) for one in hits]
    spending, working = [bool(one & SPENDING) for one in equal], [bool(one) for one in equal]
    return str(each), share(spending), share(working), *slower.values(), share(others)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--rounds", type=int, default=20)
    parser.add_argument("--seconds", type=float, default=3600)
    parser.add_argument("--each", type=int, nargs="+", default=[1, 3, 5, 10])
    arguments = parser.parse_args()
    arguments.folder.mkdir(parents=True, exist_ok=True)
    folder = arguments.folder.resolve()
    run(folder, arguments.rounds, time.monotonic() + arguments.seconds)
    paths = {v: sorted(p.parent for p in folder.glob(f"{v}*/{INFO_FILE}")) for v in VARIANTS}
    whole = min(map(len, paths.values()))
    with ThreadPoolExecutor() as pool:
        samples = {
            variant: list(pool.map(lambda path: sample_of(cs.open_source(path)), own[:whole]))
            for variant, own in paths.items()
        }
    print(f"{whole} rounds of {CYCLES} cycles; found slower by `check --baseline`:\n")
    heads = ("recordings a side", "equal runs: a callback that spends time", "any callback")
    print("|", " | ".join((*heads, "+3 % time spent", "+3 % work", "others then")), "|")
    print("|---|---|---|---|---|---|")
    for each in arguments.each:
        if 0 < 2 * each <= whole:
            print("|", " | ".join(row(samples, each)), "|", flush=True)


if __name__ == "__main__":
    main()
