"""ros2_control's loop, as the library in front sees it: a process that notes each of its turns.

The process has a stand-in for `libcontroller_manager.so`, whose functions have the same names.
"""

import shutil
import subprocess
from dataclasses import dataclass
from pathlib import Path

import polars as pl
import pytest
from traced_program import built, traced

from chainshaper.analysis import DataFlow, analyse_latency, data_flow, graph_of
from chainshaper.analysis.latency import callback_statistics
from chainshaper.sources.preload import PreloadTracer
from chainshaper.values.event_declarations import MANAGER_FUNCTIONS
from chainshaper.values.events import EventTables

pytestmark = [
    pytest.mark.waiting,
    pytest.mark.skipif(shutil.which("g++") is None, reason="g++ is not installed"),
]

SOURCES = Path(__file__).parent / "ros2_control"
PERIOD_NS = 20_000_000
TURNS = 40
CHAIN = "/commands../controller_manager:write"
MANAGER = "_ZN18controller_manager17ControllerManager"

HOST = r"""
#include <dlfcn.h>
int main(int count, char **words) {
  void *plugin = dlopen(words[1], RTLD_NOW | RTLD_LOCAL);
  int (*run)(int, char **) = plugin ? (int (*)(int, char **))dlsym(plugin, "run_node") : 0;
  return run ? run(count - 1, words + 1) : 3;
}
"""
"""As Gazebo, it loads ros2_control as a plugin, whose libraries no other one sees."""


@dataclass(frozen=True)
class Run:
    """What the library recorded of a run, and what the process noted of each turn (ns)."""

    tables: EventTables
    flow: DataFlow
    noted: pl.DataFrame

    @property
    def turns(self) -> pl.DataFrame:
        """The instances of the manager's loop, and what is known of them as turns."""
        (loop,) = (c for c in graph_of(self.flow).callbacks if c.kind == "loop")
        of_loop = self.flow.instances.filter(callback_id=loop.id)
        return of_loop.join(self.flow.turns, on="instance", maintain_order="left").sort("start")


NOTED = ("read", "returned", "update", "written", "due_next", "used")


def compiled(folder: Path, *flags: str, plugin: bool = False) -> list[str]:
    """Build the library and the process; the command that runs it."""
    tracetools = built().tracetools
    gcc = ["g++", "-std=c++17", "-O1", *flags]
    library, program = folder / "libcontroller_manager.so", folder / "ros2_control_node"
    shared = ["-shared", "-fPIC"]
    subprocess.run([*gcc, *shared, SOURCES / "controller_manager.cpp", "-o", library], check=True)
    kind = [*shared, "-DPLUGIN"] if plugin else []
    linked = [str(library), str(tracetools), f"-Wl,-rpath,{folder}:{tracetools.parent}", "-pthread"]
    including = f"-I{SOURCES.parent / 'tracetools'}"
    source = SOURCES / "ros2_control_node.cpp"
    subprocess.run([*gcc, *kind, including, source, *linked, "-o", program], check=True)
    if not plugin:
        return [str(program)]
    host = folder / "host"
    words = ["gcc", "-x", "c", "-", "-o", str(host), "-ldl"]
    subprocess.run(words, input=HOST.encode(), check=True)
    return [str(host), str(program)]


