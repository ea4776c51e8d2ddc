"""`lpac` as a user types it: as a process, or called in this one."""

import contextlib
import io
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from lpac.cli.main import main
from tests.conftest import ROOT

_COLUMNS = "200"


def lpac(*arguments: object, cwd: Path = ROOT) -> subprocess.CompletedProcess[str]:
    """The command, as a process."""
    return subprocess.run(
        [sys.executable, "-m", "lpac.cli.main", *map(str, arguments)],
        cwd=cwd, capture_output=True, text=True, check=False,
        env={**os.environ, "PYTHONPATH": str(ROOT), "COLUMNS": _COLUMNS},
    )  # fmt: skip


def called(*arguments: object) -> subprocess.CompletedProcess[str]:
    """The command, in this process: what it would have printed, and its exit code."""
    out, err = io.StringIO(), io.StringIO()
    code: int | str | None = 0
    typed = ["lpac", *map(str, arguments)]
    with pytest.MonkeyPatch.context() as patch, contextlib.chdir(ROOT):
        patch.setattr(sys, "argv", typed)
        patch.setenv("COLUMNS", _COLUMNS)
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            try:
                main()
            except SystemExit as stop:
                code = stop.code
    if isinstance(code, str):
        code, last = 1, f"{code}\n"
    else:
        code, last = code or 0, ""
    return subprocess.CompletedProcess(typed, code, out.getvalue(), err.getvalue() + last)


def error_line(result: subprocess.CompletedProcess[str]) -> str:
    """The one line that a failed command leaves."""
    assert result.returncode != 0
    *before, line = result.stderr.strip().splitlines()
    # How far it was, where it took long.
    assert all(re.match(r"[a-z ]+ \d+( of \d+)?\b|.* \d+ %", text) for text in before), before
    assert line.startswith("lpac: ")
    return line
