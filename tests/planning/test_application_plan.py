"""Plans of several chains: the file, the rules, and servers played out against brute force."""

import math
from collections.abc import Iterator
from pathlib import Path

import pytest
from bare_plans import MS, bare_plan
from hypothesis import given, settings
from hypothesis import strategies as st

from chainshaper import load_plan, save_plan
from chainshaper.flow.server_tables import server_table
from chainshaper.planning.chain_plan import ChainPlan, Server, Slot, Thread, revised
from chainshaper.planning.plan import Plan, plan_of_chain
from chainshaper.planning.plan_file import dump_plan, plan_in, plan_values
from chainshaper.values.errors import InputError


def _server(
    name: str, slots: list[Slot], threads: str = "", core: int = 1, priority: int = 2
) -> Server:
    in_ns = tuple((start * MS, end * MS) for start, end in slots)
    own = tuple(Thread(node=f"/{thread}") for thread in threads.split())
    return Server(name=name, core=core, priority=priority, slots=in_ns, threads=own)


def _chain(name: str, cycle: int, offset: int, *servers: Server) -> ChainPlan:
    """A chain's plan; times in ms."""
    named = f"/{name}"
    return bare_plan(f"{named}..", cycle * MS, *servers, output=named, offset_ns=offset * MS)


def test_a_thread_of_several_chains_runs_in_the_slots_of_all() -> None:
    """By hand: x runs at 0–1, 4–5, 8–9 for a, and at 1–2, 7–8 for b; what touches is one slot."""
    a = _chain("a", 4, 0, _server("a", [(0, 1)], "x"))
    b = _chain("b", 6, 1, _server("b", [(0, 1)], "x y"))
    shared, own = Plan.of(a, b).servers
    assert (shared.name, [thread.node for thread in shared.threads]) == ("a+b", ["/x"])
    assert shared.slots == _server("by hand", [(0, 2), (4, 5), (7, 9)]).slots
    assert (own.name, [thread.node for thread in own.threads]) == ("b", ["/y"])
    assert own.slots == _server("by hand", [(1, 2), (7, 8)]).slots
    assert Plan.of(a).servers == a.servers


_SLOTS = st.lists(st.integers(0, 5), min_size=2, max_size=4, unique=True).map(sorted)


@st.composite
def _chains(draw: st.DrawFn) -> list[ChainPlan]:
    found = []
    for number in range(draw(st.integers(1, 3))):
        cycle = draw(st.sampled_from([6, 8, 9, 12]))
        bounds = draw(_SLOTS)
        slots = list(zip(bounds[::2], bounds[1::2], strict=False))
        core, priority = draw(st.sampled_from([(0, 1), (1, 1), (1, 2)]))
        server = _server(f"s{number}", slots, f"n{number}", core, priority)
        found.append(_chain(f"c{number}", cycle, draw(st.integers(0, 11)), server))
    return found


def _marked(chain: ChainPlan, hyper_period: int) -> Iterator[int]:
    """Every millisecond of the hyper-period in which the chain's server is open, by looking."""
    (server,) = chain.servers
    for instant in range(hyper_period):
        place = (instant * MS - chain.offset_ns) % chain.cycle_ns
        if any(start <= place < end for start, end in server.slots):
            yield instant


