"""`lpac evaluate`: policies and baselines over many worlds, and how surely one is better."""

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from lpac.cli.apps import new_app
from lpac.cli.options import (
    DEFAULT_BUNDLE,
    AsJson,
    Px4,
    Ray,
    VehicleKind,
    check_px4,
    found,
    require_here,
)
from lpac.cli.study import fly_study
from lpac.cli.transport import WifiFile, calibration, transport_named, wifi_lines

if TYPE_CHECKING:
    from lpac.radio.calibration import Calibration
    from lpac.study.study import Method

app = new_app()

_OUT = Path("out/evaluate")


@app.command()
def evaluate(
    *,
    methods: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[METHOD]...",
            help="Policy bundles, the shipped one if none is given; several trainings of one "
            "method joined by commas; or names of baselines.",
        ),
    ] = None,
    world_set: Annotated[
        str, typer.Option("--set", help="training, validation, or test; look at test only once.")
    ] = "validation",
    worlds: Annotated[
        int, typer.Option("--worlds", "-k", help="How many worlds of it, from the first on.")
    ] = 20,
    duration: Annotated[float, typer.Option(help="Flight time, s.")] = 60.0,
    set_ups: Annotated[
        list[str] | None,
        typer.Option(
            "--set-up",
            metavar="NAME",
            help="Team and world: field (the default), n1 to n1000, paper, features-3, range-64, "
            "and more (docs/research.md); may be repeated.",
        ),
    ] = None,
    transfer: Annotated[
        bool,
        typer.Option(
            help="All set-ups: other numbers of robots at equal density, features and ranges."
        ),
    ] = False,
    losses: Annotated[
        list[float] | None,
        typer.Option("--loss", help="Also with messages lost with this probability."),
    ] = None,
    transports: Annotated[
        list[str] | None,
        typer.Option(
            "--transport",
            metavar="NAME",
            help="Also with the radio that such a team would have, by a model of one Wi-Fi "
            "channel: mesh, router or multicast.",
        ),
    ] = None,
    wifi: WifiFile = None,
    lost: Annotated[
        list[str] | None,
        typer.Option(
            metavar="ROBOTS@S", help="Also with robots lost in flight, such as 2@20: two at 20 s."
        ),
    ] = None,
    lags: Annotated[
        list[float] | None,
        typer.Option(
            "--lag", help="Also with robots that respond with this time constant, s; baselines too."
        ),
    ] = None,
    position_errors: Annotated[
        list[float] | None,
        typer.Option(
            "--position-error",
            help="Also with robots that are wrong about where they are: standard deviation, m.",
        ),
    ] = None,
    payloads: Annotated[
        list[str] | None,
        typer.Option(
            "--payload",
            metavar="TYPE",
            help="Also with messages that carry float32 or int8 instead of float16; each --loss "
            "and --transport is then flown with them, too.",
        ),
    ] = None,
    vehicle: Annotated[
        VehicleKind,
        typer.Option(
            help="Also as the field is flown: whole robots, at most 30, as `lpac sim` has them, "
            "and points from the same pads."
        ),
    ] = VehicleKind.POINT,
    px4: Px4 = None,
    baselines: Annotated[
        list[str] | None,
        typer.Option(
            "--baseline", metavar="NAME", help="Only these, and clairvoyant-cvt; else all."
        ),
    ] = None,
    compare: Annotated[
        bool, typer.Option("--compare", help="Say whether the first of two methods is better.")
    ] = False,
    ray: Ray = None,
    as_json: AsJson = False,
    out: Annotated[
        Path,
        typer.Option(help="Folder for evaluation.json, figures, pictures, and what was flown."),
    ] = _OUT,
) -> None:
    """Policies and baselines over many worlds: how well they cover, with confidence intervals."""
    given = methods or [str(DEFAULT_BUNDLE)]
    for path in (part for text in given for part in text.split(",") if "/" in part):
        found(Path(path))
    from edge.core.wire import PAYLOAD_TYPES
    from lpac.study.file import condition_of
    from lpac.study.study import BASELINES, Method, Study
    from lpac.study.worlds import SET_UPS, WORLD_SETS

    check_px4(vehicle, px4)
    require_here(vehicle, ray)
    if compare and len(given) != 2:
        raise ValueError(f"--compare needs two methods; {len(given)} given")
    if losses and transports:
        raise ValueError("--loss and --transport: the model itself says what is lost")
    if transfer and vehicle is not VehicleKind.POINT:
        raise ValueError("--transfer has teams that do not fly whole: choose others with --set-up")
    if transfer and set_ups:
        raise ValueError("--transfer flies all set-ups: --set-up does nothing beside it")
    for option, chosen, known in (
        ("--set", [world_set], WORLD_SETS), ("--baseline", baselines, BASELINES),
        ("--set-up", set_ups, tuple(SET_UPS)), ("--payload", payloads, PAYLOAD_TYPES),
    ):  # fmt: skip
        for name in chosen or ():
            if name not in known:
                raise ValueError(f"{option} {name}: must be one of {', '.join(known)}")
    calibrated = calibration(wifi, transport=bool(transports))
    sources = {name: source._asdict() for name, source in calibrated.sources.items()}
    changes = _changes(
        losses or [], transports or [], lost or [], lags or [], position_errors or [],
        [name for name in PAYLOAD_TYPES if name in (payloads or [])], vehicle, calibrated,
    )  # fmt: skip
    names = tuple(SET_UPS) if transfer else set_ups or ["field"]
    policies = [_policy(text, name) for text, name in zip(given, _names(given), strict=True)]
    flying = [policy.name for policy in policies]
    policies += [
        Method.of(name)
        for name in BASELINES
        if name not in flying and (not baselines or name in baselines)
    ]
    fly_study(
        Study(
            methods=tuple(policies),
            conditions=tuple(
                condition_of({"set_up": name, "duration_s": duration, **change}, "lpac evaluate")
                for name in names
                for change in changes
            ),
            world_set=next(known for known in WORLD_SETS if known == world_set),
            worlds=worlds,
            px4_build="" if px4 is None else str(px4.resolve()),
        ),
        "evaluation",
        out,
        ray,
        as_json=as_json,
        compared=compare,
        further={"wifi_from": sources if transports else None},
    )
    if transports and not as_json:
        typer.echo("\n".join(["what the model assumes of the Wi-Fi:", *wifi_lines(calibrated)]))


