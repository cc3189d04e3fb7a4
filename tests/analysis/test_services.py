"""Chains through services and actions: hand-made calls with answers worked out by hand."""

from dataclasses import dataclass, field

import polars as pl
import pytest
from story import OFFSET, Story

from chainshaper.analysis import (
    DataFlow,
    analyse_latency,
    callback_statistics,
    data_flow,
    enumerate_chains,
    find_chain,
    graph_of,
)
from chainshaper.values.errors import InputError


@dataclass
class Called:
    """Timers of /a and /b (processes 1, 2) call /add of /server (3); what comes back is published.

    With ``gids`` the tracer knows them; otherwise requests come with their source timestamps.
    """

    gids: bool = True
    story: Story = field(default_factory=Story)

    def __post_init__(self) -> None:
        story, self.timers, self.clients, self.outputs = self.story, [], [], []
        for number, name in enumerate("ab", 1):
            node = story.node(f"/{name}", number)
            self.timers.append(story.timer(node))
            self.clients.append(story.client(node, "/add", number if self.gids else None))
            self.outputs.append(story.publisher(node, f"/sum_{name}"))
        self.server = story.service(story.node("/server", 3), "/add")

    def request(self, who: int, start: int, number: int) -> None:
        """Sent 2 behind the start of the timer's instance, which takes 5."""
        self.story.start(self.timers[who], start)
        self.story.call("send_request", self.clients[who], start + 2, number)
        self.story.end(self.timers[who], start + 5)

    def serve(self, who: int, start: int, number: int, sent: int) -> None:
        """[start, start + 10); rclcpp sends the response behind that."""
        gid = {"client_gid": who + 1}
        stamp = {} if self.gids else {"source_timestamp": sent + 1 + OFFSET}
        self.story.call("take_request", self.server, start - 1, number, **gid, **stamp)
        self.story.start(self.server, start)
        self.story.end(self.server, start + 10)
        self.story.call("send_response", self.server, start + 11, number, **gid)

    def answer(self, who: int, time: int, number: int, publishes: bool = True) -> None:
        """Taken at ``time``, and published 3 later; the executor looks for work 5 later."""
        self.story.call("take_response", self.clients[who], time, number)
        if publishes:
            self.story.publish(self.outputs[who], time + 3)
        self.story.event("rclcpp_executor_get_next_ready", time + 5, who + 1)

    def flow(self) -> DataFlow:
        return data_flow(self.story.tables(), OFFSET)


def spans(flow: DataFlow, spec: str) -> list[tuple[int, int | None]]:
    analysis = analyse_latency(flow, spec)
    return list(analysis.traversals.select("start", "end").iter_rows())


def both_at_once(gids: bool) -> Called:
    """The two clients count alike, and their requests are served in the other order."""
    run = Called(gids)
    for number, start in enumerate((100, 200), 1):
        run.request(0, start, number)
        run.request(1, start + 4, number)
        run.serve(1, start + 20, number, sent=start + 6)
        run.serve(0, start + 40, number, sent=start + 2)
        run.answer(1, start + 60, number)
        run.answer(0, start + 70, number)
    return run


@pytest.mark.parametrize("gids", [True, False])
def test_responses_come_back_to_the_client_that_asked(gids: bool) -> None:
    flow = both_at_once(gids).flow()
    assert spans(flow, "/a../sum_a") == [(100, 173), (200, 273)]
    assert spans(flow, "/b../add../sum_b") == [(104, 163), (204, 263)]
    hops = analyse_latency(flow, "/a../sum_a").hops
    columns = ["hop", "topic", "start", "publish", "communication_ns", "computation_ns"]
    assert hops.filter(traversal=0).select(columns).rows() == [
        (0, "/add:request", 100, 102, None, 2),
        (1, "/add:response", 140, 151, 38, 11),
        (2, "/sum_a", 170, 173, 19, 3),
    ]


def test_two_servers_of_one_name_send_their_own_responses() -> None:
    """A node that was started twice: both take the call, and both answer, the second later."""
    run = Called()
    run.request(0, 100, 1)
    run.serve(0, 120, 1, sent=102)
    run.server = run.story.service(run.story.node("/again", 4), "/add")
    run.serve(0, 140, 1, sent=102)
    run.answer(0, 170, 1)
    flow = run.flow()
    names = dict(flow.objects.callbacks.select("callback_id", "node").unique().iter_rows())
    sent = flow.publications.filter(pl.col("topic").cast(pl.String) == "/add:response")
    assert [names[one] for one in sent.sort("time")["callback_id"]] == ["/server", "/again"]


def test_no_chain_leads_from_one_client_to_another() -> None:
    graph = graph_of(both_at_once(gids=True).flow())
    with pytest.raises(InputError, match="responses go back to the node that sent"):
        find_chain(graph, "/a../sum_b")
    listed = enumerate_chains(graph)
    assert sorted(chain.topics for chain in listed.chains) == [
        ("/add:request", "/add:response", f"/sum_{name}") for name in "ab"
    ]
    assert (listed.complete, listed.count) == (True, 2)


