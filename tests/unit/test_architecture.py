"""The dependencies point one way."""

import ast
from collections.abc import Iterator
from functools import cache
from pathlib import Path

from tests.conftest import ROOT

OURS = ("edge", "export", "lpac")

_EDGE = {
    "edge.core", "edge.messages", "edge.identity", "edge.flight", "edge.policy", "edge.robot",
    "edge.drivers", "edge.drivers.registry",
}  # fmt: skip
# Part -> the parts of the project that it may import (besides itself).
ALLOWED = {
    "edge.core": set(),
    "edge.messages": {"edge.core"},
    "edge.identity": {"edge.core", "edge.messages"},
    "edge.flight": {"edge.core", "edge.messages"},
    "edge.policy": {"edge.core", "edge.messages"},
    "edge.drivers": {"edge.core", "edge.messages", "edge.identity"},
    # Finds drivers and policy families by their names, those of other packages too.
    "edge.drivers.registry": {"edge.core", "edge.messages", "edge.policy"},
    "edge.robot": {
        "edge.core", "edge.messages", "edge.identity", "edge.flight", "edge.policy",
    },
    "edge.robot.process": {*_EDGE, "edge.robot.log"},
    "edge.robot.log": {"edge.core", "edge.flight", "edge.robot", "edge.drivers"},
    "export": {"edge.core", "edge.policy"},
    "lpac.shipped": set(),
    # The Python API: hands on what these have.
    "lpac.api": {
        *_EDGE, "lpac.shipped", "lpac.analysis", "lpac.sim", "lpac.sim.batch", "lpac.sim.engines",
        "lpac.study",
    },
    "lpac.analysis": _EDGE,
    "lpac.ground": {*_EDGE, "lpac.analysis", "lpac.fleet.settings", "lpac.radio"},
    # What describes a fleet; the ground reads it, and the simulator describes its fleets with it.
    "lpac.fleet.settings": {*_EDGE, "lpac.radio"},
    "lpac.fleet.writer": {*_EDGE, "lpac.fleet.settings"},
    "lpac.fleet.authority": _EDGE,
    "lpac.fleet": {
        *_EDGE, "lpac.shipped", "lpac.fleet.settings", "lpac.fleet.writer", "lpac.fleet.authority",
        "lpac.radio",
    },
    "lpac.sim": {
        *_EDGE, "edge.robot.log", "lpac.analysis", "lpac.ground", "lpac.fleet.settings",
        "lpac.fleet.writer", "lpac.fleet.authority", "lpac.radio", "lpac.sim.ports",
        "lpac.sim.programs",
    },
    # Small helpers of whoever starts programs.
    "lpac.sim.ports": set(),
    "lpac.sim.programs": set(),
    "lpac.radio": {"edge.core", "edge.messages", "edge.identity"},
    "lpac.radio.heat_map": {"lpac.analysis", "lpac.radio"},
    "lpac.extras": set(),
    "lpac.middleware": {
        "edge.core", "edge.messages", "edge.drivers", "lpac.analysis", "lpac.extras",
        "lpac.radio", "lpac.sim.ports", "lpac.sim.programs",
    },
    # Nothing of the simulators needs it.
    "lpac.sim.batch": {*_EDGE, "lpac.analysis", "lpac.sim"},
    "lpac.sim.engines": {*_EDGE, "lpac.analysis", "lpac.sim", "lpac.sim.batch"},
    "lpac.study": {
        *_EDGE, "lpac.shipped", "lpac.analysis", "lpac.radio", "lpac.sim", "lpac.sim.engines",
    },
    "lpac.train": {
        *_EDGE, "export", "lpac.analysis", "lpac.sim", "lpac.sim.batch", "lpac.study",
    },
    "lpac.ablate": {
        *_EDGE, "lpac.analysis", "lpac.sim", "lpac.study", "lpac.train",
    },
    "lpac.paper": {
        *_EDGE, "lpac.analysis", "lpac.radio", "lpac.sim", "lpac.sim.engines", "lpac.study",
    },
    "lpac.cli": {
        *_EDGE, "edge.robot.process", "export", "lpac.extras", "lpac.shipped",
        "lpac.analysis", "lpac.ground", "lpac.radio", "lpac.sim", "lpac.sim.batch",
        "lpac.sim.engines", "lpac.study", "lpac.train", "lpac.ablate", "lpac.paper",
        "lpac.fleet", "lpac.fleet.settings", "lpac.fleet.writer", "lpac.fleet.authority",
        "lpac.radio.heat_map", "lpac.middleware",
    },
}  # fmt: skip
# Third-party packages, and the only files or parts that may import them.
ONLY_IN = {
    "onnxruntime": {"edge/policy/graph.py"},
    "torch": {"export/", "lpac/train/"},
    "onnx": {"export/"},
    "matplotlib": {
        "lpac/sim/",
        "lpac/analysis/",
        "lpac/study/",
        "lpac/train/",
        "lpac/ablate/",
        "lpac/paper/",
        "lpac/middleware/figures.py",
    },
    "mavsdk": {"edge/drivers/"},
    "zenoh": {"edge/drivers/"},
    "cyclonedds": {"lpac/middleware/over_cyclone.py"},
    "mcap": {"edge/drivers/"},
    # Elsewhere it is `edge.core.logger`, which loads it without rich.
    "structlog": {"edge/core/logger.py", "edge/drivers/logs.py"},
    "pymavlink": {"lpac/sim/"},
    "typer": {"lpac/cli/"},
    "jinja2": {"lpac/analysis/template.py"},
    "markupsafe": {"lpac/analysis/template.py"},
    "scipy": {
        "lpac/analysis/statistics.py",
        "lpac/radio/calibration.py",
        "lpac/sim/baselines.py",
    },
    "rich": {"lpac/cli/", "lpac/ground/terminal/"},
    "textual": {"lpac/ground/terminal/"},
    "aiohttp": {"lpac/ground/map/"},
    "foxglove": {"lpac/ground/foxglove/"},
    "tomlkit": {"lpac/fleet/writer.py", "lpac/ablate/config.py"},
    "nacl": {"edge/identity/signature.py", "edge/identity/group.py"},
    "cryptography": {"lpac/fleet/authority.py", "lpac/fleet/web_certificate.py"},
    # What makes the documentation's site reads all parts; none of them knows of it.
    "handbook": set(),
    "mkdocs": set(),
}
# No clock, thread, file or socket: all of it is called by somebody who has them. What several
# threads call has a lock; bundles, configurations and records are read from their paths.
PURE = (
    "edge.core", "edge.messages", "edge.identity", "edge.flight", "edge.robot", "lpac.radio",
)  # fmt: skip
BUT = {
    "edge/robot/neighbours.py": {"threading"},
    "edge/core/toml.py": {"pathlib"},
    "edge/robot/inbox.py": {"threading"},
    "edge/identity/guard.py": {"threading"},
    "edge/robot/node.py": {"pathlib"},
    "edge/robot/config.py": {"pathlib"},
    "lpac/radio/records.py": {"pathlib"},
    "lpac/radio/calibration.py": {"pathlib"},
    # Wait for a vehicle, and measure; neither is part of a robot that flies.
    "edge/robot/setup.py": {"time"},
    "edge/robot/benchmark.py": {"time"},
    # The threads around a robot.
    "edge/robot/loops.py": {"threading", "time"},
}
IMPURE = {
    "asyncio", "io", "logging", "multiprocessing", "os", "pathlib", "random", "shutil", "signal",
    "socket", "subprocess", "tempfile", "threading", "time",
}  # fmt: skip


