"""Names that attack whoever reads them: what every verb shows of them is harmless.

The recording has them wherever a traced machine can put them: nodes, topics, functions, hosts,
processes, threads, commands. So have a plan, a launch file, folders, options, a running process.
"""

import contextlib
import json
import os
import pty
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import polars as pl
import pytest
from command_line import Finished, called
from small_chain import small_chain

from chainshaper import load_plan, open_source, plan_recording, save_plan, simulate
from chainshaper.cli.app import VERBS
from chainshaper.planning import Plan
from chainshaper.planning.chain_plan import revised
from chainshaper.reporting.figures import draw_latency
from chainshaper.values.errors import shown
from chainshaper.values.recording import Recording, write_recording
from chainshaper.verify.measure import measure_latency

HOSTILE = (
    "\x1b]0;owned\x07\x1b[31m\x1b[2J\x9b5n\r\b\x7f\t\x00\u202e\u2067\u200b\u2028\ufffe"
    "[bold][/bold][/][link=x]:smile:$x^{<b>&\"'\\"
)
IN_A_WORD = HOSTILE.replace("\x00", "")
IN_A_PATH = IN_A_WORD.replace("/", "")
_UNSAFE = re.compile(
    "[\x00-\x09\x0b-\x1f\x7f-\x9f\u200b\u200e\u200f\u2028-\u202e\u2066-\u2069\ud800-\udfff\ufffe]"
)
_OUR_COLOURS = re.compile(r"\x1b\[[0-9;]*m")
OUTPUT = f"/t3{HOSTILE}"
CHAIN = f"/t1..{OUTPUT}"


def unsafe_in(text: str) -> list[str]:
    return [repr(found) for found in _UNSAFE.findall(text)]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with as bad a name as Polars takes."""
    place = tmp_path_factory.mktemp("h") / IN_A_PATH
    place.mkdir()
    return place


@pytest.fixture(scope="module")
def recording(folder: Path) -> Recording:
    """A simulated run whose names are replaced in every table."""
    plain = simulate(small_chain(folder), folder / "plain", cycles=12)
    names = [*(f"/t{number}" for number in (2, 3)), *["first", "second", "third", "actuator"]]
    new = {name: name + HOSTILE for name in names}
    new |= {f"/{name}": f"/{name}{HOSTILE}" for name in names}
    new |= {"/t2": f"/t2{HOSTILE}", "/t3": OUTPUT}
    tables = {
        event: frame.with_columns(pl.col(pl.String).replace(new))
        for event, frame in plain.events.items()
    }
    tables["rclcpp_callback_register"] = tables["rclcpp_callback_register"].with_columns(
        symbol=pl.col("symbol") + HOSTILE
    )
    info = plain.info
    threads = tuple(
        one.model_copy(update={"comm": HOSTILE, "node": one.node + HOSTILE}) for one in info.threads
    )
    about = {
        **dict.fromkeys(("host", "kernel", "distribution", "rmw"), HOSTILE),
        **{"chain": CHAIN, "command": (HOSTILE,), "notes": (f"a note {HOSTILE}",)},
        "processes": {pid: name + HOSTILE for pid, name in info.processes.items()},
        **{"threads": threads, "lost": {HOSTILE: 3}, "application": None},
    }
    return write_recording(folder / "rec", tables, info.model_copy(update=about))


@pytest.fixture(scope="module")
def plan(recording: Recording, folder: Path) -> Path:
    """A plan with such names where it may have them; nodes and topics must have ROS 2's."""
    planned = plan_recording(open_source(folder / "plain")).chains[0]
    servers = tuple(
        one.model_copy(update={"name": f"{one.name}{IN_A_WORD}"}) for one in planned.servers
    )
    chain = planned.chain.model_copy(update={"spec": CHAIN})
    save_plan(Plan.of(revised(planned, servers=servers, chain=chain)), folder / "plan.yaml")
    return folder / "plan.yaml"


def harmless(finished: Finished, *, code: int = 0) -> Finished:
    assert finished.code == code, finished
    assert "Traceback" not in finished.err
    assert "MarkupError" not in finished.err
    assert unsafe_in(finished.out) == []
    assert unsafe_in(finished.err) == []
    return finished


VERBS_THAT_READ = (("info",), ("graph", "--all"), ("callbacks",), ("chains",), ("latency",))


@pytest.mark.parametrize("verb", VERBS_THAT_READ, ids=lambda verb: verb[0])
def test_tables_are_harmless_and_json_is_exact(recording: Recording, verb: tuple[str, ...]) -> None:
    name, *options = verb
    out = harmless(called(name, recording.path, *options)).out
    assert r"\x1b]0;" in out
    exact = harmless(called(name, recording.path, *options, "--json")).out
    assert HOSTILE in "".join(_texts(json.loads(exact)))


def _texts(value: Any) -> Iterator[str]:
    if isinstance(value, str):
        yield value
    elif isinstance(value, dict):
        yield from (text for pair in value.items() for one in pair for text in _texts(one))
    elif isinstance(value, list):
        yield from (text for one in value for text in _texts(one))


def test_on_a_terminal_nothing_but_our_own_colours_gets_out(recording: Recording) -> None:
    """All verbs in one process, which believes what a terminal believes."""
    program = (
        "import sys\nfrom chainshaper.cli import main, output\n"
        "output.PATIENCE_S = 1e6\n"  # on a slow machine a progress bar would move the cursor
        "for words in sys.argv[1:]:\n"
        "    try: main([word for word in words.split('\\x1e')])\n"
        "    except SystemExit as end: assert not end.code, (words, end.code)\n"
    )
    path = os.fsdecode(recording.path)
    words = ["\x1e".join((verb[0], path, *verb[1:])) for verb in VERBS_THAT_READ]
    words.append("\x1e".join(("compare", path, path)))
    master, slave = pty.openpty()
    child = subprocess.Popen(
        [sys.executable, "-c", program, *words],
        stdin=slave, stdout=slave, stderr=slave, close_fds=True,
        env={**os.environ, "TERM": "xterm-256color", "COLUMNS": "150"},
    )  # fmt: skip
    os.close(slave)
    said = b"".join(_read(master))
    assert child.wait() == 0, said.decode(errors="replace")[-2000:]
    text = said.decode(errors="surrogateescape").replace("\r\n", "\n")
    assert "owned" in text
    assert unsafe_in(_OUR_COLOURS.sub("", text)) == []


