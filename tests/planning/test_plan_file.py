"""The plan file: what is written is read back equal, and what would not run is refused."""

import tempfile
from pathlib import Path
from textwrap import indent
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from chainshaper.planning import (
    ChainPlan,
    Modes,
    dump_plan,
    load_plan,
    plan_json,
    publish_slots,
    save_plan,
    save_plans,
)
from chainshaper.planning.chain_plan import (
    Adaptation,
    ChainOfPlan,
    Evidence,
    LoopAge,
    Margin,
    PlannedLoop,
    Prediction,
    Server,
    ShapingNode,
    Thread,
    loop_common_ns,
    server_of,
)
from chainshaper.planning.plan import Plan
from chainshaper.values.errors import InputError, OperationError

FILE = "format: 2\nchains:\n- "
GOOD = """\
# edited by hand: keys in another order, flow style, comments
servers:
  - {name: chain, core: 1, priority: 2, slots: [[0, 64ms]], threads: [{node: /n1, role: executor}]}
  - name: output      # the gate
    priority: 1
    core: 0
    slots:
      - [64000us, 0.065s]
    threads:
      - {node: /chainshaper_t5}
cycle: 100ms
policy: shaped
chain: {spec: "/t1../t5", output: /t5, publisher: /ns/n5, period: 100ms}
evidence:
  recording: null
  samples: 320
  min_latency: 30ms
  mean_latency: 48.123456ms
  max_latency: 63ms
  realtime: yes
margin: {epsilon: 1ms, source: given}
anchor: stamp
shaping_node: {name: chainshaper_t5, input: /t5_tmp, output: /t5, core: 0, fifo_priority: 84,
               spin: 300us, pause: 500us}
predicted: {mean: 65ms, max: 65ms, jitter: 1ms, shares: [1]}
"""


def test_a_hand_edited_plan_is_read(tmp_path: Path) -> None:
    """And its JSON form has integer nanoseconds."""
    plan = _load(tmp_path, GOOD)
    assert (plan.cycle_ns, plan.evidence.mean_latency_ns) == (100_000_000, 48_123_456)
    assert plan.evidence.realtime is True
    assert plan.servers[1].slots == publish_slots(plan) == ((64_000_000, 65_000_000),)
    assert server_of(plan, Thread(node="/n1")) == plan.servers[0]
    assert server_of(plan, Thread(node="/n9")) is None
    values = plan_json(plan)
    promised = {"mean_ns": 65_000_000, "max_ns": 65_000_000, "jitter_ns": 1_000_000}
    assert values["bands_ns"] == [65_000_000]
    assert values["predicted"] == {**promised, "shares": [1.0], "modes": None, "receivers": None}
    assert values["servers"][0]["slots"] == [[0, 64_000_000]]
    assert values["chain"]["period_ns"] == 100_000_000


