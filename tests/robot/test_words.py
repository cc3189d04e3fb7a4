"""What the gates in C++ and in Python share is written once."""

import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]


def test_the_words_in_cpp_are_those_in_python() -> None:
    run = subprocess.run(
        [sys.executable, ROOT / "scripts/gate-words"], capture_output=True, text=True, check=True
    )
    assert (ROOT / "core/gate/words.hpp").read_text() == run.stdout, (
        "write it again: scripts/gate-words >core/gate/words.hpp"
    )
