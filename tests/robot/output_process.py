"""A shaping node or a standby without ROS 2: takes datagrams, writes what it publishes to stdout.

With ``counting`` instead it counts, for the gate's reasons in their order, one message more of each
that was dropped than of the one before, with its number lost before each, every second reason late;
and then one that was published.

Arguments: the folder of pages, ``shaping`` or ``standby``, the name of the page, the port to
listen at, and for how long the shaping node holds a message (ns). A message is its number, which
names it as well. ``starting`` writes with which phase and mode a node goes on, in words.
"""

import os
import socket
import sys
import threading
import time
from contextlib import suppress
from unittest.mock import MagicMock

from chainshaper.robot import handover
from chainshaper.robot.decision import DROPPED, Release
from chainshaper.robot.gate import Gate, GateModes
from chainshaper.robot.waiting import Outcome, Waiting


def publish(word: bytes, number: int) -> None:
    os.write(1, word + number.to_bytes(8, "little"))


def outcome(dropped: str | None, lost: int | None, *, late: bool, latency_ns: int) -> Outcome:
    message = Waiting(b"", latency_ns, None, 0, lost=lost)
    treated = "wait" if late else None
    release = Release(None, 0, None, 0, "cycle", treated, dropped=dropped)
    return Outcome(message, release, 0)


def main() -> None:
    folder, what, name, port, hold = sys.argv[1:]
    handover.page_folders = lambda: iter([folder])
    if what == "starting":
        modes, asked = GateModes({"city": 0, "highway": 0}, "city"), list[object]()
        shaper = MagicMock(gate=Gate(((0, 1),), 2, modes=modes))
        shaper.queue.set_phase = shaper.queue.switch = lambda what, _: asked.append(what)
        handover.Turn(name, "/t5").go_on(shaper)
        print(*asked)  # noqa: T201
        return
    if what == "counting":
        turn = handover.Turn(name, "/t5")
        for number, reason in enumerate(DROPPED):
            for _ in range(number + 1):
                turn.count(outcome(reason, number, late=number % 2 == 1, latency_ns=number))
        moves = [77]
        queue = MagicMock(move_slots=lambda by_ns, _: moves.append(by_ns))
        turn.follow(queue)
        turn.count(outcome(None, None, late=False, latency_ns=moves[-1]))
        return
    inbox = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    if what == "shaping":
        turn = handover.Turn(name, "/t5")
        inbox.bind(("127.0.0.1", int(port)))
        with suppress(PermissionError):  # else who receives may run before it has noted what it did
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1))
        publish(b"R", os.getpid())
        while True:
            number = int.from_bytes(inbox.recv(8), "little")
            if not turn.take(number):
                continue
            until = time.monotonic_ns() + int(hold)
            turn.hold(until, 0)
            time.sleep(int(hold) / 1e9)
            if not turn.was_bypassed(number):
                publish(b"S", number)
                turn.done(number)
    standby = handover.Standby(
        *(name, "/t5", lambda payload, *_: publish(b"B", int.from_bytes(payload, "little"))),
        lambda _: None,
        patience_ns=10 * int(hold),
    )
    threading.Thread(target=standby.watch, daemon=True).start()
    inbox.bind(("127.0.0.1", int(port)))
    publish(b"R", os.getpid())
    while True:
        payload = inbox.recv(8)
        standby.arrived(payload, int.from_bytes(payload, "little"))


main()