def part_of(module: str) -> str:
    names = module.split(".")
    parts = (".".join(names[:n]) for n in range(len(names), 0, -1))
    return next((part for part in parts if part in ALLOWED), names[0])


@cache
def parsed(path: Path) -> ast.Module:
    return ast.parse(path.read_text())


def imports(path: Path, *, only_top_level: bool = False) -> Iterator[str]:
    tree = parsed(path)
    for node in tree.body if only_top_level else ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            yield from {node.module or "", *(f"{node.module}.{a.name}" for a in node.names)}


@cache
def sources() -> list[Path]:
    return sorted(p for part in OURS for p in (ROOT / part).rglob("*.py"))


def test_imports_point_one_way() -> None:
    wrong = []
    for path in sources():
        name = path.relative_to(ROOT)
        own = part_of(".".join(name.with_suffix("").parts))
        for module in imports(path):
            top = module.split(".")[0]
            may = True
            if top in OURS and module not in ("edge", "lpac"):
                part = part_of(module)
                may = part == own or part in ALLOWED.get(own, set())
            if top in ONLY_IN:
                may = may and any(str(name).startswith(place) for place in ONLY_IN[top])
            if own in PURE:
                may = may and top not in IMPURE - BUT.get(str(name), set())
            if not may:
                wrong.append(f"{name} imports {module}")
    assert not wrong, "\n".join(wrong)


