"""The log of a shaping node becomes the table that every other source has."""

from pathlib import Path

import polars as pl
import pytest

from chainshaper.gate.decision import LOG_COLUMNS
from chainshaper.sources.gate_log import read_gate_log, with_gate_logs
from chainshaper.values import events
from chainshaper.values.errors import InputError

HEADER = (
    "time,pid,tid,cpu,source_timestamp,arrival,origin,release,slot,cycles_waited,anchor,overrun,"
    "mode,published,stalled\n"
)
LATE = "2000,7,8,1,1700000000000000001,1900,1000,,,0,stamp,discard,city,,\n"
EARLY = "1060,7,8,1,,1010,1000,1060,2,0,cycle,,,1071,0\n"


def test_each_line_is_a_row_of_gate_release(tmp_path: Path) -> None:
    log = tmp_path / "gate.csv"
    log.write_text(HEADER + LATE + EARLY)
    table = read_gate_log(log)
    assert dict(table.schema) == {
        **events.COMMON_COLUMNS,
        **events.FIELDS["gate_release"],
        **events.OPTIONAL_FIELDS["gate_release"],
    }
    assert set(table.columns) == {*LOG_COLUMNS, "callback"}
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


def test_only_cycles_of_the_recording_itself_count(tmp_path: Path) -> None:
    """The node was there before the plan was in force, and goes on when tracing has ended."""
    log, gone = tmp_path / "gate.csv", tmp_path / "gone.csv"
    cycles = [
        (f"{cycle + 60},7,8,1,,{cycle + 10},{cycle},{cycle + 60},2,0,cycle,,,,\n")
        for cycle in range(1000, 1500, 100)
    ]
    log.write_text(HEADER + "".join(cycles))
    tables, missing = with_gate_logs({}, [log, gone], since_ns=1050, until_ns=1360)
    assert tables["gate_release"]["origin"].to_list() == [1100, 1200]
    (note,) = missing
    assert f"{gone} is not there" in note


def test_stalls_that_a_gate_saw_are_the_machines(tmp_path: Path) -> None:
    """It watches the clock at its release: what comes between is no thread's, but the machine's."""
    log = tmp_path / "gate.csv"
    late = "1200060,7,8,1,,1010,1000,1000060,2,0,cycle,,,1200071,200000\n"
    log.write_text(HEADER + EARLY + late)
    seen = events.empty("machine_stall").vstack(
        pl.DataFrame(
            {"time": 500, "pid": 3, "tid": 3, "cpu": 0, "duration": 150_000},
            schema=events.empty("machine_stall").schema,
        )
    )
    tables, _ = with_gate_logs({"machine_stall": seen}, [log], since_ns=0, until_ns=2_000_000)
    stalls = tables["machine_stall"].select("time", "cpu", "duration").rows()
    assert stalls == [(500, 0, 150_000), (1_000_060, 1, 200_000)]