WRONG_VALUES = [
    # what to replace, by what, line, key, and words of the reason
    ("cycle: 100ms", "cycle: 100", 11, "cycle", "unit"),
    ("cycle: 100ms", "cycle: -1ms", 11, "cycle", "negative"),
    ("cycle: 100ms", "cycle: 0", 11, "cycle", "zero"),
    ("cycle: 100ms", "cycle: 1000000000000s", 11, "cycle", "292 years"),
    ("cycle: 100ms", "cycle: 150ms", 11, "cycle", "multiple"),
    ("cycle: 100ms", "cycel: 100ms", 11, "cycel", "did you mean 'cycle'"),
    ("cycle: 100ms", "cycle: 100ms\ncycle: 200ms", 12, "cycle", "second time"),
    ("cycle: 100ms", "cycle_ns: 100000000", 11, "cycle_ns", "write 'cycle'"),
    ("cycle: 100ms\n", "", 2, "cycle", "missing"),
    ("cycle: 100ms", "cycle: 100ms\ncolour: red", 12, "colour", "unknown key: remove it"),
    ("max_latency: 63ms", "max_latency: 100ms", 11, "cycle", "not longer than"),
    ("max_latency: 63ms", "max_latency: 40ms", 18, "evidence.mean_latency", "ascend"),
    ("samples: 320", "samples: many", 16, "evidence.samples", "'many' is not a whole number"),
    ("realtime: yes", "realtime: 1", 20, "evidence.realtime", "not true or false"),
    ("[[0, 64ms]]", "[[64ms, 3ms]]", 3, "servers[0].slots[0]", "empty"),
    ("[[0, 64ms]]", "[[0, 64ms], [99ms, 101ms]]", 3, "servers[0].slots[1]", "after the cycle"),
    ("[[0, 64ms]]", "[[5ms, 9ms], [0ms, 4ms]]", 3, "servers[0].slots[1]", "ascending"),
    ("[[0, 64ms]]", "[[5ms, 9ms], [8ms, 12ms]]", 3, "servers[0].slots[1]", "overlap"),
    ("[[0, 64ms]]", "[[0ms]]", 3, "servers[0].slots[0][1]", "missing"),
    ("[[0, 64ms]]", "[]", 3, "servers[0].slots", "too short"),
    ("name: output ", "name: chain ", 4, "servers[1].name", "two servers"),
    ("priority: 1", "priority: 0", 5, "servers[1].priority", "greater than or equal to 1"),
    ("core: 0\n", "core: 3\n", 23, "shaping_node.core", "make them the same"),
    ("{node: /n1, role: executor}", "/n1", 3, "servers[0].threads[0]", "not a mapping"),
    ("{node: /n1, role: executor}", "{node: n1}", 3, "servers[0].threads[0].node", "full ROS"),
    ("role: executor", "role: dds", 3, "servers[0].threads[0].role", "'executor' or 'publisher'"),
    ("{node: /n1", "{node: /chainshaper_t5", 10, "servers[1].threads[0]", "already in"),
    ("role: executor", "callbacks: [t]", 3, "servers[0].threads[0].callbacks[0]", "no callback"),
    ("{node: /chainshaper_t5}", "{node: /other}", 23, "shaping_node.name", "no server holds"),
    ("input: /t5_tmp", "input: /t5", 23, "shaping_node.input", "feed itself"),
    ("output: /t5, core", "output: /t6, core", 23, "shaping_node.output", "make them the same"),
    ("fifo_priority: 84", "fifo_priority: 99", 23, "shaping_node.fifo_priority", "equal to 98"),
    ("{name: chainshaper_t5,", "{name: /x,", 23, "shaping_node.name", "not a node's name"),
    ("spin: 300us", "spin: 0.1ns", 24, "shaping_node.spin", "finer"),
    ("shares: [1]", "shares: [.nan]", 25, "predicted.shares[0]", "finite"),
    ("shares: [1]", "shares: 1", 25, "predicted.shares", "not a list"),
    ('spec: "/t1../t5"', "spec: 7", 13, "chain.spec", "7 is not a text"),
]


def test_executors_of_a_node_are_told_apart_by_their_callbacks(tmp_path: Path) -> None:
    """Callback groups with executors of their own (section 6) may be in servers of their own."""
    named = GOOD.replace("role: executor", "callbacks: [every 0.1 s, /t1]")
    plan = _load(tmp_path, named)
    (chain,) = plan.servers[0].threads
    assert chain == Thread(node="/n1", callbacks=("every 100ms", "/t1"))
    assert "{node: /n1, role: executor, callbacks: [every 100ms, /t1]}" in dump_plan(Plan.of(plan))
    assert "callbacks" not in dump_plan(Plan.of(_load(tmp_path, GOOD)))
    text = "- {name: late, core: 0, priority: 2, slots: [[70ms, 80ms]], threads: [{node: /n1%s}]}"
    both = named.replace("cycle: 100ms", f"  {text}\ncycle: 100ms", 1)
    joint = Plan.of(_load(tmp_path, both % ", callbacks: [/t2]"))
    assert [server.name for server in joint.servers] == ["chain", "output", "late"]
    for overlapping in ("", ", callbacks: [/t2, /t1]"):
        with pytest.raises(InputError, match=r"runs every 100ms, /t1 is already in .*'chain'"):
            _load(tmp_path, both % overlapping)


