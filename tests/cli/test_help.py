"""Help has few options in its first panel; every verb says what comes next; errors look alike."""

from pathlib import Path
from typing import Any

import pytest
from command_line import called

from chainshaper import load_application, simulate
from chainshaper.cli.app import VERBS, app

MOST_IN_FRONT = 9
EXAMPLE = Path(__file__).parents[2] / "examples" / "synthetic_chain.yaml"


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("runs") / "before"
    return simulate(load_application(EXAMPLE), folder, cycles=20, seed=1).path


def options_in_panels(verb: str) -> dict[str, list[str]]:
    """The options of a verb by the panel of its help, without `--help`."""
    context: Any = app.commands[verb].make_context(verb, [], resilient_parsing=True)
    panels: dict[str, list[str]] = {}
    for parameter in context.command.params:
        if parameter.param_type_name == "option":
            panel = getattr(parameter, "rich_help_panel", None) or "Options"
            panels.setdefault(panel, []).append(max(parameter.opts, key=len))
    return panels


def test_plan_shows_its_five_common_options_first() -> None:
    panels = options_in_panels("plan")
    assert panels["Options"] == ["--chain", "--output", "--policy", "--bands", "--json"]
    said = called("plan", "--help").out
    assert said.index("--bands") < said.index("What is planned from:") < said.index("--epsilon")


@pytest.mark.parametrize("verb", VERBS)
def test_no_verb_has_many_options_in_front(verb: str) -> None:
    assert len(options_in_panels(verb).get("Options", [])) <= MOST_IN_FRONT


def test_verbs_say_the_next_command_and_json_does_not(run: Path, tmp_path: Path) -> None:
    for words, then in (
        (("info", run), f"next: chainshaper chains {run}"),
        (("graph", run), f"next: chainshaper chains {run}"),
        (("callbacks", run), f"next: chainshaper chains {run}"),
        (("chains", run), f"next: chainshaper latency {run} --chain /t1../t2../t3../t4../t5"),
        (("latency", run), f"next: chainshaper plan {run} -o plan.yaml"),
        (("plan", run), "next: the same with `-o plan.yaml` keeps the plan"),
        (("compare", run, run), f"next: chainshaper report {run} {run} -o report.html"),
        (("init", "-o", tmp_path / "app.yaml"), f"run {tmp_path / 'app.yaml'} -o before"),
    ):
        assert then in called(*words).err, words
    for verb in ("info", "graph", "chains", "latency", "plan"):
        assert "next:" not in called(verb, run, "--json").err, verb


@pytest.mark.parametrize(
    "verb", ["info", "graph", "callbacks", "chains", "latency", "plan", "compare", "report"]
)
def test_no_verb_that_reads_a_recording_is_silent_for_long(
    verb: str, run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With no patience at all, whatever takes a moment says what it does."""
    monkeypatch.setattr("chainshaper.cli.output.PATIENCE_S", 0.0)
    more: dict[str, tuple[str | Path, ...]] = {
        "compare": (run,),
        "report": ("-o", tmp_path / "report.html"),
    }
    finished = called(verb, run, *more.get(verb, ()))
    assert finished.code == 0, finished.err
    assert f"{verb}: " in finished.err
