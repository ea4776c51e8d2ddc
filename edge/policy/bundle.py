"""A policy's bundle: its files, and a manifest with their hashes.

On disk a bundle is a directory or an archive (an uncompressed, deterministic zip) with
`manifest.json`, `bundle.id`, and the files of the policy's family.
"""

import dataclasses
import hashlib
import io
import json
import tempfile
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath

from edge.core.file_errors import in_words
from edge.core.perception import PerceptionParameters
from edge.core.schema import Bounded, ConfigError, Positive, from_mapping
from edge.core.wire import FLOAT_PAYLOADS, PayloadType

# Version of the manifests that this module reads and writes.
SCHEMA_VERSION = 1
MANIFEST = "manifest.json"
BUNDLE_ID = "bundle.id"
# Family of a manifest without this key, which older bundles do not have.
LPAC = "lpac"
# The oldest date of a zip entry, so that archives do not depend on the day.
_ARCHIVE_DATE = (1980, 1, 1, 0, 0, 0)
# The shipped bundle has 4 MB. Limits protect from bundles of unknown origin.
_MAX_BYTES = 2**25
_MAX_MANIFEST_BYTES = 2**20


class BundleError(ValueError):
    """The bundle cannot be used; the text names the part and the cause."""


@dataclass(frozen=True, slots=True)
class Training(Bounded):
    """Scales and world of the policy's training.

    Model units are metres here: `max_speed` is in units/s, `time_step` in s. `idf_truncation` is
    in standard deviations; `idf_norm` is the largest importance of a cell.
    """

    max_speed: Positive
    time_step: Positive
    env_scale: Positive = 1.0
    velocity_scale: Positive = 1.0
    idf_truncation: Positive = 2.0
    idf_norm: Positive = 1.0


@dataclass(frozen=True, slots=True)
class Manifest(Bounded):
    """The bundle's description.

    `perception` is None in a bundle that robots cannot fly. `provenance` holds names and hashes of
    the bundle's sources, chosen by its maker. `parameters` are the keys of the family, in JSON's
    types. Robots refuse payloads with a number beyond `payload_limit`; None allows any finite one.
    `payload_types` are the types with which the policy was evaluated in closed loop; robots send no
    others.
    """

    schema: int
    name: str
    perception: PerceptionParameters | None
    training: Training
    provenance: dict[str, str]
    files: dict[str, str]
    family: str = LPAC
    payload_limit: Positive | None = None
    payload_types: tuple[PayloadType, ...] = FLOAT_PAYLOADS
    parameters: dict[str, object] = field(default_factory=dict)

    def check_rules(self) -> None:
        if self.schema != SCHEMA_VERSION:
            raise ValueError(f"schema = {self.schema}: this version reads {SCHEMA_VERSION}")
        for key in self.parameters.keys() & _KEYS:
            raise ValueError(f"parameters: {key} is a key of every manifest")


_KEYS = {each.name for each in dataclasses.fields(Manifest)} - {"parameters"}


@dataclass(frozen=True, slots=True)
class Bundle:
    """A bundle in memory with matching hashes. `id` is the manifest's sha256 in hexadecimal."""

    id: str
    manifest: Manifest
    files: Mapping[str, bytes]


def make_bundle(manifest: Manifest, files: Mapping[str, bytes]) -> Bundle:
    """Seal a policy's `files`: write their hashes into the manifest."""
    hashes = {name: _sha256(files[name]) for name in sorted(files)}
    mapping = dataclasses.asdict(dataclasses.replace(manifest, files=hashes))
    mapping |= mapping.pop("parameters")
    if manifest.family == LPAC:
        del mapping["family"]
    if manifest.payload_limit is None:
        del mapping["payload_limit"]
    if manifest.payload_types == FLOAT_PAYLOADS:
        del mapping["payload_types"]
    if manifest.perception and not manifest.perception.unseen_as_nan:
        del mapping["perception"]["unseen_as_nan"]
    if manifest.perception and not manifest.perception.shared_map_cell:
        del mapping["perception"]["shared_map_cell"]
    text = json.dumps(mapping, indent=2, sort_keys=True) + "\n"
    bundle_id = _sha256(text.encode())
    sealed = {**files, MANIFEST: text.encode(), BUNDLE_ID: f"{bundle_id}\n".encode()}
    return Bundle(bundle_id, _manifest(text.encode(), manifest.name), sealed)


