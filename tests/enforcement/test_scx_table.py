"""The tables of the sched_ext policy: what they hold, and that both sides agree on the layout."""

import re
import shutil
import struct
import subprocess
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from chainshaper.enforcement.scx import back_end as scx_table
from chainshaper.enforcement.scx.back_end import (
    change_word,
    check_table,
    number_servers,
    pack_cores,
    pack_servers,
    unpack_counters,
    unpack_exit,
)
from chainshaper.enforcement.servers import ReservationServer, ServerCounters, ServerTable
from chainshaper.values.errors import InputError

ABI = Path(scx_table.__file__).with_name("policy") / "table_abi.h"
MS = 1_000_000


def server(
    name: str = "a", core: int = 0, priority: int = 1, *slots: tuple[int, int]
) -> ReservationServer:
    return ReservationServer(name, core, priority, slots or ((10 * MS, 20 * MS),))


def table(*servers: ReservationServer) -> ServerTable:
    return ServerTable(50 * MS, servers)


def test_the_layouts_are_those_that_a_c_compiler_makes_of_the_header(tmp_path: Path) -> None:
    compiler = shutil.which("cc")
    if compiler is None:
        pytest.skip("no C compiler to ask: apt install gcc")
    lines = [
        "sizeof(struct table_server)",
        "offsetof(struct table_server, slots)",
        "sizeof(struct table_slot)",
        "offsetof(struct table_server, cpu)",
        "sizeof(struct table_cpu)",
        "sizeof(struct table_counters)",
        "sizeof(struct table_exit)",
        "offsetof(struct table_exit, reason)",
        "offsetof(struct table_exit, message)",
        "sizeof(struct table_config)",
        "sizeof(struct table_wake)",
        "offsetof(struct table_wake, planning)",
    ]
    source = tmp_path / "layout.c"
    source.write_text(
        f'#include <stddef.h>\n#include <stdio.h>\n#include "{ABI}"\nint main(void)\n{{\n'
        + "".join(f'\tprintf("%zu\\n", (size_t){line});\n' for line in lines)
        + "\treturn 0;\n}\n"
    )
    program = tmp_path / "layout"
    subprocess.run([compiler, "-o", program, source], check=True)
    found = subprocess.run([program], check=True, capture_output=True, text=True).stdout.split()
    assert [int(number) for number in found] == [
        scx_table.SERVER.size + scx_table.MAX_SLOTS * scx_table.SLOT.size,
        scx_table.SERVER.size,
        scx_table.SLOT.size,
        24,
        scx_table.CORE.size,
        scx_table.COUNTERS.size,
        scx_table.EXIT.size,
        16,
        80,
        scx_table.CONFIG.size,
        scx_table.WAKE.size,
        scx_table.INSTANT.size,
    ]


def test_the_limits_are_those_of_the_header() -> None:
    text = ABI.read_text()
    for name, value in {
        "TABLE_MAX_SERVERS": scx_table.MAX_SERVERS,
        "TABLE_MAX_SLOTS": scx_table.MAX_SLOTS,
        "TABLE_MAX_SERVERS_PER_CPU": scx_table.MAX_SERVERS_PER_CORE,
        "TABLE_MAX_CPUS": scx_table.MAX_CORES,
    }.items():
        assert re.search(rf"#define {name} (\d+)", text)[1] == str(value)  # type: ignore[index]


def test_a_server_is_packed_field_by_field() -> None:
    value = pack_servers(
        table(server("a", 3, 7, (1 * MS, 2 * MS), (4 * MS, 6 * MS))), {"a": 5}, 123
    )[5]
    head = struct.unpack_from("<QQQIIII", value)
    assert head == (50 * MS, 123, scx_table.ROTATION_NS, 3, 7, 2, 0)
    assert struct.unpack_from("<QQQQ", value, 40) == (1 * MS, 2 * MS, 4 * MS, 6 * MS)
    assert not any(value[72:])


def test_every_id_is_written_so_that_nothing_of_an_older_table_stays() -> None:
    packed = pack_servers(table(server("a")), {"a": 1, "gone": 2}, 0)
    assert sorted(packed) == list(range(scx_table.MAX_SERVERS))
    assert not any(packed[2])


def test_servers_of_a_core_stand_best_first_and_equals_in_the_order_of_the_table() -> None:
    servers = table(
        server("worst", 0, 9), server("b", 0, 2), server("c", 0, 2), server("x", 1), server("a", 0)
    )
    ids = number_servers(servers, {})
    packed = pack_cores(servers, ids, 2)
    names = {number: name for name, number in ids.items()}
    count, *numbers = struct.unpack("<33I", packed[0])
    assert [names[number] for number in numbers[:count]] == ["a", "b", "c", "worst"]
    assert not any(numbers[count:])
    assert struct.unpack_from("<II", packed[1]) == (1, ids["x"])


def test_a_server_keeps_its_id_when_the_table_changes() -> None:
    first = number_servers(table(server("a"), server("b")), {})
    second = number_servers(table(server("c"), server("b")), first)
    assert second == {"a": 1, "b": 2, "c": 3}


def test_ids_run_out_with_a_message() -> None:
    known = {f"s{number}": number for number in range(1, 128)}
    assert number_servers(table(server("s1")), known) == known
    with pytest.raises(InputError, match="release it and start again"):
        number_servers(table(server("another")), known)


@given(st.integers(0, 1), st.integers(0, 2**61 - 1), st.booleans(), st.integers(-(2**40), 2**40))
def test_one_word_says_which_generation_holds_at_each_instant(
    generation: int, instant: int, replaces: bool, offset: int
) -> None:
    word = int.from_bytes(change_word(generation, instant, replaces=replaces), "little")
    now = instant + offset
    # as the policy reads it
    in_force = word & 1 if now >= word >> 2 else 1 - (word & 1)
    assert in_force == (generation if offset >= 0 else 1 - generation)
    assert bool(word & 2) == replaces


def test_counters_and_the_reason_of_the_end_are_read_back() -> None:
    assert unpack_counters(struct.pack("<6Q", 5, 1, 123456, 2, 99, 98)) == ServerCounters(
        5, 1, 123456, 2
    )
    ended = unpack_exit(struct.pack("<iiq64s192s", 1026, 0, 0, b"stall", b"late\0rest"))
    assert ended == "stall: late"
    assert unpack_exit(bytes(272)) is None


def test_a_full_table_is_accepted() -> None:
    slots = tuple((k * 1000, k * 1000 + 1000) for k in range(64))
    servers = [ReservationServer(f"s{k}", k % 4, k, slots) for k in range(127)]
    check_table(ServerTable(64_000, tuple(servers)))


@pytest.mark.parametrize(
    ("wrong", "reason"),
    [
        (table(*(server(f"s{k}", k) for k in range(128))), "128 servers are more than the 127"),
        (table(*(server(f"s{k}", 3) for k in range(33))), "33 servers on core 3 are more than"),
        (table(server("a", 512)), "core 512; back end scx knows 0 to 511"),
        (table(ReservationServer("a", 0, 1, ())), "0 slots; back end scx takes 1 to 64"),
        (table(server("a", 0, 1, *((k, k + 1) for k in range(65)))), "has 65 slots"),
    ],
)
def test_a_wrong_table_is_refused_with_its_reason(wrong: ServerTable, reason: str) -> None:
    with pytest.raises(InputError, match=reason):
        check_table(wrong)