def test_a_service_at_the_end_is_its_response_and_its_client_the_subscriber() -> None:
    analysis = analyse_latency(both_at_once(gids=True).flow(), "/a../add")
    assert analysis.chain.topics == ("/add:request", "/add:response")
    assert analysis.traversals.select("latency_ns", "reception_ns").rows() == [(51, 70), (51, 70)]


def test_callbacks_of_clients_end_when_the_executor_looks_for_work() -> None:
    run = both_at_once(gids=True)
    flow = run.flow()
    found = callback_statistics(flow).filter(kind="client").select("count", "response_ns")
    assert found.rows() == [(2, dict.fromkeys(("min", "mean", "max"), 5))] * 2
    assert not flow.instances["assumed"].any()
    del run.story.rows["rclcpp_executor_get_next_ready"]  # then they have no end
    flow = run.flow()
    assert spans(flow, "/a../sum_a") == [(100, 173), (200, 273)]
    assert callback_statistics(flow).filter(kind="client").is_empty()


def test_what_does_not_come_back_says_where_and_why() -> None:
    run = Called()
    for number, start in enumerate((100, 200, 300), 1):
        run.request(0, start, number)
    run.serve(0, 220, 2, sent=202)
    run.serve(0, 320, 3, sent=302)
    run.answer(0, 340, 3)
    run.request(0, 400, 4)
    analysis = analyse_latency(run.flow(), "/a../sum_a")
    assert analysis.traversals.select("start", "broken_at", "reason").rows() == [
        (100, "/add:request", "lost"),
        (200, "/add:response", "lost"),
        (300, None, None),
        (400, "/add:request", "not taken"),
    ]


def test_a_response_that_is_sent_later_is_its_requests() -> None:
    # A deferred response: behind the start of the next instance, from another thread.
    run, about = Called(), {"client_gid": 1}
    for number, start in enumerate((100, 200), 1):
        run.request(0, start, number)
        run.story.call("take_request", run.server, start + 9, number, **about)
        run.story.start(run.server, start + 10)
        run.story.end(run.server, start + 12)
    for number, time in enumerate((230, 260), 1):
        run.story.call("send_response", run.server, time, number, tid=77, **about)
        run.answer(0, time + 5, number)
    assert spans(run.flow(), "/a../sum_a") == [(100, 238), (200, 268)]


def test_before_kilted_traces_have_no_calls_and_the_error_says_so() -> None:
    run = Called()
    run.story.publish(run.outputs[0], 50)
    with pytest.raises(InputError, match=r"no call of the service /add was recorded; before Kil"):
        find_chain(graph_of(run.flow()), "/add../sum_a")


def test_services_that_every_node_has_are_no_messages() -> None:
    story = Story()
    client = story.client(story.node("/a", 1), "/server/get_parameters", 1)
    server = story.service(story.node("/server", 2), "/server/get_parameters")
    story.call("send_request", client, 10, 1)
    story.call("take_request", server, 20, 1, client_gid=1)
    flow = data_flow(story.tables())
    assert flow.publications.is_empty()
    assert flow.takes.is_empty()


def test_feedback_is_followed_and_a_goal_leads_to_its_first_one() -> None:
    """/asker (1) has a goal worked at by /worker (2)."""
    story = Story()
    asker, worker = story.node("/asker", 1), story.node("/worker", 2)
    goals = story.client(asker, "/dock/_action/send_goal", 9)
    server = story.service(worker, "/dock/_action/send_goal", callbackless=True)
    timer = story.timer(asker)
    feedback = story.publisher(worker, "/dock/_action/feedback")
    reader = story.subscription(asker, "/dock/_action/feedback", callbackless=True)
    progress = story.publisher(asker, "/progress")
    for number, start in enumerate((100, 200), 1):
        story.start(timer, start)
        story.call("send_request", goals, start + 2, number)
        story.end(timer, start + 5)
        story.call("take_request", server, start + 10, number, client_gid=9)
        story.call("send_response", server, start + 11, number, client_gid=9)
        story.event("rclcpp_executor_get_next_ready", start + 12, 2)
        for sent in (start + 20, start + 40):  # by a thread of the goal
            story.publish(feedback, sent, tid=22)
            story.take(reader, sent + 5, sent=sent)
            story.publish(progress, sent + 7)
            story.event("rclcpp_executor_get_next_ready", sent + 8, 1)
    flow = data_flow(story.tables())
    every = spans(flow, "/dock/_action/feedback../progress")
    assert every == [(sent, sent + 7) for sent in (120, 140, 220, 240)]
    assert spans(flow, "/asker../dock/_action/feedback../progress") == [(100, 127), (200, 227)]
    assert not any("callback events" in note for note in flow.notes)
    shown = flow.objects.callbacks.filter(pl.col("kind") == "service")
    assert shown["topic"].to_list() == ["/dock/_action/send_goal"]
