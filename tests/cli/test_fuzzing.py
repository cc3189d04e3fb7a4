"""Damaged files of every kind: a verb does its work, or says in one message what is wrong.

A small campaign, seeded, by calls of the command line's entry point. ``CHAINSHAPER_FUZZ_CASES``
asks for a larger one, of so many cases of each kind; a failure names its case, which
``CHAINSHAPER_FUZZ_FIRST`` begins a campaign at.
"""

import json
import os
import random
import re
import shutil
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import polars as pl
import pytest
from command_line import called
from ctf_writing import write_lttng_trace
from small_chain import small_chain_text

from chainshaper.planning import ChainPlan, Plan, dump_plan, plan_shaping
from chainshaper.planning.chain_plan import revised
from chainshaper.values.recording import Recording

CASES = int(os.environ.get("CHAINSHAPER_FUZZ_CASES", "25"))
FIRST = int(os.environ.get("CHAINSHAPER_FUZZ_FIRST", "0"))
SECONDS = 60  # of one case, on a machine that does other things
MEMORY = 1 << 30  # that all cases of one kind may add

Arguments: TypeAlias = tuple[str | Path, ...]
SCALARS = (
    "", "~", "0", "-1", "1", "99999999999", str(2**63), str(10**40), "9" * 5000, "1e999", ".nan",
    ".inf", "-.inf", "true", "2020-01-01", "12:30:00", "0x", "0b2", "1ms", "-1ms", "0ms", "1e30ms",
    "/x", "/", "..", "/t1..", "/t1../t3", "''", "'\x85'", "[]", "{}", "[[]]", "{a: {b: c}}",
    "&a [*a]", "*a", "!!int ''", "!!bool x", "!!timestamp x", "!!float x", "!!binary x",
    "!!set {a}", "!!python/name:os.system ''", "[" * 200, "{? [a] : b}", "<<: 1", "| \n x", "@",
    "%", "\t", "\0", "\ud7ff", "'\U0010ffff'", "- 1", "#", "a: b: c", "9223372036854775807ns",
)  # fmt: skip
VALUES: tuple[Any, ...] = (
    None, True, 0, -1, 1, 2**31, 2**63 - 1, 2**63, 10**30, 1.5, float("nan"), float("inf"), "",
    "x", "1", "/t1../t3", [], [1], ["x"], [[]], {}, {"x": 1}, {"1": "x"}, "\x1b[31m", "[bold]",
)  # fmt: skip
DTYPES = (
    pl.String, pl.Float64, pl.Int8, pl.UInt8, pl.Int64, pl.UInt64, pl.Boolean, pl.Datetime("ns"),
    pl.List(pl.Int64), pl.Null, pl.Categorical, pl.Binary, pl.Decimal(20, 2), pl.Duration("ns"),
)  # fmt: skip


def _looked_at(chance: random.Random, source: Path) -> Arguments:
    """A verb that reads a recording or a trace."""
    return chance.choice([
        ("info", source), ("info", source, "--json"), ("callbacks", source), ("graph", source),
        ("latency", source, "--chain", "/t1../t3"), ("latency", source, "--json", "--instances"),
        ("chains", source), ("plan", source, "--chain", "/t1../t3"), ("compare", source, source),
        ("convert", source, "-o", source.with_name("converted")),
        ("export", source, "-o", source.with_name("out.pftrace")),
    ])  # fmt: skip


def _damaged_bytes(chance: random.Random, file: Path) -> None:
    data = bytearray(file.read_bytes())
    for _ in range(chance.choice([1, 1, 1, 2, 8])):
        kind = chance.random()
        place = chance.randrange(len(data)) if data else 0
        if kind < 0.7 and data:
            data[place] = chance.choice([0, 255, data[place] ^ (1 << chance.randrange(8))])
        elif kind < 0.85:
            del data[place:]
        else:
            data[place:place] = chance.randbytes(chance.choice([1, 8, 100]))
    file.write_bytes(data)


def _without_checksums(folder: Path) -> None:
    file = folder / "recording.json"
    values = json.loads(file.read_text())
    values["checksums"] = None
    file.write_text(json.dumps(values))


