"""What all tests share: their tiers, and the shipped policy."""

import dataclasses
import gc
import json
import signal
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy.testing  # noqa: F401 - older ones start lscpu when they are first used
import pytest
from hypothesis import HealthCheck, settings

from edge.core.logger import show
from edge.policy.bundle import Bundle, load_bundle, make_bundle
from edge.policy.lpac.policy import LpacPolicy
from lpac.sim.fleet.load import robots_carried
from tests.needs import in_one_line
from tests.published import AUTHORS_TAPS, MADE, sources

ROOT = Path(__file__).parents[1]
SHIPPED = ROOT / "policies" / "lpac_l2_k3_n10_512"

# The folders below tests/, each a marker; README.md there says what belongs in which.
TIERS = ("unit", "sim", "process", "host")

# A file that flies in real time flies two or three robots at a time.
ROBOTS_OF_A_FILE = 2.5
# The files whose flights take longest begin first, so that none is left alone at the end.
LONGEST = (
    "test_robot.py", "test_real_fleet.py", "test_walkthrough.py", "test_fleet.py",
    "test_attacks.py",
)  # fmt: skip

# What no test in unit/ and sim/ does, as Python's audit events name it.
OTHERS_ONLY = {
    "socket.bind": "uses a socket", "socket.connect": "uses a socket",
    "socket.sendto": "uses a socket", "socket.getaddrinfo": "asks for an address",
    "subprocess.Popen": "starts a process", "os.fork": "starts a process",
    "os.posix_spawn": "starts a process", "time.sleep": "waits in real time",
}  # fmt: skip
_running: list[str] = []  # the test in unit/ or sim/ that runs now


def _refuse_outside_world(event: str, _: tuple[object, ...]) -> None:
    if _running and event in OTHERS_ONLY:
        pytest.fail(f"{_running[0]} {OTHERS_ONLY[event]}: it belongs in tests/process")


sys.addaudithook(_refuse_outside_world)

# A busy machine is slow now and then; and whatever fails is to fail again.
settings.register_profile(
    "project", deadline=None, derandomize=True, suppress_health_check=[HealthCheck.too_slow]
)
settings.load_profile("project")

# Tests that run in the background inherit that Ctrl-C is ignored; so would what they interrupt.
signal.signal(signal.SIGINT, signal.default_int_handler)


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--skipped", type=Path, metavar="FILE",
        help="gathers what was skipped, so that the last of several runs tells of all of them",
    )  # fmt: skip
    group = parser.getgroup("attacks")
    group.addoption(
        "--tries", type=int, default=40, help="attacks before each hold and kill of an operator"
    )


def pytest_configure(config: pytest.Config) -> None:
    for tier in TIERS:
        config.addinivalue_line("markers", f"{tier}: what is in tests/{tier}")
    config.addinivalue_line(
        "markers", "slow: in unit/ and sim/, left to `make test` by `make check`"
    )
    config.addinivalue_line(
        "markers", "real_time: flies robots in real time: three more files do so beside it at most"
    )
    config.addinivalue_line(
        "markers", "alone: measures, or flies very many: nothing else runs meanwhile"
    )


def pytest_xdist_auto_num_workers(config: pytest.Config) -> int | None:
    """Files that fly in real time at once: as many as the machine carries, four at most."""
    if config.option.markexpr != "real_time":
        return None
    return min(max(1, round(robots_carried(SHIPPED, "mavlink") / ROBOTS_OF_A_FILE)), 4)


@pytest.hookimpl(tryfirst=True)  # before -m chooses by marker
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    for item in items:
        tier = item.path.relative_to(ROOT / "tests").parts[0]
        if tier not in TIERS:
            raise pytest.UsageError(f"{item.path} is in none of the tiers {', '.join(TIERS)}")
        item.add_marker(tier)
    if config.option.markexpr == "real_time":
        items.sort(key=lambda item: item.path.name not in LONGEST)


def pytest_collection_finish() -> None:
    """Exempt imported modules from garbage collection, and collect old objects less often."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(700, 10, 100)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call(item: pytest.Item) -> Iterator[None]:
    if item.get_closest_marker("unit") or item.get_closest_marker("sim"):
        _running.append(item.nodeid)
    try:
        return (yield)
    finally:
        _running.clear()


def pytest_unconfigure(config: pytest.Config) -> None:
    """Say in a run's last line what was skipped, and what would have run it."""
    reporter = config.pluginmanager.get_plugin("terminalreporter")
    if reporter is None or hasattr(config, "workerinput"):
        return
    skipped = [(r.nodeid, r.longrepr[2]) for r in reporter.getreports("skipped")]
    file: Path | None = config.option.skipped
    if file is not None:
        file.parent.mkdir(parents=True, exist_ok=True)
        with file.open("a+") as lines:
            lines.writelines(json.dumps(skip) + "\n" for skip in skipped)
            lines.seek(0)
            skipped = [json.loads(line) for line in lines]
    if line := in_one_line(skipped):
        reporter.write_line(line)


@pytest.fixture(autouse=True)
def logger() -> None:
    """Reset the logger, which a command run by an earlier test in this process may have set."""
    show("warning")


@pytest.fixture
def sketched(monkeypatch: pytest.MonkeyPatch) -> None:
    """Draw each figure once, at a low resolution, for tests that only need the files."""
    from matplotlib.figure import Figure  # noqa: PLC0415 - most tests draw nothing

    savefig = Figure.savefig

    def sketch(drawn: Figure, to: Any, **options: Any) -> None:
        if isinstance(to, Path) and to.suffix == ".pdf":
            to.write_bytes(b"%PDF")
        else:
            savefig(drawn, to, **options, dpi=20)

    monkeypatch.setattr(Figure, "savefig", sketch)


@pytest.fixture(scope="session")
def shipped_bundle() -> Bundle:
    return load_bundle(SHIPPED)


@pytest.fixture(scope="session")
def exploring_bundle() -> Bundle:
    """One whose small CNN sees what was explored; its weights are random."""
    states = pytest.importorskip("tests.unit.export.states", reason="torch makes the bundle")
    bundle: Bundle = states.random_bundle(channels=5)
    return bundle


@pytest.fixture(scope="session")
def sharing_bundle() -> Bundle:
    """One whose robots tell each other what they have seen, and whose CNN sees all images."""
    states = pytest.importorskip("tests.unit.export.states", reason="torch makes the bundle")
    bundle: Bundle = states.random_bundle(channels=6)
    manifest = bundle.manifest
    assert manifest.perception is not None
    perception = dataclasses.replace(manifest.perception, shared_map_cell=8)
    files = {name: bundle.files[name] for name in manifest.files}
    return make_bundle(dataclasses.replace(manifest, perception=perception), files)


@pytest.fixture(scope="session", params=sources(AUTHORS_TAPS))
def authors_taps(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of tensors as the paper's authors published theirs."""
    if request.param != MADE:
        return Path(request.param)
    states = pytest.importorskip("tests.unit.export.states", reason="torch makes the tensors")
    state = states.random_state(layers=5, hops=3, latent=256, cnn_latent=32)
    folder: Path = states.tap_folder(state, tmp_path_factory.mktemp("authors") / "authors_taps")
    return folder


@pytest.fixture(scope="session")
def shipped_policy(shipped_bundle: Bundle) -> LpacPolicy:
    return LpacPolicy(shipped_bundle)
