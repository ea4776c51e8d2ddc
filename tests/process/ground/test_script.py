"""A script that waits for its operator between trials."""

import json
import os
import pty
import signal
import subprocess
import sys
from pathlib import Path

from tests.conftest import ROOT
from tests.pretend import PretendedFleet
from tests.process.ground.conftest import PATIENCE_S, NewStation


def test_ctrl_c_at_the_question_between_trials(tmp_path: Path, new_station: NewStation) -> None:
    """A program that reads the lines of --json is told, too."""
    script = tmp_path / "script.toml"
    steps = "".join(f'[[steps]]\ndo = "{step}"\n' for step in ("preflight", "takeoff", "land"))
    origin = "latitude_deg = 47.4\nlongitude_deg = 8.5\nheading_deg = 0.0\n"
    script.write_text(f'trials = 2\n[[before]]\ndo = "origin"\n{origin}{steps}')
    person, terminal = pty.openpty()
    with PretendedFleet(tmp_path, 1) as fleet:
        runtime = new_station(fleet.fleet_toml).runtime
        arguments = ("mission", "run", script, "--json", "--fleet", fleet.fleet_toml)
        with subprocess.Popen(
            [sys.executable, "-m", "lpac.cli.main", *map(str, arguments)],
            cwd=ROOT, env={**os.environ, "XDG_RUNTIME_DIR": str(runtime)},
            stdin=terminal, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
        ) as process:  # fmt: skip
            assert process.stderr is not None
            said = b""
            while b"take off again?" not in said:
                said += os.read(process.stderr.fileno(), 1 << 12)
                assert process.poll() is None, said
            process.send_signal(signal.SIGINT)
            out, err = process.communicate(timeout=PATIENCE_S)
    os.close(person)
    os.close(terminal)
    assert process.returncode == 130
    outcome = json.loads(out.splitlines()[-1])
    assert (outcome["script"], outcome["done"]) == (str(script), False)
    assert outcome["problem"].startswith("interrupted; ")
    assert err.decode().endswith(f"lpac: {script}: {outcome['problem']}\n")
