"""The live map: who gets it, that it keeps up, and a real browser on it."""

import asyncio
import datetime
import json
import resource
import socket
import ssl
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator
from contextlib import ExitStack, asynccontextmanager, contextmanager, suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, Literal
from urllib.error import HTTPError
from urllib.parse import urlsplit
from urllib.request import HTTPCookieProcessor, build_opener, urlopen

import aiohttp
import pytest
from typer.testing import CliRunner

from edge.core.address import is_loopback
from edge.messages.codes import CheckCode, FailedCheck
from edge.messages.mission import ON_GROUND
from lpac.analysis.snapshot import FleetSnapshot
from lpac.cli.main import app
from lpac.fleet.authority import AuthorityError, create_authority
from lpac.fleet.web_certificate import web_certificate
from lpac.ground.map import connections
from lpac.ground.map.access import Access, server_addresses
from lpac.ground.map.server import Outbox, serving
from lpac.ground.station.client import command, listen
from lpac.ground.station.protocol import SetOrigin, TakeCommand
from tests.live import ORIGIN, FlownFleet
from tests.process.ground.browser import PATIENCE_S, Opened, live_map, lpac, opened
from tests.process.ground.conftest import wait_for_snapshot

HOSTILE = "<img src=x onerror=document.title='owned'> & <b>bold</b>"


