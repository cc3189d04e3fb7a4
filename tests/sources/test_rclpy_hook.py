"""What the library in front has callbacks of rclpy emit, in each Python here; rclpy is a stand-in.

Its classes hold callbacks as those of Humble to Rolling do. What calls `rcl_init` is a call of the
library's function for that event, with the interpreter's lock held.
"""

import subprocess
import sys
import textwrap
from pathlib import Path

import polars as pl
import pytest

from chainshaper.analysis import data_flow
from chainshaper.sources.preload import PreloadTracer
from chainshaper.values.events import EventTables

STAND_IN = {
    "__init__": "",
    "node": """
        import rclpy.guard_condition, rclpy.service, rclpy.subscription, rclpy.timer
        class Handle:
            def __init__(self, pointer): self.pointer = pointer
        class Node:
            def __init__(self, pointer): self.handle = Handle(pointer)
            def create_timer(self, period, callback, pointer):
                return rclpy.timer.Timer(callback, Handle(pointer))
            def create_guard_condition(self, callback):
                return rclpy.guard_condition.GuardCondition(callback)
    """,
    "timer": """
        class Timer:
            def __init__(self, callback, handle):
                self.callback = callback  # as on Humble, before the handle is there
                self.handle = handle
    """,
    "service": """
        class Service:
            def __init__(self, callback, handle):
                self.handle, self.callback = handle, callback
    """,
    "guard_condition": """
        class GuardCondition:
            def __init__(self, callback): self.callback = callback
    """,
    "subscription": """
        import inspect
        class BaseSubscription:
            def __init__(self, callback, handle):
                self.handle, self.callback = handle, callback
            @property
            def callback(self): return self._callback
            @callback.setter
            def callback(self, callback):
                inspect.signature(callback).bind(object())
                self._callback = callback
        class Subscription(BaseSubscription): pass
    """,
    "executors": """
        class Executor:
            def create_task(self, callback, *arguments): return callback, arguments
    """,
}

PROGRAM = """
import asyncio, ctypes, inspect, sys
import rclpy
library = ctypes.PyDLL(None)
CHANGED
library.ros_trace_rcl_init(ctypes.c_uint64(1), None, None, None, None)
from rclpy.executors import Executor
from rclpy.node import Handle, Node
from rclpy.service import Service
from rclpy.subscription import Subscription
for pointer in (0x10, 0x20):
    library.ros_trace_rcl_node_init(
        ctypes.c_uint64(pointer), ctypes.c_uint64(1), b"n%x" % pointer, b"/", None)
library.ros_trace_rcl_timer_init(ctypes.c_uint64(0x30), ctypes.c_uint64(1000), None, None, None)

class Callbacks:
    def tick(self): return "ticked"
    def take(self, message, more=None): return message, more
    def raises(self, request, response): raise ArithmeticError("as asked for")
    async def wait(self, message):
        try:
            return await pausing(message)
        except KeyError:
            return "thrown"

class Pause:
    def __await__(self):
        return (yield "paused")

async def pausing(message):
    return message + await Pause()

callbacks, executor = Callbacks(), Executor()
timer = Node(0x10).create_timer(1, callbacks.tick, 0x30)
condition = Node(0x20).create_guard_condition(lambda: executor.create_task(callbacks.tick))
taking = Subscription(callbacks.take, Handle(0x40))
waiting = Subscription(callbacks.wait, Handle(0x50))
service = Service(callbacks.raises, Handle(0x60))
assert timer.callback() == "ticked" and timer.callback is timer.callback
assert timer.callback.__wrapped__ == callbacks.tick and timer.callback.__name__ == "tick"
assert taking.callback("m", more=2) == ("m", 2)
assert str(inspect.signature(taking.callback)) == "(message, more=None)"
assert not inspect.iscoroutinefunction(taking.callback)
try:
    service.callback(1, 2)
except ArithmeticError as error:
    trace = error.__traceback__
    assert trace.tb_next.tb_frame.f_code.co_name == "raises" and not trace.tb_next.tb_next
else:
    raise AssertionError
assert inspect.iscoroutinefunction(waiting.callback)
first, second, third, fourth = (waiting.callback("m%d" % number) for number in range(4))
assert all(map(inspect.iscoroutine, (first, second, third)))
assert first.send(None) == second.send(None) == third.send(None) == "paused"
for coroutine, result in ((second, "m1x"), (first, "m0x")):
    try:
        coroutine.send("x")
    except StopIteration as stop:
        assert stop.value == result
    else:
        raise AssertionError
third.close()
fourth.send(None)
try:
    fourth.throw(KeyError())
except StopIteration as stop:
    assert stop.value == "thrown"
task, arguments = condition.callback()
assert task(*arguments) == "ticked"
timer.callback = taking.callback  # a callback that is traced already
assert timer.callback.__wrapped__ == callbacks.take and timer.callback("n") == ("n", None)
timer.callback = None
assert timer.callback is None
try:
    Subscription(lambda: None, Handle(0x70))
except TypeError:
    pass
else:
    raise AssertionError("what rclpy refuses is refused")
"""


