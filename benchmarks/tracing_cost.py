"""What an event costs the thread that emits it, and what reading costs, by tracer.

    python benchmarks/tracing_cost.py [--events 200000] [--seconds 10] [--waits]

A program calls three trace points of libtracetools, in blocks of a hundred: the sourced ROS 2's, or
one that does nothing. Each tracer records such a run; runs take turns, five of each.
`preload_switched` is the library where a thread has lost its core before each event: it reads the
CPU clock then. The table has the CPU time of a call in ns, median and 90th percentile over blocks,
and what no tracer takes. The second table is the CPU time of a process that records 20,000 events a
second with the library.

The third one, alone with `--waits`, is what the library adds to a wait of an executor (`rmw_wait`)
and to a sleep (`clock_nanosleep` until an instant that is over), of an rmw whose wait returns at
once: of a thread that never published outside callbacks, and of one that did, whose waits are two
events each (`followed`), also where it has left its core meanwhile (`followed, switched`), as one
that really waits does.
"""

import argparse
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from chainshaper.sources import Tracer
from chainshaper.sources.ebpf import EbpfTracer
from chainshaper.sources.lttng import LttngSession
from chainshaper.sources.preload import PreloadTracer
from chainshaper.sources.tracing_library import installed_libraries
from chainshaper.values.errors import ChainshaperError

sys.path.append(str(Path(__file__).resolve().parents[1] / "tests/helpers"))
from traced_program import built

RUNS = 5
CALLS = ("rcl_publish", "rmw_take", "callback_start")
RATE = 20_000
SWITCHED = "preload_switched"

PROGRAM = r"""
#include <stdbool.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <time.h>
void ros_trace_rcl_publish(const void *, const void *);
void ros_trace_rmw_take(const void *, const void *, int64_t, bool);
void ros_trace_callback_start(const void *, bool);
static int64_t clock_ns(clockid_t clock) {
  struct timespec t;
  clock_gettime(clock, &t);
  return t.tv_sec * 1000000000ll + t.tv_nsec;
}
static void call(int which) {
  for (int i = 0; i < 100; i++) {
    if (which == 0) ros_trace_rcl_publish(&i, &i);
    if (which == 1) ros_trace_rmw_take(&i, &i, i, true);
    if (which == 2) ros_trace_callback_start(&i, false);
  }
}
int main(int count, char **arguments) {
  int events = atoi(arguments[1]), a_second = atoi(arguments[2]);
  for (int which = 0; which < 3; which++)
    for (int block = 0; block < events / 100; block++) {
      int64_t before = clock_ns(CLOCK_THREAD_CPUTIME_ID);
      call(which);
      printf("%d %.2f\n", which, (clock_ns(CLOCK_THREAD_CPUTIME_ID) - before) / 100.0);
      if (a_second) {
        struct timespec pause = {0, 100000000000ll / a_second};
        nanosleep(&pause, NULL);
      }
    }
}
"""


WAITS = ("rmw_wait", "clock_nanosleep")
WAITING_PROGRAM = r"""
#define _GNU_SOURCE
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <time.h>
int rmw_wait(void *, void *, void *, void *, void *, void *, const uint64_t *);
void ros_trace_rcl_publish(const void *, const void *);
static int64_t used(void) {
  struct timespec t;
  clock_gettime(CLOCK_THREAD_CPUTIME_ID, &t);
  return t.tv_sec * 1000000000ll + t.tv_nsec;
}
int main(int count, char **arguments) {
  int waits = atoi(arguments[1]), follows = atoi(arguments[2]);
  uint64_t second[2] = {1, 0};
  struct timespec over = {1, 0};
  if (follows) ros_trace_rcl_publish(&waits, &waits);
  for (int which = 0; which < 2; which++)
    for (int block = 0; block < waits / 100; block++) {
      int64_t before = used();
      for (int i = 0; i < 100; i++) {
        if (which == 0) rmw_wait(0, 0, 0, 0, 0, 0, second);
        if (which == 1) clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &over, 0);
      }
      printf("%d %.2f\n", which, (used() - before) / 100.0);
    }
}
"""
MIDDLEWARE = """
int rmw_wait(void *a, void *b, void *c, void *d, void *e, void *f, const void *time) { return 0; }
"""


def waiting(folder: Path) -> Path:
    """A program that waits, linked to a middleware whose wait returns at once."""
    middleware, program = folder / "librmw.so", folder / "waiting"
    source = folder / "waiting.c"
    source.write_text(WAITING_PROGRAM)
    (folder / "rmw.c").write_text(MIDDLEWARE)
    library = ["gcc", "-O2", "-shared", "-fPIC", str(folder / "rmw.c"), "-o", str(middleware)]
    subprocess.run(library, check=True)
    trace_points = built().tracetools
    words = ["gcc", "-O2", str(source), "-o", str(program), str(middleware), str(trace_points)]
    subprocess.run([*words, f"-Wl,-rpath,{folder}:{trace_points.parent}"], check=True)
    return program