@pytest.fixture(scope="module")
def node(tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    return compiled(tmp_path_factory.mktemp("ros2_control"))


def run(command: list[str], folder: Path, how: str = "sleeps", loops: tuple[str, ...] = ()) -> Run:
    words = [*command, str(TURNS), str(PERIOD_NS // 1000), how]

    def start() -> list[list[str]]:
        ran = subprocess.run(words, check=True, timeout=60, capture_output=True, text=True)
        return [line.split() for line in ran.stdout.splitlines()]

    recorded = traced(PreloadTracer(folder, ["command"], (), None, loops), start)
    rows = [tuple(map(int, line[:-1])) for line in recorded.printed]
    flow = data_flow(recorded.tables, recorded.info.clock_offset_ns, complete=True)
    return Run(recorded.tables, flow, pl.DataFrame(rows, list(NOTED), orient="row"))


@pytest.fixture(scope="module")
def sleeping(node: list[str], tmp_path_factory: pytest.TempPathFactory) -> Run:
    return run(node, tmp_path_factory.mktemp("trace"))


def test_the_process_imports_the_names_of_ros2_control(node: list[str]) -> None:
    names = subprocess.run(["nm", "-D", *node], capture_output=True, text=True, check=True).stdout
    for name in ("4read", "6update", "5write"):
        assert f" U {MANAGER}{name}ERKN6rclcpp4TimeERKNS1_8DurationE" in names


def test_every_turn_is_seen_with_its_three_calls(sleeping: Run) -> None:
    calls, noted = sleeping.tables["controller_manager_call"], sleeping.noted
    for place, (begins, ends) in enumerate(
        (("read", "returned"), ("update", "written"), ("update", "written"))
    ):
        of_function = calls.filter(function=place).sort("began")
        assert of_function.height == noted.height == TURNS, MANAGER_FUNCTIONS[place]
        assert (of_function["began"] >= noted[begins]).all()
        assert (of_function["time"] <= noted[ends]).all()
        computed = of_function["thread_time"] - of_function["thread_time_began"]
        computes = (computed >= 90_000).sum()  # the clock is read again in some turns only
        assert computes > TURNS // 2, "each computes for 100 µs"
    found = sleeping.tables["controller_manager_found"]
    assert found["name"].to_list() == ["/controller_manager"]


def test_the_turns_are_the_loop_of_the_node(sleeping: Run) -> None:
    turns, noted = sleeping.turns, sleeping.noted
    assert turns.height == TURNS
    for column, earliest, latest in (("start", "read", "returned"), ("end", "update", "written")):
        assert (turns[column] >= noted[earliest]).all() and (turns[column] <= noted[latest]).all()
    assert (turns["execution_ns"] >= 280_000).sum() > TURNS // 2
    # From the second turn on it slept before: until when it was due, as the process has it.
    assert turns["due"][1:].to_list() == noted["due_next"][:-1].to_list()
    (loop,) = callback_statistics(sleeping.flow).filter(kind="loop").iter_rows(named=True)
    assert (loop["node"], loop["period_ns"]) == ("/controller_manager", PERIOD_NS)


@pytest.mark.parametrize("how", ["sleeps", "blocks", "blocks writing"])
def test_each_turn_wrote_what_the_process_says_it_used(
    node: list[str], tmp_path: Path, how: str
) -> None:
    """Also what came while read() waited: update() reads it in the same turn."""
    ran = run(node, tmp_path, how)
    analysis = analyse_latency(ran.flow, CHAIN)
    assert analysis.data_age is not None
    cycles, hops = analysis.data_age.cycles, analysis.hops
    stamps = hops.filter(hop=1).select("traversal", used="source_timestamp")
    used = cycles.join(stamps, on="traversal", how="left", maintain_order="left")
    assert used["used"].fill_null(0).to_list() == ran.noted["used"].to_list()
    began = analysis.traversals.select("traversal", begun="start")
    ages = used.join(began, on="traversal", how="left", maintain_order="left")
    assert (ages["age_at_end_ns"].drop_nulls() > 0).all()
    assert (ages["end"] <= ran.noted["written"]).all()
    # A message's first use is the reaction: as many cycles as there are messages that were used.
    complete = analysis.traversals.filter("complete").height
    assert complete == ran.noted.filter(pl.col("used") > 0)["used"].n_unique()


def test_a_loop_that_its_device_paces_begins_when_read_returns(
    node: list[str], tmp_path: Path
) -> None:
    ran = run(node, tmp_path, "blocks")
    turns, noted = ran.turns, ran.noted
    assert (turns["start"] > noted["read"] + PERIOD_NS // 4).sum() > TURNS // 2
    assert (turns["start"] <= noted["returned"]).all()
    assert turns["due"].null_count() == turns["overran"].null_count() == TURNS
    (note,) = (note for note in ran.flow.notes if "waits for its device in read()" in note)
    assert "a turn begins when read() returns" in note


def test_a_loop_that_waits_in_write_is_said_to(node: list[str], tmp_path: Path) -> None:
    ran = run(node, tmp_path, "blocks writing")
    assert ran.turns["overran"].null_count() == TURNS
    assert (ran.turns["start"] <= ran.noted["returned"]).all()
    assert any("waits for its device in write()" in note for note in ran.flow.notes)


def test_turns_that_end_when_the_next_should_have_begun_are_overruns(
    node: list[str], tmp_path: Path
) -> None:
    ran = run(node, tmp_path, "busy")
    overran = ran.turns["overran"]
    late = ran.noted["written"] > ran.noted["due_next"]
    busy = [turn % 10 == 9 for turn in range(TURNS)]
    assert overran.filter(pl.Series(busy)).all(), "by two and a half periods"
    assert overran.to_list()[1:] == late.to_list()[1:], "the first turn's sleep was not seen"


def test_what_throws_passes_and_is_no_write(node: list[str], tmp_path: Path) -> None:
    ran = run(node, tmp_path, "throws")
    assert ran.turns.height == TURNS
    thrown = ran.noted["written"] == 0
    assert thrown.sum() == TURNS // 10
    assert ran.turns["end"].is_null().to_list() == thrown.to_list()
    written = ran.flow.publications.filter(pl.col("topic") == "/controller_manager:write")
    assert written.height == TURNS - thrown.sum()


@pytest.mark.parametrize("loops", [("/controller_manager",), ("/sensor", "nobody")])
def test_naming_it_besides_changes_nothing(
    node: list[str], tmp_path: Path, loops: tuple[str, ...]
) -> None:
    ran = run(node, tmp_path, loops=loops)
    assert ran.turns.height == TURNS if loops[0] != "/sensor" else True
    topics = graph_of(ran.flow).topics
    assert "/controller_manager:write" in topics
    assert "/controller_manager:end" not in topics
    assert ("/sensor:end" in topics) == (loops[0] == "/sensor")


def test_a_chain_to_the_end_of_the_loop_is_the_chain_to_write(sleeping: Run) -> None:
    to_write = analyse_latency(sleeping.flow, CHAIN)
    to_end = analyse_latency(sleeping.flow, CHAIN.replace(":write", ":end"))
    assert to_end.traversals.equals(to_write.traversals)


def test_a_plugin_whose_libraries_nobody_else_sees(tmp_path: Path) -> None:
    ran = run(compiled(tmp_path, plugin=True), tmp_path)
    assert ran.turns.height == TURNS
    assert ran.tables["controller_manager_found"]["name"].to_list() == ["/controller_manager"]


def test_a_manager_whose_name_is_not_known_is_the_first_node(tmp_path: Path) -> None:
    ran = run(compiled(tmp_path, "-DWITHOUT_NAME"), tmp_path)
    assert ran.tables["controller_manager_found"]["name"].to_list() == [""]
    assert "/sensor:write" in graph_of(ran.flow).topics
