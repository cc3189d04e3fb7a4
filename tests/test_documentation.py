"""Every command in the README and in docs/ is executed, as a reader would type it.

Commands stand in ``console`` blocks behind ``$``. All blocks of one page run in one folder, in
order, because later ones use what earlier ones made. Runs are shortened; the verbs are called in
this process, which has them loaded; and live runs of the same example are recorded once for all
pages. Nothing else differs.

A machine that is busy with others' work disturbs nearly every one of so few cycles at times, and
there is no planning from what is left. What failed is therefore tried again from its beginning, in
a fresh folder and with more cycles.
"""

import hashlib
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterable
from contextlib import nullcontext
from pathlib import Path

import pytest
from command_line import Finished, called, json_of
from cores import cores

from chainshaper import load_plan, open_recording
from chainshaper.cli.app import GROUPS, VERBS

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
CONSOLE = re.compile(r"```console\n(.*?)```", re.DOTALL)
YAML_EXAMPLE = re.compile(r"```yaml\n(name: .*?)```", re.DOTALL)
PYTHON = re.compile(r"```python\n(.*?)```", re.DOTALL)
LIVE_RUN = re.compile(
    r"chainshaper (?P<verb>run|shape) (?P<files>\S+\.yaml( \S+\.yaml)?) -o (?P<output>\S+)"
    r" --cycles (?P<cycles>\d+)"
)
RUNS_LIVE = re.compile(r"^chainshaper (apply|demo|release|run|shape)\b|run_application")
CYCLES = (12, 40, 120)
pytestmark = pytest.mark.waiting  # for the cores


def commands(page: Path) -> list[str]:
    blocks = CONSOLE.findall(page.read_text())
    return [line[2:] for block in blocks for line in block.splitlines() if line.startswith("$ ")]


def marks_of(page: Path) -> list[pytest.MarkDecorator]:
    """To install a clone compiles it."""
    installs = any("pip install" in command for command in commands(page))
    return [pytest.mark.building] if installs else []


PAGES_WITH_COMMANDS = [
    pytest.param(page, id=str(page.relative_to(ROOT)), marks=marks_of(page))
    for page in PAGES
    if commands(page)
]


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
    return re.sub(r"^(chainshaper doctor).*", r"\1 --watch 300ms", command)


def as_in_a_clone(folder: Path) -> None:
    """What a command or an example takes from a clone's folder."""
    for name in ("core", "examples", "scripts", "src"):
        unread = shutil.ignore_patterns("__pycache__")
        shutil.copytree(ROOT / name, folder / name, ignore=unread)
    for file in filter(Path.is_file, ROOT.iterdir()):
        shutil.copyfile(file, folder / file.name)
    (folder / "tests/helpers").mkdir(parents=True)
    shutil.copyfile(ROOT / "tests/helpers/ctf_writing.py", folder / "tests/helpers/ctf_writing.py")


@pytest.fixture(scope="session")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The recordings of examples that earlier pages have made."""
    return tmp_path_factory.mktemp("recorded")


def executed(command: str, folder: Path, recorded: Path) -> Finished:
    """A command, in a folder; the same live run's recording is copied where there is one."""
    if run := LIVE_RUN.fullmatch(command):
        texts = ((folder / name).read_text() for name in run["files"].split())
        plain = (re.sub(r"^ *recording: .*\n", "", one, flags=re.MULTILINE) for one in texts)
        same = "\0".join([run["verb"], run["cycles"], *plain])
        known = recorded / hashlib.sha256(same.encode()).hexdigest()
        if known.exists():
            shutil.copytree(known, folder / run["output"])
            return Finished(0, "", "")
        finished = executed(f"{command} ", folder, recorded)
        if finished.code == 0:
            shutil.copytree(folder / run["output"], known)
        return finished
    with cores() if RUNS_LIVE.search(command) else nullcontext():
        return finished_of(command, folder)


def finished_of(command: str, folder: Path) -> Finished:
    """A command: of ours, called here; of others, as a process."""
    program, *words = shlex.split(command)
    if program == "chainshaper" and "--" not in words:
        with pytest.MonkeyPatch.context() as patch:
            patch.chdir(folder)
            return called(*words)
    binaries = Path(sys.executable).parent
    environment = {**os.environ, "PATH": f"{binaries}{os.pathsep}{os.environ['PATH']}"}
    done = subprocess.run(
        ["sh", "-c", command], cwd=folder, env=environment, capture_output=True, text=True,
        check=False,
    )  # fmt: skip
    return Finished(done.returncode, done.stdout, done.stderr)


def tried(steps: Callable[[Path, int], Iterable[str]], folder: Path, recorded: Path) -> Path:
    """Execute the commands of ``steps`` one by one in a folder, until none fails; that folder."""
    for cycles in CYCLES:
        clone = folder / f"{cycles}_cycles"
        as_in_a_clone(clone)
        for command in steps(clone, cycles):
            finished = executed(command, clone, recorded)
            if finished.code:
                break
        else:
            return clone
    pytest.fail(f"{command}\n{finished.out}\n{finished.err}")


