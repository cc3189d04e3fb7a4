"""A process that holds the back end, and does what it is told line by line.

Started as `scx_loader.py TABLE` with a table as JSON. Each command is a JSON list, a method's
name and its arguments; each answer is JSON, `{"ok": result}` or `{"error": class, "text": …}`.
"""

import json
import sys
from dataclasses import asdict
from typing import Any

from chainshaper.enforcement.scx.back_end import create
from chainshaper.enforcement.servers import ReservationServer, ServerTable
from chainshaper.values.errors import ChainshaperError


def table_of(text: dict[str, Any]) -> ServerTable:
    servers = tuple(
        ReservationServer(**{**s, "slots": tuple(map(tuple, s["slots"]))}) for s in text["servers"]
    )
    return ServerTable(text["cycle_ns"], servers)


def main() -> None:
    servers = None
    for line in sys.stdin:
        method, *arguments = json.loads(line)
        try:
            result: Any = None
            if method == "create":
                servers = create(table_of(arguments[0]))
            elif method == "since":
                result = servers.in_force_from()  # type: ignore[union-attr]
            elif method == "kickers":
                result = {core: k.pid for core, k in servers._kickers.items()}  # type: ignore[union-attr]
            elif method == "counters":
                result = {n: asdict(c) for n, c in servers.counters().items()}  # type: ignore[union-attr]
            else:
                result = getattr(servers, method)(*arguments)
            answer: dict[str, Any] = {"ok": result}
        except ChainshaperError as error:
            answer = {"error": type(error).__name__, "text": str(error)}
        print(json.dumps(answer), flush=True)  # noqa: T201


if __name__ == "__main__":
    main()
