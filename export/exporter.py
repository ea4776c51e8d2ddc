"""From a checkpoint and its parameters to a bundle."""

import hashlib
from collections.abc import Mapping
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path

import torch

from edge.policy.bundle import SCHEMA_VERSION, Bundle, Manifest, make_bundle
from edge.policy.family import TOLERANCE
from edge.policy.lpac.images import EXPLORED, MAP_CHANNELS
from edge.policy.lpac.manifest import GOLDEN, Images, LpacManifest
from edge.policy.lpac.policy import LpacPolicy
from export.checkpoint import Checkpoint, CheckpointError, read_checkpoint
from export.golden import golden_vectors
from export.graphs import OPSET, build_graphs
from export.parameters import PolicyParameters, read_parameters


def export_bundle(checkpoint: Path, parameters: Path, name: str | None = None) -> Bundle:
    """Make the bundle of a checkpoint: a state dict's file, or a folder of one file per tensor.

    `parameters` is our parameter file or a coverage_control_params.toml. `name` is the policy's
    name, by default the checkpoint's. A folder holds no CNN: its bundle is without perception.

    The bundle has passed `verify` on this machine. Raises CheckpointError or ConfigError, one line
    each.
    """
    network = read_checkpoint(checkpoint)
    trained = read_parameters(parameters)
    # Hashes are sha256.
    provenance = {
        "checkpoint": checkpoint.name,
        "checkpoint_sha256": network.sha256,
        "parameters": parameters.name,
        "parameters_sha256": hashlib.sha256(parameters.read_bytes()).hexdigest(),
    }
    try:
        return bundle_of(network, trained, name or checkpoint.stem, provenance)
    except CheckpointError as error:
        raise CheckpointError(f"{checkpoint}: {error}") from None


def bundle_of(
    network: Checkpoint, trained: PolicyParameters, name: str, provenance: Mapping[str, str]
) -> Bundle:
    """The bundle of a network in memory; it has passed `verify` on this machine.

    `provenance` says where the network came from; the exporter adds itself. Whether what is unseen
    is NaN in the local map follows from the network's images, whatever `trained` says. Raises
    CheckpointError, one line.
    """
    files = {GOLDEN: golden_vectors(network), **build_graphs(network)}
    images = perception = None
    if network.cnn:
        images = Images(
            MAP_CHANNELS[network.cnn.channels],
            network.cnn.image_size,
            len(network.cnn.linear.bias),
        )
        perception = replace(trained.perception, unseen_as_nan=EXPLORED in images.channels)
    manifest = Manifest(
        schema=SCHEMA_VERSION,
        name=name,
        perception=perception,
        training=trained.training,
        payload_limit=trained.messages.payload_limit,
        payload_types=trained.messages.payload_types,
        provenance={
            **provenance,
            "exporter": f"lpac-edge {version('lpac-edge')}",
            "torch": torch.__version__,
        },
        files={},  # make_bundle puts them in
        parameters=LpacManifest(OPSET, network.geometry, images).parameters,
    )
    bundle = make_bundle(manifest, files)
    for check in LpacPolicy(bundle).verify():
        if not check.passed:
            raise CheckpointError(
                f"{check.name}: float32 rounding alone gives a relative error of "
                f"{check.relative_error:.1e}, allowed is {TOLERANCE:g}"
            )
    return bundle
