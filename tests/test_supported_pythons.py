"""Every verb on each Python that is supported and here, from a wheel that is installed by itself.

A plain install, without extras, does what the documentation says, and needs no compiler.
"""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from every_verb import COMMANDS, LIVE

from chainshaper.cli.app import VERBS

ROOT = Path(__file__).parents[1]
pytestmark = pytest.mark.building


def test_no_verb_is_left_out() -> None:
    assert set(VERBS) <= {command.split()[0] for _, command in COMMANDS + LIVE}


@pytest.mark.timeout(1800)
@pytest.mark.parametrize("version", ["3.10", "3.11", "3.12", "3.13"])
def test_every_verb_does_what_it_should(version: str, tmp_path: Path) -> None:
    of_pyenv = sorted((Path.home() / ".pyenv/versions").glob(f"{version}.*/bin/python3"))
    python = str(of_pyenv[-1]) if of_pyenv else shutil.which(f"python{version}")
    if python is None:
        pytest.skip(f"Python {version} is not here")
    done = subprocess.run(
        [sys.executable, ROOT / "scripts/build_wheels", tmp_path],
        env={**os.environ, "PYTHONS": python, "WITHOUT_COMPILERS": "1", "LIVE": "0"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    (wheel,) = tmp_path.glob("*.whl")
    number = version.replace(".", "")
    pattern = rf"chainshaper-.*-cp{number}-cp{number}-manylinux_2_(\d+)_{os.uname().machine}\.whl"
    tag = re.fullmatch(pattern, wheel.name)
    assert tag is not None, wheel.name
    # Of Ubuntu 22.04, on which Humble runs, where it is built with Debian 12's compiler or ours.
    assert int(tag[1]) <= 35