MODES = """\
modes:
  topic: /mode
  default: city
  bands: {city: 2, highway: 1}
  late: next-slot
"""
WITH_MODES = GOOD.replace("- [64000us, 0.065s]", "- [40ms, 41ms]\n      - [64ms, 65ms]") + MODES
WRONG_MODES = [  # what is replaced, by what, the line in the modes, the key, and some words
    ("default: city", "default: sea", 3, "modes.default", "write one of city, highway"),
    ("default: city", "default: 1st", 3, "modes.default", "not a mode's name"),
    ("highway: 1", "highway: 3", 4, "modes.bands.highway", "from 1 to 2"),
    ("{city: 2, highway: 1}", "{}", 4, "modes.bands", "too short"),
    ("{city: 2, highway: 1}", "[2, 1]", 4, "modes.bands", "dictionary"),
    ("topic: /mode", "topic: /t5_tmp", 2, "modes.topic", "carries the chain's output"),
    ("late: next-slot", "late: never", 5, "modes.late", "'next-slot'"),
]


ADAPTED = GOOD + "adaptation: {window: 2000, late: 1.4, gain: 0.02, after: 9, max_latency: 70ms}\n"
WRONG_ADAPTATIONS = [
    ("window: 2000", "window: 7", 26, "adaptation.window", "equal to 500"),
    ("late: 1.4", "late: 1", 26, "adaptation.late", "greater than 1"),
    ("gain: 0.02", "gain: 2%", 26, "adaptation.gain", "not a number"),
    ("max_latency: 70ms", "max_latency: 64ms", 26, "adaptation.max_latency", "ends behind it"),
]


LOOP = """\
loop:
  node: /controller
  thread: update
  topic: /t5
  period: 50ms
  phase: 14ms
  jitter: 80us
  drift_ppm: -12.5
  samples: 640
  delivery: [200us, 450us, 2ms]
  lead: 600us
  in_step: output
  starts: [64ms, 99ms]
  realtime_priority: 50
  runs_at: {core: 1, priority: 1, time: 300us}
  age: {first: [114ms, 114.08ms], every: [114ms, 164.08ms], constant: true, uses: [2, 2]}
  age_at_any_phase: {first: [64ms, 114.08ms], every: [64ms, 164.6ms], constant: false, uses: [1, 3]}
"""
WITH_LOOP = GOOD + LOOP
WRONG_LOOPS = [  # as above, with the line in the loop
    ("topic: /t5\n  period", "topic: /t6\n  period", 4, "loop.topic", "chain's output is /t5"),
    ("period: 50ms", "period: 30ms", 12, "loop.in_step", "neither of its period 30 ms and"),
    ("period: 50ms", "intervals: [1ms, 2ms, 3ms]", 12, "loop.in_step", "has no period"),
    ("  period: 50ms\n  phase", "  phase", 1, "loop", "write its period, or the intervals"),
    ("in_step: output", "in_step: loop", 13, "loop.starts", "goes with in_step: output"),
    ("starts: [64ms, 99ms]", "move: 1ms", 1, "loop.starts", "goes with in_step: output"),
    ("in_step: output", "in_step: maybe", 12, "loop.in_step", "'output' or 'loop'"),
    ("samples: 640", "samples: 0", 9, "loop.samples", "1"),
]


@pytest.mark.parametrize(
    "case",
    [*WRONG_VALUES, *WRONG_MODES, *WRONG_ADAPTATIONS, *WRONG_LOOPS],
    ids=lambda case: case[1].strip(),
)
def test_a_wrong_value_is_named(tmp_path: Path, case: tuple[str, str, int, str, str]) -> None:
    old, new, line, key, words = case
    text = ADAPTED if case in WRONG_ADAPTATIONS else GOOD
    if case in WRONG_MODES:
        text, line = WITH_MODES, line + WITH_MODES[: WITH_MODES.index("modes:")].count("\n")
    if case in WRONG_LOOPS:
        text, line = WITH_LOOP, line + GOOD.count("\n")
    assert old in text
    with pytest.raises(InputError) as caught:
        _load(tmp_path, text.replace(old, new, 1))
    problem = str(caught.value).splitlines()[-1]
    line += FILE.count("\n")
    assert problem.startswith(f"{tmp_path / 'plan.yaml'}:{line}: chains[0].{key}: ")
    assert words in problem


