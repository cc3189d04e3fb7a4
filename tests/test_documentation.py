"""Every command in the README and in docs/ is executed, as a reader would type it.

Commands stand in ``console`` blocks behind ``$``. All blocks of one page run in one folder, in
order, because later ones use what earlier ones made. Runs are shortened; nothing else differs.

A machine that is busy with others' work disturbs nearly every one of so few cycles at times, and
there is no planning from what is left. What failed is therefore tried again from its beginning, in
a fresh folder and with more cycles.
"""

import os
import re
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterable
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
CONSOLE = re.compile(r"```console\n(.*?)```", re.DOTALL)
YAML_EXAMPLE = re.compile(r"```yaml\n(name: .*?)```", re.DOTALL)
PYTHON = re.compile(r"```python\n(.*?)```", re.DOTALL)
CYCLES = (12, 40, 120)


def commands(page: Path) -> list[str]:
    blocks = CONSOLE.findall(page.read_text())
    return [line[2:] for block in blocks for line in block.splitlines() if line.startswith("$ ")]


def shortened(command: str, cycles: int) -> str:
    """Fewer cycles, and less watching; a verb that runs the workload gets a cycle count.

    What `make` does, install and test the project, is going on already: that its targets exist
    is left to be shown.
    """
    command = re.sub(r"^make ", "make --dry-run ", command)
    if not command.startswith("chainshaper apply"):  # a run that is governed needs time to be
        command = re.sub(r"--cycles \d+", f"--cycles {cycles}", command)
    runs = re.match(r"chainshaper (run|shape|demo)\b(?!.*--help)", command)
    if runs and "--cycles" not in command:
        command += f" --cycles {cycles}"
    if command.startswith("chainshaper sweep"):
        command += " --workers 1"  # starting more would take longer than so few cycles do
    if command.startswith("chainshaper doctor") and "--watch" not in command:
        command += " --watch 300ms"
    return command


def as_in_a_clone(folder: Path) -> None:
    """What a command or an example takes from a clone's folder."""
    for name in ("examples", "scripts"):
        shutil.copytree(ROOT / name, folder / name)
    for file in ("Makefile", "pyproject.toml"):
        shutil.copyfile(ROOT / file, folder / file)
    (folder / "tests").mkdir()
    shutil.copyfile(ROOT / "tests/ctf_writing.py", folder / "tests/ctf_writing.py")


def executed(command: list[str], folder: Path) -> subprocess.CompletedProcess[str]:
    binaries = Path(sys.executable).parent
    return subprocess.run(
        command,
        cwd=folder,
        env={**os.environ, "PATH": f"{binaries}{os.pathsep}{os.environ['PATH']}"},
        capture_output=True,
        text=True,
        check=False,
    )


def tried(steps: Callable[[Path, int], Iterable[list[str]]], folder: Path) -> Path:
    """Execute the commands of ``steps`` one by one in a folder, until none fails; that folder."""
    for cycles in CYCLES:
        clone = folder / f"{cycles}_cycles"
        as_in_a_clone(clone)
        for command in steps(clone, cycles):
            run = executed(command, clone)
            if run.returncode:
                break
        else:
            return clone
    pytest.fail(f"{run.args}\n{run.stdout}\n{run.stderr}")


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_command_runs(page: Path, tmp_path: Path) -> None:
    def read(folder: Path, cycles: int) -> Iterable[list[str]]:
        text = page.read_text()
        for number, example in enumerate(YAML_EXAMPLE.findall(text)):
            name = re.findall(r"Save the example as `([^`]+)`", text)[number]
            (folder / name).write_text(example)
        return [["sh", "-c", shortened(command, cycles)] for command in commands(page)]

    tried(read, tmp_path)


def test_the_python_example_of_the_readme_runs(tmp_path: Path) -> None:
    (example,) = PYTHON.findall((ROOT / "README.md").read_text())

    def run(folder: Path, cycles: int) -> Iterable[list[str]]:
        shutil.copyfile(folder / "examples/synthetic_chain.yaml", folder / "my_robot.yaml")
        short, verbs = re.subn(r'"(before|after)"\)', rf'"\1", cycles={cycles})', example)
        assert verbs == 2
        return [[sys.executable, "-c", short]]

    assert (tried(run, tmp_path) / "after" / "recording.json").is_file()


def test_the_python_example_about_traces_runs(tmp_path: Path) -> None:
    (example,) = PYTHON.findall((ROOT / "docs" / "traces.md").read_text())
    write = (
        "import sys, runpy; sys.argv[1:] = ['my_trace']; "
        "runpy.run_path('examples/write_trace.py', run_name='__main__')"
    )
    as_in_a_clone(tmp_path)
    for program in (write, example):
        run = executed([sys.executable, "-c", program], tmp_path)
        assert run.returncode == 0, run.stderr
    assert "jazzy rmw_cyclonedds_cpp" in run.stdout


def test_links_between_pages_lead_somewhere() -> None:
    for page in [*PAGES, ROOT / "CONTRIBUTING.md"]:
        for target in re.findall(r"\]\(([^)#]+)[^)]*\)", page.read_text()):
            if not target.startswith("http"):
                assert (page.parent / target).exists(), f"{page.name} links to {target}"
