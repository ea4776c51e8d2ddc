"""The robot's image: what is in it, what it was made of, and that it runs."""

import json
import os
import re
import shutil
import stat
import subprocess
import sys
import tarfile
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest
from packaging.utils import canonicalize_name

from tests.conftest import ROOT, SHIPPED
from tests.host.conftest import BuildImage
from tests.host.deploy.entering import inside
from tests.unit.deploy.test_image import pinned

DOCKER = ROOT / "deploy" / "docker"
ARCHITECTURES = ("amd64", "arm64")
ELF_MACHINES = {"amd64": 62, "arm64": 183}
FORBIDDEN = re.compile(
    r"(torch|pip|setuptools|wheel|rich|libtorch.*)"  # packages of a workstation
    r"|(sh|bash|dash|busybox|gcc|g\+\+|cc|cc1|ld|as|make|apt.*|dpkg.*|perl.*)"  # programs
    r"|.*\.(h|a|pyi)|tests?|ensurepip|idlelib|lib2to3|tkinter"
)


@pytest.fixture(scope="module", params=ARCHITECTURES)
def tree(request: pytest.FixtureRequest, build_image: BuildImage) -> Path:
    return build_image(request.param)


def test_it_holds_only_what_a_robot_runs(tree: Path) -> None:
    machine = ELF_MACHINES[tree.parent.name]
    names, programs = set(), set()
    for path in tree.rglob("*"):
        status = path.lstat()
        names.add(path.name)
        assert path.exists(), f"{path} points to nothing"
        assert (status.st_uid, status.st_gid, status.st_mtime) == (0, 0, 0.0), path
        if stat.S_ISREG(status.st_mode):
            if status.st_mode & 0o111:
                programs.add(path.name)
            with path.open("rb") as file:
                head = file.read(20)
            if head.startswith(b"\x7fELF"):
                assert int.from_bytes(head[18:20], "little") == machine, path
        if not stat.S_ISLNK(status.st_mode):
            assert stat.S_IMODE(status.st_mode) in (0o755, 0o644), path
    assert not {name for name in names if FORBIDDEN.fullmatch(name)}
    assert {name for name in programs if not name.startswith("ld-linux")} == {"lpac", "python3.11"}
    assert list((tree / "release").iterdir()) == []


def test_of_our_own_it_holds_edge_and_the_commands_of_a_robot(tree: Path) -> None:
    site = tree / "usr/lib/python3/dist-packages"
    assert not (site / "export").exists()
    assert {str(p.relative_to(site / "lpac")) for p in (site / "lpac").rglob("*.py")} == {
        "__init__.py", "cli/__init__.py", "cli/apps.py", "cli/bundle.py", "cli/log.py",
        "cli/main.py", "cli/robot.py",
    }  # fmt: skip
    assert {str(p.relative_to(site / "edge")) for p in (site / "edge").rglob("*.py")} == {
        str(p.relative_to(ROOT / "edge")) for p in (ROOT / "edge").rglob("*.py")
    }


def test_it_says_what_it_is_made_of(tree: Path) -> None:
    versions = json.loads((tree / "usr/share/lpac/versions.json").read_text())
    assert versions["architecture"] == tree.parent.name
    locked = pinned(DOCKER / "requirements.lock")
    wheels = {name.split("-")[0]: name.split("-")[1] for name in versions["wheels"]}
    assert {canonicalize_name(name): v for name, v in wheels.items()} == locked | {
        "lpac-edge": tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
    }
    lines = (DOCKER / "debian.lock").read_text().splitlines()
    packages = {tuple(line.split()) for line in lines if line.startswith(tree.parent.name)}
    debian = versions["debian"].items()
    architecture = versions["architecture"]
    assert {(architecture, n, p["version"], p["sha256"]) for n, p in debian} == packages


