"""Have callbacks of rclpy say when they begin and end, as those of rclcpp do by themselves.

This file is run, not imported: by the interpreter of a node, from the text that the library in
front of ROS 2 carries (`in_python.h`), while `rclpy.init` calls `rcl_init`. So it is Python 3.8,
imports nothing of ours, and finds as globals what the library gives:

* ``traced(callback)``: a function that calls the callback and emits `callback_start` and
  `callback_end`; and its handle.
* ``registered(kind, entity, callback, owner, symbol)``: emits the events of a registration.
* ``step(callback, call, state)``: emits `coroutine_step`.

What rclpy runs is the attribute `callback` of a timer, subscription, service or guard condition,
whichever executor runs it: this attribute becomes one that gives a traced callback. What is set
stays what it was; whatever is not as expected leaves the callback as it is. ``problem`` says of
what nothing is traced (empty: all is); None: there is no rclpy yet.
"""

import functools
import inspect
import itertools
import sys
import types
from typing import Any, Callable, List, Optional, Tuple, Type

# What the library gives.
traced: Callable[[Any], Tuple[Any, int]]
registered: Callable[[int, int, int, int, str], None]
step: Callable[[int, int, int], None]

Change = Tuple[Type[Any], str, Callable[..., Any]]
TIMER, SUBSCRIPTION, SERVICE, OF_NODE, TIMER_OF_NODE = range(5)
BEGINS, RUNS, WAITS, DONE, CREATED = range(5)
TRACED, HANDLE, NODE = "_chainshaper_traced", "_chainshaper_handle", "_chainshaper_node"
EMITS = "chainshaper_emits_events"
ENTITIES = (
    ("rclpy.timer", "Timer", TIMER),
    ("rclpy.subscription", "Subscription", SUBSCRIPTION),
    ("rclpy.service", "Service", SERVICE),
    ("rclpy.guard_condition", "GuardCondition", None),  # whose node is known when it is created
)
calls = itertools.count(1)


@types.coroutine
def steps(coroutine: Any, handle: int, call: int) -> Any:
    """Run a coroutine as `await` does; emit when it runs, when it waits, and when it is done."""
    value = error = None
    step(handle, call, BEGINS)
    while True:
        try:
            awaited = coroutine.send(value) if error is None else coroutine.throw(error)
        except StopIteration as stop:
            step(handle, call, DONE)
            return stop.value
        except BaseException:
            step(handle, call, DONE)
            raise
        step(handle, call, WAITS)
        value = error = None
        try:
            value = yield awaited
            step(handle, call, RUNS)
        except GeneratorExit:  # it is cancelled
            step(handle, call, RUNS)
            try:
                coroutine.close()
            finally:
                step(handle, call, DONE)
            raise
        except BaseException as thrown:
            step(handle, call, RUNS)
            error = thrown


def traced_callback(callback: Any) -> Any:
    """Return a callback that emits its events and can do all that this one can."""
    if inspect.iscoroutinefunction(callback):

        async def run(*arguments: Any, **named: Any) -> Any:
            coroutine = callback(*arguments, **named)
            if not inspect.iscoroutine(coroutine):
                return await coroutine
            return await steps(coroutine, handle, next(calls))

        handle = id(run)
    else:
        function, handle = traced(callback)
        run = functools.partial(function)  # which can have attributes
    functools.update_wrapper(run, callback)  # its signature is looked at
    run.__dict__[HANDLE] = handle
    return run


def untraced(callback: Any) -> Any:
    """Return what was traced: the callback of one entity may be given to another one."""
    return callback.__wrapped__ if HANDLE in getattr(callback, "__dict__", ()) else callback


def symbol_of(callback: Any) -> str:
    """Return a callback's name."""
    while isinstance(callback, functools.partial):
        callback = callback.func
    name = getattr(callback, "__qualname__", None) or type(callback).__qualname__
    module = getattr(callback, "__module__", None)
    return (module + "." if isinstance(module, str) else "") + name


def register(kind: Optional[int], entity: Any, run: Any) -> bool:
    """Emit which entity a traced callback belongs to; return whether it could be done."""
    if kind is None:
        return True
    try:
        pointer = entity.handle.pointer
    except Exception:  # it is not there yet: the callback is registered before it runs first
        return False
    registered(kind, pointer, run.__dict__[HANDLE], id(entity), symbol_of(run.__wrapped__))
    if NODE in entity.__dict__:  # rclcpp says it after the callback as well
        registered(TIMER_OF_NODE, pointer, 0, entity.__dict__[NODE], "")
    return True


