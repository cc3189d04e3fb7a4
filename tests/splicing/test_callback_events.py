"""The Python nodes' callbacks, and on Humble their messages, as the library behind the trace points
of ROS 2 hears of them.
"""

import shutil
import subprocess
import time
from pathlib import Path

import pytest
from known import known
from node_run import RELIABLE, parameters_of, running_node, stamped

from chainshaper.planning import ChainPlan
from chainshaper.splicing.shaping_process import write_shaping_process, write_throttler

MS = 1_000_000
IMAGES = [{"type": "sensor_msgs/msg/Image", "qos": RELIABLE}]
# As the stand-in for rclpy has them.
NODE, SUBSCRIPTION, PUBLISHER, TIMER = 0x1000, 0x2000, 0x4000, 0x7F0000003000

LIBRARIES = {
    "tracetools": r"""
#include <stdbool.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>

#ifndef BY
#define BY "HEARD"
#endif

static void tell(const char * event, const void * first, intptr_t second, const char * text)
{
  FILE * heard = fopen(getenv(BY), "a");
  fprintf(heard, "%s %zu %zu %s\n", event, (size_t)first, (size_t)second, text);
  fclose(heard);
}

#define TRACE_POINT(event) \
  void ros_trace_ ## event(const void * first, const void * second) \
  {tell(#event, first, (intptr_t)second, "-");}

TRACE_POINT(rclcpp_subscription_init)
TRACE_POINT(rclcpp_subscription_callback_added)
TRACE_POINT(rclcpp_timer_callback_added)
TRACE_POINT(rclcpp_timer_link_node)
TRACE_POINT(rcl_publish)
void ros_trace_rclcpp_callback_register(const void * callback, const char * symbol)
{tell("rclcpp_callback_register", callback, 0, symbol);}
void ros_trace_callback_start(const void * callback, bool intra)
{tell("callback_start", callback, intra, "-");}
void ros_trace_rmw_publish(const void * message) {tell("rmw_publish", message, 0, "-");}
void ros_trace_rmw_take(const void * handle, const void * message, int64_t stamp, bool taken)
{
  char text[32];
  snprintf(text, sizeof(text), "%lld", taken ? (long long)stamp : 0);
  tell("rmw_take", handle, (intptr_t)message, text);
}
#ifndef INCOMPLETE
void ros_trace_callback_end(const void * callback) {tell("callback_end", callback, 0, "-");}
#endif
""",
    "rcl": "const void * rcl_subscription_get_rmw_handle(const char * subscription)"
    " {return subscription + 8;}\n",
}


def preloaded(folder: Path, *flags: str) -> dict[str, str]:
    """An environment in which the libraries are loaded; the events are written down."""
    if shutil.which("gcc") is None:
        pytest.skip("no gcc to build the tracing library with")
    libraries = []
    for name, text in LIBRARIES.items():
        source, library = folder / f"{name}.c", folder / f"lib{name}.so"
        source.write_text(text)
        gcc = ["gcc", "-shared", "-fPIC", f"-Wl,-soname,lib{name}.so", *flags]
        subprocess.run([*gcc, "-o", library, source], check=True)
        libraries.append(str(library))
    return {"LD_PRELOAD": ":".join(libraries), "HEARD": str(folder / "heard")}


def heard(folder: Path) -> list[tuple[str, int, int, str]]:
    lines = [line.split() for line in (folder / "heard").read_text().splitlines()]
    return [(event, int(first), int(second), text) for event, first, second, text in lines]


def throttled_once(folder: Path, environment: dict[str, str]) -> None:
    process = write_throttler({"/raw": "/scan"}, 100_000_000, "python", folder)
    with running_node(process, folder, {"/raw": IMAGES}, environment=environment) as run:
        run.tell(topic="/raw", payload="aa", source=1)
        run.tell(tick=1)
        run.hear(lambda words: "published" in words)
        assert run.end() == 0