def _changes(
    losses: Sequence[float],
    transports: Sequence[str],
    lost: Sequence[str],
    lags_s: Sequence[float],
    position_errors_m: Sequence[float],
    payloads: Sequence[str],
    vehicle: VehicleKind,
    calibrated: "Calibration",
) -> list[dict[str, Any]]:
    """The keys of each condition, as a study has them; the first is as usual."""
    wifi = asdict(calibrated.wifi)
    lossy: list[dict[str, Any]] = [
        *({"loss": loss} for loss in losses),
        *(
            {"radio": {"transport": transport_named(name), "wifi": wifi}}
            for name in dict.fromkeys(transports)
        ),
    ]
    whole: list[dict[str, Any]]
    whole = [] if vehicle is VehicleKind.POINT else [{"from_pads": True}, {"engine": vehicle.value}]
    return [
        {},
        *lossy,
        *({"lost": robots} for robots in lost),
        *({"lag_s": lag_s} for lag_s in lags_s),
        *({"position_error_m": error_m} for error_m in position_errors_m),
        *({"payload": payload, **loss} for payload in payloads for loss in ({}, *lossy)),
        *whole,
    ]


def _names(given: Sequence[str]) -> list[str]:
    """Short ones: of each path the last parts, as many as tell it from the others."""
    parts = [[Path(path).resolve().parts for path in text.split(",")] for text in given]
    for depth in range(1, max(len(part) for text in parts for part in text) + 1):
        names = [",".join("/".join(part[-depth:]) for part in text) for text in parts]
        if len(set(names)) == len(set(given)):
            break
    return names


def _policy(text: str, name: str) -> "Method":
    """A baseline by its name, or bundles by their paths. Raises BundleError."""
    from lpac.study.study import BASELINES, Method

    return Method.of(text) if text in BASELINES else Method.of(name, *text.split(","))
