"""What a configuration of callback_isolated_executor gives to threads, beside what they have."""

from collections.abc import Iterable

from chainshaper.enforcement.node_threads import NodeThread
from chainshaper.linux.threads import RunningThread
from chainshaper.values.callback_groups import (
    CallbackGroup,
    GroupConfiguration,
    ThreadConfiguration,
)
from chainshaper.values.recording import ThreadInfo


def difference(entry: ThreadConfiguration, thread: ThreadInfo | RunningThread) -> str | None:
    """Return how a thread differs from what a configuration gives it; None: it does not."""
    has = [f"{thread.policy} {thread.priority}" if thread.priority else thread.policy]
    same = (thread.policy, thread.priority) == (entry.policy, entry.real_time_priority)
    if entry.affinity and tuple(sorted(entry.affinity)) != tuple(thread.cores):
        same = False
        has.append(f"cores {', '.join(map(str, thread.cores))}")
    return None if same else f"has {', '.join(has)}, and the file gives {entry.text}"


def configured(
    threads: Iterable[NodeThread], configuration: GroupConfiguration
) -> dict[tuple[int, int], tuple[CallbackGroup, ThreadConfiguration]]:
    """Return what a configuration gives to threads that run, by their identities."""
    pairs = ((listed, configuration.of_thread(listed.callbacks)) for listed in threads)
    return {listed.thread.identity: pair for listed, pair in pairs if pair is not None}