def interpreters() -> dict[str, str]:
    """The Pythons of this machine, from 3.8 on, by version."""
    found = {"own": sys.executable}
    for version in (f"3.{minor}" for minor in range(8, 15)):
        places = [*Path.home().glob(f".pyenv/versions/{version}.*/bin/python")]
        places += [Path(f"/usr/bin/python{version}")]
        found |= dict.fromkeys([version], str(next(filter(Path.exists, places), "")))
    return {version: place for version, place in found.items() if place}


INTERPRETERS = interpreters()


@pytest.fixture(params=INTERPRETERS)
def interpreter(request: pytest.FixtureRequest) -> str:
    return INTERPRETERS[request.param]


def run(interpreter: str, folder: Path, changed: str = "", **variables: str) -> EventTables:
    """Run the program behind the library; return its events' tables."""
    package = folder / "modules/rclpy"
    package.mkdir(parents=True)
    for name, text in STAND_IN.items():
        (package / f"{name}.py").write_text(textwrap.dedent(text))
    (folder / "trace").mkdir()
    tracer = PreloadTracer(folder / "trace", ["command"], ())
    try:
        variables |= tracer.start()
        program = f"import sys; sys.path.insert(0, {str(package.parent)!r})\n"
        program += PROGRAM.replace("CHANGED", changed)
        words = ["env", *(f"{name}={value}" for name, value in variables.items())]
        done = subprocess.run(
            [*words, interpreter, "-I", "-S", "-c", program],
            capture_output=True,
            text=True,
            check=False,
        )
        assert (done.returncode, done.stderr) == (0, "")
    finally:
        tracer.remove()
    return tracer.recording()[0]


def test_callbacks_emit_what_those_of_rclcpp_emit(interpreter: str, tmp_path: Path) -> None:
    tables = run(interpreter, tmp_path)
    assert tables["rclpy_followed"]["problem"].to_list() == [""]
    symbols = tables["rclcpp_callback_register"]["symbol"].to_list()
    assert [symbol.split(".")[-1] for symbol in symbols] == [
        *("tick", "<lambda>", "take", "wait", "raises", "take")
    ]
    started, ended = tables["callback_start"], tables["callback_end"]
    assert started["callback"].to_list() == ended["callback"].to_list()
    flow = data_flow(tables)
    timers = flow.objects.callbacks.filter(kind="timer")
    assert {*timers["node"]} == {"/n10"}, "not that of the node that was created last"
    (condition,) = tables["rclpy_callback_added"]["callback"]
    (node,) = flow.objects.callbacks.filter(handle=condition)["node"]
    assert node == "/n20"
    steps = tables["coroutine_step"]
    by_call = steps.group_by("call", maintain_order=True).agg("state", "callback")
    states = by_call.filter(pl.col("callback").list.first() != 0)["state"].to_list()
    assert states == [[0, 2, 1, 3]] * 4, "the ends of those that are closed and thrown into as well"
    ((task, where),) = [row for row in by_call.select("state", "callback").rows() if row[1][0] == 0]
    assert (task, where) == ([4, 0, 3], [0, 0, 0])
    (waits,) = {*steps.filter(pl.col("callback") != 0)["callback"]}
    (number,) = flow.objects.callbacks.filter(handle=waits)["callback_id"]
    waited = flow.instances.filter(callback_id=number)
    calls = steps.filter(pl.col("callback") != 0).group_by("call", maintain_order=True)
    expected = calls.agg(start=pl.col("time").first(), end=pl.col("time").last())
    assert waited.select("start", "end").rows() == expected.select("start", "end").rows()
    assert waited["execution_ns"].null_count() == 0
    assert (waited["execution_ns"] <= waited["end"] - waited["start"]).all()


@pytest.mark.parametrize(
    ("changed", "says"),
    [
        ("import rclpy.executors; del rclpy.executors.Executor.create_task", "create_task"),
        ("import rclpy.timer; rclpy.timer.Timer.callback = 'a constant'", "Timer"),
        ("sys.modules['rclpy.node'] = None", "rclpy.node"),
    ],
)
def test_an_unexpected_rclpy_goes_on_and_is_said(tmp_path: Path, changed: str, says: str) -> None:
    program = f"{changed}\nlibrary.ros_trace_rcl_init(1, None, None, None, None); sys.exit()"
    tables = run(sys.executable, tmp_path, program)
    (problem,) = tables["rclpy_followed"]["problem"]
    assert says in problem
    (note,) = [note for note in data_flow(tables).objects.notes if "inferred, not followed" in note]
    assert says in note


def test_inference_can_be_wished_for(tmp_path: Path) -> None:
    program = "library.ros_trace_rcl_init(1, None, None, None, None)\n"
    program += "import rclpy.node; assert 'callback' not in vars(rclpy.timer.Timer); sys.exit()"
    tables = run(sys.executable, tmp_path, program, CHAINSHAPER_RCLPY="inferred")
    assert "rclpy_followed" not in tables
