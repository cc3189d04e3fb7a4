"""The throttler's rules: which messages of an input, not quite periodic, pass on (paper, 5.1).

``newest``: at fixed instants, once a period, the newest message that came since the last instant.

``first``, the paper's: messages as they come, but none that "has not come after a certain time
interval with respect to the previous one" that passed. A whole period would halve an input that is
a little faster than the period, so the interval is four fifths of it, and only the first message of
each period passes. Periods follow each other, and each begins a fifth before its message is due: a
late message does not cost the one behind it.
"""

from typing import Literal, TypeAlias, get_args

Rule: TypeAlias = Literal["newest", "first"]
RULES = get_args(Rule)
EARLY_DIVISOR = 5  # a message may come early by the period divided by this


class FirstOfPeriod:
    """The rule ``first`` for one topic. Times are ns of CLOCK_MONOTONIC, ascending.

    k + 1 messages that pass take more than k - 1 periods. Every message passes of an input whose
    messages come a period apart or more, or periodically but for delays of at most a fifth of a
    period. Of an input whose messages come 0.8 to 1 periods apart, one passes in every period.
    """

    def __init__(self, period_ns: int) -> None:
        self._period_ns, self._early_ns = period_ns, period_ns // EARLY_DIVISOR
        self._due_ns = self._passed_ns = -2 * period_ns  # the first message passes

    def passes(self, now_ns: int) -> bool:
        """Return whether a message that comes now passes."""
        if now_ns < max(self._due_ns, self._passed_ns + self._period_ns) - self._early_ns:
            return False
        none_came = now_ns >= self._due_ns + self._period_ns - self._early_ns
        self._due_ns = (now_ns if none_came else self._due_ns) + self._period_ns
        self._passed_ns = now_ns
        return True