def test_the_throttlers_callbacks_are_seen_like_those_of_rclcpp(tmp_path: Path) -> None:
    throttled_once(tmp_path, preloaded(tmp_path))
    subscribed, added, named, timed, linked, named_too, *ran = heard(tmp_path)
    reader, timer = added[2], timed[2]
    assert subscribed[:2] == ("rclcpp_subscription_init", SUBSCRIPTION)
    assert added == ("rclcpp_subscription_callback_added", subscribed[2], reader, "-")
    assert named == ("rclcpp_callback_register", reader, 0, "Channel.take")
    assert timed == ("rclcpp_timer_callback_added", TIMER, timer, "-")
    assert linked == ("rclcpp_timer_link_node", TIMER, NODE, "-")
    assert named_too == ("rclcpp_callback_register", timer, 0, "Channel.publish")
    assert [(event, callback) for event, callback, *_ in ran] == [
        *(("callback_start", reader), ("callback_end", reader)),
        *(("callback_start", timer), ("callback_end", timer)),
    ]


def test_a_library_without_all_trace_points_is_left_alone(tmp_path: Path) -> None:
    throttled_once(tmp_path, preloaded(tmp_path, "-DINCOMPLETE"))
    assert not (tmp_path / "heard").exists()


def test_a_library_in_front_of_the_process_gets_the_events(tmp_path: Path) -> None:
    """It hands them on to the library behind it; the one that records by default is such."""
    behind, front = preloaded(tmp_path), tmp_path / "libfront.so"
    gcc = ["gcc", "-shared", "-fPIC", '-DBY="IN_FRONT"', "-o", str(front)]
    subprocess.run([*gcc, str(tmp_path / "tracetools.c")], check=True)
    preload = f"{front}:{behind['LD_PRELOAD']}"
    environment = {**behind, "LD_PRELOAD": preload, "IN_FRONT": str(tmp_path / "front")}
    throttled_once(tmp_path, environment)
    assert not (tmp_path / "heard").exists()
    assert "callback_start" in (tmp_path / "front").read_text()


def test_on_humble_serialized_messages_are_seen_as_on_later_distributions(
    tmp_path: Path, plan: ChainPlan
) -> None:
    """There neither rcl nor rmw has events of them, and a callback gets no source timestamp."""
    log = tmp_path / "gate.csv"
    process = write_shaping_process(plan, known(plan.shaping_node), "python", tmp_path, log=log)
    environment = {**preloaded(tmp_path), "STAND_IN_HUMBLE": "1"}
    with running_node(process, tmp_path, environment=environment) as run:
        run.send(stamped(), 77)
        run.hear_published()
        assert run.end() == 0
    assert log.read_text().splitlines()[1].split(",")[4] == ""
    taken, started, published, written, ended = heard(tmp_path)[-5:]
    message = taken[2]
    assert taken[:2] == ("rmw_take", SUBSCRIPTION + 8)
    assert int(taken[3]) > 0
    assert published == ("rcl_publish", PUBLISHER, message, "-")
    assert written == ("rmw_publish", message, 0, "-")
    assert (started[0], ended[0]) == ("callback_start", "callback_end"), "where it is executed"


def test_on_humble_what_waited_was_taken_when_it_came(tmp_path: Path, plan: ChainPlan) -> None:
    """Later messages may have been published meanwhile; the stand-in's second and third came while
    the first waited for its slot, one without a source timestamp.
    """
    process = write_shaping_process(plan, known(plan.shaping_node), "python", tmp_path)
    parameters_of(process, cycle_ns=1000 * MS, slots_ns=[400 * MS, 600 * MS])
    environment = {**preloaded(tmp_path), "STAND_IN_HUMBLE": "1"}
    with running_node(process, tmp_path, environment=environment) as run:
        for source in (77, 78, None):
            run.send(stamped(), source)
        for _ in range(3):
            run.hear_published()
        offset = time.time_ns() - time.monotonic_ns()
        left = [words["time"] + offset for words in run.said if words.get("published") == "/t3"]
        assert run.end() == 0
    first, second, third = (int(text) for event, *_, text in heard(tmp_path) if event == "rmw_take")
    assert second == 78
    assert first <= third < left[0]
