"""Release: image, policy, world, configuration, units and versions, sent as one.

Its id is the first 16 hex digits of the sha256 of its manifest, which has the hash of every file.
On the robot it is a folder named by its number.
"""

import hashlib
import json
import os
import stat
import time
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

from edge.core.world import parse_world
from edge.policy.bundle import Bundle, load_bundle
from lpac.fleet.settings import DEFAULT_DIRECTORY, FleetConfig, RobotHost
from lpac.fleet.writer import robot_toml
from lpac.shipped import shipped

_UNITS = tuple(shipped(f"systemd/{name}") for name in ("lpac-robot.service", "lpac-land.service"))
_IMAGE_VERSIONS = Path("usr/share/lpac/versions.json")

Entry = tuple[str, str]


class ReleaseError(ValueError):
    """Invalid part of a release. The message is one line: the cause, then what to do."""


@dataclass(frozen=True, slots=True)
class Image:
    """Unpacked image in `folder`.

    `entries` maps paths to (mode, sha256) or ("link", target). `id` is the hash of its content,
    `machine` the `uname -m` of the robots that it runs on.
    """

    folder: Path
    id: str
    machine: str
    packages: dict[str, Any]
    entries: dict[str, Entry]
    size_bytes: int


class Release(NamedTuple):
    """One robot's release: `image`, and everything else in `folder`.

    `number` is greater than that of any earlier release.
    """

    id: str
    number: int
    image: Image
    folder: Path
    size_bytes: int


class Common(NamedTuple):
    """Checked parts that a fleet's releases share, and their number: the Unix time, s."""

    number: int
    image: Image
    bundle: Bundle
    world: bytes
    units: dict[str, bytes]


def load_common(config: FleetConfig) -> Common:
    """Read and check image, bundle and world. Raises ReleaseError, ValueError or OSError."""
    world = config.world.read_bytes()
    parse_world(world.decode("utf-8-sig"), str(config.world))
    bundle = load_bundle(config.bundle)
    if bundle.manifest.perception is None:
        raise ReleaseError(f"{config.bundle}: the bundle has no perception: it cannot fly")
    units = {unit.name: unit.read_bytes() for unit in _UNITS}
    return Common(int(time.time()), load_image(config.image), bundle, world, units)


def load_image(folder: Path) -> Image:
    """Load the unpacked image from `make image`. Raises ReleaseError."""
    root = folder / "root"
    try:
        packages = json.loads((root / _IMAGE_VERSIONS).read_text("utf-8"))
        machine = {"arm64": "aarch64", "amd64": "x86_64"}[packages["architecture"]]
    except (OSError, ValueError, KeyError):
        raise ReleaseError(f"{folder}: has no image: run `make image`") from None
    entries: dict[str, Entry] = {}
    size_bytes = 0
    for parent, folders, files in os.walk(root):
        for name in (*folders, *files):
            path = Path(parent, name)
            info = path.lstat()
            if stat.S_ISREG(info.st_mode):
                size_bytes += info.st_size
            if not stat.S_ISDIR(info.st_mode):
                entries[str(path.relative_to(root))] = _entry(path, info)
    text = json.dumps(entries, sort_keys=True).encode()
    return Image(
        root, hashlib.sha256(text).hexdigest()[:16], machine, packages, entries, size_bytes
    )


def make_release(config: FleetConfig, robot: RobotHost, common: Common, folder: Path) -> Release:
    """Write everything but the image to `folder`, which must be empty."""
    slot = config.slot_of(robot.name)
    files = {f"bundle/{name}": data for name, data in common.bundle.files.items()}
    files["world.env"] = common.world
    files |= common.units
    files |= {name: text.encode() for name, text in drop_ins(config, robot).items()}
    if slot is not None:
        files["robot.toml"] = robot_toml(config, robot.name).encode()
    versions = {
        "lpac-edge": version("lpac-edge"),
        "fleet": config.fleet,
        "robot": robot.name,
        "image": common.image.id,
        "bundle": common.bundle.id,
        "world": hashlib.sha256(common.world).hexdigest()[:12],
        "packages": common.image.packages,
    }
    files["versions.json"] = json.dumps(versions, indent=2, sort_keys=True).encode()
    entries = {f"root/{path}": entry for path, entry in common.image.entries.items()}
    for path, data in files.items():
        target = folder / path
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_bytes(data)
        target.chmod(0o644)
        entries[path] = _entry(target, target.lstat())
    manifest = json.dumps({"files": entries}, sort_keys=True).encode()
    (folder / "manifest.json").write_bytes(manifest)
    (folder / "manifest.json").chmod(0o644)
    size_bytes = common.image.size_bytes + len(manifest) + sum(map(len, files.values()))
    name = hashlib.sha256(manifest).hexdigest()[:16]
    return Release(name, common.number, common.image, folder, size_bytes)


def drop_ins(config: FleetConfig, robot: RobotHost) -> dict[str, str]:
    """Drop-ins of the units: the texts of lpac-robot.conf and lpac-land.conf, if any."""
    unit, place = [], []
    if config.directory != DEFAULT_DIRECTORY:
        current = f"{config.directory}/current"
        unit = ["ConditionPathExists=", f"ConditionPathExists={current}/robot.toml"]
        place = [
            f"RootDirectory={config.directory}/sandbox",
            # The empty assignment also clears BindPaths.
            "BindReadOnlyPaths=",
            f"BindReadOnlyPaths={current}/root:/",
            f"BindReadOnlyPaths={current}:/release",
        ]
    flies = list(place)
    if place:
        flies += [
            "BindReadOnlyPaths=/run/systemd/notify",
            "BindPaths=/var/lib/private/lpac:/var/lib/lpac",
        ]
    if robot.cpus:
        flies += ["CPUAffinity=", f"CPUAffinity={' '.join(map(str, robot.cpus))}"]
    texts = {}
    for name, service in (("lpac-robot.conf", flies), ("lpac-land.conf", place)):
        sections = {"[Unit]": unit, "[Service]": service}
        written = ["\n".join([head, *lines, ""]) for head, lines in sections.items() if lines]
        if written:
            texts[name] = "\n".join(written)
    return texts


def _entry(path: Path, info: os.stat_result) -> Entry:
    """Manifest entry, as `lpac.fleet.agent.check` computes it on the robot."""
    if stat.S_ISLNK(info.st_mode):
        return "link", str(path.readlink())
    with path.open("rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
    return oct(stat.S_IMODE(info.st_mode)), digest
