"""`lpac train` as a user types it: over cores, killed, interrupted, and gone on with."""

import json
import os
import resource
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch

from edge.policy.bundle import load_bundle
from lpac.train.config import read_config
from lpac.train.run import TrainingRun
from tests.command import called, error_line, lpac
from tests.training import SMALL, here, said

# Shards enough to be killed between; and few candidates.
LONGER = (
    SMALL.replace("flights = 2", "flights = 12", 1)
    .replace("[2, 3]", "[15, 15]", 1)
    .replace("every_epochs = 1", "every_epochs = 2")
)


@pytest.fixture
def config(tmp_path: Path) -> Path:
    path = tmp_path / "small.toml"
    path.write_text(LONGER)
    return path


def start(config: Path, out: Path) -> "subprocess.Popen[str]":
    command = [sys.executable, "-m", "lpac.cli.main", "train", str(config), "--out", str(out)]
    return subprocess.Popen(command, stderr=subprocess.PIPE, process_group=0, text=True)


def until_there_is(pattern: str, out: Path, process: "subprocess.Popen[str]") -> None:
    while not list(out.glob(pattern)):
        assert process.poll() is None, process.communicate()
        time.sleep(0.02)


@pytest.mark.usefixtures("sketched")
def test_killed_it_goes_on_and_comes_to_the_same(
    config: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Other sums, if not as many threads add.
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    torch.set_num_threads(1)
    out, again = tmp_path / "killed", tmp_path / "whole"
    with start(config, out) as process:
        until_there_is("data/*-*.npz", out, process)
        process.send_signal(signal.SIGKILL)
    result = lpac("train", config, "--out", out, "--json")
    assert result.returncode == 0, (result.stdout, result.stderr)
    told = json.loads(result.stdout)
    whole = TrainingRun(read_config(config), again, lambda now: None).run(here)
    assert said(told) == said(whole)
    assert (out / "small.pt").read_bytes() == (again / "small.pt").read_bytes()
    assert load_bundle(out / "small").id == told["bundle_id"]


def test_what_ends_it_is_one_line_and_loses_nothing(config: Path, tmp_path: Path) -> None:
    out = tmp_path / "run"
    with start(config, out) as process:
        until_there_is("data/*-*.npz", out, process)
        # Or the first would be done before the second has begun.
        os.killpg(process.pid, signal.SIGSTOP)
        second = called("train", config, "--out", out)
        assert f"is in use by process {process.pid} on this machine" in error_line(second)
        os.killpg(process.pid, signal.SIGINT)
        os.killpg(process.pid, signal.SIGCONT)
        _, told = process.communicate()
    assert process.returncode == 130 and told.strip().endswith(
        "lpac: interrupted: the same command continues"
    )
    before = {path: path.read_bytes() for path in (out / "data").glob("*-*.npz")}

    with start(config, out) as process:
        while len(list((out / "data").glob("*-*.npz"))) <= len(before):
            assert process.poll() is None
            time.sleep(0.02)
        for worker in workers(process.pid):
            os.kill(worker, signal.SIGKILL)
        _, told = process.communicate()
    assert process.returncode == 1 and told.strip() == "lpac: a worker process was killed"

    def limit() -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (2000, 2000))

    command = [sys.executable, "-m", "lpac.cli.main", "train", str(config), "--out", str(out)]
    full = subprocess.run(command, capture_output=True, text=True, check=False, preexec_fn=limit)
    assert error_line(full) == "lpac: [Errno 27] File too large"
    assert all(path.read_bytes() == content for path, content in before.items())


def workers(pid: int) -> list[int]:
    """The processes that fly for it."""
    children = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
    return [
        int(child)
        for child in children
        if b"spawn_main" in Path(f"/proc/{child}/cmdline").read_bytes()
    ]


def test_what_cannot_be_is_one_line(config: Path, tmp_path: Path) -> None:
    """Others are in tests/unit/train."""
    config.write_text(SMALL.replace("rounds = 1", "rounds = -1"))
    assert "dagger: rounds = -1: must be at least 0" in error_line(called("train", config))
    config.write_text(SMALL)
    told = error_line(called("train", config, "--ray", "127.0.0.1:1", "--out", tmp_path / "run"))
    assert "no Ray cluster at 127.0.0.1:1" in told
