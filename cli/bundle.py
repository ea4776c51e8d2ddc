"""`lpac bundle`: look at a bundle, or prove that this machine computes what torch computed."""

import json
from pathlib import Path
from typing import Annotated

import typer

app = typer.Typer(name="bundle", help="Look at a policy bundle, or verify it on this machine.")

BundlePath = Annotated[
    Path, typer.Argument(metavar="BUNDLE", help="A bundle's directory or .zip archive.")
]
AsJson = Annotated[bool, typer.Option("--json", help="Print JSON.")]


@app.command()
def info(path: BundlePath, as_json: AsJson = False) -> None:
    """Print what the bundle holds: geometry, perception, training, origin."""
    from edge.runtime.bundle import MANIFEST, load_bundle

    bundle = load_bundle(path)
    manifest, geometry = bundle.manifest, bundle.manifest.geometry
    if as_json:
        typer.echo(json.dumps({"id": bundle.id, **json.loads(bundle.files[MANIFEST])}, indent=2))
        return
    images, perception, training = manifest.images, manifest.perception, manifest.training
    sizes = " -> ".join(map(str, geometry.feature_sizes))
    rows = [
        ("name", manifest.name),
        ("id", bundle.id),
        ("network", f"L = {geometry.layers} layers ({sizes}), K = {geometry.hops} hops"),
        (
            "message",
            f"{geometry.message_size} values: {4 * geometry.message_size:,} B in float32, "
            f"{2 * geometry.message_size:,} B in float16",
        ),
    ]
    if images and perception:
        rows += [
            ("images", f"{', '.join(images.channels)}: {images.size} x {images.size}"),
            (
                "perception",
                f"world {perception.world_size}, local map {perception.local_map_size}, "
                f"sensor {perception.sensor_size}, range {perception.communication_range:g}",
            ),
        ]
    else:
        rows.append(("perception", "none: graph neural network and action only"))
    rows += [
        ("training", f"{training.max_speed:g} units/s, time step {training.time_step:g} s"),
        ("exported", f"from {manifest.provenance.checkpoint} ({manifest.provenance.exporter})"),
        *((name, f"{len(bundle.files[name]):,} B") for name in manifest.files),
    ]
    for label, value in rows:
        typer.echo(f"{label:12} {value}")


@app.command()
def verify(path: BundlePath, as_json: AsJson = False) -> None:
    """Check every hash, then run every graph and a swarm against torch's golden outputs."""
    from edge.runtime.bundle import load_bundle
    from edge.runtime.verify import TOLERANCE
    from edge.runtime.verify import verify as run_checks

    bundle = load_bundle(path)
    checks = []
    for check in run_checks(bundle):
        checks.append(check)
        if not as_json:
            verdict = "ok" if check.passed else "FAILED"
            typer.echo(f"{check.name:12} relative error {check.relative_error:.1e}  {verdict}")
    failed = [check.name for check in checks if not check.passed]
    if as_json:
        errors = {check.name: check.relative_error for check in checks}
        report = {"id": bundle.id, "tolerance": TOLERANCE, "failed": failed, "errors": errors}
        typer.echo(json.dumps(report, indent=2))
    elif not failed:
        name = f"{bundle.manifest.name} {bundle.id[:12]}"
        typer.echo(f"{name}: this machine computes the golden outputs")
    if failed:
        raise ValueError(
            f"{path}: {', '.join(failed)}: not within {TOLERANCE:g} of torch's golden outputs"
        )
