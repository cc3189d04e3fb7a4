"""A recording on disk: whole or not there."""

import json
import os
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path

import polars as pl
import pytest

from chainshaper.flow.exploration import convert_recording
from chainshaper.reporting.overviews import contents_json
from chainshaper.values import events
from chainshaper.values.errors import InputError, OperationError
from chainshaper.values.files import write_whole
from chainshaper.values.recording import (
    RecordingInfo,
    StallMeterInfo,
    ThreadInfo,
    open_recording,
    refuse_existing,
    write_recording,
)

INFO = RecordingInfo(
    source="live",
    clock_offset_ns=1_700_000_000_000_000_000,
    command=("chainshaper", "run", "ä b"),
    processes={17: "/node1"},
    threads=(ThreadInfo(tid=17, pid=17, comm="node1", node="/node1", role="executor",
                        policy="SCHED_FIFO", priority=80, cores=(1,)),),
    realtime=True,
    notes=("a note",),
    lost={"ring buffer": 3},
    stall_meter=StallMeterInfo(cores=(0, 1), period_ns=1, threshold_ns=2, wakeups=3,
                               median_lateness_ns=(4, 5), realtime=True),
    chain="/t1../t5",
    application={"name": "x"},
)  # fmt: skip


def _tables() -> dict[str, pl.DataFrame]:
    row = {"time": [20, 10], "pid": [1, 1], "tid": [1, 1], "cpu": [None, 0], "callback": [7, 8]}
    return {
        "callback_end": pl.DataFrame(row, schema=events.empty("callback_end").schema),
        "machine_stall": events.empty("machine_stall"),
    }


def _names(folder: Path) -> list[str]:
    """What is in a folder, hidden things as well."""
    return sorted(entry.name for entry in folder.iterdir())


def test_what_is_written_is_read_back(tmp_path: Path) -> None:
    written = write_recording(tmp_path / "rec", _tables(), INFO)
    for recording in (written, open_recording(tmp_path / "rec")):
        assert recording.info.model_copy(update={"checksums": None}) == INFO
        assert sorted(recording.info.checksums or {}) == [
            "callback_end.parquet",
            "machine_stall.parquet",
        ]
        assert sorted(recording.events) == ["callback_end", "machine_stall"]
        assert len(recording.events) == 2
        assert recording.events["callback_end"]["time"].to_list() == [10, 20], "sorted by time"
        for name in recording.events:
            assert recording.events[name].schema == events.empty(name).schema
        with pytest.raises(KeyError):
            _ = recording.events["rmw_take"]
    assert (tmp_path / "rec").stat().st_mode & 0o777 == 0o755, "others may read it"


@pytest.fixture
def whole(tmp_path: Path) -> Path:
    return write_recording(tmp_path / "rec", _tables(), INFO).path


def _refused(path: Path, table: str | None = None) -> str:
    """The one line that opening a recording, or reading a table of it, ends with."""
    with pytest.raises(InputError) as refused:
        recording = open_recording(path)
        if table is not None:
            _ = recording.events[table]
    assert "\n" not in str(refused.value)
    return str(refused.value)


def test_nothing_of_the_users_is_overwritten(tmp_path: Path) -> None:
    folder = tmp_path / "thesis"
    folder.mkdir()
    (folder / "chapter1.tex").write_text("years of work")
    for path in (folder, folder / "chapter1.tex"):
        with pytest.raises(InputError, match="exists already and is not overwritten: name another"):
            write_recording(path, _tables(), INFO)
    assert (folder / "chapter1.tex").read_text() == "years of work"


def test_places_that_cannot_take_a_folder_are_refused_before(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(InputError, match=f"{tmp_path / 'no'}: no such folder to write rec into"):
        refuse_existing(tmp_path / "no" / "rec")
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError, match="name one inside it"):
        refuse_existing(".")
    assert refuse_existing("rec") == Path("rec")
    (tmp_path / "rec").mkdir()
    assert len(write_recording("rec", _tables(), INFO).events) == 2, "an empty folder is filled"


def test_a_folder_without_permission_is_refused_before() -> None:
    """Root may write anywhere: a test that runs as root becomes another user meanwhile."""
    with tempfile.TemporaryDirectory() as folder:
        Path(folder).chmod(0o555)
        if as_root := os.geteuid() == 0:
            os.setresuid(65534, 65534, 0)
        try:
            with pytest.raises(InputError, match=f"{folder}: no permission to write rec into it"):
                refuse_existing(Path(folder) / "rec")
        finally:
            if as_root:
                os.setresuid(0, 0, 0)


