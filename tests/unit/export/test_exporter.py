"""From a checkpoint to a bundle on disk: `lpac export`, and the shipped policy."""

import hashlib
import shutil
from pathlib import Path

import pytest
import torch
import typer
from typer.testing import CliRunner, Result

from edge.core.perception import PerceptionParameters
from edge.policy.bundle import load_bundle
from edge.policy.lpac.manifest import LpacManifest
from edge.policy.lpac.policy import LpacPolicy
from export.checkpoint import CheckpointError, Cnn, read_checkpoint
from export.exporter import export_bundle
from export.training_maps import outside_share
from lpac.cli.export import export
from tests.conftest import ROOT
from tests.unit.export.states import random_state

POLICIES = ROOT / "policies"
NAME = "lpac_l2_k3_n10_512"


def run(*arguments: str | Path) -> Result:
    app = typer.Typer()
    app.command()(export)
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


def test_shipped_policy_is_what_its_checkpoint_gives() -> None:
    shipped = load_bundle(POLICIES / NAME)
    bundle = export_bundle(POLICIES / f"{NAME}.pt", POLICIES / f"{NAME}.toml")
    for name in LpacManifest.of(bundle.manifest).graphs:
        assert bundle.files[name] == shipped.files[name], name
    assert bundle.manifest.name == NAME
    for field in ("family", "parameters", "perception", "training"):
        assert getattr(bundle.manifest, field) == getattr(shipped.manifest, field)
    provenance = shipped.manifest.provenance
    for file, sha256 in (
        (provenance["checkpoint"], provenance["checkpoint_sha256"]),
        (provenance["parameters"], provenance["parameters_sha256"]),
    ):
        assert hashlib.sha256((POLICIES / file).read_bytes()).hexdigest() == sha256


def test_a_parameter_file_of_another_world_is_refused_unless_it_is_forced(tmp_path: Path) -> None:
    """Each shipped network shows how much of its training maps lay outside the world."""
    text = (POLICIES / f"{NAME}.toml").read_text()
    other = tmp_path / "other.toml"
    other.write_text(text.replace("world_size = 512", "world_size = 1024"))
    # Without the bundle next to it.
    field = shutil.copy(POLICIES / "field" / "field.pt", tmp_path)
    for checkpoint in (POLICIES / f"{NAME}.pt", Path(field)):
        share = outside_share(cnn_of(checkpoint))
        assert share is not None and 0.1 < share < 0.2
        export_bundle(checkpoint, POLICIES / f"{NAME}.toml")
        with pytest.raises(CheckpointError, match=r"world_size = 1024.*--force"):
            export_bundle(checkpoint, other)
    refused = run(POLICIES / f"{NAME}.pt", "--params", other, "-o", tmp_path / "bundle")
    assert isinstance(refused.exception, CheckpointError)
    forced = run(POLICIES / f"{NAME}.pt", "--params", other, "-o", tmp_path / "bundle", "--force")
    assert forced.exit_code == 0
    torch.save(random_state(), tmp_path / "untrained.pt")
    assert outside_share(cnn_of(tmp_path / "untrained.pt")) is None


def cnn_of(checkpoint: Path) -> Cnn:
    cnn = read_checkpoint(checkpoint).cnn
    assert cnn is not None
    return cnn


@pytest.mark.parametrize(
    ("changed", "why"),
    [
        ("max_speed = 1.0", r"max_speed = 1, the mean training action .* 3\.6 times the maximum"),
        ("max_speed = 100.0", "max_speed = 100, the mean training action"),
    ],
)
def test_a_speed_that_its_actions_cannot_have_is_refused(
    changed: str, why: str, tmp_path: Path
) -> None:
    checkpoint = Path(shutil.copy(POLICIES / f"{NAME}.pt", tmp_path))
    other = tmp_path / "other.toml"
    other.write_text((POLICIES / f"{NAME}.toml").read_text().replace("max_speed = 5.0", changed))
    with pytest.raises(CheckpointError, match=why):
        export_bundle(checkpoint, other)


def test_a_bundle_beside_the_checkpoint_knows_what_it_was_trained_with(tmp_path: Path) -> None:
    with pytest.raises(CheckpointError) as caught:
        export_bundle(POLICIES / "field" / "field.pt", POLICIES / f"{NAME}.toml")
    text = str(caught.value)
    assert (
        "env_scale = 1.0 (in the bundle 16.0)" in text
        and "shared_map_cell = 0 (in the bundle 8)" in text
    )
    assert "world_size" not in text and "unseen" not in text
    # The configuration of `lpac train` has the same values.
    export_bundle(POLICIES / "field" / "field.pt", POLICIES / "field" / "config.toml")
    # The bundle of another checkpoint is ignored.
    shutil.copytree(POLICIES / "field" / "field", tmp_path / NAME)
    shutil.copy(POLICIES / f"{NAME}.pt", tmp_path)
    export_bundle(tmp_path / f"{NAME}.pt", POLICIES / f"{NAME}.toml")