def _manifest(text: bytes, where: str) -> Manifest:
    """Parse a manifest. Raises BundleError, one line with `where`."""
    if len(text) > _MAX_MANIFEST_BYTES:
        raise BundleError(f"{where} has {len(text)} bytes: more than {_MAX_MANIFEST_BYTES}")
    try:
        mapping = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise BundleError(f"{where} is not JSON: {error}") from None
    try:
        if isinstance(mapping, dict):
            parameters = {key: mapping.pop(key) for key in mapping.keys() - _KEYS}
            mapping["parameters"] = parameters
        return from_mapping(Manifest, mapping, where)
    except ConfigError as error:
        raise BundleError(str(error)) from None


def load_bundle(path: Path | str) -> Bundle:
    """Read a bundle's directory or archive. Raises BundleError that names the fault.

    Checks the schema, every hash, and missing and unknown files. The family checks the rest.
    """
    path = Path(path)
    files = _read(path)
    for name in (MANIFEST, BUNDLE_ID):
        if name not in files:
            raise BundleError(f"{path}: {name} is missing: not a bundle")
    bundle_id = _sha256(files[MANIFEST])
    if files[BUNDLE_ID] != f"{bundle_id}\n".encode():
        raise BundleError(f"{path}: {MANIFEST} does not have the hash that {BUNDLE_ID} states")
    manifest = _manifest(files[MANIFEST], f"{path}: {MANIFEST}")
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

    Replaces an existing bundle. Raises BundleError if `path` is something else or not writable.
    """
    try:
        _write(bundle, path.resolve())
    except OSError as error:
        raise BundleError(f"{path}: cannot write the bundle: {in_words(error)}") from None


def _write(bundle: Bundle, path: Path) -> None:
    is_archive = path.suffix == ".zip"
    if path.exists() and (path.is_file() != is_archive or not _is_replaceable(path)):
        raise BundleError(
            f"{path}: exists and is not a bundle: choose another name "
            "(an archive's ends in .zip, a directory's does not)"
        )
    path.parent.mkdir(parents=True, exist_ok=True)
    # Build it next to the destination, then move: readers never find half a bundle.
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


def _is_replaceable(path: Path) -> bool:
    """Whether `path` holds only a bundle's files, or is an empty folder."""
    try:
        files = _read(path)
        belongs = {MANIFEST, BUNDLE_ID, *_manifest(files[MANIFEST], str(path)).files}
    except BundleError:
        return False
    except KeyError:
        return path.is_dir() and not any(path.iterdir())
    return BUNDLE_ID in files and files.keys() <= belongs


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
                return {}  # may be a large unrelated folder
            entries = list(path.iterdir())
            _check_size(path, sum(entry.stat().st_size for entry in entries if entry.is_file()))
            return {entry.name: entry.read_bytes() if entry.is_file() else b"" for entry in entries}
        _check_size(path, path.stat().st_size)
        content = path.read_bytes()
    except OSError as error:
        raise BundleError(f"{path}: {in_words(error)}") from None
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            _check_size(path, sum(info.file_size for info in archive.infolist()))
            files = {name: archive.read(name) for name in archive.namelist()}
    except BundleError:
        raise
    except Exception as error:  # zipfile raises many types for damaged files
        raise BundleError(
            f"{path}: is neither a bundle's directory nor its archive: {error}"
        ) from None
    if any(PurePosixPath(name).name == "data.pkl" for name in files):
        raise BundleError(
            f"{path}: is a torch checkpoint; `lpac export {path} --params FILE.toml -o BUNDLE` "
            "makes a bundle of it"
        )
    if _archive(files) != content:
        raise BundleError(f"{path}: its bytes differ from those that `lpac` writes for its content")
    return files


def _check_size(path: Path, size: int) -> None:
    if size > _MAX_BYTES:
        raise BundleError(
            f"{path}: has {size / 1e6:.0f} MB; a bundle has at most {_MAX_BYTES / 1e6:.0f}"
        )
