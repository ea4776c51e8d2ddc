"""`lpac bundle`: show, verify and time a policy bundle."""

import dataclasses
import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from lpac.cli.apps import AsJson, new_app

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from edge.policy.bundle import Bundle, Manifest
    from edge.policy.graph import Shape
    from edge.policy.network.manifest import NetworkManifest

app = new_app("bundle", "Show, verify or time a policy bundle on this machine.")

BundlePath = Annotated[
    Path, typer.Argument(metavar="BUNDLE", help="A bundle's directory or .zip archive.")
]


@app.command()
def info(path: BundlePath, as_json: AsJson = False) -> None:
    """Print the bundle's geometry, perception, training and provenance."""
    from edge.policy.bundle import MANIFEST, load_bundle

    bundle = load_bundle(path)
    if as_json:
        typer.echo(json.dumps({"id": bundle.id, **json.loads(bundle.files[MANIFEST])}, indent=2))
    else:
        show(bundle)


def show(bundle: "Bundle") -> None:
    """Print a line per property and file of the bundle."""
    manifest, training = bundle.manifest, bundle.manifest.training
    rows = [
        ("name", manifest.name),
        ("id", bundle.id),
        ("family", manifest.family),
        *_network(manifest),
        *_perception(manifest),
        ("trained for", f"{training.max_speed:g} units/s, time step {training.time_step:g} s"),
        *((k, value) for k, value in sorted(manifest.provenance.items()) if "sha256" not in k),
        *((name, f"{len(bundle.files[name]):,} B") for name in manifest.files),
    ]
    for label, value in rows:
        typer.echo(f"{label:12} {value}")


def _network(manifest: "Manifest") -> list[tuple[str, str]]:
    """Geometry for the family lpac, inputs and outputs for network, parameters for others."""
    from edge.policy.bundle import LPAC
    from edge.policy.lpac.manifest import LpacManifest
    from edge.policy.network.manifest import NETWORK, NetworkManifest

    if manifest.family == NETWORK:
        return _graphs(NetworkManifest.of(manifest))
    if manifest.family != LPAC:
        return [(key, json.dumps(value)) for key, value in sorted(manifest.parameters.items())]
    lpac = LpacManifest.of(manifest)
    geometry, images = lpac.geometry, lpac.images
    sizes = " -> ".join(map(str, geometry.feature_sizes))
    rows = [
        ("network", f"L = {geometry.layers} layers ({sizes}), K = {geometry.hops} hops"),
        _message(geometry.message_size),
    ]
    if images:
        rows.append(_images(images.channels, images.size))
    return rows


def _graphs(network: "NetworkManifest") -> list[tuple[str, str]]:
    def listed(shapes: "Mapping[str, Shape]") -> str:
        return ", ".join(
            f"{name} ({' x '.join(map(str, shape)) or 'number'})" for name, shape in shapes.items()
        )

    encode, step = (
        listed({name: array.shape for name, array in inputs.items()})
        for inputs in (network.encode, network.step)
    )
    rows = [
        ("encode", f"{encode} -> {listed(network.encode_outputs)}"),
        ("step", f"{step} -> {listed(network.step_outputs)}"),
        ("action", f"velocity, {network.action.unit}"),
        ("rates", f"encode {network.rates.encode_hz:g} Hz, step {network.rates.step_hz:g} Hz"),
        ("order", f"of the neighbours: {network.order}"),
        _message(network.message_size),
    ]
    if network.maps:
        rows.append(_images(network.maps.channels, network.maps.size))
    return rows


def _message(values: int) -> tuple[str, str]:
    size = f"{values} values: {4 * values:,} B in float32, {2 * values:,} B in float16"
    return "message", size


def _images(channels: "Sequence[str]", size: int) -> tuple[str, str]:
    return "images", f"{', '.join(channels)}: {size} x {size}"


def _perception(manifest: "Manifest") -> list[tuple[str, str]]:
    perception = manifest.perception
    if perception is None:
        return [("perception", "none: graph neural network and action only")]
    rows = []
    if perception.shared_map_cell:
        side, cell = perception.shared_map_side, perception.shared_map_cell
        rows.append(("shared map", f"{side} x {side} cells of {cell}: {side * side:,} B more"))
    sizes = f"world {perception.world_size}, local map {perception.local_map_size}"
    senses = f"sensor {perception.sensor_size}, range {perception.communication_range:g}"
    return [*rows, ("perception", f"{sizes}, {senses}")]


@app.command()
def verify(path: BundlePath, as_json: AsJson = False) -> None:
    """Check all hashes, then compare this machine's outputs with the bundle's golden outputs."""
    from edge.drivers.registry import load_policy
    from edge.policy.bundle import load_bundle
    from edge.policy.family import TOLERANCE, golden_checks

    bundle = load_bundle(path)
    checks = []
    for check in golden_checks(load_policy(bundle)):
        checks.append(check)
        if not as_json:
            verdict = "ok" if check.passed else "FAILED"
            typer.echo(f"{check.name:12} relative error {check.relative_error:.1e}  {verdict}")
    failed = [check.name for check in checks if not check.passed]
    tolerance = max((check.tolerance for check in checks), default=TOLERANCE)
    if as_json:
        errors = {check.name: check.relative_error for check in checks}
        report = {"id": bundle.id, "tolerance": tolerance, "failed": failed, "errors": errors}
        typer.echo(json.dumps(report, indent=2))
    elif not failed:
        name = f"{bundle.manifest.name} {bundle.id[:12]}"
        found = "this machine computes the golden outputs"
        if not checks:
            found = "has no golden outputs: nothing was compared"
        typer.echo(f"{name}: {found}")
    if failed:
        raise ValueError(
            f"{path}: {', '.join(failed)}: not within {tolerance:g} of the golden outputs"
        )


@app.command()
def benchmark(
    path: BundlePath,
    neighbours: Annotated[int, typer.Option(help="Number of neighbours that send.")] = 10,
    seconds: Annotated[float, typer.Option(help="How long to measure, s.")] = 3.0,
    as_json: AsJson = False,
) -> None:
    """Time a robot's steps on this machine; fails if one takes over half of its period."""
    from edge.drivers.registry import load_policy
    from edge.policy.bundle import load_bundle
    from edge.robot.benchmark import MOST_OF_PERIOD
    from edge.robot.benchmark import benchmark as measure

    bundle = load_bundle(path)
    result = measure(load_policy(bundle), neighbours, seconds)
    if as_json:
        steps = {
            step.step: {**dataclasses.asdict(step), "share": step.share} for step in result.steps
        }
        typer.echo(
            json.dumps({**dataclasses.asdict(result), "id": bundle.id, "steps": steps}, indent=2)
        )
    else:
        typer.echo(f"{bundle.manifest.name} on {result.architecture}, {neighbours} neighbours, ms:")
        for step in result.steps:
            typer.echo(
                f"{step.step:12} p50 {step.p50_ms:.2f}  p99 {step.p99_ms:.2f}  "
                f"max {step.max_ms:.2f}  p99 is {step.share:.1%} of {step.period_ms:.0f} ms"
            )
    slow = [step for step in result.steps if not step.fits]
    if slow:
        times = ", ".join(f"{s.step} {s.p99_ms:.0f} of {s.period_ms:.0f} ms" for s in slow)
        raise ValueError(
            f"{path}: too slow on this machine: {times} (p99), and at most {MOST_OF_PERIOD:.0%} "
            "may be taken: end what else runs, or fly a smaller policy"
        )