def test_the_mount_point_of_a_disk_is_refused_before(full_disk: Path) -> None:
    (full_disk / "filling").unlink()
    with pytest.raises(InputError, match=f"{full_disk} cannot be replaced.*name one inside it"):
        refuse_existing(full_disk)


def test_a_full_disk_leaves_nothing_that_looks_whole(full_disk: Path) -> None:
    path = full_disk / "rec"
    with pytest.raises(OperationError, match=f"{path}: the recording cannot be written.*No space"):
        write_recording(path, _tables(), INFO)
    assert _names(full_disk) == ["filling"], "no recording, and no hidden part of one"


class _Breaks(pl.DataFrame):
    """A table that cannot be written: a disk fails half-way, or somebody presses Ctrl-C."""

    error: BaseException

    def write_parquet(self, *_: object, **__: object) -> None:
        raise self.error


@pytest.mark.parametrize("there", [False, True], ids=["no folder", "an empty folder"])
@pytest.mark.parametrize(
    ("error", "raised", "said"),
    [
        (OSError(5, "Input/output error"), OperationError, "Input/output error"),
        (KeyboardInterrupt(), KeyboardInterrupt, None),
    ],
)
def test_a_table_that_cannot_be_written_leaves_nothing(
    tmp_path: Path, error: BaseException, raised: type[BaseException], said: str | None, there: bool
) -> None:
    path = tmp_path / "rec"
    if there:
        path.mkdir()
    table = _Breaks()
    table.error = error
    with pytest.raises(raised, match=said):
        write_recording(path, {**_tables(), "rmw_take": table}, INFO)
    assert _names(tmp_path) == ["rec"] * there
    assert not there or _names(path) == []


def test_what_is_no_recording_is_said_to_be_none(tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    (tmp_path / "file").touch()
    made = "a recording is made with `chainshaper run"
    assert f"a folder without recording.json; {made}" in _refused(tmp_path / "empty")
    assert f"no such folder; {made}" in _refused(tmp_path / "nothing")
    assert made in _refused(tmp_path / "file")


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"", "not readable as JSON"),
        (b'{"format": 1,', "not readable as JSON"),
        (b"\x80\x81", "not readable as JSON"),
        (b"[" * 100_000, "not readable as JSON"),
        (b"[]", "not a recording's description: the file"),
        (b'{"format": 1}', "source: is missing"),
        (b'{"source": "live", "clock_offset_ns": "soon"}', "clock_offset_ns: "),
        # Whatever else it holds.
        (b'{"format": 2, "origin": "live", "clocks": []}', "reads format 1; update it"),
    ],
)
def test_an_unreadable_description_is_named(whole: Path, content: bytes, said: str) -> None:
    (whole / "recording.json").write_bytes(content)
    text = _refused(whole)
    assert text.startswith(f"{whole / 'recording.json'}: ")
    assert said in text


@pytest.mark.parametrize("share", [0.0, 0.5, 0.99])
def test_a_cut_off_table_is_named_when_it_is_opened(whole: Path, share: float) -> None:
    file = whole / "callback_end.parquet"
    content = file.read_bytes()
    file.write_bytes(content[: int(len(content) * share)])
    assert _refused(whole).startswith(f"{file}: not a readable event table")


def test_a_table_that_is_no_events_or_vanishes_is_named(whole: Path) -> None:
    recording = open_recording(whole)
    pl.DataFrame({"a": [1]}).write_parquet(whole / "mine.parquet")
    assert "mine.parquet: an event table needs a column `time`" in _refused(whole, "mine")
    shutil.rmtree(whole)
    with pytest.raises(InputError, match=r"callback_end.parquet: not a readable event table"):
        _ = recording.events["callback_end"]


def test_every_flipped_bit_is_noticed(whole: Path) -> None:
    file = whole / "callback_end.parquet"
    content = file.read_bytes()
    for place in range(0, len(content), 21):
        damaged = bytearray(content)
        damaged[place] ^= 1 << place % 8
        file.write_bytes(damaged)
        assert _refused(whole, "callback_end").startswith(f"{file}: "), place


def test_a_table_of_several_parts_has_a_checksum_for_each(tmp_path: Path) -> None:
    path = write_recording(tmp_path / "rec", [_tables(), _tables(), _tables()], INFO).path
    recording = open_recording(path)
    assert recording.events["callback_end"]["time"].to_list() == [10, 10, 10, 20, 20, 20]
    parts = sorted((path / "callback_end.parquet").iterdir())
    assert {str(part.relative_to(path)) for part in parts} < set(recording.info.checksums or {})
    parts[1].write_bytes(parts[0].read_bytes().replace(b"Polars", b"Qolars"))
    assert f"{parts[1]}: damaged: its checksum is crc32:" in _refused(path, "callback_end")
    parts[2].unlink()
    assert f"{parts[2]}: no such file, but recording.json names it" in _refused(path)


