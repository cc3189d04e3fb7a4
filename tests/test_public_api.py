"""The public names: all there, and free of charge until they are used."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import chainshaper

HEAVY = ("polars", "matplotlib", "pydantic", "cyclonedds", "numpy", "yaml", "rich")


def _modules_after(statement: str) -> set[str]:
    """Modules that are loaded after a statement in a fresh interpreter."""
    program = f"{statement}\nimport sys\nprint(*sys.modules)"
    run = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True
    )
    return {name.split(".")[0] for name in run.stdout.split()}


@pytest.mark.parametrize("name", chainshaper.__all__)
def test_every_public_name_resolves(name: str) -> None:
    value = getattr(chainshaper, name)
    assert value.__doc__, f"{name} has no docstring"
    assert value.__module__.startswith("chainshaper.")


def test_names_that_do_not_exist_are_said_not_to() -> None:
    with pytest.raises(AttributeError, match="'chainshaper' has no attribute 'shape_it'"):
        _ = chainshaper.shape_it


def test_names_are_listed_before_they_are_imported() -> None:
    program = "import chainshaper, sys; print(*dir(chainshaper))"
    run = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True
    )
    listed = run.stdout.split()
    assert {"plan_recording", "measure_latency", "Recording", "__doc__"} <= {*listed}
    assert {*chainshaper.__all__} <= {*listed}
    assert listed == sorted(listed)
    assert _modules_after("import chainshaper; dir(chainshaper)").isdisjoint(HEAVY)


def test_importing_the_package_loads_nothing_heavy() -> None:
    assert _modules_after("import chainshaper").isdisjoint(HEAVY)


def test_importing_the_command_line_loads_nothing_heavy() -> None:
    every_verb = "[verb.get_short_help_str() for verb in app.commands.values()]"
    statement = f"from chainshaper.cli.app import app; {every_verb}"
    assert _modules_after(statement).isdisjoint(HEAVY)


def test_a_plan_without_a_recording_is_applied_without_what_reads_recordings() -> None:
    """Robots, and guests of other kernels, have Pydantic and NumPy alone."""
    statement = "from chainshaper.flow import apply; apply.evidence_of(None)"
    assert _modules_after(statement).isdisjoint({"polars", "matplotlib", "cyclonedds", "rich"})


def test_the_gate_needs_the_standard_library_only() -> None:
    robot = Path(chainshaper.__file__).parent / "robot"
    # It also runs inside a ROS 2 node, where nothing of ours may be installed.
    ours = ["chainshaper", "chainshaper.robot"]
    ours += [f"chainshaper.robot.{path.stem}" for path in robot.glob("[a-z]*.py")]
    loaded = _modules_after(f"import {', '.join(ours)}") - _modules_after("pass")
    assert loaded - {"chainshaper"} <= sys.stdlib_module_names


def test_every_name_that_our_code_takes_from_the_package_exists() -> None:
    """Names are resolved when they are used, so no type checker sees one that is gone."""
    sources = Path(chainshaper.__file__).parent
    taken: dict[str, str] = {}  # name → a file that takes it
    for path in sources.rglob("*.py"):
        tree = ast.parse(path.read_text(encoding="utf-8"))
        aliases = {
            alias.asname or alias.name
            for node in ast.walk(tree)
            if isinstance(node, ast.Import)
            for alias in node.names
            if alias.name == "chainshaper"
        }
        for node in ast.walk(tree):
            if (
                isinstance(node, ast.Attribute)
                and isinstance(node.value, ast.Name)
                and node.value.id in aliases
            ):
                taken[node.attr] = str(path.relative_to(sources))
    rooms = {path.name for path in sources.iterdir() if path.is_dir()}
    assert len(taken) > 30, "the CLI takes most of its names so"
    assert {
        name: file
        for name, file in taken.items()
        if name not in chainshaper.__all__ and name not in rooms and not name.startswith("__")
    } == {}
