"""Services and an action of C++ nodes, recorded by the library in front: what the nodes print."""

import os
from pathlib import Path
from unittest import mock

import numpy as np
import pytest
from command_line import called, json_of
from roles import printed, role
from ros2 import ros2_environment

import chainshaper as cs

SECONDS = 8
NODES = {
    "server": ["server"],
    "worker": ["worker"],
    "client": ["client", "50"],
    "other": ["client", "50", "--ros-args", "-r", "__node:=other", "-r", "/sum:=/sum_of_other"],
    "asker": ["asker", "300"],
}


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What was recorded, beside a file for each node with what it printed."""
    folder = tmp_path_factory.mktemp("services")
    starts = [
        f'"{role()}" {" ".join(words)} > "{folder}/{name}" &' for name, words in NODES.items()
    ]
    script = "\n".join(["trap 'kill $(jobs -p)' INT TERM", *starts, "wait", "wait"])
    with mock.patch.dict(os.environ, ros2_environment()):
        made = called(
            *("record", "--source", "preload", "-o", folder / "recording"),
            *("--duration", f"{SECONDS}s", "--", "bash", "-c", script),
        )
    assert made.code == 0, made.err
    return folder / "recording"


@pytest.mark.ros2("rclcpp_action")
@pytest.mark.timeout(300)
@pytest.mark.parametrize("node", ["client", "other"])
def test_every_call_is_followed_to_the_client_that_made_it(recording: Path, node: str) -> None:
    """Both clients call one server at one pace; each prints when it began and published."""
    output = {"client": "/sum", "other": "/sum_of_other"}[node]
    analysis = cs.analyse_latency(cs.open_source(recording), f"/{node}../add..{output}")
    assert analysis.incomplete.keys() <= {"not taken", "not executed", "still running"}
    assert sum(analysis.incomplete.values()) <= 1
    found = analysis.traversals.drop_nulls("end").select("start", "end").to_numpy()
    truth = printed((recording.parent / node).read_text(), "cycle")
    assert len(found) > 100
    truth = truth[: len(found)]
    # In the order of events: the timer's start, BEGAN, ..., SENT, the publication.
    assert (found[:, 0] <= truth[:, 0]).all()
    assert (truth[:, 1] <= found[:, 1]).all()
    known = truth[1:, 0] > truth[0, 0] + 1_000_000_000  # first answers may take 0.1 s
    # On a busy machine an answer may come when the next cycle has begun, in the truth as well.
    apart = truth[1:, 0] >= truth[:-1, 1]
    assert apart.sum() > 50
    before_next = truth[1:, 0] >= found[:-1, 1]
    assert before_next[known & apart].all(), "each is its own cycle's"
    span = truth[:, 1] - truth[:, 0]
    assert np.median(np.abs(found[:, 1] - found[:, 0] - span) / span) < 0.1
    hops = analysis.hops.filter(hop=1)["computation_ns"].drop_nulls().to_numpy()
    assert hops.min() >= 2_000_000, "the server computes for that at least"


@pytest.mark.ros2("rclcpp_action")
@pytest.mark.timeout(300)
def test_an_actions_feedback_and_result_are_followed(recording: Path) -> None:
    source, folder = cs.open_source(recording), recording.parent
    feedback = cs.analyse_latency(source, "/errand/_action/feedback../progress")
    assert not feedback.incomplete
    found = feedback.traversals.select("start", "end").to_numpy()
    assert len(found) > 30
    asked, worked = ((folder / name).read_text() for name in ("asker", "worker"))
    for place, truth in enumerate((printed(worked, "feedback"), printed(asked, "progress"))):
        assert (found[:-1, place] <= truth[1 : len(found), 0]).all()
        if place:
            assert (truth[: len(found), 0] <= found[:, place]).all()
        else:  # a loop of the goal's thread, which begins as it wakes up
            assert (truth[: len(found) - 1, 0] <= found[1:, place]).all()
    for spec, parts in (
        ("/asker../errand/_action/send_goal../errand/_action/feedback../progress", 1),
        ("/asker../errand/_action/get_result../finished", 3),
    ):
        analysis = cs.analyse_latency(source, spec)
        assert sum(analysis.incomplete.values()) <= 1
        took = analysis.traversals["latency_ns"].drop_nulls().to_numpy()
        assert len(took) > 10
        assert took.min() >= parts * 20_000_000, "the worker pauses before each part"
        assert analysis.traversals["start"][0] <= printed(asked, "goal")[0, 0]


@pytest.mark.ros2("rclcpp_action")
@pytest.mark.timeout(300)
def test_the_commands_show_services_and_clients(recording: Path) -> None:
    callbacks = {
        (one["node"], one["kind"], one["topic"]): one
        for one in json_of("callbacks", recording, "--json")
    }
    assert callbacks["/server", "service", "/add"]["count"] > 200
    assert callbacks["/server", "service", "/add"]["response_ns"]["min"] >= 2_000_000
    shown = called("chains", recording, "--from", "/client", "--to", "/sum")
    assert "/add:request" in shown.out
    assert "/add:response" in shown.out


@pytest.mark.ros2("rclcpp_action")
@pytest.mark.timeout(300)
@pytest.mark.usefixtures("lttng_of_ros2")
def test_lttng_has_no_calls_before_kilted_and_latency_says_so(tmp_path: Path) -> None:
    environment = ros2_environment()
    if environment["ROS_DISTRO"] not in ("humble", "jazzy"):
        return  # tracetools has trace points for calls
    script = f'"{role()}" server & "{role()}" client 50 & sleep 5; kill %1 %2; wait'
    with mock.patch.dict(os.environ, environment):
        folder = tmp_path / "lttng"
        made = called("record", "--source", "lttng", "-o", folder, "--", "bash", "-mc", script)
    assert made.code == 0, made.err
    shown = called("latency", folder, "--chain", "/client../add../sum")
    assert shown.code == 2
    assert "no call of the service /add was recorded" in shown.err
    assert "record --source preload" in shown.err
