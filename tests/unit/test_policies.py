"""The policies that ship are what their checksums, their cards and their bundles say."""

import hashlib
import tomllib
from pathlib import Path

import pytest

from edge.drivers.registry import load_verified_policy
from edge.policy.bundle import load_bundle
from lpac.cli.options import DEFAULT_BUNDLE
from lpac.train.config import config_digest
from tests.conftest import ROOT

POLICIES = ROOT / "policies"
LINES = [line.split("  ") for line in (POLICIES / "SHA256SUMS").read_text().splitlines()]
SUMS = {name: checksum for checksum, name in LINES}
TRAINED = sorted(path.parent for path in POLICIES.glob("*/config.toml"))


def test_each_checkpoint_and_bundle_has_its_checksum() -> None:
    suffixes = {".pt", ".onnx", ".npz", ".json", ".id", ".toml"}
    files = {path for path in POLICIES.rglob("*") if path.suffix in suffixes}
    assert {POLICIES / name for name in SUMS} == files
    for path in files:
        told = hashlib.sha256(path.read_bytes()).hexdigest()
        assert told == SUMS[str(path.relative_to(POLICIES))], path


@pytest.mark.parametrize("folder", TRAINED, ids=lambda folder: folder.name)
def test_a_card_tells_of_the_policy_beside_it(folder: Path) -> None:
    text = (folder / "config.toml").read_text()
    name = tomllib.loads(text)["export"]["name"]
    bundle = load_bundle(folder / name)
    checkpoint = hashlib.sha256((folder / f"{name}.pt").read_bytes()).hexdigest()
    assert bundle.manifest.provenance["checkpoint_sha256"] == checkpoint
    card = (folder / "README.md").read_text()
    for told in (bundle.id, config_digest(text), "Licence: MIT."):
        assert told in card
    for figure in card.split("](")[1:]:
        assert (folder / figure.partition(")")[0]).exists()
    load_verified_policy(folder / name)
    # `lpac train` makes it again.
    example = (ROOT / "examples" / f"{folder.name}.toml").read_text()
    assert config_digest(example) == config_digest(text)


def test_robots_fly_the_fields_if_nothing_else_is_said() -> None:
    assert DEFAULT_BUNDLE == POLICIES / "field" / "field"
