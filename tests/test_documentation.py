"""Every command in the README and in docs/ is executed, as a reader would type it.

Commands stand in ``console`` blocks behind ``$``. All blocks of one page run in one folder, in
order, because later ones use what earlier ones made. Runs are shortened; nothing else differs.
"""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
CONSOLE = re.compile(r"```console\n(.*?)```", re.DOTALL)
YAML_EXAMPLE = re.compile(r"```yaml\n(name: .*?)```", re.DOTALL)
PYTHON = re.compile(r"```python\n(.*?)```", re.DOTALL)
SHORT = 12


def commands(page: Path) -> list[str]:
    blocks = CONSOLE.findall(page.read_text())
    return [line[2:] for block in blocks for line in block.splitlines() if line.startswith("$ ")]


def shortened(command: str) -> str:
    """Fewer cycles, and less watching; a verb that runs the workload gets a cycle count.

    What `make` does, install and test the project, is going on already: that its targets exist
    is left to be shown.
    """
    command = re.sub(r"^make ", "make --dry-run ", command)
    if not command.startswith("chainshaper apply"):  # a run that is governed needs time to be
        command = re.sub(r"--cycles \d+", f"--cycles {SHORT}", command)
    runs = re.match(r"chainshaper (run|shape|demo)\b(?!.*--help)", command)
    if runs and "--cycles" not in command:
        command += f" --cycles {SHORT}"
    if command.startswith("chainshaper sweep"):
        command += " --workers 1"  # starting more would take longer than so few cycles do
    if command.startswith("chainshaper doctor") and "--watch" not in command:
        command += " --watch 300ms"
    return command


@pytest.fixture
def reader(tmp_path: Path) -> dict[str, str]:
    """A folder like a fresh clone's, and an environment with `chainshaper` on the path."""
    for folder in ("examples", "scripts"):
        shutil.copytree(ROOT / folder, tmp_path / folder)
    for file in ("Makefile", "pyproject.toml"):
        shutil.copyfile(ROOT / file, tmp_path / file)
    binaries = Path(sys.executable).parent
    return {**os.environ, "PATH": f"{binaries}{os.pathsep}{os.environ['PATH']}"}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_command_runs(page: Path, tmp_path: Path, reader: dict[str, str]) -> None:
    text = page.read_text()
    for number, example in enumerate(YAML_EXAMPLE.findall(text)):
        name = re.findall(r"Save the example as `([^`]+)`", text)[number]
        (tmp_path / name).write_text(example)
    for command in commands(page):
        run = subprocess.run(
            ["sh", "-c", shortened(command)],
            cwd=tmp_path,
            env=reader,
            capture_output=True,
            text=True,
            check=False,
        )
        assert run.returncode == 0, f"{page.name}: {command}\n{run.stdout}\n{run.stderr}"


def test_the_python_example_of_the_readme_runs(tmp_path: Path, reader: dict[str, str]) -> None:
    (example,) = PYTHON.findall((ROOT / "README.md").read_text())
    shutil.copyfile(tmp_path / "examples/synthetic_chain.yaml", tmp_path / "my_robot.yaml")
    for verb in ("before", "after"):
        example = example.replace(f'"{verb}")', f'"{verb}", cycles={SHORT})')
    run = subprocess.run(
        [sys.executable, "-c", example],
        cwd=tmp_path,
        env=reader,
        capture_output=True,
        text=True,
        check=False,
    )
    assert run.returncode == 0, run.stderr
    assert (tmp_path / "after" / "recording.json").is_file()


def test_the_python_example_about_traces_runs(tmp_path: Path, reader: dict[str, str]) -> None:
    (example,) = PYTHON.findall((ROOT / "docs" / "traces.md").read_text())
    write = (
        "import sys, runpy; sys.argv[1:] = ['my_trace']; "
        "runpy.run_path('examples/write_trace.py', run_name='__main__')"
    )
    for program in (write, example):
        run = subprocess.run(
            [sys.executable, "-c", program],
            cwd=tmp_path,
            env=reader,
            capture_output=True,
            text=True,
            check=False,
        )
        assert run.returncode == 0, run.stderr
    assert "jazzy rmw_cyclonedds_cpp" in run.stdout


def test_links_between_pages_lead_somewhere() -> None:
    for page in [*PAGES, ROOT / "CONTRIBUTING.md"]:
        for target in re.findall(r"\]\(([^)#]+)[^)]*\)", page.read_text()):
            if not target.startswith("http"):
                assert (page.parent / target).exists(), f"{page.name} links to {target}"