def test_a_loop_that_reads_the_output_is_part_of_the_plan(tmp_path: Path) -> None:
    plan = _load(tmp_path, WITH_LOOP)
    loop = plan.loop
    assert loop is not None
    assert (loop.period_ns, loop.stored_ns) == (50_000_000, (200_000, 599_999))
    assert loop_common_ns(plan) == 50_000_000
    assert loop.age.first_ns == (114_000_000, 114_080_000)
    assert _load(tmp_path, GOOD).loop is None
    two_slots = WITH_LOOP.replace("- [64000us, 0.065s]", "- [40ms, 41ms]\n      - [64ms, 65ms]")
    with pytest.raises(InputError, match=r"loop\.in_step: .* in one slot of the cycle"):
        _load(tmp_path, two_slots)
    irregular = WITH_LOOP.replace("period: 50ms", "intervals: [10ms, 20ms, 90ms]")
    for line in ("in_step: output", "starts: [64ms, 99ms]"):
        irregular = irregular.replace(f"  {line}\n", "")
    with pytest.raises(ValueError, match="no loop with a period"):
        loop_common_ns(_load(tmp_path, irregular))


def test_a_mode_publishes_in_a_slot_of_its_own(tmp_path: Path) -> None:
    bands = {"city": 2, "highway": 1}
    given = Modes(topic="/mode", default="city", bands=bands, late="next-slot")
    assert _load(tmp_path, WITH_MODES).modes == given
    shorter = _load(tmp_path, WITH_MODES.replace("  late: next-slot\n", "")).modes
    assert shorter == given.model_copy(update={"late": "wait"})
    start, end = WITH_MODES.index("shaping_node:"), WITH_MODES.index("predicted:")
    with pytest.raises(InputError, match=r"modes: only a shaping node knows the mode"):
        _load(tmp_path, WITH_MODES[:start] + WITH_MODES[end:])


def test_every_wrong_value_is_named_once(tmp_path: Path) -> None:
    text = GOOD.replace("cycle: 100ms", "cycel: 100ms").replace("[[0, 64ms]]", "[[0, 64]]")
    with pytest.raises(InputError) as caught:
        _load(tmp_path, text)
    named = [line.split(": ")[1] for line in str(caught.value).splitlines()]
    assert named == [f"chains[0].{key}" for key in ("cycle", "servers[0].slots[0][1]", "cycel")]


def test_overlap_is_judged_per_core_and_priority(tmp_path: Path) -> None:
    inside = GOOD.replace("[64000us, 0.065s]", "[30ms, 31ms]")
    assert publish_slots(_load(tmp_path, inside)) == ((30_000_000, 31_000_000),)
    same_core = inside.replace("core: 0", "core: 1")
    _load(tmp_path, same_core)  # the better priority pre-empts
    with pytest.raises(
        InputError, match=r":10: chains\[0\]\.servers\[1\]\.slots\[0\]: .* overlaps .*'chain'"
    ):
        _load(tmp_path, same_core.replace("priority: 1", "priority: 2"))
    touching = GOOD.replace("core: 0", "core: 1").replace("priority: 1", "priority: 2")
    _load(tmp_path, touching)  # half-open: [0, 64) and [64, 65) do not overlap
    second = "further_shaping_nodes:\n  - {name: other, input: /a, output: /t5, core: 0,"
    with pytest.raises(InputError, match="both must be its own"):
        _load(tmp_path, f"{GOOD}{second} fifo_priority: 84, spin: 0, pause: 0}}\n")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", ":1: the file is empty"),
        ("- 1\n- 2\n", ":1: expected a YAML mapping"),
        ("chain: {period: 1ms\n", ":2: not YAML"),
        ("chain: 1\n---\nchain: 2\n", ":2: not YAML"),
        ("a: &x [1]\nb: *x\n", "alias"),
        ("a: &x [*x]\n", "alias"),
        ("a: 1\nchain: \x00\n", ":2: not YAML: the character 0x0000 may not stand here"),
        ("[" * 2000, ":1: not YAML: more than 100 lists and mappings inside each other"),
        ("a:\n" + "".join(" " * n + "a:\n" for n in range(1, 2000)), ":101: not YAML"),
        ("a: &x [1, 1]\nb: &y [*x, *x]\nc: [*y, *y]\n", ":1: b[0]: refers to this by a YAML"),
        ("[1]: 2\n", ":1: the file: a key here is a list or mapping: write a text"),
        ("chain: !!int ''\n", ":1: chain: '' is no !!int: write the value without a tag"),
        ("chain: !!timestamp x\n", ":1: chain: 'x' is no !!timestamp"),
        ("chain: !!python/object:os.system x\n", ":1: chain: 'x' is no !!python/object"),
        (f"chain: {10**30}\n", ":1: chain: a number of more than 64 bits"),
        ("chain: 9" + "9" * 5000 + "\n", "chain"),
        ("chains:\n- chain: {period: 2020-01-01}\n", "'2020-01-01' is not a duration"),
    ],
)
def test_what_is_no_plan_at_all_is_refused(tmp_path: Path, text: str, words: str) -> None:
    file = tmp_path / "plan.yaml"
    file.write_text(text, encoding="utf-8")
    with pytest.raises(InputError) as caught:
        load_plan(file)
    assert words in str(caught.value)


