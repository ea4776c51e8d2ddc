"""A policy as a bundle: ONNX graphs, golden outputs, and a manifest that pins every byte.

On disk a bundle is a directory, or its archive (an uncompressed zip whose bytes follow from the
content): `manifest.json`, `bundle.id`, `cnn.onnx`, `gnn_<l>.onnx`, `action.onnx`,
`golden.npz`.
"""

import dataclasses
import hashlib
import io
import json
import re
import tempfile
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from edge.core.aggregation import Geometry
from edge.core.perception import MAP_CHANNELS, PerceptionParameters
from edge.core.schema import ConfigError, from_mapping

SCHEMA_VERSION = 1
MANIFEST = "manifest.json"
BUNDLE_ID = "bundle.id"
GOLDEN = "golden.npz"
CNN = "cnn.onnx"
ACTION = "action.onnx"
# The oldest date that a zip entry can have, so that archives do not depend on the day.
_ARCHIVE_DATE = (1980, 1, 1, 0, 0, 0)


class BundleError(ValueError):
    """The bundle cannot be used; the text says which part and why."""


def gnn_graph(layer: int) -> str:
    """File name of GNN layer `layer` = 1..L."""
    return f"gnn_{layer}.onnx"


@dataclass(frozen=True, slots=True)
class Images:
    """What the CNN takes and gives."""

    channels: tuple[str, ...]
    size: int
    features: int
    activation: Literal["leaky_relu_0.01"] = "leaky_relu_0.01"
    padding: Literal["none"] = "none"

    def __post_init__(self) -> None:
        if self.channels not in MAP_CHANNELS.values():
            allowed = " or ".join(", ".join(names) for names in MAP_CHANNELS.values())
            raise ValueError(f"channels = {', '.join(self.channels)}: allowed are {allowed}")
        if self.size < 1 or self.features < 1:
            raise ValueError(f"size = {self.size}, features = {self.features}: must be positive")


@dataclass(frozen=True, slots=True)
class Training:
    """The scales and the world that the policy was trained with.

    Model units are metres here: `max_speed` is in units/s, `time_step` in s. `idf_truncation` is
    in standard deviations; `idf_norm` is the importance of the most important cell.
    """

    max_speed: float
    time_step: float
    env_scale: float = 1.0
    velocity_scale: float = 1.0
    idf_truncation: float = 2.0
    idf_norm: float = 1.0

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            if not 0 < value < float("inf"):
                raise ValueError(f"{field.name} = {value}: must be positive and finite")


@dataclass(frozen=True, slots=True)
class Provenance:
    """Where the bundle came from; hashes are sha256."""

    checkpoint: str
    checkpoint_sha256: str
    parameters: str
    parameters_sha256: str
    exporter: str
    torch: str


@dataclass(frozen=True, slots=True)
class Manifest:
    """The bundle's description. `images` and `perception` are None in one without perception."""

    schema: int
    name: str
    opset: int
    geometry: Geometry
    images: Images | None
    perception: PerceptionParameters | None
    training: Training
    provenance: Provenance
    files: dict[str, str]

    def __post_init__(self) -> None:
        if self.schema != SCHEMA_VERSION:
            raise ValueError(f"schema = {self.schema}: this version reads {SCHEMA_VERSION}")
        if (self.images is None) != (self.perception is None):
            raise ValueError("images and perception: both or neither")
        if self.images and self.geometry.feature_sizes[0] != self.images.features + 2:
            raise ValueError(
                f"geometry.feature_sizes[0] = {self.geometry.feature_sizes[0]}: must be "
                f"images.features + 2 = {self.images.features + 2}"
            )
        expected = {*self.graphs, GOLDEN}
        if set(self.files) != expected:
            raise ValueError(
                f"files = {', '.join(sorted(self.files))}: must be {', '.join(sorted(expected))}"
            )

    @property
    def graphs(self) -> tuple[str, ...]:
        """The graphs' file names, in the order of computation."""
        layers = (gnn_graph(layer) for layer in range(1, self.geometry.layers + 1))
        return (*((CNN,) if self.images else ()), *layers, ACTION)


@dataclass(frozen=True, slots=True)
class Bundle:
    """A bundle in memory whose hashes agree. `id` is the manifest's sha256 in hexadecimal."""

    id: str
    manifest: Manifest
    files: Mapping[str, bytes]


def make_bundle(manifest: Manifest, files: Mapping[str, bytes]) -> Bundle:
    """Seal `files` (graphs and golden vectors): their hashes are written into the manifest."""
    hashes = {name: _sha256(files[name]) for name in sorted(files)}
    manifest = dataclasses.replace(manifest, files=hashes)
    text = json.dumps(dataclasses.asdict(manifest), indent=2, sort_keys=True) + "\n"
    bundle_id = _sha256(text.encode())
    sealed = {**files, MANIFEST: text.encode(), BUNDLE_ID: f"{bundle_id}\n".encode()}
    return Bundle(bundle_id, manifest, sealed)


