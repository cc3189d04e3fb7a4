"""Mistakes that people make in an application's description, and what is said about each."""

from typing import NamedTuple

__all__ = ["MISTAKES", "RIGHT", "Mistake"]

RIGHT = """\
name: two nodes
chain: /scan../command
scheduling:
  executors: {core: 1, priority: 80}
  dds: {core: 0, priority: 90}
nodes:
  lidar:
    callbacks:
      - {timer: 50ms, execution: {uniform: [2ms, 6ms]}, publishes: [/scan]}
  planner:
    core: 0
    callbacks:
      - subscription: /scan
        execution: {normal: [8ms, 2ms], within: [4ms, 14ms]}
        publishes: [/command]
topics:
  /command: {depth: 3}
"""

LIDAR = "nodes.lidar.callbacks[0]"
PLANNER = "nodes.planner.callbacks[0]"


class Mistake(NamedTuple):
    """What is replaced by what, and what is said about it: line, key, reason, remedy."""

    right: str
    wrong: str
    line: int
    key: str
    reason: str
    remedy: str


MISTAKES = {
    "unknown topic": Mistake(
        "subscription: /scan",
        "subscription: /scam",
        13,
        PLANNER + ".subscription",
        "no node publishes /scam",
        "/command, /scan",
    ),
    "topic of nobody": Mistake(
        "  /command: {depth: 3}",
        "  /cmd: {depth: 3}",
        17,
        "topics./cmd",
        "published by no node",
        "remove it",
    ),
    "chain to nowhere": Mistake(
        "chain: /scan../command",
        "chain: /scan../brake",
        2,
        "chain",
        "no topic or node is called '/brake'",
        "/command, /lidar, /planner, /scan",
    ),
    "chain with an end missing": Mistake(
        "chain: /scan../command",
        "chain: /scan..",
        2,
        "chain",
        "no topic or node is called ''",
        "FIRST..LAST",
    ),
    "missing key": Mistake("name: two nodes\n", "", 1, "name", "is missing", "add it"),
    "missing part": Mistake(
        "  dds: {core: 0, priority: 90}\n", "", 3, "scheduling.dds", "is missing", "add it"
    ),
    "key twice": Mistake(
        "    core: 0\n",
        "    core: 0\n    core: 1\n",
        12,
        "nodes.planner.core",
        "a second time",
        "remove one",
    ),
    "node twice": Mistake(
        "  planner:\n", "  lidar:\n", 10, "nodes.lidar", "a second time", "remove one"
    ),
    "node twice with a slash": Mistake(
        "  planner:\n", "  /lidar:\n", 10, "nodes./lidar", "the same name as 'lidar'", "rename one"
    ),
    "misspelt key": Mistake(
        "    core: 0\n",
        "    cores: 0\n",
        11,
        "nodes.planner.cores",
        "unknown key",
        "did you mean 'core'?",
    ),
    "strange key": Mistake(
        "    core: 0\n", "    colour: red\n", 11, "nodes.planner.colour", "unknown key", "remove it"
    ),
    "key of Python": Mistake(
        "timer: 50ms", "timer_ns: 50ms", 9, LIDAR + ".timer_ns", "unknown key", "write 'timer'"
    ),
    "no unit": Mistake(
        "timer: 50ms",
        "timer: 50",
        9,
        LIDAR + ".timer",
        "50 is not a duration",
        "a number and a unit",
    ),
    "wrong unit": Mistake(
        "timer: 50ms", "timer: 50m", 9, LIDAR + ".timer", "'50m' is not a duration", "such as 250us"
    ),
    "negative": Mistake(
        "[2ms, 6ms]",
        "[-2ms, 6ms]",
        9,
        LIDAR + ".execution.uniform[0]",
        "-2ms is negative",
        "0ms or more",
    ),
    "zero period": Mistake(
        "timer: 50ms", "timer: 0ms", 9, LIDAR + ".timer", "is zero", "longer than 0ms"
    ),
    "endless": Mistake(
        "timer: 50ms",
        "timer: 99999999999s",
        9,
        LIDAR + ".timer",
        "longer than 292 years",
        "a shorter one",
    ),
    "wrong order": Mistake(
        "[2ms, 6ms]",
        "[6ms, 2ms]",
        9,
        LIDAR + ".execution.uniform",
        "the shorter",
        "exchange the two",
    ),
    "one limit": Mistake(
        "[2ms, 6ms]", "[2ms]", 9, LIDAR + ".execution.uniform[1]", "is missing", "add it"
    ),
    "two distributions": Mistake(
        "{uniform: [2ms, 6ms]}",
        "{uniform: [2ms, 6ms], constant: 1ms}",
        9,
        LIDAR + ".execution",
        "exactly one of",
        "constant, uniform, normal",
    ),
    "normal without limits": Mistake(
        ", within: [4ms, 14ms]", "", 14, PLANNER + ".execution", "`within", "needs it"
    ),
    "limits that leave nothing": Mistake(
        "within: [4ms, 14ms]",
        "within: [8ms, 8ms]",
        14,
        PLANNER + ".execution.within",
        "closer together",
        "write `uniform`",
    ),
    "mean outside": Mistake(
        "within: [4ms, 14ms]",
        "within: [9ms, 14ms]",
        14,
        PLANNER + ".execution.normal",
        "the mean must lie",
        "within the limits",
    ),
    "two triggers": Mistake(
        "subscription: /scan",
        "subscription: /scan\n        timer: 5ms",
        13,
        PLANNER,
        "either `timer: PERIOD`",
        "`subscription: TOPIC`",
    ),
    "no trigger": Mistake(
        "timer: 50ms, ", "", 9, LIDAR, "either `timer: PERIOD`", "`subscription: TOPIC`"
    ),
    "phase of a subscription": Mistake(
        "subscription: /scan",
        "subscription: /scan\n        phase: 1ms",
        14,
        PLANNER + ".phase",
        "a timer's delay",
        "remove it",
    ),
    "relative topic": Mistake(
        "publishes: [/command]",
        "publishes: [command]",
        15,
        PLANNER + ".publishes[0]",
        "'command' is not a full",
        "write /name",
    ),
    "bare topic": Mistake(
        "publishes: [/command]",
        "publishes: /command",
        15,
        PLANNER + ".publishes",
        "not a list",
        "[square brackets]",
    ),
    "bad node name": Mistake(
        "  planner:\n",
        "  path-planner:\n",
        10,
        "nodes.path-planner",
        "letters, digits, _ and /",
        "only",
    ),
    "no callbacks": Mistake(
        "    callbacks:\n      - {timer",
        "    callbacks: []\n    x:\n      - {timer",
        8,
        "nodes.lidar.callbacks",
        "too short",
        "one element at least",
    ),
    "priority too high": Mistake(
        "priority: 80",
        "priority: 99",
        4,
        "scheduling.executors.priority",
        "99",
        "less than or equal to 97",
    ),
    "negative core": Mistake(
        "    core: 0\n",
        "    core: -1\n",
        11,
        "nodes.planner.core",
        "-1",
        "greater than or equal to 0",
    ),
    "text for a number": Mistake(
        "core: 1,",
        "core: one,",
        4,
        "scheduling.executors.core",
        "'one' is not a whole number",
        "write one",
    ),
    "depth of nothing": Mistake(
        "depth: 3", "depth: 0", 17, "topics./command.depth", "0", "greater than or equal to 1"
    ),
    "unknown word": Mistake(
        "{depth: 3}",
        "{reliability: perfect}",
        17,
        "topics./command.reliability",
        "'perfect'",
        "'reliable' or 'best_effort'",
    ),
}