def test_unreadable_files_are_refused(tmp_path: Path) -> None:
    (tmp_path / "latin").write_bytes(b"a: 1\nchain: \xff\xfe")
    for name, words in (
        ("absent.yaml", "cannot be read"),
        ("", "is a folder; wanted is a file"),
        ("latin", ":2: not a text in UTF-8"),
    ):
        with pytest.raises(InputError, match=words):
            load_plan(tmp_path / name)


def test_nothing_is_overwritten_unless_told_and_a_failed_write_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plan, target = _load(tmp_path, GOOD), tmp_path / "out.yaml"
    save_plan(Plan.of(plan), target)
    with pytest.raises(InputError, match="not overwritten"):
        save_plan(Plan.of(plan), target)
    save_plan(Plan.of(plan), target, overwrite=True)
    assert load_plan(target) == Plan.of(plan)
    with pytest.raises(InputError, match="no such folder"):
        save_plan(Plan.of(plan), tmp_path / "absent" / "plan.yaml")

    def full(_: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.fsync", full)
    with pytest.raises(OperationError, match="No space left"):
        save_plan(Plan.of(plan), tmp_path / "other.yaml")
    assert sorted(file.name for file in tmp_path.iterdir()) == ["out.yaml", "plan.yaml"]
    monkeypatch.undo()
    written = save_plans([plan, plan], tmp_path / "both")
    assert [file.name for file in written] == ["1_t5.yaml", "2_t5.yaml"]
    monkeypatch.setattr("os.fsync", full)
    with pytest.raises(OperationError, match="No space left"):
        save_plans([plan], tmp_path / "none")
    assert not (tmp_path / "none").exists()
    with pytest.raises(InputError, match="not overwritten"):
        save_plans([plan], tmp_path / "both")


NAMES = st.from_regex(r"(/[A-Za-z_][A-Za-z0-9_]{0,5}){1,3}", fullmatch=True)
SHARES = st.lists(st.floats(0, 1), max_size=4).map(tuple)


def modes(slots: int) -> st.SearchStrategy[Modes]:
    """Modes with names that YAML might take for something else, in any of the slots."""
    names = st.sampled_from(["city", "on", "no", "null", "e1", "_"])
    return st.builds(
        lambda bands, late: Modes(topic="/mode", default=min(bands), bands=bands, late=late),
        st.dictionaries(names, st.integers(1, slots), min_size=1),
        st.sampled_from(["wait", "discard", "publish", "next-slot"]),
    )


@st.composite
def plans(draw: st.DrawFn) -> ChainPlan:
    """Any plan the rules allow: times anywhere in 64 bits, names as ROS 2 permits them."""

    def some(**fields: st.SearchStrategy[Any]) -> dict[str, Any]:
        return draw(st.fixed_dictionaries({}, optional=fields))

    period = draw(st.integers(8, 2**62))
    low, mean, high = sorted(draw(st.lists(st.integers(1, period - 1), min_size=3, max_size=3)))
    bounds = sorted(draw(st.sets(st.integers(0, period), min_size=4, max_size=8)))
    slots = tuple(zip(bounds[::2], bounds[1::2], strict=False))
    output, times, any_bool = draw(NAMES), st.integers(0, 10**12), st.booleans()
    priority = draw(st.integers(1, 98))
    waits: dict[str, Any] = {"core": 0, "fifo_priority": priority}
    waits |= {"spin_ns": draw(times), "pause_ns": draw(times)}
    node = ShapingNode(name="gate", input=output + "_tmp", output=output, **waits)
    threads = {Thread(node=name) for name in draw(st.sets(NAMES, max_size=3))} - {node.thread}
    name = draw(st.text(min_size=1).filter(lambda name: name != "chain"))
    derived = Margin(epsilon_ns=7, source="derived", confidence_interval_ns=(3, 123_456_789))
    whole, own = ((0, period),), tuple(sorted(threads, key=lambda thread: thread.node))
    latencies: dict[str, Any] = {"min_latency_ns": low, "mean_latency_ns": mean}
    latencies |= {"max_latency_ns": high}
    known = some(
        recording=st.text(),
        realtime=any_bool,
        longest_stall_ns=times,
        utilisation=st.floats(0, 2),
        longest_send_ns=times,
        longest_publication_ns=times,
        all_disturbed=st.just(True),
    )
    chain = some(spec=st.text(), publisher=NAMES, output_depth=st.integers(1, 100))
    late, after = st.floats(1.1, 10), st.integers(1, 10**6)
    age = LoopAge(first_ns=(1, 2), every_ns=(1, 3), constant=draw(any_bool), uses=(0, 7))
    loop = PlannedLoop(
        node="/n",
        topic=output,
        period_ns=draw(st.integers(1, 2**62)),
        samples=3,
        delivery_ns=(1, 2, 3),
        lead_ns=draw(times),
        drift_ppm=draw(st.floats(-1e6, 1e6)),
        age=age,
        **some(thread=st.text(min_size=1), phase_ns=times, age_at_any_phase=st.just(age)),
    )
    return ChainPlan(
        chain=ChainOfPlan(output=output, period_ns=period, **chain),
        evidence=Evidence(samples=draw(st.integers(1, 10**12)), **latencies, **known),
        margin=draw(st.sampled_from([derived, Margin(epsilon_ns=draw(times))])),
        policy="shaped",
        cycle_ns=period,
        offset_ns=draw(st.integers(0, 3)),
        servers=(
            Server(name="chain", core=1, priority=2, slots=whole, threads=own),
            Server(name=name, core=0, priority=1, slots=slots, threads=(node.thread,)),
        ),
        shaping_node=node,
        predicted=Prediction(mean_ns=1, max_ns=high, jitter_ns=0, shares=draw(SHARES)),
        **some(
            anchor=st.sampled_from(["stamp", "cycle"]),
            overrun=st.sampled_from(["wait", "discard", "publish"]),
            into_open_slot=st.sampled_from(["at-once", "next-slot"]),
            fallback=st.sampled_from(["bypass", "silence"]),
            modes=modes(len(slots)),
            adaptation=st.builds(Adaptation, late=late, after=after),
            loop=st.just(loop),
        ),
    )


@settings(deadline=None, max_examples=40)  # it writes files, on whatever machine
@given(plans())
def test_what_is_dumped_is_loaded_equal(plan: ChainPlan) -> None:
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "plan.yaml"
        save_plan(Plan.of(plan), file)
        again = load_plan(file)
    assert again == Plan.of(plan)
    assert dump_plan(again) == dump_plan(Plan.of(plan))


def _load(folder: Path, text: str) -> ChainPlan:
    """The chain of a plan's file that has this text as its only chain."""
    file = folder / "plan.yaml"
    file.write_text(FILE + indent(text, "  ")[2:], encoding="utf-8")
    return load_plan(file).chains[0]