def test_the_authors_taps_with_a_cnn_are_a_whole_policy(authors_taps: Path, tmp_path: Path) -> None:
    parameters, whole = POLICIES / f"{NAME}.toml", POLICIES / f"{NAME}.pt"
    bundle = export_bundle(authors_taps, parameters, cnn=whole)
    assert bundle.manifest.perception is not None and "cnn.onnx" in bundle.files
    assert bundle.files["cnn.onnx"] == load_bundle(POLICIES / NAME).files["cnn.onnx"]
    sha256 = hashlib.sha256(whole.read_bytes()).hexdigest()
    assert bundle.manifest.provenance["cnn_sha256"] == sha256
    with pytest.raises(CheckpointError, match="has no CNN"):
        export_bundle(authors_taps, parameters, cnn=authors_taps)
    torch.save(random_state(), tmp_path / "small.pt")
    with pytest.raises(CheckpointError, match="gives 8 features, expected the 32"):
        export_bundle(authors_taps, parameters, cnn=tmp_path / "small.pt")


def test_two_exports_give_the_same_bytes(tmp_path: Path) -> None:
    torch.save(random_state(), tmp_path / "model.pt")
    first, second = (
        export_bundle(tmp_path / "model.pt", POLICIES / f"{NAME}.toml") for _ in range(2)
    )
    assert first.files == second.files
    assert str(tmp_path).encode() not in b"".join(first.files.values())


def test_command_writes_a_bundle_that_verifies(tmp_path: Path) -> None:
    torch.save(random_state(channels=2, image_size=20), tmp_path / "model.pt")
    for output in (tmp_path / "bundle", tmp_path / "bundle.zip"):
        result = run(
            *(tmp_path / "model.pt", "--params", POLICIES / f"{NAME}.toml"),
            *("-o", output, "--name", "ours"),
        )
        assert result.exit_code == 0, result.output
        bundle = load_bundle(output)
        assert bundle.manifest.name == "ours"
        images = LpacManifest.of(bundle.manifest).images
        assert images and images.channels == ("importance", "obstacles")
        assert (images.size, images.features) == (20, 8)
        assert bundle.manifest.perception == PerceptionParameters(512, 256, 64, 256.0)
        assert all(check.passed for check in LpacPolicy(bundle).verify())
        assert bundle.id in result.output
        assert "L = 2 layers (10 -> 16 -> 16), K = 1 hops" in result.output


def test_a_checkpoint_of_five_images_sees_what_was_explored(tmp_path: Path) -> None:
    torch.save(random_state(channels=5), tmp_path / "model.pt")
    result = run(
        *(tmp_path / "model.pt", "--params", POLICIES / f"{NAME}.toml"),
        *("-o", tmp_path / "bundle"),
    )
    assert result.exit_code == 0, result.output
    bundle = load_bundle(tmp_path / "bundle")
    images = LpacManifest.of(bundle.manifest).images
    assert images is not None and images.channels == (
        "importance", "neighbours_x", "neighbours_y", "explored", "obstacles",
    )  # fmt: skip
    assert bundle.manifest.perception == PerceptionParameters(
        512, 256, 64, 256.0, unseen_as_nan=True
    )
    assert all(check.passed for check in LpacPolicy(bundle).verify())


def test_authors_taps_give_a_bundle_without_perception(authors_taps: Path, tmp_path: Path) -> None:
    result = run(*(authors_taps, "--params", POLICIES / f"{NAME}.toml", "-o", tmp_path / "bundle"))
    assert result.exit_code == 0, result.output
    assert "none: graph neural network and action only" in result.output
    manifest = load_bundle(tmp_path / "bundle").manifest
    assert manifest.name == authors_taps.name
    assert manifest.perception is None
    lpac = LpacManifest.of(manifest)
    assert lpac.images is None and lpac.geometry.layers == 5


def test_nothing_is_written_when_the_input_is_wrong(tmp_path: Path) -> None:
    (tmp_path / "model.pt").write_text("not a checkpoint")
    result = run(
        *(tmp_path / "model.pt", "--params", POLICIES / f"{NAME}.toml"),
        *("-o", tmp_path / "bundle"),
    )
    assert result.exit_code == 1
    assert isinstance(result.exception, ValueError)
    assert sorted(tmp_path.iterdir()) == [tmp_path / "model.pt"]


def test_a_network_that_float32_cannot_compute_is_refused(tmp_path: Path) -> None:
    state = random_state(convolutions=2)
    # Two equal channels with values in the millions, which cancel only in exact arithmetic.
    for name in state:
        if ".conv1." in name or (".batch_norm1." in name and state[name].dim()):
            state[name][1] = state[name][0]
    linear = state["cnn_backbone.linear_1.weight"].view(8, 8, -1)
    linear[:, 0] += 1e6
    linear[:, 1] -= 1e6
    torch.save(state, tmp_path / "model.pt")
    with pytest.raises(CheckpointError, match=r"model\.pt: cnn\.onnx: float32 rounding alone"):
        export_bundle(tmp_path / "model.pt", POLICIES / f"{NAME}.toml")