def bytes_of_tables(chance: random.Random, folder: Path, recording: Recording) -> Arguments:
    """A bit or more of a Parquet file flipped, also where there are no checksums."""
    source = Path(shutil.copytree(recording.path, folder / "source"))
    if chance.random() < 0.5:
        _without_checksums(source)
    _damaged_bytes(chance, chance.choice(sorted(source.glob("*.parquet"))))
    return _looked_at(chance, source)


def columns_of_tables(chance: random.Random, folder: Path, recording: Recording) -> Arguments:
    """Columns dropped, renamed, of another type, with nulls, with other values; tables lost."""
    source = Path(shutil.copytree(recording.path, folder / "source"))
    _without_checksums(source)
    file = chance.choice(sorted(source.glob("*.parquet")))
    frame = pl.read_parquet(file, glob=False)
    column = chance.choice(frame.columns)
    extreme = chance.choice([0, -1, 2**31 - 1, 2**63 - 1, -(2**63)])
    other, dtype = chance.choice(["x", "times", column.upper()]), chance.choice(DTYPES)
    share, order = chance.choice([0, 1, 2]), chance.sample(frame.columns, len(frame.columns))
    damage: list[Callable[[], pl.DataFrame | None]] = [
        lambda: None,
        lambda: frame.drop(column),
        lambda: frame.rename({column: other}),
        lambda: frame.with_columns(pl.col(column).cast(dtype, strict=False)),
        lambda: frame.with_columns(pl.when(pl.col("time") % 3 > 0).then(column).alias(column)),
        lambda: frame.with_columns(pl.lit(extreme).alias(column)),
        lambda: frame.sample(fraction=share, with_replacement=True, seed=1),
        lambda: frame.select(order),
    ]
    try:
        damaged = chance.choice(damage)()
    except pl.exceptions.PolarsError:
        damaged = frame.drop(column)  # a cast that does not exist
    if damaged is None:
        file.unlink()
    else:
        damaged.write_parquet(file)
    return _looked_at(chance, source)


def facts_of_recordings(chance: random.Random, folder: Path, recording: Recording) -> Arguments:
    """Values of `recording.json` of every other type, keys lost, bytes flipped."""
    source = Path(shutil.copytree(recording.path, folder / "source"))
    file = source / "recording.json"
    values = json.loads(file.read_text())
    for _ in range(chance.choice([1, 1, 3])):
        place: Any = values
        while True:
            key: Any = chance.choice(list(place) if isinstance(place, dict) else range(len(place)))
            if not isinstance(place[key], dict | list) or not place[key] or chance.random() < 0.4:
                break
            place = place[key]
        if chance.random() < 0.2:
            del place[key]
        else:
            place[key] = chance.choice(VALUES)
        if not values:
            break
    file.write_text(json.dumps(values))
    if chance.random() < 0.1:
        _damaged_bytes(chance, file)
    return _looked_at(chance, source)


def traces(chance: random.Random, folder: Path, recording: Recording) -> Arguments:
    """Streams and metadata of a CTF trace."""
    whole = recording.path.with_name("trace")
    if not whole.exists():
        write_lttng_trace(whole, recording.events)
    source = Path(shutil.copytree(whole, folder / "source"))
    files = [path for path in sorted(source.rglob("*")) if path.is_file()]
    file = chance.choice(files)
    if file.name == "metadata" and chance.random() < 0.7:
        data = file.read_bytes()
        words = [m.span() for m in re.finditer(rb"[0-9]{1,4}|[a-z_]{3,}|[;{}\[\]]", data)]
        start, end = chance.choice(words)
        other = data[slice(*chance.choice(words))]
        file.write_bytes(data[:start] + other.rjust(end - start)[: end - start] + data[end:])
    else:
        _damaged_bytes(chance, file)
    return _looked_at(chance, source)


