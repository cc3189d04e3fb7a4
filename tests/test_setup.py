"""`scripts/setup` on a machine that lacks what the build needs."""

import shutil
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]


def set_up(folder: Path, **programs: str) -> "subprocess.CompletedProcess[str]":
    """Run a copy of it where there are a few programs only, none a compiler; some are scripts."""
    (folder / "scripts").mkdir()
    shutil.copy(ROOT / "scripts/setup", folder / "scripts")
    (folder / "bin").mkdir()
    for name in ("dirname", "id", "sed", "sh"):
        (folder / "bin" / name).symlink_to(str(shutil.which(name)))
    (folder / "bin/python3").symlink_to(getattr(sys, "_base_executable", sys.executable))
    for name, text in programs.items():
        script = folder / "bin" / name.replace("_", "-")
        script.unlink(missing_ok=True)
        script.write_text(f"#!/bin/sh\n{text}\n")
        script.chmod(0o755)
    environment = {"PATH": str(folder / "bin"), "HOME": str(folder)}
    words = ["sh", str(folder / "scripts/setup")]
    return subprocess.run(words, env=environment, capture_output=True, text=True, check=False)


def test_a_missing_compiler_is_named_where_nothing_can_be_installed(tmp_path: Path) -> None:
    done = set_up(tmp_path)
    assert done.returncode == 3
    assert done.stderr.startswith("error: the build lacks what Debian has as")
    assert " g++" in done.stderr
    assert not (tmp_path / ".venv").exists()


def test_who_may_not_install_it_is_told_the_command(tmp_path: Path) -> None:
    done = set_up(tmp_path, apt_get="exit 1", id="echo 1000")
    assert done.returncode == 3
    assert "; run: sudo apt install" in done.stderr
    assert done.stderr.rstrip().endswith(" g++")


def test_a_missing_compiler_is_installed_by_root(tmp_path: Path) -> None:
    said = tmp_path / "said"
    set_up(tmp_path, apt_get=f'echo "$*" >>{said}; exit 1', id="echo 0")
    first, *others = said.read_text().splitlines()
    assert first.startswith("install -y --no-install-recommends ")
    assert first.endswith(" g++")
    assert others == ["update"], "a fresh machine has no package lists"


def test_changed_sources_of_the_library_are_built_again() -> None:
    places = ("core/bands/placement.cpp", "src/chainshaper/sources/preload/preload.c")
    for source in (*places, "src/chainshaper/robot/gate.py"):
        words = ["make", "--dry-run", f"--what-if={source}", ".venv/.ready-dev"]
        done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, check=True)
        assert "scripts/setup dev" in done.stdout.splitlines(), source
