"""`ros2 chain` is `chainshaper`: the same verbs, options, output and exit codes."""

import argparse
import re
import subprocess
import sys
from collections.abc import Sequence
from importlib.metadata import entry_points
from pathlib import Path
from xml.etree import ElementTree

import pytest
from command_line import called

from chainshaper import _core
from chainshaper.cli.ros2_chain import ChainCommand

ROOT = Path(__file__).parents[2]


def _ros2(*arguments: str) -> int:
    """Stands for `ros2`: parses as its `add_subparsers_on_demand` does (ros2cli 0.18 to 0.38)."""
    parser = argparse.ArgumentParser("ros2")
    subparsers = parser.add_subparsers(dest=" command")
    extension = ChainCommand()
    command_parser = subparsers.add_parser("chain")
    try:
        known, _ = parser.parse_known_args(arguments)  # upstream suppresses what this prints
        assert getattr(known, " command") == "chain"
    except SystemExit:
        pass
    command_parser.set_defaults(_command=extension)
    extension.add_arguments(command_parser, "ros2 chain", argv=None)
    args = parser.parse_args(arguments)
    code: int = extension.main(parser=parser, args=args)
    return code


def _said(capsys: pytest.CaptureFixture[str], arguments: Sequence[str]) -> tuple[int, str]:
    try:
        code = _ros2(*arguments)
    except SystemExit as ended:
        code = int(ended.code or 0)
    return code, capsys.readouterr().out


def test_it_is_found_by_ros2_and_the_same(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    (found,) = entry_points(group="ros2cli.command")
    assert found.name == "chain"
    assert found.load() is ChainCommand
    assert ChainCommand.__doc__, "the line that `ros2` shows"
    for help_, *words in (
        (["chain", "--help"], "latency", "ros2 chain"),
        (["chain"], "latency", "ros2 chain"),
        (["chain", "latency", "-h"], "--instances"),
    ):
        code, said = _said(capsys, help_)
        assert code == 0
        assert [word for word in words if word not in said] == []
    file = tmp_path / "latencies.txt"
    file.write_text("20ms\n30ms\n")
    arguments = ["plan", "--latencies", str(file), "--period", "100ms", "--json"]
    code, said = _said(capsys, ["chain", *arguments])
    assert (code, said) == (0, called(*arguments).out)
    assert _ros2("chain", "info", str(tmp_path / "nothing")) == 2
    assert _ros2("chain", "no-such-verb") == 2


def test_what_colcon_did_not_install_is_named(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delitem(sys.modules, "chainshaper.cli.app", raising=False)
    monkeypatch.setitem(sys.modules, "typer", None)
    assert _ros2("chain", "info") == 3
    assert "needs the Python package typer: install" in capsys.readouterr().err


def test_colcon_s_manifest_has_our_version_and_depends_on_what_we_use() -> None:
    manifest = ElementTree.parse(ROOT / "ros" / "package.xml")  # noqa: S314 - our own
    project = (ROOT / "pyproject.toml").read_text()
    assert f'version = "{manifest.findtext("version")}"' in project
    packages = [one.text or "" for one in manifest.findall("exec_depend")]
    names = [name.removeprefix("python3-") for name in packages if name.startswith("python3-")]
    assert names
    assert [name for name in names if not re.search(rf'"(py)?{name}>=', project)] == []


@pytest.mark.building
@pytest.mark.timeout(600)
def test_colcon_would_install_everything(tmp_path: Path) -> None:
    """What colcon runs for an `ament_python` package, as far as setuptools goes."""
    pytest.importorskip("setuptools", reason="setuptools is not in this environment")
    prefix = tmp_path / "install"
    build = subprocess.run(
        [
            *(sys.executable, "setup.py", "-q", "egg_info", "--egg-base", str(tmp_path)),
            # Of this checkout, in which CMake compiles only what has changed since.
            *("build", "--build-base", str(ROOT / "build/colcon")),
            *("install_lib", "--install-dir", str(prefix / "lib"), "--no-compile"),
            *("install_data", "--install-dir", str(prefix)),
        ],
        cwd=ROOT / "ros",
        capture_output=True,
        text=True,
        check=False,
    )
    assert build.returncode == 0, build.stderr
    installed = {p.relative_to(prefix / "lib") for p in (prefix / "lib").rglob("*") if p.is_file()}
    ours = {p.relative_to(ROOT / "src") for p in (ROOT / "src" / "chainshaper").rglob("*")}
    wanted = {p for p in ours if (ROOT / "src" / p).is_file() and "__pycache__" not in p.parts}
    assert wanted - installed == set()
    native = {Path(_core.__file__).name, "libchainshaper_gate.so", "libchainshaper_trace.so"}
    assert native <= {p.name for p in installed if p.parent.name == "chainshaper"}
    assert (prefix / "share/ament_index/resource_index/packages/chainshaper").is_file()
    assert (prefix / "share/chainshaper/package.xml").is_file()
