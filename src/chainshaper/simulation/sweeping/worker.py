"""A process that computes points of a sweep, one after the other.

    python -m chainshaper.simulation.sweeping.worker PARENT

It reads pickled functions with their arguments from its parent, and writes what each returns or
raises. It ends with its parent, in the middle of a point if need be.
"""

import os
import pickle
import signal
import sys

from chainshaper.linux.scheduling import signalled_with_parent


def main() -> None:
    """Until the parent has no more work."""
    signalled_with_parent(int(sys.argv[1]), signal.SIGKILL)
    asked, answers = sys.stdin.buffer, os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # what a library prints is no answer
    while True:
        try:
            function, arguments = pickle.load(asked)  # noqa: S301 - our parent's
        except EOFError:
            return
        result = failure = None
        try:
            result = function(*arguments)
        except Exception as error:
            failure = error
        pickle.dump((result, failure), answers)
        answers.flush()


if __name__ == "__main__":
    main()
