"""The action for GitHub and the job for GitLab: their steps are run here, on a recording."""

import os
import re
import shutil
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from xml.etree import ElementTree

import pytest
import yaml
from command_line import called
from small_chain import small_chain_text

import chainshaper as cs

ROOT = Path(__file__).parents[1]
PULL_REQUEST = {"github.repository": "team/robot", "github.event.pull_request.number": "7"}
GH = """#!/bin/sh
echo "$*" >> "$0.calls"
case "$*" in *--jq*) cat "$0.earlier" ;; *) cat "${7#*@}" > "$0.body" ;; esac
"""
"""Stands for GitHub's own command: it keeps what it is asked, and what is commented."""
CURL = """#!/bin/sh
echo "$*" >> "$0.calls"
"""


@pytest.fixture
def robot(tmp_path: Path) -> Path:
    """A folder with a recording, a budget that it keeps, one that it breaks, and stand-ins."""
    (tmp_path / "app.yaml").write_text(small_chain_text())
    cs.simulate(cs.load_application(tmp_path / "app.yaml"), tmp_path / "run", cycles=20)
    assert called("budget", tmp_path / "run", "-o", tmp_path / "kept.yaml").code == 0
    strict = re.sub(r"maximum: .*", "maximum: 1us", (tmp_path / "kept.yaml").read_text(), count=1)
    (tmp_path / "broken.yaml").write_text(strict)
    (tmp_path / "bin").mkdir()
    for name, text in (("gh", GH), ("curl", CURL)):
        (tmp_path / "bin" / name).write_text(text)
        (tmp_path / "bin" / name).chmod(0o755)
    return tmp_path


def _environment(robot: Path, **more: str) -> dict[str, str]:
    programs = f"{robot / 'bin'}{os.pathsep}{Path(sys.executable).parent}"
    return {**os.environ, "PATH": f"{programs}{os.pathsep}{os.environ['PATH']}", **more}


def _on_github(robot: Path, inputs: Mapping[str, str]) -> tuple[int, str]:
    """Run the steps as a runner of GitHub does; return the check's exit code, and the summary."""
    action = yaml.safe_load((ROOT / "action.yml").read_text())
    files = {name: robot / name for name in ("GITHUB_PATH", "GITHUB_OUTPUT", "GITHUB_STEP_SUMMARY")}
    for file in files.values():
        file.write_text("")
    values = {f"inputs.{name}": str(of.get("default", "")) for name, of in action["inputs"].items()}
    values |= {f"inputs.{name}": value for name, value in inputs.items()} | PULL_REQUEST
    values["inputs.token"] = "secret"
    codes = []
    for step in action["runs"]["steps"]:
        assert step["shell"] == "bash"
        assert "${{" not in step["run"], "a title of a pull request would be run by the shell"
        given = {
            name: re.sub(r"\$\{\{ (\S+) \}\}", lambda place: values[place[1]], text)
            for name, text in step["env"].items()
        }
        done = subprocess.run(
            ["bash", "--noprofile", "--norc", "-eo", "pipefail", "-c", step["run"]],
            env=_environment(robot, RUNNER_TEMP=str(robot), **{n: str(f) for n, f in files.items()})
            | given,
            cwd=robot,
            check=False,
        )
        codes.append(done.returncode)
        for line in files["GITHUB_OUTPUT"].read_text().splitlines():
            name, _, value = line.partition("=")
            values[f"steps.check.outputs.{name}"] = value
    assert codes[0] == codes[2] == 0
    return codes[1], files["GITHUB_STEP_SUMMARY"].read_text()


def test_on_github_a_broken_limit_fails_and_is_commented_once(robot: Path) -> None:
    code, summary = _on_github(robot, {"recordings": "run", "budget": "kept.yaml"})
    assert code == 0
    body = (robot / "bin/gh.body").read_text()
    assert body == f"<!-- chainshaper check -->\n### chainshaper check\n\n{summary}"
    assert (
        (robot / "bin/gh.calls")
        .read_text()
        .splitlines()[-1]
        .startswith("api --silent --method POST repos/team/robot/issues/7/comments")
    )
    (robot / "bin/gh.earlier").write_text("1234\n")
    code, summary = _on_github(robot, {"recordings": "\nru*\n", "budget": "broken.yaml"})
    assert code == 1
    assert "1 us" in summary or "1 µs" in summary or "0.001" in summary, summary
    assert (robot / "bin/gh.body").read_text().endswith(summary)
    assert (
        (robot / "bin/gh.calls")
        .read_text()
        .splitlines()[-1]
        .startswith("api --silent --method PATCH repos/team/robot/issues/comments/1234")
    )
    suite = ElementTree.parse(robot / "chainshaper-check.xml").getroot()  # noqa: S314 - our own
    assert list(suite.iter("failure"))


def test_on_github_what_cannot_be_checked_is_commented_too(robot: Path) -> None:
    code, summary = _on_github(robot, {"recordings": "run", "baseline": "nothing"})
    assert code == 2
    assert summary.startswith("error: ") and "nothing" in summary
    assert (robot / "bin/gh.body").read_text().endswith(summary)


@pytest.mark.parametrize(
    ("variables", "code"),
    [
        ({"CHAINSHAPER_BUDGET": "kept.yaml"}, 0),
        ({"CHAINSHAPER_BUDGET": "broken.yaml"}, 1),
        ({"CHAINSHAPER_BASELINE": "nothing"}, 2),
    ],
)
def test_on_gitlab_the_same(robot: Path, variables: dict[str, str], code: int) -> None:
    job = yaml.safe_load((ROOT / "ci/gitlab.yml").read_text())[".chainshaper-check"]
    of_gitlab = {
        **{name: str(value) for name, value in job["variables"].items()},
        "CHAINSHAPER_RECORDINGS": "run",
        "CHAINSHAPER_TOKEN": "secret",
        "CI_API_V4_URL": "https://gitlab/api/v4",
        "CI_PROJECT_ID": "3",
        "CI_MERGE_REQUEST_IID": "7",
        **variables,
    }
    shell = shutil.which("dash") or "sh"  # images without bash have a plain shell
    done = subprocess.run(
        [shell, "-ec", "\n".join(job["script"])],
        env=_environment(robot, **of_gitlab),
        cwd=robot,
        check=False,
    )
    assert done.returncode == code
    assert (robot / job["artifacts"]["paths"][0]).read_text().strip()
    assert (robot / job["artifacts"]["reports"]["junit"]).is_file() == (code != 2)
    (call,) = (robot / "bin/curl.calls").read_text().splitlines()
    assert "body=<chainshaper-check.md" in call
    assert call.endswith("https://gitlab/api/v4/projects/3/merge_requests/7/notes")
