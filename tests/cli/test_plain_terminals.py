"""Locales without UTF-8 (LC_ALL=C), and signals that come before a verb has begun."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from command_line import Finished
from field_traces import chain_tables, write_chain

PLAIN = {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONWARNDEFAULTENCODING": "1"}

ONE_BY_ONE = r"""
import os, runpy, sys, traceback
for line in sys.stdin.buffer.read().splitlines():
    sys.argv = ["chainshaper", *map(os.fsdecode, line.split(b"\0"))]
    code = 0
    try:
        runpy.run_module("chainshaper", run_name="__main__")
    except SystemExit as end:
        code = end.code or 0
    except BaseException:
        code = 1
        traceback.print_exc()
    for stream in (sys.stdout, sys.stderr):
        print(f"\0{code}\0", end="", file=stream, flush=True)
"""
"""Runs verbs as `python -m` does, one behind the other; behind what each says is its exit code."""


def in_plain_locale(*verbs: list[str | Path]) -> list[Finished]:
    """Commands where text is ASCII, and files are too unless it says otherwise.

    What is what, Python decides as it starts: it does so once for all of them.
    """
    lines = [b"\0".join(os.fsencode(str(word)) for word in words) for words in verbs]
    run = subprocess.run(
        [sys.executable, "-c", ONE_BY_ONE], env={**os.environ, **PLAIN}, capture_output=True,
        input=b"\n".join(lines), check=True, timeout=170,
    )  # fmt: skip
    out, err = (stream.decode("ascii").split("\0")[:-1] for stream in (run.stdout, run.stderr))
    assert len(out) == len(err) == 2 * len(verbs)
    return [
        Finished(int(code), printed, said)
        for printed, code, said in zip(out[::2], out[1::2], err[::2], strict=True)
    ]


def test_every_verb_reads_writes_and_prints_without_utf_8(tmp_path: Path) -> None:
    trace = write_chain(tmp_path / "trace", chain_tables())
    rec, app, plan, sim = (tmp_path / name for name in ("rec", "app.yaml", "plan.yaml", "sim"))
    budget = tmp_path / "budget.yaml"
    verbs: list[list[str | Path]] = [
        ["info", trace], ["callbacks", trace], ["latency", trace], ["chains", trace],
        ["convert", trace, "-o", rec], ["info", rec], ["graph", rec],
        ["graph", rec, "-o", tmp_path / "graph.svg"], ["describe", rec, "-o", app],
        ["plan", rec, "-o", plan], ["budget", rec, "-o", budget],
        ["check", rec, "--budget", budget, "--markdown", tmp_path / "check.md"],
        ["report", rec, "-o", tmp_path / "page.html"], ["compare", rec, rec],
        ["export", rec, "--perfetto", "-o", tmp_path / "trace.pftrace"],
        ["simulate", app, "-o", sim, "--cycles", "50"], ["latency", sim],
        ["sweep", app, "--vary", "epsilon=1ms,2ms", "-o", tmp_path / "s.parquet", "--cycles", "50"],
        ["generate", app, "-o", tmp_path / "package"], ["init", "-o", tmp_path / "new.yaml"],
        ["--help"], ["plan", "--help"],
    ]  # fmt: skip
    for words, done in zip(verbs, in_plain_locale(*verbs), strict=True):
        assert done.code == 0, (words, done.err)
        # What is opened without an encoding is said by Python itself.
        ours = [line for line in done.err.splitlines() if "EncodingWarning" in line]
        assert [line for line in ours if "/chainshaper/" in line] == []


def test_what_a_terminal_cannot_show_is_written_with_what_it_can(tmp_path: Path) -> None:
    trace = write_chain(tmp_path / "trace", chain_tables())
    shown, missing = in_plain_locale(["latency", trace], ["latency", tmp_path / "Fräse"])
    assert "/detector <- /image -> /objects" in shown.out
    said = missing.err
    assert "no such file or folder" in said or "no such folder" in said
    assert "Fr\\" in said


def test_files_in_utf_8_are_read_as_such(tmp_path: Path) -> None:
    file = tmp_path / "latencies.txt"
    file.write_text("# gemessen an der Fräse, in µs\n59300µs\n61ms\n", encoding="utf-8")
    text = (Path(__file__).parents[2] / "examples" / "synthetic_chain.yaml").read_text("utf-8")
    (tmp_path / "app.yaml").write_text("# Fräse\n" + text, encoding="utf-8")
    planned, simulated = in_plain_locale(
        ["plan", "--latencies", file, "--period", "100ms", "--json"],
        ["simulate", tmp_path / "app.yaml", "-o", tmp_path / "sim", "--cycles", "20"],
    )
    assert planned.code in (0, 2)
    assert "Traceback" not in planned.err
    assert simulated.code == 0, simulated.err


@pytest.mark.parametrize("words", [
    ["info", "TRACE"], ["plan", "TRACE"], ["report", "TRACE", "-o", "PAGE"],
])  # fmt: skip
def test_a_signal_at_any_instant_ends_a_verb_without_a_traceback(
    tmp_path: Path, words: list[str]
) -> None:
    """But before Python runs our first line: that is the interpreter's own."""
    trace = write_chain(tmp_path / "trace", chain_tables())
    names = {"TRACE": str(trace), "PAGE": str(tmp_path / "page.html")}
    command = [sys.executable, "-m", "chainshaper", *(names.get(word, word) for word in words)]
    begun = time.monotonic()
    subprocess.run(command, capture_output=True, check=False, timeout=100)
    lasted = time.monotonic() - begun
    for part in range(10):
        number = (signal.SIGINT, signal.SIGTERM)[part % 2]
        process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
        time.sleep(lasted * (part + 0.5) / 10)
        process.send_signal(number)
        _, said = process.communicate(timeout=100)
        if b"Traceback" in said:
            assert b"chainshaper" not in said.partition(b"Traceback")[2], said.decode()
            continue
        endings = (0, 2, 130, -number, -signal.SIGINT)
        assert process.returncode in endings, (words, part, said)
        (tmp_path / "page.html").unlink(missing_ok=True)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_while_the_interpreter_ends_leaves_no_traceback(number: signal.Signals) -> None:
    """Libraries have functions of theirs called then."""
    program = (
        "import atexit, os, sys\n"
        "import chainshaper.__main__ as entry\n"
        f"atexit.register(os.kill, os.getpid(), {int(number)})\n"
        "sys.argv = ['chainshaper', '--version']\n"
        "entry.main()\n"
    )
    # Who runs tests in the background of a shell has them ignore Ctrl-C.
    command = ["env", "--default-signal=INT", sys.executable, "-c", program]
    run = subprocess.run(command, capture_output=True, check=False)
    assert (run.returncode, run.stderr) == (-number, b"")
    assert run.stdout.startswith(b"chainshaper "), "it was done"


def test_a_signal_in_a_callback_that_raises_nothing_ends_a_verb_all_the_same() -> None:
    """Python prints what is raised in one, and goes on: the signal is repeated behind it."""
    program = (
        "import signal, sys, time\n"
        "import chainshaper.__main__ as entry\n"
        "class Dying:\n"
        "    def __del__(self): signal.raise_signal(signal.SIGTERM)\n"
        "def verb(*_, **__):\n"
        "    Dying()\n"
        "    time.sleep(100)\n"
        "import chainshaper.cli.app as cli\n"
        "cli.app = verb\n"
        "entry.main()\n"
    )
    run = subprocess.run([sys.executable, "-c", program], capture_output=True, check=False)
    assert (run.returncode, run.stderr) == (130, b"")