def _without_checksums(whole: Path) -> Path:
    file = whole / "recording.json"
    values = json.loads(file.read_text())
    del values["checksums"]
    file.write_text(json.dumps(values))
    return whole / "callback_end.parquet"


def test_a_recording_from_before_there_were_checksums_is_read(whole: Path) -> None:
    _without_checksums(whole)
    recording = open_recording(whole)
    assert recording.info == INFO
    assert recording.events["callback_end"]["callback"].to_list() == [8, 7]
    said = "this recording has no checksums"
    assert any(said in note for note in contents_json(recording)["notes"])
    converted = convert_recording(recording, whole.parent / "converted")
    assert not any(said in note for note in contents_json(converted)["notes"])


@pytest.mark.parametrize(
    ("column", "said"),
    [
        (None, "an event table needs a column `callback`, this one has none"),
        (pl.lit("x"), "column `callback` has values of type String, not UInt64"),
        (pl.lit(1.5), "column `callback` has values of type Float64, not UInt64"),
        (pl.lit([1]), "column `callback` has values of type List"),
        (pl.lit(-1), "not a readable event table (conversion from `i32` to `u64` failed"),
    ],
)
def test_columns_that_are_not_the_events_are_named(
    whole: Path, column: pl.Expr | None, said: str
) -> None:
    file = _without_checksums(whole)
    frame = pl.read_parquet(file)
    changed = frame.drop("callback") if column is None else frame.with_columns(callback=column)
    changed.write_parquet(file)
    text = _refused(whole, "callback_end")
    assert text.startswith(f"{file}: ")
    assert said in text


def test_integers_of_another_width_and_tables_without_cores_are_taken(whole: Path) -> None:
    file = _without_checksums(whole)
    frame = pl.read_parquet(file).with_columns(pl.col("callback", "pid").cast(pl.Int64))
    frame.drop("cpu").write_parquet(file)
    found = open_recording(whole).events["callback_end"]
    assert {**found.schema} == {**events.empty("callback_end").schema}


def test_rows_that_no_file_of_this_size_has_are_refused(whole: Path) -> None:
    file = _without_checksums(whole)
    zeros = {name: pl.repeat(0, 20_000_000, dtype=kind, eager=True)
             for name, kind in events.empty("callback_end").schema.items()}  # fmt: skip
    pl.DataFrame(zeros).write_parquet(file, compression="zstd", statistics=False)
    assert "20000000 rows in" in _refused(whole, "callback_end")


@pytest.mark.parametrize(
    "change",
    [
        {"clock_offset_ns": "5"}, {"clock_offset_ns": 10**30}, {"clock_offset_ns": 1.5},
        {"clock_offset_ns": None}, {"lost": {"x": "many"}}, {"lost": []}, {"notes": "x"},
        {"threads": [{}]}, {"threads": {"x": 1}}, {"processes": {"x": "y"}}, {"host": 1},
        {"plan": []}, {"application": "x"}, {"stall_meter": 1}, {"realtime": "yes"},
        {"checksums": ["x"]}, {"checksums": {"callback_end.parquet": 1}}, {"format": [1]},
        {"endpoints": [{"node": "/x", "topic": "/y", "kind": "service"}]}, {"format": "1"},
    ],
)  # fmt: skip
def test_facts_of_the_wrong_type_are_named(whole: Path, change: dict[str, object]) -> None:
    file = whole / "recording.json"
    file.write_text(json.dumps({**json.loads(file.read_text()), **change}))
    text = _refused(whole)
    assert text.startswith(f"{file}: ")
    assert next(iter(change)) in text


def test_whatever_ends_writing_leaves_nothing(tmp_path: Path) -> None:
    def parts() -> Iterator[bytes]:
        yield b"half"
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_whole(tmp_path / "file", parts())
    assert list(tmp_path.iterdir()) == []


def test_a_run_lasts_from_its_first_callback_to_its_last_also_where_none_emits_events() -> None:
    def at(name: str, *times: int) -> events.EventTables:
        return {name: events.empty(name).clear(len(times)).with_columns(time=pl.Series(times))}

    taken, called = at("rmw_take", 5, 30), at("rcl_timer_call", 10, 20)
    assert events.first_and_last_start({**taken, **called}) == (5, 30)  # rclpy
    started = {**taken, **called, **at("callback_start", 11, 21)}
    assert events.first_and_last_start(started) == (11, 21)
    assert events.first_and_last_start({}) == (0, 0)