def _damaged_text(chance: random.Random, text: str) -> str:
    for _ in range(chance.choice([1, 1, 1, 2, 4])):
        lines, kind, at = text.split("\n"), chance.random(), chance.randrange(len(text) or 1)
        place = chance.randrange(len(lines))
        if kind < 0.6 and (found := list(re.finditer(r"(?<=[:\[,\-] )[^\s,\]}]+", text))):
            start, end = chance.choice(found).span()
            text = text[:start] + chance.choice(SCALARS) + text[end:]
        elif kind < 0.9:  # a line that is lost, or twice there, or indented
            indented = " " * chance.randrange(1, 9) + lines[place].lstrip(" ")
            lines[place : place + 1] = chance.choice([[], [lines[place]] * 2, [indented]])
            text = "\n".join(lines)
        else:
            text = text[:at] + chance.choice(":[]{}&*!|>'\"%@`,#?-<\x00\x85\udcff") + text[at + 1 :]
    return text


def _write_damaged(chance: random.Random, file: Path, text: str) -> Path:
    file.write_bytes(_damaged_text(chance, text).encode("utf-8", "surrogateescape"))
    return file


def applications(chance: random.Random, folder: Path, recording: Recording) -> Arguments:
    """The description of an application."""
    file = _write_damaged(chance, folder / "application.yaml", small_chain_text())
    return ("simulate", file, "-o", folder / "out", "--cycles", "3")


def _with_a_branch(plan: ChainPlan) -> str:
    """The plan and that of a second output, [22 ms, 23 ms), in one file: they share a server."""
    about = {"spec": "/t1../t2", "output": "/t2", "publisher": "/second"}
    core, latencies = plan.servers[0].core, np.array([5_000_000, 21_000_000])
    other = plan_shaping(latencies, plan.cycle_ns, core=core, **about)  # type: ignore[arg-type]
    output = other.servers[1].model_copy(update={"name": "output_2"})
    return dump_plan(Plan.of(plan, revised(other, servers=(plan.servers[0], output))))


def plans(chance: random.Random, folder: Path, recording: Recording, plan: ChainPlan) -> Arguments:
    """A plan of a chain, or of two, in use with an application and with a recording."""
    (folder / "application.yaml").write_text(small_chain_text())
    text = chance.choice([dump_plan(Plan.of(plan)), _with_a_branch(plan)])
    file = _write_damaged(chance, folder / "plan.yaml", text)
    output = ("-o", folder / "out")
    launch = folder / "robot.launch.xml"
    launch.write_text('<launch><node pkg="p" exec="e" name="third"/></launch>')
    return chance.choice([
        ("simulate", folder / "application.yaml", file, *output, "--cycles", "3"),
        ("splice", file, launch, *output),
        ("apply", file, "--dry-run"),
    ])  # fmt: skip


def axes(chance: random.Random, folder: Path, recording: Recording) -> Arguments:
    """An axis of a sweep."""
    (folder / "application.yaml").write_text(small_chain_text())
    names = ["seed", "epsilon", "bands", "policy", "publish-slot", "interference", "nodes.first",
             "nodes.first.core", "scheduling", "topics./t3.depth", "x", ""]  # fmt: skip
    values = ",".join(chance.choice(SCALARS) for _ in range(chance.choice([1, 1, 2])))
    axis = f"{chance.choice(names)}={values}".replace("\0", "")
    output = folder / "out.parquet"
    return ("sweep", folder / "application.yaml", "--vary", axis, "-o", output, "--cycles", "3",
            "--workers", "1")  # fmt: skip


def latencies(chance: random.Random, folder: Path, recording: Recording) -> Arguments:
    """Bare latencies: durations in lines, or what `numpy.save` wrote."""
    sample = np.array([59_000_000 + 1000 * n for n in range(100)])
    file = folder / chance.choice(["latencies.npy", "latencies.txt"])
    if file.suffix == ".npy":
        np.save(file, sample)
        if chance.random() < 0.5:  # its header is at the beginning
            data = file.read_bytes()
            file.write_bytes(data[:128])
            _damaged_bytes(chance, file)
            file.write_bytes(file.read_bytes() + data[128:])
        else:
            _damaged_bytes(chance, file)
    else:
        _write_damaged(chance, file, "\n".join(f"{one}ns" for one in sample.tolist()))
    return ("plan", "--latencies", file, "--period", "100ms")