@pytest.mark.timeout(600)  # it waits for the cores, or compiles a clone
@pytest.mark.parametrize("page", PAGES_WITH_COMMANDS)
def test_every_command_runs(page: Path, tmp_path: Path, recorded: Path) -> None:
    def read(folder: Path, cycles: int) -> Iterable[str]:
        text = page.read_text()
        for number, example in enumerate(YAML_EXAMPLE.findall(text)):
            name = re.findall(r"Save the example as `([^`]+)`", text)[number]
            (folder / name).write_text(example)
        return [shortened(command, cycles) for command in commands(page)]

    clone = tried(read, tmp_path, recorded)
    if page.name == "command_line.md":
        demo_puts_everything_into_one_folder(clone / "my_demo")


def demo_puts_everything_into_one_folder(folder: Path) -> None:
    assert sorted(entry.name for entry in folder.iterdir()) == [
        *("after", "application.yaml", "before", "comparison.json"),
        *("plan.yaml", "report.html"),
    ]
    example = (ROOT / "examples/synthetic_chain.yaml").read_text()
    assert (folder / "application.yaml").read_text() == example
    assert open_recording(folder / "after").info.plan is not None
    # Every figure can be recomputed from what is on disk.
    compared = json_of("compare", folder / "before", folder / "after")["recordings"]
    written = json.loads((folder / "comparison.json").read_text())["recordings"]
    paths = [Path(one.pop("recording")).name for one in (*compared, *written)]
    assert compared == written
    assert paths == ["before", "after"] * 2


def test_the_python_example_of_the_readme_runs(tmp_path: Path, recorded: Path) -> None:
    (example,) = PYTHON.findall((ROOT / "README.md").read_text())

    def run(folder: Path, cycles: int) -> Iterable[str]:
        shutil.copyfile(folder / "examples/synthetic_chain.yaml", folder / "my_robot.yaml")
        short, verbs = re.subn(r'"(before|after)"\)', rf'"\1", cycles={cycles})', example)
        assert verbs == 2
        return [shlex.join([sys.executable, "-c", short])]

    assert (tried(run, tmp_path, recorded) / "after" / "recording.json").is_file()


def test_the_python_example_about_traces_runs(tmp_path: Path, recorded: Path) -> None:
    (example,) = PYTHON.findall((ROOT / "docs" / "traces.md").read_text())
    as_in_a_clone(tmp_path)
    assert executed("python examples/write_trace.py my_trace", tmp_path, recorded).code == 0
    run = executed(shlex.join(["python", "-c", example]), tmp_path, recorded)
    assert run.code == 0, run.err
    assert "jazzy rmw_cyclonedds_cpp" in run.out


def test_the_python_example_about_several_chains_runs(tmp_path: Path, recorded: Path) -> None:
    page = ROOT / "docs" / "several_chains.md"
    (example,) = PYTHON.findall(page.read_text())
    as_in_a_clone(tmp_path)
    simulated, *_ = commands(page)
    for command in (simulated, shlex.join([sys.executable, "-c", example])):
        run = executed(command, tmp_path, recorded)
        assert run.code == 0, run.err
    assert len(load_plan(tmp_path / "planned.yaml").chains) == 2


def test_each_verb_has_a_page_with_its_options_of_today() -> None:
    pages = sorted(page.stem for page in (ROOT / "docs/verbs").glob("*.md"))
    assert pages == sorted(VERBS)
    checked = subprocess.run(
        [sys.executable, ROOT / "scripts/verb-pages", "--check"], capture_output=True, check=False
    )
    assert checked.returncode == 0, f"run scripts/verb-pages for {checked.stdout.decode()}"
    for verb in VERBS:
        example = (ROOT / f"docs/verbs/{verb}.md").read_text().partition("## Example\n")[2]
        assert f"chainshaper {verb} " in example or f"chainshaper {verb}\n" in example
        assert "## Exit codes\n" in example
        assert "](../" in example.partition("## How to use it\n")[2]


def test_pages_that_explain_are_short() -> None:
    for name in ("shaping_node", "distributions", "plans", "overruns"):
        assert len((ROOT / f"docs/{name}.md").read_text().split()) <= 1500


def test_the_site_builds_without_warnings(tmp_path: Path) -> None:
    """It has every page in its navigation, and no link that leads nowhere."""
    built = executed(f"mkdocs build --strict -d {tmp_path}", ROOT, tmp_path)
    assert built.code == 0, built.err
    verbs = re.findall(r"verbs/(\w+)\.md", (ROOT / "mkdocs.yml").read_text())
    assert verbs == " ".join(GROUPS.values()).split()


@pytest.mark.parametrize("page", ["index", "command_line"])
def test_what_lists_the_verbs_lists_them_all_in_their_groups(page: str) -> None:
    text = (ROOT / f"docs/{page}.md").read_text()
    for title, verbs in GROUPS.items():
        _, begin, rest = text.partition(f"\n| {title.lower()} |")
        group = re.split(r"\n(?!\| \|)", rest)[0]  # rows without a first cell go on with it
        assert begin, title
        assert re.findall(r"\]\(verbs/(\w+)\.md\)", group) == verbs.split()


def test_links_between_pages_lead_somewhere() -> None:
    for page in [*PAGES, ROOT / "CONTRIBUTING.md"]:
        for target in re.findall(r"\]\(([^)#]+)[^)]*\)", page.read_text()):
            if not target.startswith("http"):
                assert (page.parent / target).exists(), f"{page.name} links to {target}"
