"""Which outputs are shaped on this machine at the moment, and which go around their shaping node.

Shaping nodes and their standbys share a page of memory for each output
(:mod:`chainshaper.gate.handover`). Here it is only looked at: nothing is locked or changed.
"""

import os
import time
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, TypeAlias

from pydantic import TypeAdapter, ValidationError

from chainshaper.gate.decision import DROPPED
from chainshaper.gate.handover import Page, page_folders
from chainshaper.values.durations import format_duration
from chainshaper.values.yaml_file import FullName

__all__ = ["ShapedOutput", "find_outputs", "output_text"]

OutputState: TypeAlias = Literal["shaped", "bypassed", "silent", "no standby"]
_TOPIC: TypeAdapter[str] = TypeAdapter(FullName)


@dataclass(frozen=True)
class ShapedOutput:
    """An output with a shaping node, as it is now.

    ``state`` is ``bypassed`` or ``silent`` while no shaping node is in force, and ``no standby``
    when one is, but nothing would stand in for it. ``since_ns`` (CLOCK_MONOTONIC) is since when it
    is bypassed or silent, with how many ``messages``; ``messages_in_all`` counts since the machine
    has booted. The processes are None where there is none. ``starts`` counts those of the node.

    Shaping nodes have ``published`` so many since then, and ``lost`` so many, by reason; of both,
    ``late`` came behind the last slot that they were due in.
    """

    topic: str
    state: OutputState
    shaping_node: int | None
    standby: int | None
    since_ns: int | None
    messages: int
    messages_in_all: int
    starts: int
    published: int
    lost: dict[str, int]
    late: int
    page: str


def find_outputs(folders: Iterator[str] | None = None) -> tuple[ShapedOutput, ...]:
    """The outputs that this user may see, root those of all users; one whose processes have both
    ended is none any more.
    """
    found = []
    for folder in _folders() if folders is None else folders:
        try:
            names = sorted(os.listdir(folder))  # noqa: PTH208 - of names, not of paths
        except OSError:
            continue
        for name in names:
            with suppress(OSError, ValueError, ValidationError):
                output = _looked_at(Page(folder, name))
                if output is not None:
                    found.append(output)
    return tuple(found)


def output_text(output: ShapedOutput) -> str:
    """The state of an output in a line, with what the gate has counted."""
    counted = f"{output.published} messages published, {output.late} late"
    lost = "".join(f", {count} {why}" for why, count in output.lost.items())
    state = _state_text(output)
    return f"{state}; so far {counted}{lost}" if output.published or lost else state


def _state_text(output: ShapedOutput) -> str:
    if output.state == "shaped":
        return f"{output.topic} is shaped by process {output.shaping_node}"
    if output.state == "no standby":
        return (
            f"{output.topic} is shaped by process {output.shaping_node}, but has no standby: it "
            "falls silent when that ends"
        )
    since_ns = 0 if output.since_ns is None else time.monotonic_ns() - output.since_ns
    for_long = f"for {format_duration(since_ns // 1_000_000 * 1_000_000)}"
    done = "bypassed" if output.state == "bypassed" else "silent"
    what = "go around its shaping node" if output.state == "bypassed" else "were not published"
    return f"{output.topic} is {done} {for_long}, {output.messages} messages {what}"


def _folders() -> Iterator[str]:
    yield from page_folders()
    if os.geteuid() == 0:
        others = {str(path) for path in Path("/run/user").glob("*/chainshaper/outputs")}
        others |= {str(path) for path in Path("/dev/shm").glob("chainshaper-*")}  # noqa: S108
        yield from sorted(others - {*page_folders()})


def _looked_at(page: Page) -> ShapedOutput | None:
    try:
        holder = page["holder"] if page.is_locked else 0
        standby = page["standby"] if page.has_standby else 0
        if not holder and not standby:
            return None
        since = page["bypassing_since_ns"] if standby else 0
        state: OutputState = "shaped" if standby else "no standby"
        if since or not holder:
            state = "silent" if page["silent"] else "bypassed"
        return ShapedOutput(
            topic=_TOPIC.validate_python(page.topic),  # another user's: no text of any other form
            state=state,
            shaping_node=holder or None,
            standby=standby or None,
            since_ns=since or None,
            messages=page["bypassed"] - page["bypassed_before"] if since else 0,
            messages_in_all=page["bypassed"],
            starts=page["starts"],
            published=page["published"],
            lost={
                why: count
                for why in (*DROPPED, "lost by DDS")
                if (count := page[why.replace(" ", "_").lower()])
            },
            late=page["late"],
            page=page.path,
        )
    finally:
        page.close()