BUDGET = """format: 1
chains:
- {chain: /t1../t3, maximum: 50ms, percentiles: {'99': 40ms}, jitter: 9ms, missing: 0.01}
callbacks:
- {node: /first, starts: every 20ms, response: 5ms}
"""
CARET = """path_name_aliases:
- {path_name: all, callbacks: [/first/timer_callback_0, /second/subscription_callback_0]}
nodes:
- node_name: /first
  callbacks: [{callback_name: timer_callback_0, type: timer_callback, period_ns: 20000000}]
  publishes: [{topic_name: /t1, callback_name: timer_callback_0}]
- node_name: /second
  callbacks: [{callback_name: subscription_callback_0, topic_name: /t1}]
  publishes: [{topic_name: /t2, callback_name: UNDEFINED}]
"""


def limits_and_paths(chance: random.Random, folder: Path, recording: Recording) -> Arguments:
    """A budget, or a CARET architecture file."""
    if chance.random() < 0.5:
        file = _write_damaged(chance, folder / "budget.yaml", BUDGET)
        return ("check", recording.path, "--budget", file)
    file = _write_damaged(chance, folder / "architecture.yaml", CARET)
    return ("latency", recording.path, "--chains", file)


LOOP = """format: 1
plant: {state_space: {A: [[0, 1], [1, 0]], B: [[0], [1]], C: [[1, 0]]}}
noise: {process: 1, measurement: [0.01]}
cost: {output: 1, input: 0.01}
period: 100ms
controller: {design: lqg, delay: 20ms}
modes: {city: 30ms, highway: 60ms}
"""


def control_loops(chance: random.Random, folder: Path, recording: Recording) -> Arguments:
    """The description of a control loop."""
    text = LOOP
    if chance.random() < 0.5:
        text = text.replace(
            "A: [[0, 1], [1, 0]], B: [[0], [1]], C: [[1, 0]]",
            "numerator: [1], denominator: [1, 0, -1]",
        )
        text = text.replace("state_space", "transfer_function")
    if chance.random() < 0.3:
        text = text.replace("{design: lqg, delay: 20ms}", "{gains: [[3.5]]}")
    file = _write_damaged(chance, folder / "plant.yaml", text)
    sample = folder / "latencies.txt"
    sample.write_text("".join(f"{30 + number % 50}ms\n" for number in range(60)))
    if chance.random() < 0.5:
        return ("control", file, "--latencies", sample)
    return ("plan", "--latencies", sample, "--period", "100ms", "--plant", file, "--grid", "1ms")


KINDS: tuple[Callable[..., Arguments], ...] = (
    bytes_of_tables, columns_of_tables, facts_of_recordings, traces, applications, plans, axes,
    latencies, limits_and_paths, control_loops,
)  # fmt: skip


def _peak() -> int:
    status = Path("/proc/self/status").read_text()
    return int(re.findall(r"VmHWM:\s+(\d+)", status)[0]) << 10


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: str(kind.__name__))
def test_whatever_is_damaged_there_is_a_result_or_one_message(
    kind: Callable[..., Arguments], tmp_path: Path, simulated: Recording, plan: ChainPlan
) -> None:
    before, codes = _peak(), set()
    for number in range(FIRST, FIRST + CASES):
        folder = tmp_path / str(number)
        folder.mkdir()
        chance = random.Random(f"{kind.__name__} {number}")
        arguments = kind(chance, folder, simulated, *([plan] if kind is plans else []))
        said, started = f"case {number} of {kind.__name__}: {arguments}", time.process_time()
        try:
            finished = called(*arguments)
        except BaseException as error:
            raise AssertionError(said) from error
        assert time.process_time() - started < SECONDS, said
        assert finished.code in (0, 1, 2, 3), (said, finished)
        assert "Traceback" not in finished.err, (said, finished)
        if finished.code:
            one_message = re.search(r"error\"?: ", finished.err) or "Usage: " in finished.err
            assert one_message, (said, finished)
        codes.add(finished.code)
        shutil.rmtree(folder)
    assert _peak() - before < MEMORY
    assert codes - {0}, "some of the damage is seen"
