"""Latency samples from files: exact, and refused with the place of what is wrong."""

from pathlib import Path

import numpy as np
import pytest

from chainshaper.planning import check_latencies, read_latencies
from chainshaper.values.errors import InputError


def test_one_duration_a_line(tmp_path: Path) -> None:
    file = tmp_path / "latencies.txt"
    file.write_text("# measured on Monday\n59.1ms\n\n  250us  # fast\n0.1ms\n1s")
    found = read_latencies(file)
    assert found.dtype == np.int64
    assert found.tolist() == [59_100_000, 250_000, 100_000, 1_000_000_000]


def test_a_file_as_spreadsheets_write_it(tmp_path: Path) -> None:
    file = tmp_path / "latencies.csv"
    file.write_bytes(b"\xef\xbb\xbf59.1ms\r\n60ms\r\n")
    assert read_latencies(file).tolist() == [59_100_000, 60_000_000]


@pytest.mark.parametrize("dtype", [np.int64, np.uint32, np.float64])
def test_whole_nanoseconds_of_any_type(tmp_path: Path, dtype: type) -> None:
    file = tmp_path / "latencies.npy"
    np.save(file, np.array([5, 7, 6], dtype=dtype))
    assert read_latencies(file).tolist() == [5, 7, 6]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("1ms\n2\n", ":2: '2' is not a duration"),
        ("1ms\nnan\n", ":2: 'nan' is not a duration"),
        ("1ms\n\n-2ms\n", ":3: -2ms is no latency"),
        ("1ms\n999999999s\n", ":2: 999999999s is no latency"),
        ("", "0 latencies are too few"),
        ("1ms\n", "1 latencies are too few"),
        ("0ms\n0ms\n", "every latency is 0ms"),
    ],
)
def test_wrong_lines_are_named(tmp_path: Path, text: str, words: str) -> None:
    file = tmp_path / "latencies.txt"
    file.write_text(text)
    with pytest.raises(InputError) as caught:
        read_latencies(file)
    assert str(caught.value).startswith(str(file))
    assert words in str(caught.value)


@pytest.mark.parametrize(
    ("array", "words"),
    [
        (np.array([1.0, np.nan]), r"number 1 \(nan\) is not a number"),
        (np.array([np.inf, 1.0]), r"number 0 \(inf\) is not a number"),
        (np.array([1.0, 1.5]), r"number 1 \(1\.5\) is not a whole number"),
        (np.array([1, 2, -3]), r"number 2 \(-3\) is negative"),
        (np.array([1, 2**62]), "check the unit"),
        (np.array([[1, 2], [3, 4]]), "2-dimensional"),
        (np.array(["a", "b"]), "one row of numbers"),
        (np.array([5]), "too few"),
        (np.array([], dtype=np.int64), "too few"),
    ],
)
def test_wrong_arrays_are_named(tmp_path: Path, array: np.ndarray, words: str) -> None:
    with pytest.raises(InputError, match=words):
        check_latencies(array)
    file = tmp_path / "latencies.npy"
    np.save(file, array)
    with pytest.raises(InputError, match=words):
        read_latencies(file)


def test_files_that_are_not_what_they_say(tmp_path: Path) -> None:
    (tmp_path / "a.npy").write_text("59ms")
    (tmp_path / "objects.npy").write_bytes(b"")
    np.save(tmp_path / "pickled.npy", np.array([{"a": 1}], dtype=object), allow_pickle=True)
    (tmp_path / "b.txt").write_bytes(b"\xff\xfe\x00")
    for name in ("a.npy", "objects.npy", "pickled.npy", "b.txt"):
        with pytest.raises(InputError, match=name):
            read_latencies(tmp_path / name)
    with pytest.raises(InputError, match="cannot be read"):
        read_latencies(tmp_path / "absent.txt")
