"""Threads of a run that look again and again at what runs, beside the cores that serve it."""

import os
import threading
from collections.abc import Callable, Collection

from chainshaper.values.errors import ChainshaperError, OperationError


class Background:
    """Work that goes on in a thread of its own until it is ended.

    The thread may end before: when the work is over, or has failed.

    * ``work``: does it; it returns once ``stop`` is set.
    * ``doing``: the work in a word, for messages, such as "following".
    * ``cores``: where the thread runs; none: anywhere.
    * ``failure``: why it has failed; None: it has not. What fails because it is to end is none.
    """

    def __init__(
        self, name: str, work: Callable[[], None], doing: str, cores: Collection[int] = ()
    ) -> None:
        self.stop = threading.Event()
        self.failure: ChainshaperError | None = None
        self._work, self._doing, self._cores = work, doing, cores
        self._thread = threading.Thread(target=self.run, name=name, daemon=True)

    def start(self) -> None:
        """Begin."""
        self._thread.start()

    def end(self, *, waits: bool = True) -> None:
        """Have it end; unless it ``waits``, what is under way goes on for a moment."""
        self.stop.set()
        if waits and self._thread.ident is not None:
            self._thread.join()

    def run(self) -> None:
        """Do the work in the calling thread; note why it has failed, if it has."""
        try:
            if self._cores:
                os.sched_setaffinity(0, self._cores)  # the calling thread's alone
            self._work()
        except ChainshaperError as error:
            if not self.stop.is_set():
                self.failure = error
        except Exception as error:  # a thread that ends in silence does nothing more
            failed = f"{self._doing} has failed ({type(error).__name__}: {error})"
            self.failure = OperationError(failed)