def follow_callbacks(entity_class: Any, kind: Optional[int]) -> None:
    """Have the attribute `callback` of a class give traced callbacks."""
    before = getattr(entity_class, "callback", None)  # a property, or there is none

    def raw(entity: Any) -> Any:
        if before is not None:
            return before.__get__(entity, type(entity))
        try:
            return entity.__dict__["callback"]
        except KeyError:
            raise AttributeError("callback") from None

    def read(entity: Any) -> Any:
        callback = raw(entity)
        entry = entity.__dict__.get(TRACED)
        if entry is None or entry[0] is not callback:
            return callback
        if not entry[2]:
            entry[2] = register(kind, entity, entry[1])
        return entry[1]

    def write(entity: Any, callback: Any) -> None:
        callback = untraced(callback)
        if before is not None:
            before.__set__(entity, callback)
        else:
            entity.__dict__["callback"] = callback
        try:
            entity.__dict__.pop(TRACED, None)
            if not callable(callback) or getattr(callback, EMITS, False):
                return
            run = traced_callback(callback)
            entity.__dict__[TRACED] = [raw(entity), run, register(kind, entity, run)]
        except Exception:  # it is not traced
            pass

    if before is not None and not hasattr(before, "__set__"):
        raise TypeError("`callback` of {} is no attribute".format(entity_class.__name__))
    entity_class.callback = property(read, write)


def following_owners(node_class: Any) -> List[Change]:
    """Have a node say which timers and guard conditions are its own when it creates them."""

    def linking(name: str, link: Callable[[Any, int], None]) -> Change:
        create = getattr(node_class, name)

        @functools.wraps(create)
        def created(self: Any, *arguments: Any, **named: Any) -> Any:
            entity = create(self, *arguments, **named)
            try:
                link(entity, self.handle.pointer)
            except Exception:  # its node is not known
                pass
            return entity

        return node_class, name, created

    def link_timer(timer: Any, node: int) -> None:
        entry = timer.__dict__.get(TRACED)
        timer.__dict__[NODE] = node
        if entry is not None and entry[2]:
            registered(TIMER_OF_NODE, timer.handle.pointer, 0, node, "")
        getattr(timer, "callback", None)  # which registers it, if it is not

    def link_condition(condition: Any, node: int) -> None:
        run = condition.__dict__[TRACED][1]
        registered(OF_NODE, 0, run.__dict__[HANDLE], node, symbol_of(run.__wrapped__))

    return [
        linking("create_timer", link_timer),
        linking("create_guard_condition", link_condition),
    ]


def traced_task(callback: Any, call: int) -> Any:
    """Return what runs a task, a function, a coroutine function or a coroutine, with its events."""
    if inspect.iscoroutinefunction(callback):

        async def run(*arguments: Any, **named: Any) -> Any:
            return await steps(callback(*arguments, **named), 0, call)

        return functools.update_wrapper(run, callback)
    if inspect.iscoroutine(callback):

        async def run_on() -> Any:
            return await steps(callback, 0, call)

        return run_on()
    if not callable(callback):
        return callback

    def run_once(*arguments: Any, **named: Any) -> Any:
        step(0, call, BEGINS)
        try:
            return callback(*arguments, **named)
        finally:
            step(0, call, DONE)

    return functools.update_wrapper(run_once, callback)


def following_tasks(executor_class: Any) -> Change:
    """Have tasks say when they run, and in which callback they were created."""
    create = executor_class.create_task

    @functools.wraps(create)
    def create_task(self: Any, callback: Any, *arguments: Any, **named: Any) -> Any:
        try:
            call = next(calls)
            task = traced_task(callback, call)
            step(0, call, CREATED)
        except Exception:
            task = callback
        return create(self, task, *arguments, **named)

    return executor_class, "create_task", create_task


def follow() -> str:
    """Follow all that there is of rclpy; return what is not followed."""
    __import__("rclpy.node")
    __import__("rclpy.executors")
    problems: List[str] = []
    changes: List[Change] = []
    for module, name, kind in ENTITIES:
        try:
            follow_callbacks(getattr(sys.modules[module], name), kind)
        except Exception as error:
            problems.append("{}: {!r}".format(name, error))
    classes = [sys.modules["rclpy.executors"].Executor]
    native = sys.modules.get("rclpy._rclpy_pybind11")
    if native is not None and hasattr(native, "EventsExecutor"):
        classes.append(native.EventsExecutor)
    try:
        changes += following_owners(sys.modules["rclpy.node"].Node)
        changes += map(following_tasks, classes)
        for changed in changes:
            setattr(*changed)
    except Exception as error:
        problems.append(repr(error))
    return "; ".join(problems)


rclpy = sys.modules.get("rclpy")
problem: Optional[str] = None
if rclpy is not None:
    try:
        problem = follow()
    except Exception as error:
        problem = repr(error)