def show_waits(console: Console, scratch: Path, waits: int) -> None:
    """Print what a wait costs the thread."""
    program = str(waiting(scratch))
    kinds = {  # whether it is traced, whether it is followed, and in which environment it runs
        "none": (False, "0", ()),
        "preload": (True, "0", ()),
        "preload, followed": (True, "1", ()),
        "preload, followed, switched": (
            True,
            "1",
            ("env", "GLIBC_TUNABLES=glibc.pthread.rseq=0"),
        ),
    }
    costs: dict[tuple[str, int], list[float]] = {}
    for turn in range(RUNS):
        for name, (traced, follows, before) in kinds.items():
            folder = scratch / f"waits {name} {turn}"
            folder.mkdir()
            make = (lambda folder: PreloadTracer(folder, [program], ())) if traced else None
            said, _ = run_under(make, [*before, program, str(waits), follows], folder)
            for line in said.splitlines():
                which, cost = line.split()
                costs.setdefault((name, int(which)), []).append(float(cost))
    table = Table("ns of CPU time a wait", *WAITS, title="median, 90th percentile")
    for name in kinds:
        cells = (np.percentile(costs[name, which], [50, 90]) for which in range(len(WAITS)))
        table.add_row(name, *(f"{median:.0f}, {high:.0f}" for median, high in cells))
    console.print(table)


def compiled(folder: Path) -> Path:
    """The program, linked to the sourced libtracetools or to one that does nothing."""
    real = [one.path for one in installed_libraries(os.environ)]
    library = real[0] if real else built().tracetools
    print(f"trace points of {library}")
    source, program = folder / "program.c", folder / "program"
    source.write_text(PROGRAM)
    words = ["gcc", "-O2", str(source), "-o", str(program), str(library)]
    words += [f"-Wl,-rpath,{library.parent}", "-Wl,--allow-shlib-undefined"]
    subprocess.run(words, check=True)
    return program


def run_under(
    make: Callable[[Path], Tracer] | None, command: Sequence[str], folder: Path
) -> tuple[str, float]:
    """What the program printed under a tracer, and our CPU time from its start to its end (s)."""
    environment = dict(os.environ)
    tracer = None if make is None else make(folder)
    try:
        if tracer is not None:
            environment |= tracer.start()
        before = time.process_time()
        printed = subprocess.run(
            command, env=environment, capture_output=True, text=True, check=True
        ).stdout
        used = time.process_time() - before
        if tracer is not None:
            tracer.stop()
    finally:
        if tracer is not None:
            tracer.remove()
    return printed, used


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--events", type=int, default=200_000, help="of each trace point, each run")
    parser.add_argument("--seconds", type=float, default=10, help="of reading, each run")
    parser.add_argument("--waits", action="store_true", help="the third table alone")
    given = parser.parse_args()
    console = Console()
    with tempfile.TemporaryDirectory() as scratch:
        if given.waits:
            show_waits(console, Path(scratch), given.events)
            return
        program = str(compiled(Path(scratch)))
        tracers: dict[str, Callable[[Path], Tracer] | None] = {
            "none": None,
            "preload": lambda folder: PreloadTracer(folder, [program], ()),
            SWITCHED: lambda folder: PreloadTracer(folder, [program], ()),
            "lttng": lambda folder: LttngSession(folder, [program], ()),
            "ebpf": lambda folder: EbpfTracer(folder, [program], ()),
        }
        costs: dict[tuple[str, int], list[float]] = {}
        for turn in range(RUNS):
            for name, make in list(tracers.items()):
                folder = Path(scratch) / f"{name}_{turn}"
                folder.mkdir()
                try:
                    command = [program, str(given.events), "0"]
                    if name == SWITCHED:
                        command = ["env", "GLIBC_TUNABLES=glibc.pthread.rseq=0", *command]
                    said, _ = run_under(make, command, folder)
                except ChainshaperError as error:
                    console.print(f"without {name}: {error}")
                    del tracers[name]
                    continue
                for line in said.splitlines():
                    which, cost = line.split()
                    costs.setdefault((name, int(which)), []).append(float(cost))
        table = Table("ns of CPU time a call", *CALLS, title="median, 90th percentile")
        for name in tracers:
            cells = (np.percentile(costs[name, which], [50, 90]) for which in range(len(CALLS)))
            table.add_row(name, *(f"{median:.0f}, {high:.0f}" for median, high in cells))
        console.print(table)
        shares = []
        for turn in range(RUNS):
            folder = Path(scratch) / f"reading_{turn}"
            folder.mkdir()
            events = str(int(given.seconds * RATE / len(CALLS)))
            begun = time.monotonic()
            _, used = run_under(tracers["preload"], [program, events, str(RATE)], folder)
            shares.append(used / (time.monotonic() - begun))
        console.print(
            f"reading {RATE:,} events a second: {np.median(shares):.2%} of a core"
            f" (most {max(shares):.2%} of {RUNS} runs)"
        )
        show_waits(console, Path(scratch), given.events)


if __name__ == "__main__":
    main()
