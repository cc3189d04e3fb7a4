"""The log of a shaping node becomes the table that every other source has."""

from pathlib import Path

import polars as pl
import pytest

from chainshaper import events
from chainshaper.errors import InputError
from chainshaper.splicing.gate_log import read_gate_log

HEADER = (
    "time,pid,tid,cpu,source_timestamp,arrival,origin,release,slot,cycles_waited,anchor,overrun,"
    "mode,published\n"
)
LATE = "2000,7,8,1,1700000000000000001,1900,1000,,,0,stamp,discard,city,\n"
EARLY = "1060,7,8,1,,1010,1000,1060,2,0,cycle,,,1071\n"


def test_each_line_is_a_row_of_gate_release(tmp_path: Path) -> None:
    log = tmp_path / "gate.csv"
    log.write_text(HEADER + LATE + EARLY)
    table = read_gate_log(log)
    assert dict(table.schema) == {
        **events.COMMON_COLUMNS,
        **events.FIELDS["gate_release"],
        **events.OPTIONAL_FIELDS["gate_release"],
    }
    early, late = table.rows(named=True)
    assert (early["time"], early["release"], early["slot"], early["published"]) == (
        *(1060, 1060, 2),
        1071,
    )
    assert (early["overrun"], early["mode"], early["source_timestamp"]) == (None, None, None)
    assert late["source_timestamp"] == 1_700_000_000_000_000_001
    assert (late["release"], late["slot"], late["overrun"], late["mode"]) == (
        *(None, None),
        *("discard", "city"),
    )
    assert table["callback"].null_count() == 2


def test_a_line_that_was_cut_off_is_left_out(tmp_path: Path) -> None:
    log = tmp_path / "gate.csv"
    log.write_text(HEADER + EARLY + LATE[:20])
    assert read_gate_log(log)["time"].to_list() == [1060]


def test_a_log_without_messages_is_an_empty_table(tmp_path: Path) -> None:
    log = tmp_path / "gate.csv"
    log.write_text(HEADER)
    assert read_gate_log(log).height == 0


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "gate.csv:1: this is not the log of a shaping node"),
        ("a,b\n1,2\n", "gate.csv:1: this is not the log of a shaping node"),
        (HEADER + EARLY.replace("1060", "soon"), "a line is not as a shaping node writes it"),
    ],
)
def test_what_is_no_log_is_refused(tmp_path: Path, text: str, words: str) -> None:
    log = tmp_path / "gate.csv"
    log.write_text(text)
    with pytest.raises(InputError) as caught:
        read_gate_log(log)
    assert words in str(caught.value)


def test_a_missing_log_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"gate\.csv: cannot be read: No such file"):
        read_gate_log(tmp_path / "gate.csv")


def test_a_table_of_it_can_stand_beside_another_source(tmp_path: Path) -> None:
    log = tmp_path / "gate.csv"
    log.write_text(HEADER + EARLY)
    both = pl.concat([events.empty("gate_release"), read_gate_log(log)], how="diagonal")
    assert both.height == 1
