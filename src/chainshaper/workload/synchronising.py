"""Synchronising callbacks: what several inputs bring together is computed once (message_filters).

Each input has a subscription and a callback of its own. The callback that completes a set, of the
oldest message of every input, computes and publishes; the others only leave their message.
"""

from collections import deque
from collections.abc import Sequence
from typing import Generic, TypeVar

__all__ = ["Synchroniser"]

Message = TypeVar("Message")


class Synchroniser(Generic[Message]):
    """The messages that wait for their set, at most ``depths[i]`` of input i (the newest)."""

    def __init__(self, depths: Sequence[int]) -> None:
        self._waiting: list[deque[Message]] = [deque(maxlen=depth) for depth in depths]

    def add(self, number: int, message: Message) -> tuple[Message, ...]:
        """A message of an input; the set that is complete now, or nothing."""
        self._waiting[number].append(message)
        if not all(self._waiting):
            return ()
        return tuple(waiting.popleft() for waiting in self._waiting)