def test_an_engine_can_load_it(tree: Path) -> None:
    archive = tree.parents[1] / f"lpac-edge-{tree.parent.name}.tar.gz"
    with tarfile.open(archive) as tar:
        files = {m.name: tar.extractfile(m) for m in tar if m.name.endswith(".json")}
        contents = {name: json.load(file) for name, file in files.items() if file}
    (entry,) = contents.pop("manifest.json")
    config = contents[entry["Config"]]
    assert entry["RepoTags"][0].endswith(f"lpac-edge:{tree.parent.name}")
    assert config["architecture"] == tree.parent.name
    assert config["config"]["User"] == "65532:65532"
    assert config["config"]["Entrypoint"] == ["/usr/bin/lpac"]


def test_it_is_small(tree: Path) -> None:
    (archive,) = tree.parents[1].glob(f"lpac-edge-{tree.parent.name}.tar.gz")
    # A quarter of what torch alone would add.
    assert archive.stat().st_size < 100e6


def test_it_runs_without_a_user_and_a_place_to_write(
    build_image: BuildImage, tmp_path: Path
) -> None:
    tree = build_image("amd64")
    if os.uname().machine != "x86_64":
        pytest.skip("this machine is no x86-64")
    shutil.copytree(SHIPPED, tmp_path, dirs_exist_ok=True)
    result = run_inside(tree, tmp_path, "--help")
    assert (result.returncode, result.stderr) == (0, "")
    listed = result.stdout.partition("Commands:")[2]
    assert re.findall(r"^  (\w+)  ", listed, re.MULTILINE) == ["bundle", "robot", "log"]
    result = run_inside(tree, tmp_path, "sim")
    assert result.returncode == 1
    assert result.stderr == (
        "lpac: lpac.cli.sim is not installed here: this command is for a workstation\n"
    )
    result = run_inside(tree, tmp_path, "bundle", "verify", "/release")
    assert (result.returncode, result.stderr) == (0, "")
    assert "this machine computes the golden outputs" in result.stdout
    result = run_inside(tree, tmp_path, "robot", "run", "--config", "/release/robot.toml")
    assert result.returncode == 1
    (line,) = result.stderr.splitlines()
    assert line.startswith("lpac: /release/robot.toml: cannot be read")


def run_inside(
    tree: Path, release: Path, *arguments: str, program: str = "/usr/bin/lpac"
) -> subprocess.CompletedProcess[str]:
    command = inside(tree, release, program, *arguments)
    return subprocess.run(command, capture_output=True, text=True, timeout=300.0, check=False)


class Builder:
    """The Dockerfile's build stage as a container, after it built the tree in /root_fs."""

    def __init__(self) -> None:
        certificates = os.environ.get("SSL_CERT_FILE", "/etc/ssl/certs/ca-certificates.crt")
        secret = ["--secret", f"id=certificates,src={certificates}"]
        host = buildah("info", "--format", "{{.host.arch}}")
        # As image.sh calls it: all comes from its cache.
        image = buildah(
            "build", "--quiet", "--platform=linux/amd64", "--file=deploy/docker/Dockerfile",
            "--build-arg=BASE=docker.io/library/debian:bookworm-slim",
            f"--build-arg=BUILDPLATFORM=linux/{host}", "--isolation=chroot", "--network=host",
            "--layers", "--pull=never", "--timestamp=0", "--target=build", *secret,
            "--ignorefile=deploy/docker/Dockerfile.dockerignore", ".",
        )  # fmt: skip
        self.container = buildah("from", "--pull-never", image.splitlines()[-1])
        self.files = Path(buildah("mount", self.container))
        self.volume = [f"--volume={certificates}:/run/secrets/certificates:ro"]

    def build_root(self, *arguments: str) -> subprocess.CompletedProcess[str]:
        command = ["buildah", "run", "--isolation=chroot", "--network=host", *self.volume,
                   self.container, "--", "python3", "/src/deploy/docker/build_root.py"]  # fmt: skip
        return subprocess.run([*command, *arguments], capture_output=True, text=True, check=False)


