"""Mistakes on the command line, each told in one line: in this process.

That the line goes to stderr, without a traceback, is in tests/process/cli.
"""

import pytest

from tests.command import called, error_line
from tests.conftest import SHIPPED


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["sim", "--robots", "0"], "--robots 0: must be at least 1"),
        (["sim", "--seed", "-1"], "--seed = -1: must be at least 0"),
        (["sim", "--world", "docs/demo.png"], "docs/demo.png: is not a text file"),
        (["sim", "--out", "README.md"], "README.md"),
        (["sim", "--loss", "2"], "--loss = 2.0: must be from 0 to 1"),
        (["sim", "--transport", "mesh", "--loss", "0.1"], "must be 0 with a modelled radio"),
        (["sim", "--transport", "mesh", "--delay", "1"], "must be 0 with a modelled radio"),
        (["sim", "--transport", "mesh", "--wifi", "absent.toml"], "absent.toml"),
        (["sim", "--wifi", "README.md"], "--wifi does nothing without --transport"),
        (["sim", "--world", "absent.env"], "absent.env: there is no such file"),
        (["sim", "--world", "tests"], "tests: is a folder; a file is needed"),
        (["sim", "--features", "0"], "--features 0: the world would have nothing in it to cover"),
        (["sim", "--world", "/dev/null"], "/dev/null: the world would have nothing in it"),
        (["sim", "--starts", "Makefile"], "Makefile: line 1: must be 'x y', in m"),
        (["sim", "--starts", "/dev/null"], "/dev/null: has 0 starts, and there are 10 robots"),
        (["sim", "--policy-hz", "0"], "--policy-hz = 0.0: must be from 0.1 to 100"),
        (["sim", "--position-error", "-1"], "--position-error = -1.0: must be at least 0"),
        (["sim", "--lost", "10@5"], "lost robots 10@5: must be fewer than the team's 10"),
        (["sim", "--lost", "2@60"], "robot 8 is away from 60 s on: must be within the flight"),
        (["sim", "--range", "0"], "--range = 0.0: must be above 0 and finite"),
        (["sim", "--secure"], "--secure does nothing with --vehicle point"),
        (["sim", "--no-script"], "--no-script does nothing with --vehicle point"),
        (["sim", "--world", "a.env", "--features", "3"], "--features does nothing with --world"),
        (
            ["sim", "--controller", "shared-cvt", "--loss", "0.5"],
            "--loss does nothing with --controller shared-cvt",
        ),
        (
            ["sim", "--vehicle", "simulated", "--control-hz", "1"],
            "robots.r0, in slots[0]: rates: control_hz = 1.0: must be from 4 to 100: PX4 needs",
        ),
        (
            ["drill", "--sensor", "foo", "--fault", "none"],
            "sensor: type = 'foo': is not installed here",
        ),
        (["paper", "all", "--namespaces", "a,b"], "2 given, and 10 robots need one each"),
        (
            ["sim", "--away", "3@20-10"],
            "failure of robot 3: until_s = 10.0: must be after from_s = 20.0",
        ),
        (
            ["sim", "--lag", "1", "--vehicle", "mavlink"],
            "--lag does nothing with --vehicle mavlink",
        ),
        (["sim", "--bundle", f"{SHIPPED}.pt"], "is a torch checkpoint; `lpac export"),
        (["sim", "--bundle", "absent"], "absent: there is no such file or folder"),
        (["bundle", "verify", "README.md"], "neither a bundle's directory nor its archive"),
        (["bundle", "info", "tests"], "manifest.json is missing"),
        (["bundle", "benchmark", str(SHIPPED), "--neighbours", "-1"], "must be from 0 to 1000"),
        (["export", "absent.pt", "--params", f"{SHIPPED}.toml", "-o", "x"], "absent.pt"),
        (["export", "README.md", "--params", f"{SHIPPED}.toml", "-o", "x"], "README.md"),
        (["export", f"{SHIPPED}.pt", "--params", "absent.toml", "-o", "x"], "absent.toml"),
    ],
)
def test_a_mistake_is_one_line(arguments: list[str], text: str) -> None:
    assert text in error_line(called(*arguments))


@pytest.mark.parametrize("command", ["sim", "evaluate"])
def test_an_unknown_transport_is_told_with_those_that_are(command: str) -> None:
    result = called(command, "--transport", "router")
    assert result.returncode == 2
    assert "'router' is not one of 'mesh', 'multicast'" in result.stderr
