"""The walk through a fleet in docs/fleet.md, line by line as it stands there."""

import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from lpac.sim.hosts.base import NoHostsError, require_tools
from tests.conftest import ROOT, SHIPPED


def test_the_page_can_be_followed_line_by_line(amd64_image: Path, tmp_path: Path) -> None:
    try:
        require_tools()
    except NoHostsError as reason:
        pytest.skip(str(reason))
    text = (ROOT / "docs" / "fleet.md").read_text()
    (block,) = re.findall(r"```sh\n(\. \.venv/bin/activate\nexport LPAC_FLEET=.*?)```", text, re.S)
    activate, setting, *lines = block.splitlines()
    assert activate == ". .venv/bin/activate"
    variable, _, value = setting.removeprefix("export ").partition("=")
    programs = Path(sys.executable).parent
    environment = os.environ | {variable: value, "PATH": f"{programs}:{os.environ['PATH']}"}
    demo = subprocess.Popen(
        [sys.executable, "-m", "lpac.cli.main", "hosts", "-n", "2", "--image", str(amd64_image),
         "--bundle", str(SHIPPED), "--out", str(tmp_path / Path(value).parent)],
        cwd=ROOT, stdout=subprocess.PIPE, text=True,
    )  # fmt: skip
    try:
        assert demo.stdout is not None
        for line in demo.stdout:
            if "Ctrl-C ends all" in line:
                break
        said = {}
        for line in lines:
            done = subprocess.run(
                line, shell=True, cwd=tmp_path, env=environment, stdin=subprocess.DEVNULL,
                capture_output=True, text=True, check=False,
            )  # fmt: skip
            command = line.partition("#")[0].strip()
            # The first look finds computers that are nobody's yet.
            wrong = 1 if command == "lpac fleet status" and command not in said else 0
            assert done.returncode == wrong, (line, done.stdout, done.stderr)
            assert "Traceback" not in done.stderr
            said[command] = done.stdout
        assert said["lpac fleet deploy"].count("runs") == 2
        assert said["lpac fleet rollback"].count("rolled back") == 2
        assert "fleet GO" in said["lpac fleet up"]
    finally:
        demo.send_signal(signal.SIGINT)
        demo.communicate()
