"""`lpac evaluate`: compare policies and baselines over many worlds."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from msgspec import Meta

from lpac.cli.apps import new_app
from lpac.cli.fields import options_of
from lpac.cli.options import (
    DEFAULT_BUNDLE,
    AsJson,
    Px4,
    Ray,
    VehicleKind,
    check_px4,
    existing,
    require_here,
)
from lpac.cli.study import StudyTask, fly_study
from lpac.cli.transport import Transport, WifiFile, calibration, wifi_lines

if TYPE_CHECKING:
    from lpac.radio.calibration import Calibration
    from lpac.study.study import Method

app = new_app()

_OUT = Path("out/evaluate")


@dataclass(frozen=True, slots=True, kw_only=True)
class EvaluateOptions:
    """Options of the study."""

    methods: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[METHOD]...",
            help="Policy bundles, the shipped one if none is given; several trainings of one "
            "method joined by commas; or names of baselines.",
        ),
    ] = None
    world_set: Annotated[
        str,
        typer.Option("--set", help="training, validation, or test; look at test only once."),
    ] = "validation"
    worlds: Annotated[
        int,
        Meta(ge=1),
        typer.Option("--worlds", "-k", help="How many worlds of it, from the first on."),
    ] = 20
    set_ups: Annotated[
        list[str] | None,
        typer.Option(
            "--set-up", metavar="NAME",
            help="Team and world: field (the default), n1 to n1000, paper, features-3, range-64, "
            "and more (docs/research.md); may be repeated.",
        ),
    ] = None  # fmt: skip
    transfer: Annotated[
        bool, "All set-ups: other numbers of robots at equal density, features and ranges."
    ] = False
    baselines: Annotated[
        list[str] | None,
        typer.Option(
            "--baseline", metavar="NAME", help="Only these, and clairvoyant-cvt; else all."
        ),
    ] = None
    compare: Annotated[bool, "Say whether the first of two methods is better."] = False
    px4: Px4 = None
    ray: Ray = None
    as_json: AsJson = False
    out: Annotated[
        Path, "Folder for README.md, evaluation.json, figures, pictures, and what was flown."
    ] = _OUT


@dataclass(frozen=True, slots=True, kw_only=True)
class ConditionOptions:
    """Options of further conditions, each in addition to the usual one."""

    duration: Annotated[float, "Flight time, s."] = 60.0
    losses: Annotated[
        list[float] | None,
        typer.Option("--loss", help="Also with messages lost with this probability."),
    ] = None
    transports: Annotated[
        list[Transport] | None,
        typer.Option(
            "--transport",
            help="Also with a team's radio, by a model of one Wi-Fi channel.",
        ),
    ] = None
    wifi: WifiFile = None
    lost: Annotated[
        list[str] | None,
        typer.Option(
            metavar="ROBOTS@S", help="Also with robots lost in flight, such as 2@20: two at 20 s."
        ),
    ] = None
    lags: Annotated[
        list[float] | None,
        typer.Option(
            "--lag", help="Also with robots that respond with this time constant, s; baselines too."
        ),
    ] = None
    position_errors: Annotated[
        list[float] | None,
        typer.Option(
            "--position-error",
            help="Also with errors of the estimated positions: standard deviation, m.",
        ),
    ] = None
    payloads: Annotated[
        list[str] | None,
        typer.Option(
            "--payload", metavar="TYPE",
            help="Also with messages in float32 or int8 instead of float16, alone and with each "
            "--loss and --transport.",
        ),
    ] = None  # fmt: skip
    vehicle: Annotated[
        VehicleKind,
        "Also as in the field: at most 30 whole robots, as in `lpac sim`, and points from the "
        "same pads.",
    ] = VehicleKind.POINT


@app.command()
@options_of(EvaluateOptions, ConditionOptions)
def evaluate(options: EvaluateOptions, extra: ConditionOptions) -> None:
    """Compare policies and baselines over many worlds, with confidence intervals."""
    given = options.methods or [str(DEFAULT_BUNDLE)]
    for path in (part for text in given for part in text.split(",") if "/" in part):
        existing(Path(path))
    from lpac.study.file import condition_of
    from lpac.study.study import Study
    from lpac.study.worlds import SET_UPS, WORLD_SETS

    _check(options, extra, given)
    calibrated = calibration(extra.wifi, transport=bool(extra.transports))
    names = tuple(SET_UPS) if options.transfer else options.set_ups or ["field"]
    conditions = [
        condition_of({"set_up": name, "duration_s": extra.duration, **change}, "lpac evaluate")
        for name in names
        for change in _changes(extra, calibrated)
    ]
    study = Study(
        methods=_methods(given, options.baselines),
        conditions=tuple(dict.fromkeys(conditions)),
        world_set=next(known for known in WORLD_SETS if known == options.world_set),
        worlds=options.worlds,
        px4_build="" if options.px4 is None else str(options.px4.resolve()),
    )
    sources = {name: source._asdict() for name, source in calibrated.sources.items()}
    task = StudyTask(
        name="evaluation", study=study, folder=options.out, compared=options.compare,
        further={"wifi_from": sources if extra.transports else None},
    )  # fmt: skip
    fly_study(task, options.ray, as_json=options.as_json)
    if extra.transports and not options.as_json:
        typer.echo("\n".join(["what the model assumes of the Wi-Fi:", *wifi_lines(calibrated)]))


def _check(options: EvaluateOptions, extra: ConditionOptions, given: Sequence[str]) -> None:
    """Raise ValueError for impossible options."""
    from edge.core.wire import PAYLOAD_TYPES
    from lpac.study.study import BASELINES
    from lpac.study.worlds import SET_UPS, WORLD_SETS

    check_px4(extra.vehicle, options.px4)
    require_here(extra.vehicle, options.ray)
    if options.compare and len(given) != 2:
        raise ValueError(f"--compare needs two methods; {len(given)} given")
    if extra.losses and extra.transports:
        raise ValueError("--loss and --transport: the model of --transport decides what is lost")
    if options.transfer and extra.vehicle is not VehicleKind.POINT:
        raise ValueError("--transfer has teams that do not fly whole: choose others with --set-up")
    if options.transfer and options.set_ups:
        raise ValueError("--transfer flies all set-ups: --set-up does nothing beside it")
    for option, chosen, known in (
        ("--set", [options.world_set], WORLD_SETS),
        ("--baseline", options.baselines, BASELINES),
        ("--set-up", options.set_ups, tuple(SET_UPS)),
        ("--payload", extra.payloads, PAYLOAD_TYPES),
    ):
        for name in chosen or ():
            if name not in known:
                raise ValueError(f"{option} {name}: must be one of {', '.join(known)}")


def _methods(given: Sequence[str], baselines: Sequence[str] | None) -> "tuple[Method, ...]":
    """The given methods, then the baselines. Raises BundleError."""
    from lpac.study.study import BASELINES, Method

    methods = [
        Method.of(text) if text in BASELINES else Method.of(name, *text.split(","))
        for text, name in zip(given, _names(given), strict=True)
    ]
    named = [method.name for method in methods]
    wanted = [name for name in BASELINES if not baselines or name in baselines]
    return (*methods, *(Method.of(name) for name in wanted if name not in named))


def _changes(extra: ConditionOptions, calibrated: "Calibration") -> list[dict[str, Any]]:
    """Keys of each condition, as in a study's file; the first is the usual condition."""
    from edge.core.wire import PAYLOAD_TYPES

    wifi = asdict(calibrated.wifi)
    lossy: list[dict[str, Any]] = [
        *({"loss": loss} for loss in extra.losses or ()),
        *(
            {"radio": {"transport": transport, "wifi": wifi}}
            for transport in dict.fromkeys(extra.transports or ())
        ),
    ]
    payloads = [name for name in PAYLOAD_TYPES if name in (extra.payloads or ())]
    whole: list[dict[str, Any]] = [{"from_pads": True}, {"engine": extra.vehicle.value}]
    return [
        {},
        *lossy,
        *({"lost": robots} for robots in extra.lost or ()),
        *({"lag_s": lag_s} for lag_s in extra.lags or ()),
        *({"position_error_m": error_m} for error_m in extra.position_errors or ()),
        *({"payload": payload, **loss} for payload in payloads for loss in ({}, *lossy)),
        *(whole if extra.vehicle is not VehicleKind.POINT else ()),
    ]


def _names(given: Sequence[str]) -> list[str]:
    """Short names: the fewest last parts of each path that make it unique."""
    parts = [[Path(path).resolve().parts for path in text.split(",")] for text in given]
    for depth in range(1, max(len(part) for text in parts for part in text) + 1):
        names = [",".join("/".join(part[-depth:]) for part in text) for text in parts]
        if len(set(names)) == len(set(given)):
            break
    return names