def test_cli_imports_its_parts_only_when_a_command_runs() -> None:
    loads = {*OURS, "numpy", "rich"}
    assert [
        f"{path.relative_to(ROOT)} imports {module}"
        for path in sources()
        if path.is_relative_to(ROOT / "lpac" / "cli")
        for module in imports(path, only_top_level=True)
        if part_of(module) not in ("lpac", "lpac.cli", "lpac.shipped")
        and module.split(".")[0] in loads
    ] == []


def test_functions_of_the_cli_are_short() -> None:
    """At most 40 lines, and 8 parameters; an option that is shared is a dataclass's field."""
    long = []
    for path in sources():
        if not path.is_relative_to(ROOT / "lpac" / "cli"):
            continue
        for node in ast.walk(parsed(path)):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                lines = (node.end_lineno or node.lineno) - node.lineno + 1
                of = node.args
                parameters = len([*of.posonlyargs, *of.args, *of.kwonlyargs])
                if lines > 40 or parameters > 8:
                    where = f"{path.relative_to(ROOT)}: {node.name}"
                    long.append(f"{where}: {lines} lines, {parameters} parameters")
    assert not long, "\n".join(long)


def test_log_lines_have_their_details_by_name() -> None:
    """structlog formats the event with further positional arguments, which can raise in flight."""
    wrong = []
    for path in sources():
        for node in ast.walk(parsed(path)):
            match node:
                case ast.Call(ast.Attribute(ast.Name("log"), "info" | "warning" | "error"), args):
                    if len(args) != 1:
                        wrong.append(f"{path.relative_to(ROOT)}:{node.lineno}")
    assert not wrong, "\n".join(wrong)


def test_a_class_name_means_one_thing() -> None:
    """A port and what implements it are two things, too."""
    places: dict[str, list[str]] = {}
    for path in sources():
        for node in ast.walk(parsed(path)):
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                places.setdefault(node.name, []).append(str(path.relative_to(ROOT)))
    assert {name: where for name, where in places.items() if len(where) > 1} == {}


def test_what_runs_on_the_robots_own_python_is_one_file() -> None:
    """All else of `lpac.fleet` is commands over SSH, and runs on the laptop."""
    assert len((ROOT / "lpac" / "fleet" / "agent.py").read_text().splitlines()) <= 500
    text = (ROOT / "lpac" / "fleet" / "session.py").read_text()
    assert "modules = (raw_mavlink, agent)" in text


def test_docstrings_open_with_an_imperative_or_a_noun() -> None:
    """Relative clauses name neither the thing nor its action."""
    openings = {"That", "What", "Where", "Which", "Who", "Whom", "Whose"}
    wrong = []
    for path in (*sources(), *(ROOT / "bench").rglob("*.py"), *(ROOT / "handbook").rglob("*.py")):
        for node in ast.walk(parsed(path)):
            if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
                text = ast.get_docstring(node)
                if text and text.split(None, 1)[0].rstrip(",:;.") in openings:
                    wrong.append(f"{path.relative_to(ROOT)}: {text.splitlines()[0]}")
    assert not wrong, "\n".join(wrong)
