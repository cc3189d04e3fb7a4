"""Runs tests of the project and reports each as a line of JSON on standard output.

Started as `run_tests.py NODE_ID…`. A test that is skipped has not passed: the guest was made to
have all that it needs. Everything that pytest says goes to standard error.
"""

import json
import os
import sys

import pytest

LIMIT_S = 400
"""Of one test: without hardware to help it, the guest is some twenty times as slow."""


class Report:
    """A plugin of pytest."""

    def __init__(self) -> None:
        self._lines = os.fdopen(os.dup(1), "w")
        os.dup2(2, 1)

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Set-up and tear-down count only if they fail, or skip the test."""
        if report.when != "call" and report.passed:
            return
        name = report.nodeid.rpartition("::")[2].removeprefix("test_").replace("_", " ")
        text = report.longreprtext or str(report.longrepr or "")
        line = json.dumps({"check": name, "passed": report.passed, "text": text})
        self._lines.write(line + "\n")
        self._lines.flush()


if __name__ == "__main__":
    options = ["-p", "no:cacheprovider", f"--timeout={LIMIT_S}"]
    sys.exit(pytest.main([*options, *sys.argv[1:]], plugins=[Report()]))