def load_bundle(path: Path) -> Bundle:
    """Read a bundle's directory or archive; raises BundleError that names what is wrong.

    Checked here: the schema, every hash, missing and unknown files. Whether the graphs compute
    what torch computed is `verify`'s matter.
    """
    files = _read(path)
    for name in (MANIFEST, BUNDLE_ID):
        if name not in files:
            raise BundleError(f"{path}: {name} is missing; is this a bundle?")
    bundle_id = _sha256(files[MANIFEST])
    if files[BUNDLE_ID] != f"{bundle_id}\n".encode():
        raise BundleError(f"{path}: {MANIFEST} does not have the hash that {BUNDLE_ID} states")
    try:
        manifest = from_mapping(Manifest, json.loads(files[MANIFEST]), f"{path}: {MANIFEST}")
    except ConfigError as error:
        raise BundleError(str(error)) from None
    except ValueError as error:
        raise BundleError(f"{path}: {MANIFEST} is not JSON: {error}") from None
    for name in sorted(manifest.files.keys() - files.keys()):
        raise BundleError(f"{path}: {name} is missing")
    for name in sorted(files.keys() - manifest.files.keys() - {MANIFEST, BUNDLE_ID}):
        raise BundleError(f"{path}: {name} does not belong to the bundle")
    for name, expected in manifest.files.items():
        if _sha256(files[name]) != expected:
            raise BundleError(f"{path}: {name} does not have the hash that {MANIFEST} states")
    return Bundle(bundle_id, manifest, files)


def write_bundle(bundle: Bundle, path: Path) -> None:
    """Write the bundle as an archive if `path` ends in .zip, else as a directory.

    Replaces a bundle of that name; raises BundleError if something else is there, or if it cannot
    be written.
    """
    try:
        _write(bundle, path.resolve())
    except OSError as error:
        raise BundleError(f"{path}: cannot be written: {error.strerror}") from None


def _write(bundle: Bundle, path: Path) -> None:
    is_archive = path.suffix == ".zip"
    if path.exists() and (path.is_file() != is_archive or not _holds_a_bundle(path)):
        raise BundleError(
            f"{path}: is there already and is no bundle: choose another name "
            "(an archive's ends in .zip, a directory's does not)"
        )
    path.parent.mkdir(parents=True, exist_ok=True)
    # Built beside its place and moved there, so that no half-written bundle is ever found.
    with tempfile.TemporaryDirectory(dir=path.parent, prefix=f".{path.name}.") as scratch:
        new = Path(scratch) / "new"
        if is_archive:
            new.write_bytes(_archive(bundle.files))
        else:
            new.mkdir()
            for name, content in bundle.files.items():
                (new / name).write_bytes(content)
            if path.is_dir():
                path.rename(Path(scratch) / "old")
        new.replace(path)


def _holds_a_bundle(path: Path) -> bool:
    """Whether there is nothing but a bundle's files, or nothing at all, at `path`."""
    if path.is_dir():
        names = {entry.name for entry in path.iterdir()}
    else:
        try:
            names = set(zipfile.ZipFile(path).namelist())
        except zipfile.BadZipFile:
            return False
    belongs = re.compile(r"manifest\.json|bundle\.id|golden\.npz|(cnn|gnn_\d+|action)\.onnx")
    return not names or (BUNDLE_ID in names and all(map(belongs.fullmatch, names)))


def _sha256(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


def _archive(files: Mapping[str, bytes]) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_STORED) as archive:
        for name in sorted(files):
            info = zipfile.ZipInfo(name, _ARCHIVE_DATE)
            info.create_system = 3
            info.external_attr = 0o644 << 16
            archive.writestr(info, files[name])
    return buffer.getvalue()


def _read(path: Path) -> dict[str, bytes]:
    try:
        if path.is_dir():
            if not (path / MANIFEST).is_file():
                return {}  # perhaps a large folder of something else
            return {
                entry.name: entry.read_bytes() if entry.is_file() else b""
                for entry in path.iterdir()
            }
        content = path.read_bytes()
    except OSError as error:
        raise BundleError(f"{path}: {error.strerror}") from None
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            files = {name: archive.read(name) for name in archive.namelist()}
    except Exception as error:  # zipfile raises many kinds on damaged input
        raise BundleError(
            f"{path}: is neither a bundle directory nor its archive: {error}"
        ) from None
    if _archive(files) != content:
        raise BundleError(f"{path}: the archive's bytes are not those that its content gives")
    return files
