"""The picture of a terminal: what commands printed, whole, without playing or fetching anything."""

import subprocess
import sys
from pathlib import Path
from xml.etree import ElementTree

ROOT = Path(__file__).parents[1]
TEXT = "{http://www.w3.org/2000/svg}text"
DEMO = ROOT / "docs/images/demo.svg"


def lines_of(picture: Path) -> list[str]:
    """Return the lines that a picture shows, without the spaces that look the same."""
    lines: dict[float, str] = {}
    for text in ElementTree.parse(picture).iter(TEXT):  # noqa: S314 - our own
        place = float(text.attrib["y"])
        lines[place] = lines.get(place, "") + (text.text or "").replace("\xa0", " ")
    return [lines[place].strip() for place in sorted(lines)]


def test_a_picture_has_every_line_in_order_and_a_command_that_fails_ends_it(
    tmp_path: Path,
) -> None:
    script = [sys.executable, str(ROOT / "scripts/terminal_picture"), str(tmp_path / "two.svg")]
    subprocess.run([*script, "seq 30", "printf '<&>\\n'; echo left out >&2"], check=True)
    said = ["$ seq 30", *map(str, range(1, 31)), "$ printf '<&>\\n'; echo left out >&2", "<&>"]
    assert [line for line in lines_of(tmp_path / "two.svg") if line] == said
    refused = subprocess.run([*script, "echo gone; false"], capture_output=True, check=False)
    assert refused.returncode == 1
    assert b"false: ended with code 1" in refused.stderr


def test_the_picture_of_the_demo_stands_still_and_loads_nothing() -> None:
    text = DEMO.read_text()
    assert "<animate" not in text
    assert "<set" not in text
    assert "url(http" not in text.replace('"', "")
    shown = lines_of(DEMO)
    assert "$ chainshaper demo" in shown
    for word in ("before", "after", "jitter", "longest", "average", "late", "Look", "Your robot"):
        assert any(line.startswith(word) for line in shown), word
    for page in ("README.md", "docs/index.md"):
        assert "images/demo.svg" in (ROOT / page).read_text()
