"""The log of a shaping node becomes the table that every other source has."""

from pathlib import Path

import polars as pl
import pytest

from chainshaper.robot.gate_log import LOG_COLUMNS
from chainshaper.sources.gate_log import read_gate_log, with_gate_logs
from chainshaper.values import events
from chainshaper.values.errors import InputError

HEADER = (
    "time,pid,tid,cpu,source_timestamp,arrival,origin,release,slot,cycles_waited,anchor,overrun,"
    "mode,published,stalled\n"
)
LATE = "2000,7,8,1,1700000000000000001,1900,1000,,,0,stamp,discard,city,,\n"
EARLY = "1060,7,8,1,,1010,1000,1060,2,0,cycle,,,1071,0\n"


@pytest.fixture
def log(tmp_path: Path) -> Path:
    return tmp_path / "gate.csv"


def test_each_line_is_a_row_of_gate_release(log: Path) -> None:
    log.write_text(HEADER + LATE + EARLY + LATE[:20])  # the last one was cut off
    table = read_gate_log(log)
    assert dict(table.schema) == {
        **events.COMMON_COLUMNS,
        **events.FIELDS["gate_release"],
        **events.OPTIONAL_FIELDS["gate_release"],
    }
    assert set(table.columns) == {*LOG_COLUMNS, "callback", "gate"}
    assert set(table["gate"]) == {"gate"}
    shown = ("time", "release", "slot", "published", "overrun", "mode", "source_timestamp")
    assert table.select(shown).rows() == [
        (1060, 1060, 2, 1071, None, None, None),
        (2000, None, None, None, "discard", "city", 1_700_000_000_000_000_001),
    ]
    assert table["callback"].null_count() == 2
    assert pl.concat([events.empty("gate_release"), table], how="diagonal").height == 2
    log.write_text(HEADER)
    assert read_gate_log(log).height == 0


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (None, r"gate\.csv: cannot be read: No such file"),
        ("", "gate.csv:1: this is not the log of a shaping node"),
        ("a,b\n1,2\n", "gate.csv:1: this is not the log of a shaping node"),
        (HEADER + EARLY.replace("1060", "soon"), "a line is not as a shaping node writes it"),
    ],
)
def test_what_is_no_log_is_refused(log: Path, text: str | None, words: str) -> None:
    if text is not None:
        log.write_text(text)
    with pytest.raises(InputError, match=words):
        read_gate_log(log)


def test_only_cycles_of_the_recording_itself_count_and_absent_logs_are_named(log: Path) -> None:
    """The node was there before the plan was in force, and goes on when tracing has ended."""
    gone, empty = log.with_name("gone.csv"), log.with_name("empty.csv")
    empty.touch()  # as a full disk leaves it
    log.with_name("gate.csv.1").touch()
    cycles = (
        f"{cycle + 60},7,8,1,,{cycle + 10},{cycle},{cycle + 60},2,0,cycle,,,,\n"
        for cycle in range(1000, 1500, 100)
    )
    log.write_text(HEADER + "".join(cycles))
    tables, notes = with_gate_logs({}, [log, gone, empty], since_ns=1050, until_ns=1360)
    assert tables["gate_release"]["origin"].to_list() == [1100, 1200]
    for absent, note in zip((gone, empty), notes, strict=True):
        assert f"{absent} is not there: it has let nothing through" in note


def test_stalls_that_a_gate_saw_are_the_machines(log: Path) -> None:
    """It watches the clock at its release: what comes between is no thread's, but the machine's."""
    late = "1200060,7,8,1,,1010,1000,1000060,2,0,cycle,,,1200071,200000\n"
    log.write_text(HEADER + EARLY + late)
    row = {"time": 500, "pid": 3, "tid": 3, "cpu": 0, "duration": 150_000}
    seen = pl.DataFrame([row], schema=events.empty("machine_stall").schema)
    tables, _ = with_gate_logs({"machine_stall": seen}, [log], since_ns=0, until_ns=2_000_000)
    stalls = tables["machine_stall"].select("time", "cpu", "duration").rows()
    assert stalls == [(500, 0, 150_000), (1_000_060, 1, 200_000)]


def test_gates_of_one_process_count_their_rows_for_themselves(tmp_path: Path) -> None:
    """Rows 1 to 3 of the one; of the other 2 was not written: one is missing, and no more."""
    logs = [tmp_path / "one.csv", tmp_path / "two.csv"]
    for log, numbers in zip(logs, ((1, 2, 3), (1, 3)), strict=True):
        rows = (EARLY.replace("1060,7", f"{1060 + n},7", 1)[:-1] + f",{n}\n" for n in numbers)
        log.write_text(HEADER[:-1] + ",row\n" + "".join(rows))
    tables, notes = with_gate_logs({}, logs, since_ns=0, until_ns=2000)
    assert tables["gate_release"].group_by("gate").len().sort("gate").rows() == [
        ("one", 3),
        ("two", 2),
    ]
    (note,) = notes
    assert note.startswith("1 rows of shaping nodes' logs could not be written")


@pytest.mark.parametrize("again", ["link", "same file", "copy"])
def test_a_log_and_its_older_part_that_are_one_file_count_once(log: Path, again: str) -> None:
    log.write_text(HEADER + LATE + EARLY)
    before = log.with_name("gate.csv.1")
    if again == "link":
        before.symlink_to(log)
    elif again == "same file":
        before.hardlink_to(log)
    else:
        before.write_text(log.read_text())
    assert read_gate_log(log).height == 2
    tables, _ = with_gate_logs({}, [log, log], 0, 10_000)
    assert tables["gate_release"].height == 2
