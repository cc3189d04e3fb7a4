"""`ros2 chain` is `chainshaper`: the same verbs, options, output and exit codes."""

import argparse
import os
import sys
from collections.abc import Sequence
from importlib.metadata import entry_points
from pathlib import Path
from types import ModuleType

import pytest
from command_line import called

from chainshaper import vendored_packages
from chainshaper.cli.ros2_chain import ChainCommand


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


@pytest.mark.parametrize(
    ("words", "prefix", "wanted"),
    [
        ([], "pl", ["plan"]),
        (["plan"], "--pol", ["--policy"]),
        (["plan", "--policy"], "server-per-ch", ["server-per-chain"]),
    ],
)
def test_argcomplete_gets_what_may_stand_at_the_cursor(
    words: list[str], prefix: str, wanted: list[str]
) -> None:
    """Called as argcomplete calls a completer (3.7, `finders.py`)."""
    parser = argparse.ArgumentParser("ros2 chain")
    ChainCommand().add_arguments(parser, "ros2 chain")
    (action,) = [action for action in parser._actions if action.dest == "arguments"]
    given = argparse.Namespace(arguments=words)
    completer = action.completer  # type: ignore[attr-defined]
    assert completer(prefix=prefix, parsed_args=given, action=action, parser=parser) == wanted


def test_where_packages_are_brought_ros2_becomes_chainshaper(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """The packages of an installation for ROS 2 are not imported into the process of `ros2`."""
    replaced: list[list[str]] = []
    monkeypatch.setattr(vendored_packages, "FOLDER", str(tmp_path))
    monkeypatch.setattr(os, "execv", lambda _, command: replaced.append(command))
    monkeypatch.setenv(vendored_packages.CALLED, "")
    _ros2("chain", "info")
    assert replaced[0] == [sys.executable, "-m", "chainshaper", "info"]
    assert os.environ[vendored_packages.CALLED] == "ros2 chain"
    monkeypatch.setattr(sys, "path", [*sys.path])
    vendored_packages.use_vendored()
    vendored_packages.use_vendored()
    assert sys.path.count(str(tmp_path)) == 1 and sys.path[0] == str(tmp_path)


class _Launch:
    """Stands for launch's `LaunchDescription`."""

    def __init__(self, entities: Sequence[object]) -> None:
        self.entities = entities


def test_ros2_launch_gets_the_plan_s_action_before_all_else(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """As `ros2 launch` calls its options (ros2launch 0.26, `api/api.py`)."""
    (found,) = entry_points(group="ros2launch.option")
    option = found.load()()
    parser = argparse.ArgumentParser("ros2 launch")
    option.add_arguments(parser, "ros2 launch")
    actions = ModuleType("chainshaper.launch_actions")
    monkeypatch.setattr(actions, "Shape", lambda **values: values, raising=False)
    launch = ModuleType("launch")
    monkeypatch.setattr(launch, "LaunchDescription", _Launch, raising=False)
    monkeypatch.setitem(sys.modules, "chainshaper.launch_actions", actions)
    monkeypatch.setitem(sys.modules, "launch", launch)
    robot = _Launch(["robot"])

    def launched(*words: str) -> Sequence[object]:
        args = parser.parse_args(words)
        option.prestart(args)
        (result,) = option.prelaunch(robot, args)
        option.postlaunch(0, args)
        entities: Sequence[object] = result.entities
        return entities

    assert launched() == ["robot"]
    assert launched("--shape", "p.yaml") == [{"plan": "p.yaml", "apply": None}, "robot"]
    with_plan = launched("--shape", "p.yaml", "--shape-apply", "fifo")
    assert with_plan == [{"plan": "p.yaml", "apply": "fifo"}, "robot"]
    with pytest.raises(RuntimeError, match="add --shape PLAN"):  # ros2 shows its text
        launched("--shape-apply", "auto")
