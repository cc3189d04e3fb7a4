"""A chain of two callbacks without any costs, so that its latencies can be worked out by hand."""

import json
from typing import Any

from chainshaper.values.yaml_file import AS_YAML
from chainshaper.workload.description import Application

__all__ = ["quick_chain"]

FREE = {"constant": "0ms"}


def quick_chain(first: Any = None, second: Any = None, **simulation: Any) -> Application:
    """``/t1../t2`` every 50 ms on core 1; execution times as in a description (default: 2 ms)."""
    executions = (first or {"constant": "2ms"}, second or {"constant": "2ms"})
    costs = dict.fromkeys(("wake_up", "take", "publish", "delivery"), FREE)
    description = {
        "name": "quick chain",
        "chain": "/t1../t2",
        "seed": 7,
        "scheduling": {
            "executors": {"core": 1, "priority": 80},
            "dds": {"core": 0, "priority": 90},
        },
        "simulation": {**costs, "interrupts": 0.0, **simulation},
        "nodes": {
            "first": {
                "callbacks": [{"timer": "50ms", "execution": executions[0], "publishes": ["/t1"]}]
            },
            "second": {
                "callbacks": [
                    {"subscription": "/t1", "execution": executions[1], "publishes": ["/t2"]}
                ]
            },
        },
    }
    return Application.model_validate_json(json.dumps(description), context=AS_YAML)
