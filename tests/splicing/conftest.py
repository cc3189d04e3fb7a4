"""What several tests of this room need."""

from pathlib import Path

import pytest
from launch_cases import NDT


@pytest.fixture
def robot(tmp_path: Path) -> Path:
    """A launch file of one node, ``/ndt``."""
    path = tmp_path / "robot.launch.xml"
    path.write_text(NDT)
    return path