def buildah(*arguments: str) -> str:
    result = subprocess.run(
        ["buildah", *arguments], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert result.returncode == 0, result.stderr
    return result.stdout.strip()


@pytest.fixture(scope="module")
def builder(build_image: BuildImage) -> Iterator[Builder]:
    build_image("amd64")
    if buildah("images", "--quiet", "--filter", "reference=lpac-edge") == "":
        pytest.skip("docker built the image, and buildah knows nothing of it")
    made = Builder()
    yield made
    buildah("rm", made.container)


def test_two_builds_are_equal(builder: Builder) -> None:
    result = builder.build_root("assemble", "amd64", "/fetched", "/again")
    assert result.returncode == 0, result.stderr
    first, second = (contents(builder.files / name) for name in ("root_fs", "again"))
    assert first == second


def test_a_package_of_ones_own_is_on_the_robot(builder: Builder, tmp_path: Path) -> None:
    """As docs/extending.md says; and what it needs has to be there too."""
    packages = builder.files / "src/deploy/docker/packages"
    pip = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--wheel-dir"]
    needs_more = tmp_path / "lora"
    needs_more.mkdir()
    (needs_more / "lora.py").write_text("")
    (needs_more / "pyproject.toml").write_text(
        '[build-system]\nrequires = ["hatchling"]\nbuild-backend = "hatchling.build"\n'
        '[project]\nname = "lora"\nversion = "1"\ndependencies = ["spidev>=3"]\n'
    )
    try:
        subprocess.run([*pip, packages, ROOT / "examples" / "camera"], check=True)
        result = builder.build_root("assemble", "amd64", "/fetched", "/with_camera")
        assert result.returncode == 0, result.stderr
        subprocess.run([*pip, packages, needs_more], check=True)
        refused = builder.build_root("assemble", "amd64", "/fetched", "/with_lora")
    finally:
        for wheel in packages.glob("*.whl"):
            wheel.unlink()
    tree = builder.files / "with_camera"
    versions = json.loads((tree / "usr/share/lpac/versions.json").read_text())
    assert any(name.startswith("lpac_camera-") for name in versions["wheels"])
    opens = """
from edge.drivers.registry import open_sensor
from edge.policy.bundle import load_bundle
from pathlib import Path
with open_sensor("camera", {}, load_bundle(Path("/release")).manifest) as over:
    print(type(over("CircularBND 10 10 5 1", "world")).__name__)
"""
    said = run_inside(tree, SHIPPED, "-c", opens, program="/usr/bin/python3.11")
    assert (said.stdout, said.stderr) == ("RenderedCamera\n", "")
    assert refused.returncode == 1
    assert "spidev" in refused.stderr
    assert "image: the wheels of deploy/docker/packages do not fit" in refused.stderr


def contents(tree: Path) -> dict[str, tuple[object, ...]]:
    entries: dict[str, tuple[object, ...]] = {}
    for path in tree.rglob("*"):
        status = path.lstat()
        data = path.read_bytes() if stat.S_ISREG(status.st_mode) else None
        target = path.readlink() if path.is_symlink() else None
        entries[str(path.relative_to(tree))] = (status.st_mode, status.st_mtime, target, data)
    return entries


@pytest.mark.parametrize(
    ("lock", "told"),
    [("debian.lock", "is not what debian.lock names"), ("requirements.lock", "DO NOT MATCH")],
)
def test_nothing_is_built_of_what_the_lock_does_not_name(
    builder: Builder, lock: str, told: str
) -> None:
    folder = builder.files / "src/deploy/docker"
    kept = {}
    # One package of each is enough to be fetched.
    for name, entry in {
        "debian.lock": r"^amd64 gcc-12-base .*\n",
        "requirements.lock": r"^annotated-doc==.*\n(    --hash=.*\n)+",
    }.items():
        kept[name] = (folder / name).read_text()
        text = re.search(entry, kept[name], re.MULTILINE)
        assert text, name
        # Every hash is of another file than the one that was locked.
        changed = re.sub(r"[0-9a-f]{64}", "0" * 64, text[0]) if name == lock else text[0]
        (folder / name).write_text(changed)
    try:
        result = builder.build_root("fetch", "amd64", f"/fetched-{lock}")
    finally:
        for name, whole in kept.items():
            (folder / name).write_text(whole)
    assert result.returncode == 1
    assert told in result.stderr
