"""The animated terminal: what a run printed, whole and in order, in a picture of modest size."""

import re
import subprocess
from pathlib import Path
from xml.etree import ElementTree

ROOT = Path(__file__).parents[1]
TEXT = "{http://www.w3.org/2000/svg}text"


def test_a_film_has_every_line_in_order_and_ends_with_a_command_that_fails(tmp_path: Path) -> None:
    film = [str(ROOT / "scripts/film_terminal"), str(tmp_path / "film.svg")]
    subprocess.run([*film, "seq 40", "printf '<&>\\n' >&2"], check=True)
    texts = list(ElementTree.parse(tmp_path / "film.svg").iter(TEXT))  # noqa: S314 - our own
    said = [text.text for text in texts]
    assert said == ["$ seq 40", *map(str, range(1, 41)), "$ printf '<&>\\n' >&2", "<&>"]
    begins = [float(known["begin"][:-1]) for text in texts for known in [text[0].attrib]]
    assert begins == sorted(begins)
    refused = subprocess.run([*film, "echo gone; false"], capture_output=True, check=False)
    assert refused.returncode == 1
    assert b"ended with code 1\ngone" in refused.stderr


def test_the_film_of_the_readme_shows_verbs_that_the_readme_has() -> None:
    file = ROOT / "docs/images/terminal.svg"
    assert file.stat().st_size < 300_000
    assert "docs/images/terminal.svg" in (ROOT / "README.md").read_text()
    texts = ElementTree.parse(file).iter(TEXT)  # noqa: S314 - our own
    typed = [text.text or "" for text in texts if text.get("class") == "typed"]
    verbs = [known[1] for line in typed if (known := re.match(r"\$ chainshaper (\w+)", line))]
    assert verbs == ["run", "plan", "shape", "compare"]
