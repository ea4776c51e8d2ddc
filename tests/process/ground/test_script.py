"""A script that waits for its operator between trials."""

import json
import os
import pty
import signal
import subprocess
import sys
from dataclasses import asdict
from pathlib import Path

from tests.conftest import ROOT
from tests.live import ORIGIN, FlownFleet
from tests.process.ground.conftest import PATIENCE_S, NewStation


def test_ctrl_c_at_the_question_between_trials(tmp_path: Path, new_station: NewStation) -> None:
    """A program that reads the lines of --json is told, too."""
    script = tmp_path / "script.toml"
    steps = "".join(f'[[steps]]\ndo = "{step}"\n' for step in ("preflight", "takeoff", "land"))
    origin = "".join(f"{key} = {value}\n" for key, value in asdict(ORIGIN).items())
    script.write_text(f'trials = 2\n[[before]]\ndo = "origin"\n{origin}{steps}')
    person, terminal = pty.openpty()
    with FlownFleet(tmp_path, 1) as fleet:
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
