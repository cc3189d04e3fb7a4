"""Synchronising callbacks: which publication a message goes into."""

from dataclasses import dataclass, field

from story import Callback, Publisher, Story
from test_traversals import reasons, spans, traversals

MESSAGE_FILTER = "message_filters::Subscriber<Cloud>::subscribe(rclcpp::Node*)::{lambda()#1}"


@dataclass
class Fusion:
    """/left and /right (timers) → /fusion, whose two inputs publish /fused together."""

    symbol: str | None = None
    story: Story = field(default_factory=Story)

    def __post_init__(self) -> None:
        story = self.story
        self.fusion = story.node("/fusion", pid=3)
        self.fused = story.publisher(self.fusion, "/fused")
        self.timers: dict[str, tuple[Callback, Publisher]] = {}
        self.inputs: dict[str, Callback] = {}
        for pid, side in enumerate(("left", "right"), 1):
            node = story.node(f"/{side}", pid)
            self.timers[side] = (story.timer(node), story.publisher(node, f"/{side}/points"))
            self.inputs[side] = story.subscription(
                self.fusion, f"/{side}/points", symbol=self.symbol
            )

    def read(self, side: str, sent: int, start: int, published: int | None = None) -> None:
        """Published at ``sent`` (its cycle starts 1 before), read at ``start``."""
        timer, publisher = self.timers[side]
        self.story.runs(timer, sent - 1, sent + 1, writes=((publisher, sent),))
        writes = () if published is None else ((self.fused, published),)
        self.story.runs(
            self.inputs[side], start, (published or start) + 1, reads=sent, writes=writes
        )


def test_a_synchronised_message_leaves_with_the_input_that_completes_the_set() -> None:
    # Left always comes first, right completes the set and publishes for both.
    run = Fusion()
    for cycle in (0, 100):
        run.read("left", cycle + 10, cycle + 20)
        run.read("right", cycle + 30, cycle + 40, published=cycle + 45)
    assert spans(traversals(run.story, "/left/points../fused")) == [(9, 45), (109, 145)]
    assert spans(traversals(run.story, "/right/points../fused")) == [(29, 45), (129, 145)]
    found = traversals(run.story, "/left/points../fused")
    assert found.hops.filter(hop=1)["via"].to_list() == ["sibling", "sibling"]
    assert found.notes == ()


def test_either_input_may_complete_the_set() -> None:
    # Left completes the second set; message_filters registered both callbacks.
    run = Fusion(MESSAGE_FILTER)
    run.read("left", 10, 20)
    run.read("right", 30, 40, published=45)
    run.read("right", 110, 120)
    run.read("left", 130, 140, published=145)
    assert spans(traversals(run.story, "/left/points../fused")) == [(9, 45), (129, 145)]
    assert spans(traversals(run.story, "/right/points../fused")) == [(29, 45), (109, 145)]


def test_two_inputs_may_go_into_one_output_and_the_last_into_none() -> None:
    # Two left messages wait for one right message; the third waits for ever.
    run = Fusion()
    run.read("left", 10, 20)
    run.read("left", 22, 25)
    run.read("right", 30, 40, published=45)
    run.read("left", 110, 120)
    found = traversals(run.story, "/left/points../fused")
    assert spans(found) == [(9, 45), (21, 45), (109, None)]
    assert reasons(found)[2] == (109, "/fused", "not published")


def test_outputs_without_a_new_input_give_a_holding_synchroniser_away() -> None:
    # Right publishes at 45 and 65 without a left message between: one of the two earlier left
    # messages was held back, which one the events do not show.
    run = Fusion(MESSAGE_FILTER)
    run.read("left", 10, 20)
    run.read("left", 22, 25)
    run.read("right", 30, 40, published=45)
    run.read("right", 50, 60, published=65)
    run.read("left", 110, 120)
    run.read("right", 130, 140, published=145)
    (note,) = traversals(run.story, "/left/points../fused").notes
    assert note.startswith("1 of 3 publications on /fused came without a new message")


def test_independent_publishers_of_one_topic_do_not_answer_for_each_other() -> None:
    # Both are the application's own functions and publish each for itself: the left message of
    # 110 is dropped on purpose, the right one's answer at 145 is not its own.
    run = Fusion("Fusion::on_points(Cloud)")
    run.read("left", 10, 20, published=25)
    run.read("right", 30, 40, published=45)
    run.read("left", 110, 120)
    run.read("right", 130, 140, published=145)
    found = traversals(run.story, "/left/points../fused")
    assert spans(found) == [(9, 25), (109, None)]


def test_a_node_created_anew_knows_no_message_of_the_one_before() -> None:
    # Left waits at 120 for a right message. The node is destroyed, created again at 200 in the
    # same process, and publishes a set of its own.
    run = Fusion()
    run.read("left", 10, 20)
    run.read("right", 30, 40, published=45)
    run.read("left", 110, 120)
    fusion = run.story.node("/fusion", pid=3, time=200)
    run.fused = run.story.publisher(fusion, "/fused", time=200)
    for side in ("left", "right"):
        run.inputs[side] = run.story.subscription(fusion, f"/{side}/points", time=200)
    run.read("left", 310, 320)
    run.read("right", 330, 340, published=345)
    found = traversals(run.story, "/left/points../fused")
    assert spans(found) == [(9, 45), (109, None), (309, 345)]
    assert reasons(found)[1] == (109, "/fused", "not published")
