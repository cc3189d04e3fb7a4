"""Progress: silent about what is quick, told about what is slow."""

import time

import pytest

from chainshaper.cli import output


def test_nothing_is_said_about_what_is_quick(capsys: pytest.CaptureFixture[str]) -> None:
    with output.late_progress("info") as report:
        report(0.5, "decoding events")
    assert capsys.readouterr().err == ""


def test_what_takes_longer_says_what_it_does(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(output, "PATIENCE_S", 0.01)
    with output.late_progress("latency") as report:
        report(0.1, "opening the trace")
        said = ""
        for _ in range(200):
            time.sleep(0.01)
            said += capsys.readouterr().err
            if said:
                break
        report(0.5, "decoding events")
    assert said + capsys.readouterr().err == (
        "latency: opening the trace\nlatency: decoding events\n"
    )
