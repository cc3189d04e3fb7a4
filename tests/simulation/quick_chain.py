"""A chain of two callbacks without any costs, so that its latencies can be worked out by hand."""

import json
from typing import Any

from schedules import application

from chainshaper.workload.description import Application


def quick_chain(first: Any = None, second: Any = None, **simulation: Any) -> Application:
    """``/t1../t2`` every 50 ms on core 1; execution times as in a description (default: 2 ms)."""
    one, two = (json.dumps(each or {"constant": "2ms"}) for each in (first, second))
    text = f"""
    chain: /t1../t2
    seed: 7
    nodes:
      first: {{callbacks: [{{timer: 50ms, execution: {one}, publishes: [/t1]}}]}}
      second: {{callbacks: [{{subscription: /t1, execution: {two}, publishes: [/t2]}}]}}
    """
    return application(text, **simulation)
