"""Run every verb of an installed chainshaper once: `PYTHON tests/helpers/every_verb.py FOLDER`.

PYTHON is that of the environment it is installed in, FOLDER is made and gets what the verbs write.
Prints a line for each command, with its exit code and how long it took (s); exit code 1 where one
is not as expected, and what it said. With WITHOUT_COMPILERS=1 the commands find no compiler. Needs
nothing but the standard library, of any supported Python.
"""

import os
import subprocess
import sys
import time
from contextlib import nullcontext
from pathlib import Path

from cores import cores

CYCLES = "40"
CHAIN = "/t1../t5"
PLANT = """format: 1
plant: {transfer_function: {numerator: [1], denominator: [1, 0, -9]}}
noise: {process: 1, measurement: 0.000001}
cost: {output: 1000, input: 0.001}
controller: {design: lqg, delay: 50ms}
"""
COMMANDS = (
    (0, "--version"),
    (0, "--help"),
    (0, "init -o app.yaml"),
    (0, f"simulate app.yaml --cycles {CYCLES} -o before"),
    (0, "info before"),
    (0, "graph before"),
    (0, "callbacks before"),
    (0, "chains before"),
    (0, "latency before"),
    (0, "convert before -o converted"),
    (0, "describe before -o described.yaml"),
    (0, "plan before -o plan.yaml"),
    (0, "plan before --bands 2 -o bands.yaml"),
    (0, f"simulate app.yaml plan.yaml --cycles {CYCLES} -o after"),
    (0, "compare before after"),
    (3, "control plant.yaml before"),  # it needs an extra
    (0, "report before after -o page.html"),
    (0, "export --perfetto after -o after.pftrace"),
    (0, "budget before -o budget.yaml"),
    (0, "check before --budget budget.yaml"),
    (0, "check before --baseline before"),
    (0, "sweep app.yaml --vary epsilon=0ms,1ms --cycles 20 -o grid.parquet"),
    (0, "offsets plan.yaml -o offsets.yaml"),
    (0, "generate app.yaml -o package"),
    (0, "splice plan.yaml -o spliced --node python -- ros2 run robot node5"),
    (0, "plan before --publication in-process -o inside.yaml"),
    (0, "splice inside.yaml -o spliced_inside -- ros2 run robot node5"),
    (0, "doctor --watch 200ms"),
    (0, "threads"),
    (0, "status"),
    (0, "release"),
    (0, "apply plan.yaml --dry-run --backend litmus"),
    (0, "watch --environment"),
    (0, f"watch --json --chain {CHAIN} -- true"),
    (1, "record -o recorded -- true"),  # no node is in it
    (1, "profile -o profiled --node node5 -- true"),
)
LIVE = (
    (0, "run app.yaml -o measured --cycles 12"),
    (0, "shape app.yaml plan.yaml -o shaped --cycles 12"),
    (0, "demo --cycles 100 -o demonstrated"),
)
COMPILERS = ("cc", "c++", "gcc", "g++", "clang", "clang++")
OF_COMPILERS = ("gcc-", "g++-", "clang-", "c89", "c99")


def main() -> int:
    """Run the commands in the folder that is named; the exit code."""
    folder, failed = Path(sys.argv[1]), 0
    folder.mkdir(parents=True)
    (folder / "plant.yaml").write_text(PLANT)
    environment = dict(os.environ, PYTHONDONTWRITEBYTECODE="1")
    if os.environ.get("WITHOUT_COMPILERS"):
        environment["PATH"] = str(_programs_but_compilers(folder))
    commands = COMMANDS if os.environ.get("LIVE") == "0" else COMMANDS + LIVE
    for expected, command in commands:
        code, printed, seconds = run(command, folder, environment)
        sys.stdout.write(f"{code} {seconds:6.2f} s  chainshaper {command}\n")
        sys.stdout.flush()
        named = code == 0 or "error: " in printed
        if code != expected or not named or "Traceback" in printed:
            failed += 1
            sys.stdout.write(f"    expected {expected}; it printed:\n{printed}\n")
    return min(failed, 1)


def run(command: str, folder: Path, environment: "dict[str, str]") -> "tuple[int, str, float]":
    """A command's exit code, all it said, and the seconds that it took."""
    begun = time.monotonic()
    # `release` ends every plan in force on this machine, also that of a test that runs beside this.
    with cores() if command == "release" else nullcontext():
        done = subprocess.run(
            [sys.executable, "-m", "chainshaper", *command.split()],
            cwd=str(folder),
            env=environment,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            check=False,
        )
    return done.returncode, done.stdout.decode(errors="replace"), time.monotonic() - begun


def _programs_but_compilers(folder: Path) -> Path:
    """A folder of links to the programs on the PATH, without the compilers among them."""
    links = folder / "programs"
    links.mkdir()
    for place in os.environ["PATH"].split(os.pathsep):
        for program in sorted(Path(place).glob("*")) if place else ():
            name = program.name
            is_compiler = name in COMPILERS or name.startswith(OF_COMPILERS)
            if not is_compiler and not (links / name).exists():
                (links / name).symlink_to(program)
    return links


if __name__ == "__main__":
    sys.exit(main())