@pytest.fixture(autouse=True, scope="module")
def _own_sockets(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_RUNTIME_DIR", str(tmp_path_factory.mktemp("run")))
        yield


@pytest.fixture(scope="module")
def fleet(tmp_path_factory: pytest.TempPathFactory) -> Iterator[FlownFleet]:
    """Four robots and their ground process; nobody has taken off."""
    with _with_ground(tmp_path_factory.mktemp("fleet"), 4) as robots:
        yield robots


@contextmanager
def _with_ground(folder: Path, robots: int) -> Iterator[FlownFleet]:
    with (
        FlownFleet(folder, robots) as fleet,
        lpac("ground", "--fleet", str(fleet.fleet_toml), "--name", "alice"),
    ):
        yield fleet


# Who may see it


Ask = Callable[..., Awaitable[aiohttp.ClientResponse]]


@asynccontextmanager
async def asking(
    fleet: str, *, token: str | None = None, operate: bool = False
) -> AsyncIterator[tuple[str, aiohttp.ClientSession]]:
    access = Access(local=True, token=token)
    async with (
        serving(fleet, host="127.0.0.1", port=0, access=access, operate=operate) as (address,),
        # Cookies of addresses are kept, as browsers do.
        aiohttp.ClientSession(cookie_jar=aiohttp.CookieJar(unsafe=True)) as session,
    ):
        yield address, session


def test_what_a_stranger_gets_from_the_server() -> None:
    async def ask() -> None:
        async with asking("nobody", token="correct-horse") as (address, session):
            bare = address.partition("?")[0]
            for path in ("", "map.js", "map.css", "live", "nothing"):
                assert (await session.get(bare + path)).status == 403
            with pytest.raises(aiohttp.WSServerHandshakeError):
                await session.ws_connect(bare + "live")
            # The address that was printed gives a cookie, and hides the token.
            page = await session.get(address)
            assert page.status == 200 and page.url.query_string == ""
            assert "script-src 'self'" in page.headers["Content-Security-Policy"]
            assert "http" not in (await page.text()).replace("http-equiv", "")
            assert (await session.get(bare + "map.js")).content_type == "text/javascript"
            assert (await session.get(bare + "../live_map.py")).status == 404
            async with session.ws_connect(bare + "live") as stream:
                assert (await stream.receive_json())["kind"] == "hello"
            for headers in ({"Origin": "http://evil.example"}, {"Host": "evil.example"}):
                assert (await session.get(bare, headers=headers)).status == 403
                with pytest.raises(aiohttp.WSServerHandshakeError):
                    await session.ws_connect(bare + "live", headers=headers)

    asyncio.run(ask())


def test_on_the_network_the_address_has_a_token(fleet: FlownFleet) -> None:
    async def ask(address: str) -> None:
        async with aiohttp.ClientSession(cookie_jar=aiohttp.CookieJar(unsafe=True)) as session:
            bare = address.partition("?")[0]
            assert (await session.get(bare)).status == 403
            assert (await session.get(address)).status == 200
            async with session.ws_connect(bare + "live", headers={"Origin": bare[:-1]}) as stream:
                assert (await stream.receive_json())["kind"] == "hello"

    # It serves as at 0.0.0.0.
    with live_map(fleet.fleet_toml, "--host", "::") as address:
        assert len(address.partition("?token=")[2]) >= 16
        name = urlsplit(address).hostname
        # One that a tablet can open, unless this machine is on no network.
        assert name in server_addresses("0.0.0.0") and name is not None and not is_loopback(name)
        asyncio.run(ask(address))
    assert server_addresses("127.0.0.1") == ["127.0.0.1"]


@pytest.mark.parametrize("with_tls", [False, True], ids=["http", "https"])
def test_connections_that_ask_for_nothing_keep_no_page_from_opening(
    tmp_path: Path, with_tls: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of many addresses, too; and they are closed in time."""
    limits = resource.getrlimit(resource.RLIMIT_NOFILE)
    monkeypatch.setattr(connections, "HEAD_S", 1.0)
    tls: ssl.SSLContext | None = None
    scheme: Literal["http", "https"] = "http"
    if with_tls:
        files = web_certificate(
            create_authority(tmp_path / "keys", "field"),
            ["127.0.0.1"],
            datetime.datetime.now(datetime.UTC),
        )
        tls, scheme = ssl.create_default_context(ssl.Purpose.CLIENT_AUTH), "https"
        tls.load_cert_chain(files.certificate, files.key)

    async def connects(place: tuple[str, int], source: str) -> socket.socket:
        idle = socket.socket()
        idle.setblocking(False)
        idle.bind((source, 0))
        await asyncio.get_running_loop().sock_connect(idle, place)
        return idle

    async def ends(idle: socket.socket) -> None:
        with suppress(ConnectionError):
            assert await asyncio.get_running_loop().sock_recv(idle, 1) == b""

    async def ask() -> None:
        access = Access(local=True, token="correct-horse", scheme=scheme)
        async with (
            serving("nobody", host="127.0.0.1", port=0, access=access, operate=False, tls=tls) as (
                address,
            ),
            aiohttp.ClientSession(cookie_jar=aiohttp.CookieJar(unsafe=True)) as session,
        ):
            parts = urlsplit(address)
            assert parts.hostname is not None and parts.port is not None
            place = parts.hostname, parts.port
            idle = [await connects(place, "127.0.0.2") for _ in range(1200)]
            # At once, since those of one address are so many at most.
            async with asyncio.timeout(PATIENCE_S):
                assert (await session.get(address, ssl=False)).status == 200
                async with session.ws_connect(address.replace("/?", "/live?"), ssl=False) as page:
                    assert (await page.receive_json())["kind"] == "hello"
                    for host in range(3, 23):
                        idle += [await connects(place, f"127.0.0.{host}") for _ in range(40)]
                    async with aiohttp.ClientSession() as another:
                        assert (await another.get(address, ssl=False)).status == 403
                    await asyncio.gather(*map(ends, idle))
                    # Who asked stays.
                    await page.send_json({"select": None})
                    assert not page.closed
                assert (await session.get(address, ssl=False)).status == 200
            for each in idle:
                each.close()

    resource.setrlimit(resource.RLIMIT_NOFILE, (min(4096, limits[1]), limits[1]))
    try:
        asyncio.run(ask())
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, limits)


def test_over_tls_browsers_know_the_fleets_authority(tmp_path: Path) -> None:
    now = datetime.datetime.now(datetime.UTC)
    files, stranger = (
        web_certificate(create_authority(tmp_path / name, "field"), ["127.0.0.1"], now)
        for name in ("keys", "strangers")
    )
    tls = ssl.create_default_context(ssl.Purpose.CLIENT_AUTH)
    tls.load_cert_chain(files.certificate, files.key)
    assert files.key.stat().st_mode & 0o077 == 0
    access = Access(local=True, token="correct-horse", scheme="https")

    async def ask() -> None:
        async with (
            serving("nobody", host="127.0.0.1", port=0, access=access, operate=True, tls=tls) as (
                address,
            ),
            aiohttp.ClientSession(cookie_jar=aiohttp.CookieJar(unsafe=True)) as session,
        ):
            assert address.startswith("https://127.0.0.1:")
            known = ssl.create_default_context(cafile=str(files.authority))
            known.verify_flags |= ssl.VERIFY_X509_STRICT  # as Python does from 3.13 on
            assert (await session.get(address, ssl=known)).status == 200
            bare = address.partition("?")[0]
            origin = {"Origin": bare[:-1]}
            async with session.ws_connect(bare + "live", ssl=known, headers=origin) as stream:
                assert (await stream.receive_json())["kind"] == "hello"
            other = ssl.create_default_context(cafile=str(stranger.authority))
            with pytest.raises(aiohttp.ClientConnectorCertificateError):
                await session.get(bare, ssl=other)

    asyncio.run(ask())


def test_no_authority_vouches_for_a_public_address(tmp_path: Path) -> None:
    authority = create_authority(tmp_path / "keys", "field")
    with pytest.raises(AuthorityError, match="private networks"):
        web_certificate(authority, ["8.8.8.8"], datetime.datetime.now(datetime.UTC))


def test_a_port_that_is_taken_is_told_in_one_line() -> None:
    async def ask() -> None:
        async with asking("nobody") as (address, _):
            port = int(address.rstrip("/").rpartition(":")[2])
            access = Access(local=True, token=None)
            with pytest.raises(OSError, match=f"--port {port}: cannot serve there: .*in use"):
                async with serving(
                    "nobody", host="127.0.0.1", port=port, access=access, operate=False
                ):
                    pass

    asyncio.run(ask())


# What it tells


async def until(
    stream: aiohttp.ClientWebSocketResponse, wanted: Callable[[dict[str, Any]], bool]
) -> dict[str, Any]:
    async with asyncio.timeout(PATIENCE_S):
        while True:
            message: dict[str, Any] = await stream.receive_json()
            if wanted(message):
                return message


def of_kind(kind: str) -> Callable[[dict[str, Any]], bool]:
    return lambda message: message["kind"] == kind


def test_without_a_ground_it_says_so() -> None:
    async def ask() -> None:
        async with (
            asking("nobody") as (address, session),
            session.ws_connect(address + "live") as stream,
        ):
            told = await until(stream, lambda m: m["kind"] == "ground" and "lpac" in m["problem"])
            assert "no ground station runs for fleet nobody" in told["problem"]

    asyncio.run(ask())


@pytest.mark.parametrize(
    "wish",
    [
        {"do": "takeoff", "robots": []},
        {"do": "hold", "robots": ["r3"]},
        {"do": "kill", "robots": ["r3"]},
    ],
)
def test_a_map_that_only_observes_refuses_every_action(
    fleet: FlownFleet, wish: dict[str, Any]
) -> None:
    async def ask() -> None:
        async with (
            asking(fleet.name) as (address, session),
            session.ws_connect(address + "live") as stream,
        ):
            await until(stream, of_kind("snapshot"))
            for nonsense in ("", "[", "[]", '{"do": 3, "robots": []}', '{"do": "land"}'):
                await stream.send_str(nonsense)
            await stream.send_json(wish)
            report = await until(stream, of_kind("report"))
            assert not report["done"] and report["problem"]["code"] == "may_not"
            snapshot = await until(stream, of_kind("snapshot"))
            assert snapshot["safety_action"] == "none"

    asyncio.run(ask())
    assert all(robot.state in ON_GROUND for robot in fleet.flown)


def test_kill_is_no_action_of_the_map(fleet: FlownFleet) -> None:
    async def ask() -> None:
        async with (
            asking(fleet.name, operate=True) as (address, session),
            session.ws_connect(address + "live") as stream,
        ):
            await stream.send_json({"do": "kill", "robots": ["r3"]})
            report = await until(stream, of_kind("report"))
            assert report["problem"]["code"] == "not_understood"

    asyncio.run(ask())


def test_thirty_robots_reach_the_page_as_often_as_the_ground_tells_of_them(
    tmp_path: Path,
) -> None:
    """Five times a second of the ground's own clock, as soon as this machine lets it."""

    async def straight(fleet: FlownFleet, told_s: list[float]) -> None:
        async for told in listen(fleet.name):
            match told:
                case FleetSnapshot(unix_time_s):
                    told_s.append(unix_time_s)

    def keeps_up(told_s: list[float], shown_s: list[float]) -> bool:
        # What was told last may still be on its way.
        wanted_s = [t_s for t_s in told_s if shown_s and shown_s[0] <= t_s <= shown_s[-1]][-30:]
        return (
            len(wanted_s) == 30
            and len(set(wanted_s) & set(shown_s)) >= 0.9 * len(wanted_s)
            and (wanted_s[-1] - wanted_s[0]) / (len(wanted_s) - 1) < 0.3
        )

    async def ask(fleet: FlownFleet) -> None:
        told_s: list[float] = []
        shown_s: list[float] = []
        async with (
            asking(fleet.name) as (address, session),
            session.ws_connect(address + "live") as stream,
        ):
            direct = asyncio.create_task(straight(fleet, told_s))
            async with asyncio.timeout(PATIENCE_S):
                while not keeps_up(told_s, shown_s):
                    text = await stream.receive_str()
                    message = json.loads(text)
                    if message["kind"] == "snapshot":
                        assert len(message["robots"]) == 30
                        assert len(text) < 40_000
                        shown_s.append(message["unix_time_s"])
            direct.cancel()
            await asyncio.gather(direct, return_exceptions=True)

    with _with_ground(tmp_path, 30) as fleet:
        asyncio.run(ask(fleet))


def test_a_page_that_takes_nothing_misses_snapshots() -> None:
    async def ask() -> list[str]:
        page = Outbox()
        page.put("setup", "setup")
        for n in range(1000):
            page.put(f"snapshot {n}", "snapshot")
            page.put_each(f"event {n}")
        return await page.take()

    taken = asyncio.run(ask())
    assert taken[:2] == ["setup", "snapshot 999"]
    assert taken[-1] == "event 999" and len(taken) <= 202


def test_a_world_that_the_ground_does_not_have(tmp_path: Path) -> None:
    async def ask(fleet: FlownFleet) -> None:
        async with (
            asking(fleet.name) as (address, session),
            session.ws_connect(address + "live") as stream,
        ):
            # It is not known before a robot says it.
            await until(stream, lambda m: m["kind"] == "setup" and m["density"] is None)
            told = await until(stream, of_kind("coverage"))
            assert told["cost"] is None and not told["cells"]
            snapshot = await until(stream, of_kind("snapshot"))
            assert "world_not_here" in [alarm["code"] for alarm in snapshot["alarms"]]

    with FlownFleet(tmp_path, 1) as fleet:
        with fleet.paused():
            fleet.robots[0].world = "CircularBND 100 100 20 5\n"
            fleet.robots[0].start()
        with lpac("ground", "--fleet", str(fleet.fleet_toml), "--name", "alice"):
            asyncio.run(ask(fleet))


# A real browser


@pytest.fixture(scope="module")
def few(tmp_path_factory: pytest.TempPathFactory) -> Iterator[FlownFleet]:
    """Three robots, of which one says things that a careless page would run."""
    with FlownFleet(tmp_path_factory.mktemp("few"), 3) as robots:
        hostile = (FailedCheck(CheckCode.OTHER, HOSTILE),)
        robots.says[2] = lambda said: replace(said, ready=False, failed_checks=hostile)
        yield robots


def test_a_map_that_commands_asks_for_its_token_on_this_machine_too(few: FlownFleet) -> None:
    for options, asks in (((), False), (("--operate",), True)):
        with live_map(few.fleet_toml, *options) as address:
            bare, _, token = address.partition("?token=")
            assert bool(token) is asks
            with build_opener(HTTPCookieProcessor()).open(address) as page:
                assert page.status == 200
            if asks:
                with pytest.raises(HTTPError) as refused:
                    urlopen(bare)
                assert refused.value.code == 403
                refused.value.close()


def check_innocence(seen: Opened) -> None:
    assert seen.errors == []
    assert seen.hosts == {"127.0.0.1"}
    assert seen.page.locator("img").count() == 0
    assert "owned" not in seen.page.title()


def set_an_origin_that_is_missed(seen: Opened, fleet: str) -> None:
    wait_for_snapshot(fleet)
    seen.page.wait_for_selector("#no-origin >> text=no origin")
    assert command(fleet, SetOrigin(ORIGIN)).done
    seen.page.wait_for_selector("#no-origin", state="hidden")
    seen.page.wait_for_selector(f"#origin >> text={ORIGIN.latitude_deg:.5f}")


def take_the_command_back(seen: Opened, few: FlownFleet, runtime: Path) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_RUNTIME_DIR", str(runtime))
        with lpac("ground", "--fleet", str(few.fleet_toml), "--name", "bob"):
            wait_for_snapshot(few.name)
            assert command(few.name, TakeCommand()).done
            seen.act("command")
            seen.page.wait_for_selector("#ask >> text=Take the command from bob?")
            seen.page.click("#ask-yes")
            seen.page.wait_for_selector("#commander >> text=alice")
            seen.page.wait_for_selector("#command", state="hidden")


def test_a_flight_by_clicks(few: FlownFleet, short_path: Path) -> None:
    with (
        lpac("ground", "--fleet", str(few.fleet_toml), "--name", "alice"),
        live_map(few.fleet_toml, "--operate") as address,
        opened(address) as seen,
    ):
        page = seen.page
        set_an_origin_that_is_missed(seen, few.name)
        # On a tablet, upright, and on a phone hold is in reach.
        for width, height in ((768, 1024), (400, 800), (1280, 800)):
            page.set_viewport_size({"width": width, "height": height})
            box = page.locator("#hold").bounding_box()
            assert box is not None and box["x"] >= 0.0 and box["y"] >= 0.0
            assert box["x"] + box["width"] <= width and box["y"] + box["height"] <= height
        seen.act("enable")
        seen.wait_for_states(dict.fromkeys(("r0", "r1", "r2"), "preflight"))
        # Takeoff asks first; who will not is named, in text; and it follows what robots say.
        seen.act("takeoff")
        page.wait_for_selector("#ask >> text=Take off 2 of 3")
        few.says[0] = lambda said: replace(said, ready=False)
        page.wait_for_selector("#ask >> text=Take off 1 of 3")
        del few.says[0]
        page.wait_for_selector("#ask >> text=Take off 2 of 3")
        page.wait_for_selector(f"#ask >> text={HOSTILE}")
        page.click("#ask-no")
        assert page.is_hidden("#ask")
        assert seen.state_of("r0") == "preflight"
        seen.act("takeoff", sure=True)
        seen.wait_for_states({"r0": "hold", "r1": "hold", "r2": "preflight"})
        page.wait_for_selector(f"#toasts >> text={HOSTILE}")
        seen.act("start")
        seen.wait_for_states({"r0": "mission", "r1": "mission"})
        assert few.flown[0].said.trial == page.inner_text("#trial")
        # The cost, and that of Lloyd's algorithm.
        page.wait_for_function("() => Number(document.querySelector('#lloyd').textContent) > 0")
        page.wait_for_function("() => Number(document.querySelector('#share').textContent) > 0")
        # One robot, from its drawer.
        page.click(r"tr[data-robot=r1] >> text=/^\d+\.\d m$/")
        page.wait_for_selector("#drawer >> text=landing")
        page.wait_for_selector("#drawer table td >> text=r0")
        page.click("#drawer [data-robot-do=hold]")
        page.wait_for_selector("#drawer .state >> text=hold")
        seen_states = {"r0": "mission", "r1": "hold"}
        page.keyboard.press("Escape")
        seen.wait_for_states(seen_states)
        # Hold is one key, also while something is asked.
        seen.act("land")
        page.wait_for_selector("#ask >> text=Land")
        page.keyboard.press("h")
        seen.wait_for_states({"r0": "hold"})
        page.wait_for_selector("#safety-action >> text=HOLD by alice")
        page.click("#ask-no")
        seen.act("resume")
        seen.wait_for_states({"r0": "mission"})
        page.click("#hold")
        seen.wait_for_states({"r0": "hold", "r1": "hold"})
        seen.act("land", sure=True)
        seen.wait_for_states({"r0": "landed", "r1": "landed"})
        take_the_command_back(seen, few, short_path)
        check_innocence(seen)


def test_the_terminal_says_that_there_is_no_ground(
    few: FlownFleet, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def serve(_: object, ready: Callable[[list[str]], None]) -> None:
        ready(["http://127.0.0.1:8300/"])

    monkeypatch.setattr("lpac.ground.serve.serve", serve)
    said = CliRunner().invoke(app, ["map", "--fleet", str(few.fleet_toml)]).stdout.splitlines()
    assert said[0].endswith("http://127.0.0.1:8300/")
    assert "start `lpac ground`; until then the map shows nothing" in said[-1]


# Where a robot is drawn the pointer finds it, up to 24 px beside it, and so in all four corners
# around; gives the number of such points, and what lies over the map there.
OVER_ROBOTS = """async () => {
  for (let frame = 0; frame < 2; frame++) await new Promise(requestAnimationFrame);
  const canvas = document.querySelector("#map");
  const { left, top, right, bottom } = canvas.getBoundingClientRect();
  const finds = (clientX, clientY) => {
    canvas.dispatchEvent(new PointerEvent("pointermove", { clientX, clientY }));
    return canvas.classList.contains("over");
  };
  // In any square of 24 px that is found there is a point of a grid of 16 px.
  const near = new Map();
  for (let x = left; x < right; x += 16) {
    for (let y = top; y < bottom; y += 16) {
      if (!finds(x, y)) continue;
      for (let dx = -12; dx <= 12; dx += 4) {
        for (let dy = -12; dy <= 12; dy += 4) near.set(`${x + dx} ${y + dy}`, [x + dx, y + dy]);
      }
    }
  }
  let points = 0;
  const over = new Set();
  for (const [x, y] of near.values()) {
    if (x < left || x >= right || y < top || y >= bottom) continue;
    if (![-12, 12].every((dx) => [-12, 12].every((dy) => finds(x + dx, y + dy)))) continue;
    points++;
    const element = document.elementFromPoint(x, y);
    if (element !== canvas) over.add(element.closest("[id]").id);
  }
  return [points, [...over]];
}"""


def test_nothing_covers_a_robot(few: FlownFleet) -> None:
    """Wherever in the world it is, on a phone too; nor when the map has something to say."""

    def check() -> None:
        for width, height in ((390, 844), (768, 1024), (1280, 800)):
            seen.page.set_viewport_size({"width": width, "height": height})
            points, over = seen.page.evaluate(OVER_ROBOTS)
            # Some fifteen for each robot.
            assert (points > 30, over) == (True, []), (width, height)

    said = dict(few.says)
    corners_m = (0.0, 0.0), (0.0, 32.0), (32.0, 0.0)
    for robot, (x_m, y_m) in enumerate(corners_m):
        few.says[robot] = partial(replace, position_m=(x_m, y_m, 5.0))
    with live_map(few.fleet_toml) as address, ExitStack() as ground:
        ground.enter_context(lpac("ground", "--fleet", str(few.fleet_toml), "--name", "alice"))
        with opened(address) as seen:
            for name in ("r0", "r1", "r2"):
                seen.page.wait_for_selector(f"tr[data-robot={name}] >> text=5.0 m")
            check()
            seen.page.keyboard.press("h")
            ground.close()
            seen.page.wait_for_selector("#toasts >> text=lpac mission hold")
            seen.page.wait_for_selector("#banner >> text=lpac ground")
            check()
    few.says.clear()
    few.says |= said


def test_a_page_that_observes(few: FlownFleet) -> None:
    """It has nothing to command with, says what is missing, and goes on when the ground does."""
    with live_map(few.fleet_toml) as address, ExitStack() as first:
        ground = "ground", "--fleet", str(few.fleet_toml), "--name", "alice"
        no_ground = "#banner >> text=no ground station runs"
        with opened(address, theme="dark", shows=no_ground) as seen:
            page = seen.page
            banner = page.inner_text("#banner")
            assert "start `lpac ground`" in banner and "nothing to show" in banner
            assert page.inner_text("#link") == "no ground"
            first.enter_context(lpac(*ground))
            page.wait_for_selector("#robots tr[data-robot]")
            page.wait_for_selector("#banner", state="hidden")
            assert page.is_hidden("#bar")
            assert "lpac mission hold" in page.inner_text("#observing")
            page.keyboard.press("h")
            page.wait_for_selector("#toasts >> text=lpac mission hold")
            below_360 = "async () => (await import('./dom.js')).direction(359.9)"
            assert page.evaluate(below_360) == "0°"
            page.click("tr[data-robot=r1]")
            page.wait_for_selector("#drawer >> text=satellites")
            assert page.locator("[data-robot-do]:visible").count() == 0
            page.wait_for_selector("#banner", state="hidden")
            first.close()
            page.wait_for_selector("#banner >> text=lpac ground")
            with lpac(*ground):
                page.wait_for_selector("#banner", state="hidden")
                page.wait_for_selector("#link >> text=ground live")
                assert "HOLD" not in page.inner_text("#safety-action")
                # Of a world that this laptop does not have.
                assert command(few.name, SetOrigin(ORIGIN)).done
                page.keyboard.press("Escape")
                page.wait_for_selector("#absolute >> text=/e/")
                said = dict(few.says)
                for robot in range(3):
                    few.says[robot] = lambda said: replace(said, world_id="feedbeef0000")
                page.wait_for_selector("#importance >> text=no importance known")
                costs = [page.inner_text(f"#{name}") for name in ("share", "lloyd", "absolute")]
                assert costs == ["\N{EN DASH}"] * 3 and page.is_hidden("#ramp")
                few.says.clear()
                few.says |= said
                page.wait_for_selector("#importance >> text=/^importance/")
            check_innocence(seen)
