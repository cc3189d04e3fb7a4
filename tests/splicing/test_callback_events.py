"""Callbacks of the Python nodes, as the library behind the trace points of ROS 2 hears of them."""

import shutil
import subprocess
from pathlib import Path

import pytest
from node_run import RELIABLE, running_node, stamped

from chainshaper.planning import Plan
from chainshaper.splicing.shaping_process import write_shaping_process, write_throttler

IMAGES = [{"type": "sensor_msgs/msg/Image", "qos": RELIABLE}]
NODE, SUBSCRIPTION, TIMER = 0x1000, 0x2000, 0x7F0000003000  # as the stand-in for rclpy has them

LIBRARY = r"""
#include <stdbool.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>

static void tell(const char * event, const void * first, intptr_t second, const char * text)
{
  FILE * heard = fopen(getenv("HEARD"), "a");
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
void ros_trace_rclcpp_callback_register(const void * callback, const char * symbol)
{tell("rclcpp_callback_register", callback, 0, symbol);}
void ros_trace_callback_start(const void * callback, bool intra)
{tell("callback_start", callback, intra, "-");}
#ifndef INCOMPLETE
void ros_trace_callback_end(const void * callback) {tell("callback_end", callback, 0, "-");}
#endif
"""


def preloaded(folder: Path, *flags: str) -> dict[str, str]:
    """An environment in which the library is loaded, and writes down what it is told."""
    if shutil.which("gcc") is None:
        pytest.skip("no gcc to build the tracing library with")
    source, library = folder / "tracetools.c", folder / "libtracetools.so"
    source.write_text(LIBRARY)
    gcc = ["gcc", "-shared", "-fPIC", "-Wl,-soname,libtracetools.so", *flags]
    subprocess.run([*gcc, "-o", library, source], check=True)
    return {"LD_PRELOAD": str(library), "HEARD": str(folder / "heard")}


def heard(folder: Path) -> list[tuple[str, int, int, str]]:
    lines = [line.split() for line in (folder / "heard").read_text().splitlines()]
    return [(event, int(first), int(second), text) for event, first, second, text in lines]


def test_the_throttlers_callbacks_are_seen_like_those_of_rclcpp(tmp_path: Path) -> None:
    process = write_throttler({"/raw": "/scan"}, 100_000_000, "python", tmp_path)
    with running_node(process, tmp_path, {"/raw": IMAGES}, **preloaded(tmp_path)) as run:
        run.tell(topic="/raw", payload="aa", source=1)
        run.tell(tick=1)
        run.hear(lambda words: "published" in words)
        assert run.end() == 0
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


def test_the_shaping_node_still_gets_message_and_source_timestamp(
    tmp_path: Path, plan: Plan
) -> None:
    """rclpy looks at how many arguments a callback takes."""
    assert plan.shaping_node is not None
    log = tmp_path / "gate.csv"
    process = write_shaping_process(plan, plan.shaping_node, "python", tmp_path, log=log)
    with running_node(process, tmp_path, {"/t3_tmp": IMAGES}, **preloaded(tmp_path)) as run:
        run.tell(topic="/t3_tmp", payload=stamped().hex(), source=77)
        run.hear(lambda words: words.get("published") == "/t3")
        assert run.end() == 0
    assert log.read_text().splitlines()[1].split(",")[4] == "77"
    assert [event for event, *_ in heard(tmp_path)][-2:] == ["callback_start", "callback_end"]


def test_a_library_without_all_trace_points_is_left_alone(tmp_path: Path) -> None:
    process = write_throttler({"/raw": "/scan"}, 100_000_000, "python", tmp_path)
    library = preloaded(tmp_path, "-DINCOMPLETE")
    with running_node(process, tmp_path, {"/raw": IMAGES}, **library) as run:
        run.tell(topic="/raw", payload="aa", source=1)
        run.tell(tick=1)
        run.hear(lambda words: "published" in words)
        assert run.end() == 0
    assert not (tmp_path / "heard").exists()