def _read(master: int) -> Iterator[bytes]:
    with contextlib.suppress(OSError):  # the other end is closed
        while part := os.read(master, 1 << 16):
            yield part


def test_pictures_and_pages_are_well_formed(recording: Recording, folder: Path) -> None:
    svg, dot, page = (folder / name for name in ("graph.svg", "graph.dot", "report.html"))
    trace, figures, curve = folder / "trace.pftrace", folder / "figures", folder / "curve.svg"
    for words in (
        ("graph", recording.path, "-o", svg),
        ("graph", recording.path, "-o", dot),
        ("report", recording.path, "-o", page),
        ("export", recording.path, "--perfetto", "-o", trace),
        ("compare", recording.path, recording.path, "--figures", figures),
    ):
        harmless(called(*words))
    draw_latency([measure_latency(recording, CHAIN)], curve)
    for picture in (svg, curve):
        ElementTree.fromstring(picture.read_bytes())  # noqa: S314 - ours
    assert "<b>" not in svg.read_text()
    for file in (svg, curve, dot, page):
        assert unsafe_in(file.read_text()) == []
    # Every text of the page that a script shows, as that script reads it.
    data = re.search(r'<script[^>]*id="data"[^>]*>(.*?)</script>', page.read_text(), re.DOTALL)
    assert data is not None
    assert unsafe_in(json.dumps(json.loads(data[1]), ensure_ascii=False)) == []
    assert b"\x1b]0;" not in trace.read_bytes()
    assert len(list(figures.iterdir())) == 3


def test_a_plan_and_a_launch_file_are_named_harmlessly(plan: Path, folder: Path) -> None:
    launch = folder / f"robot{IN_A_PATH}.launch.xml"
    launch.write_text('<launch><node pkg="p" exec="e" name="a&#x202e;b"/></launch>')
    harmless(called("splice", plan, launch, "-o", folder / "spliced"))
    launch.write_text("<robot/>")
    harmless(called("splice", plan, launch, "-o", folder / "spliced"), code=2)
    broken = folder / "broken.yaml"
    broken.write_text(plan.read_text().replace("cycle: ", "cycle: x"))
    harmless(called("simulate", broken, "-o", folder / "none"), code=2)
    finished = called("apply", plan, "--dry-run")
    harmless(finished, code=finished.code)
    harmless(called("threads", plan), code=called("threads", plan).code)
    assert load_plan(plan).chains[0].chain.spec == CHAIN


@pytest.mark.parametrize(
    "words",
    [
        ("latency", "REC", "--chain", HOSTILE),
        ("latency", "REC", "--chain", f"/t1../{HOSTILE}"),
        ("latency", f"/{IN_A_PATH}\udcff"),
        ("plan", "REC"),  # whose names no plan takes
        ("plan", "REC", "--epsilon", HOSTILE),
        ("plan", "REC", f"--{HOSTILE}"),
        ("run", f"{IN_A_PATH}.yaml", "-o", "x"),
        (HOSTILE,),
        ("record", "-o", "/x", "--", IN_A_WORD),
    ],
)
def test_errors_are_harmless(recording: Recording, words: tuple[str, ...]) -> None:
    finished = called(*(recording.path if word == "REC" else word for word in words))
    harmless(finished, code=2)
    assert "owned" in finished.err


def test_threads_of_running_processes_are_named_harmlessly() -> None:
    """Every process may name itself, its threads, and in its arguments a node."""
    program = (
        "import ctypes, sys\n"
        f"ctypes.CDLL(None).prctl(15, {IN_A_WORD.encode()[:15]!r}, 0, 0, 0)\n"
        "print('ready', flush=True); sys.stdin.read()"
    )
    arguments = ("--ros-args", "-r", f"__node:=a{IN_A_WORD}")
    with subprocess.Popen(
        [sys.executable, "-c", program, *arguments], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as child:
        assert child.stdout is not None
        child.stdout.readline()
        out = harmless(called("threads", str(child.pid))).out
        assert r"\x1b]0;" in out
        assert json.loads(called("threads", str(child.pid), "--json").out)["threads"]
        child.communicate()


def test_nothing_is_shown_but_through_the_one_place() -> None:
    """Rich's markup is not used, and nothing else writes to the terminal."""
    sources = Path(open_source.__code__.co_filename).parents[1]
    texts = {path.relative_to(sources): path.read_text() for path in sources.rglob("*.py")}
    assert not [path for path, text in texts.items() if "rich.markup" in text]
    of_rich = [path for path, text in texts.items() if "from rich.table" in text]
    assert not [path for path in of_rich if re.search(r"(?<!\w)Table\(", texts[path])]
    assert not [p for p, t in texts.items() if p.parts[0] == "cli" and p.name != "output.py"
                and re.search(r"std(err|out)\.write|\bprint\(", t)]  # fmt: skip


@pytest.mark.parametrize("text", ["/t5", "µs – ε → [ms]", "名前", "نام‌ها", "a\xa0b"])
def test_what_is_only_seen_stays_as_it_is(text: str) -> None:
    assert shown(text) == text
    assert len(VERBS) > 10