@settings(max_examples=300, deadline=None)
@given(_chains())
def test_slots_and_collisions_are_those_of_a_timeline(chains: list[ChainPlan]) -> None:
    hyper_period = math.lcm(*(chain.cycle_ns // MS for chain in chains))
    open_at = [set(_marked(chain, hyper_period)) for chain in chains]
    where = [(chain.servers[0].core, chain.servers[0].priority) for chain in chains]
    collide = any(
        where[j] == where[k] and open_at[j] & open_at[k]
        for k in range(len(chains))
        for j in range(k)
    )
    if collide:
        with pytest.raises(InputError, match=r"meets .* of server '.*' of /c\d\.\. in some cycles"):
            Plan.of(*chains)
        return
    for server, expected in zip(Plan.of(*chains).servers, open_at, strict=True):
        found = [n for a, b in server.slots for n in range(a // MS, b // MS)]
        assert found == sorted(expected)


@pytest.fixture
def three() -> Plan:
    """Two branches of a graph that share a server, and a chain of 50 ms that takes turns."""
    running = _server("chain", [(0, 20)], "first second")
    branches = [
        _chain(name, 100, 0, running, _server(f"out_{name}", [slot], f"gate_{name}", priority=1))
        for name, slot in (("a", (20, 21)), ("b", (21, 22)))
    ]
    return Plan.of(*branches, _chain("c", 50, 20, _server("chain_2", [(0, 10)], "third")))


def test_a_plan_is_written_with_each_server_once_and_read_again(
    three: Plan, tmp_path: Path
) -> None:
    path, alone = tmp_path / "plan.yaml", tmp_path / "alone.yaml"
    save_plan(three, path)
    text = path.read_text()
    assert text.count("name: chain\n") == 1
    assert "servers:\n  - chain\n" in text
    assert load_plan(path) == three
    assert plan_in(plan_values(three)) == three
    assert [one.name for one in three.servers] == ["chain", "out_a", "out_b", "chain_2"]
    assert plan_of_chain(three, "/b") == three.chains[1]
    assert plan_of_chain(three, "/nowhere") is None
    # A plan of one chain is written in the same form.
    of_one = Plan.of(three.chains[2])
    save_plan(of_one, alone)
    assert alone.read_text() == dump_plan(of_one)
    assert "format: 2\nchains:\n- chain:" in alone.read_text()
    assert load_plan(alone) == plan_in(plan_values(of_one)) == of_one


def test_threads_have_the_plans_order_unless_single_callbacks_were_measured(
    three: Plan,
) -> None:
    assert three.most_urgent_first == ("/first", "/second", "/gate_a", "/gate_b", "/third")
    assert [one.places for one in server_table(three).servers] == [2, 1, 1, 1]
    stages = Plan.of(revised(three.chains[0], policy="pipelined"))
    assert stages.most_urgent_first == ("/gate_a", "/second", "/first"), "the older first"
    single = Plan.of(revised(three.chains[0], policy="let-per-callback"))
    assert single.most_urgent_first == ("/first",)
    assert [one.places for one in server_table(single).servers] == [2, 1], "the others share one"
    turns = Plan.of(revised(three.chains[0], equal_priorities="round-robin"))
    assert turns.most_urgent_first == ()


@pytest.mark.parametrize(
    ("old", "new", "reason"),
    [
        ("  - chain\n", "  - chian\n", "no chain before this one has a server 'chian'"),
        ("output: /b", "output: /a", "/a is the output of an earlier chain too"),
        ("name: out_b", "name: out_a", "an earlier chain has another server 'out_a': rename one"),
        ("offset: 20ms", "offset: 15ms", "'chain_2' meets [0 ms, 20 ms) of server 'chain' of /a.."),
        # 100 and 50 ms meet modulo 50: where c begins 65 ms late it runs 15 ms late as well.
        ("offset: 20ms", "offset: 65ms", "'chain_2' meets [0 ms, 20 ms) of server 'chain' of /a.."),
        ("offset: 20ms", "ofset: 20ms", "offset"),
        ("  - chain\n", "  - {name: chain}\n", "slots"),
        ("  - chain\n", "  - {name: {a: b}}\n", "what stands here is not a text"),
        ("  - chain\n", "  - [{a: b}]\n", "what stands here is not a mapping of keys"),
    ],
)
def test_what_was_edited_wrongly_is_named_with_its_line(
    old: str, new: str, reason: str, three: Plan, tmp_path: Path
) -> None:
    path, text = tmp_path / "plan.yaml", dump_plan(three)
    assert old in text
    path.write_text(text.replace(old, new))
    lines = enumerate(path.read_text().splitlines(), start=1)
    number = max(number for number, line in lines if new.strip() in line)
    with pytest.raises(InputError) as refused:
        load_plan(path)
    assert str(refused.value).startswith(f"{path}:{number}: ")
    assert reason in str(refused.value)


def test_what_makes_no_plan_together_is_refused() -> None:
    shared = _chain("a", 10, 0, _server("s", [(0, 1)], "x"))
    # 997, 1009 and 1013 ms have no common divisor: together they repeat after eleven days.
    cycles = enumerate((("a", 997), ("b", 1009), ("c", 1013)))
    apart = [_chain(n, ms, 0, _server(n, [(0, 1)], n, core=core)) for core, (n, ms) in cycles]
    for chains, words in (
        ([shared, _chain("b", 10, 1, *shared.servers)], "cycles have another length or offset"),
        (
            [shared, _chain("b", 10, 0, _server("t", [(0, 1)], "x", core=2))],
            "of /x would run on core 2 here and on core 1",
        ),
        (apart, r"repeat together after .* 10000 is the most"),
    ):
        with pytest.raises(InputError, match=words):
            Plan.of(*chains)
    assert len(Plan.of(*apart[:2]).servers[0].slots) == 1009
