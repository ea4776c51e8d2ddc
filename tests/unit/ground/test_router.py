"""What the router of a fleet with keys knows before it listens."""

import time
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import pytest

from edge.drivers.identity_folder import load_identity
from edge.drivers.stop import Stop
from edge.identity.card import Role
from edge.identity.guard import SignedGuard
from lpac.fleet.authority import create_authority, new_member
from lpac.ground import router

PLACE = "192.0.2.1:7447"


def test_no_knock_of_a_start_far_ahead_opens_the_routers_port(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    authority = create_authority(tmp_path / "authority", "demo")
    new_member(authority, tmp_path / "ann", Role.OPERATOR, "ann")
    new_member(authority, tmp_path / "r1", Role.ROBOT, "r1", 1)
    opened: list[SignedGuard | None] = []

    def open_router(*, members: SignedGuard, tls: Any, **_: Any) -> nullcontext[None]:
        assert tls == load_identity(Config.keys, fleet="demo", unix_s=time.time()).tls
        opened.append(members)
        return nullcontext()

    class Config:
        fleet, router, keys = "demo", "tls/127.0.0.1:7447", tmp_path / "ann"

    monkeypatch.setattr(router, "load_fleet", lambda _: Config)
    monkeypatch.setattr(router, "ZenohRouter", open_router)
    monkeypatch.setattr(router, "allow_most_descriptors", lambda: opened.append(None))
    stop = Stop()
    stop.set()
    router.serve_router(tmp_path / "fleet.toml", stop, lambda _: None)
    allowed, guard = opened
    assert allowed is None and guard is not None

    def knock(ahead_s: float) -> bytes:
        folder, unix_s = tmp_path / "r1", time.time() + ahead_s
        return load_identity(folder, fleet="demo", unix_s=unix_s).guard(time.monotonic).knock(PLACE)

    assert guard.is_knock(knock(0.0), PLACE)
    assert not guard.is_knock(knock(30 * 86_400.0), PLACE)
