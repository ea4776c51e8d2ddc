"""A run of the tests on a machine that lacks programs."""

import os
import subprocess
import sys
from pathlib import Path

from tests.conftest import ROOT


def test_the_last_line_says_what_was_skipped_in_all_runs(tmp_path: Path) -> None:
    command = [
        sys.executable, "-m", "pytest", "-p", "no:cacheprovider",
        "tests/process/systemd/test_unit.py", "--skipped", str(tmp_path / "out" / "skipped"),
    ]  # fmt: skip
    for tests in (3, 6):
        told = subprocess.run(
            command, cwd=ROOT, env=os.environ | {"PATH": str(tmp_path)}, capture_output=True,
            text=True, check=True,
        )  # fmt: skip
        assert told.stdout.splitlines()[-1] == (
            f"skipped: {tests} in tests/process/systemd; to run them: sudo apt install systemd"
        )
