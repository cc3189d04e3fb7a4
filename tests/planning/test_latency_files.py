"""Files of bare latencies, some of them damaged."""

from pathlib import Path

import numpy as np
import pytest
from command_line import json_of, refused

_SAMPLE = np.array([59_000_000 + 1000 * number for number in range(200)])


def damaged(folder: Path, before: bytes, after: bytes) -> Path:
    file = folder / "latencies.npy"
    np.save(file, _SAMPLE)
    data = file.read_bytes()
    assert before in data
    file.write_bytes(data.replace(before, after.ljust(len(before))[: len(before)], 1))
    return file


@pytest.mark.parametrize(
    ("before", "after"),
    [
        (b"{'descr'", b"{'desc(("),
        (b"{'descr'", b"[[[[[[[["),
        (b"'<i8'", b"'|O8'"),
        (b"'<i8'", b"'<i8\\"),
        (b"(200,)", b"(2e9,)"),
        (b"(200,)", b"(-20,)"),
        (b"(200,)", b"200L,)"),
        (b"'shape'", b"'shap\x00'"),
        (b"'shape'", b"'shaqe'"),
        (b"\x93NUMPY\x01", b"\x93NUMPY\x09"),
        (b"\x93NUMPY\x01\x00", b"PK\x03\x04\x00\x00\x00\x00"),
        (b"'shape': (200,), }" + b" " * 30, b"'shape': (9999999999999999999999999,), }"),
    ],
)
def test_a_damaged_header_is_one_message(tmp_path: Path, before: bytes, after: bytes) -> None:
    file = damaged(tmp_path, before, after)
    said = refused(2, "plan", "--latencies", file, "--period", "100ms")
    assert str(file) in said
    assert "by numpy.save" in said or "latencies must be one row" in said


def test_what_numpy_wrote_is_read(tmp_path: Path) -> None:
    np.save(tmp_path / "latencies.npy", _SAMPLE)
    planned = json_of("plan", "--latencies", tmp_path / "latencies.npy", "--period", "100ms")
    assert planned["predicted"]["max_ns"] > int(_SAMPLE.max())
