"""What `lpac ground` needs to know of its fleet."""

from dataclasses import dataclass

from lpac.analysis.snapshot import FleetSetup


@dataclass(frozen=True, slots=True)
class GroundConfig:
    """`setup` is what its clients are told; `connect` are all robots' endpoints, for zenoh."""

    setup: FleetSetup
    connect: tuple[str, ...]
