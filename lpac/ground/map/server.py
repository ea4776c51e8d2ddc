"""`lpac map`: web server of the live map, a client of the ground process.

One event loop follows the ground and sends updates to each page. Coverage is computed in threads.
"""

import asyncio
import contextlib
import dataclasses
import json
import ssl
import time
from collections import deque
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from typing import Any

from aiohttp import WSMsgType, web

from lpac.analysis.snapshot import Explored, FleetSetup, FleetSnapshot, GroundEvent
from lpac.ground.alarms import Alarm, SnapshotHistory, alarms
from lpac.ground.cost import Cost, MissionCosts, positions_of
from lpac.ground.map.access import Access, server_addresses
from lpac.ground.map.connections import Connection, accepting
from lpac.ground.map.view import (
    Curve,
    Json,
    Paths,
    detail_view,
    report_view,
    setup_view,
    snapshot_view,
)
from lpac.ground.rendering import rows
from lpac.ground.station.client import listen, send
from lpac.ground.station.protocol import CommandReport, Problem, ProblemCode, of_robots

_PAGE = Path(__file__).parent / "page"
_FILES = {
    "/": ("index.html", "text/html"),
    **{
        f"/{name}": (name, "text/javascript")
        for name in ("map.js", "canvas.js", "chart.js", "panel.js", "drawer.js", "dom.js")
    },
    "/map.css": ("map.css", "text/css"),
    "/icon.svg": ("icon.svg", "image/svg+xml"),
}
# Only the page's own files, and no inline scripts or styles.
_HEADERS = {
    "Content-Security-Policy": (
        "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self'; "
        "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    ),
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cache-Control": "no-store",
}
_RETRY_S = 1.0
# WebSocket ping period; a page that does not answer is closed.
_HEARTBEAT_S = 10.0
_MAX_EVENTS = 200
_MAX_REQUEST_BYTES = 4096

# Commands that a page can give. Not kill, for which `lpac mission kill` asks first.
_ACTIONS = ("enable", "takeoff", "start", "hold", "resume", "return", "land", "command")


class Outbox:
    """Queue of an open page: the newest message of each kind, and the last events.

    A slow page misses snapshots, and does not use up memory.
    """

    def __init__(self) -> None:
        self.selected: str | None = None
        self._newest: dict[str, str] = {}
        self._each: deque[str] = deque(maxlen=_MAX_EVENTS)
        self._some = asyncio.Event()

    def put(self, text: str, kind: str) -> None:
        self._newest[kind] = text
        self._some.set()

    def put_each(self, text: str) -> None:
        self._each.append(text)
        self._some.set()

    async def take(self) -> list[str]:
        """Wait for messages and return all of them, in order."""
        await self._some.wait()
        texts = [*self._newest.values(), *self._each]
        self._newest.clear()
        self._each.clear()
        self._some.clear()
        return texts


class LiveMap:
    """Live map of one fleet for any number of pages; commands only with `operate`."""

    def __init__(self, fleet: str, access: Access, *, operate: bool) -> None:
        self._fleet = fleet
        self._access = access
        self._operate = operate
        self._pages: set[Outbox] = set()
        self._sockets: set[web.WebSocketResponse] = set()
        self._tasks: set[asyncio.Task[None]] = set()
        self._problem = "not connected to the ground process yet"
        self._setup: FleetSetup | None = None
        self._setup_text = ""
        self._snapshot: FleetSnapshot | None = None
        # Positions, m, of the robots that count for the cost.
        self._places_m: dict[str, tuple[float, float]] = {}
        self._alarms: tuple[Alarm, ...] = ()
        self._history = SnapshotHistory()
        self._explored: dict[str, Explored] = {}
        self._events: deque[GroundEvent] = deque(maxlen=_MAX_EVENTS)
        self._costs = MissionCosts()
        self._curve: Curve | None = None
        self._paths = Paths()
        self._new_snapshot = asyncio.Event()

    def app(self) -> web.Application:
        """Make the web application; `follow` and `compute` must run beside it."""
        app = web.Application(middlewares=[self._guard], client_max_size=_MAX_REQUEST_BYTES)
        for path in _FILES:
            app.router.add_get(path, self._file)
        app.router.add_get("/live", self._live)
        app.on_shutdown.append(self._close)
        return app

    async def follow(self) -> None:
        """Follow the ground process forever, reconnecting when it has ended."""
        while True:
            try:
                async for message in listen(self._fleet):
                    await self._take(message)
            except (OSError, ValueError) as error:
                self._problem = str(error)
                self._costs.interrupt()
                self._history = SnapshotHistory()
                self._put(self._ground_view())
            await asyncio.sleep(_RETRY_S)

    async def _take(self, message: object) -> None:
        match message:
            case FleetSetup():
                await self._take_setup(message)
            case FleetSnapshot():
                self._take_snapshot(message)
            case GroundEvent() if message not in self._events:
                self._events.append(message)
                for page in self._pages:
                    page.put_each(_text(_event_view(message)))
            case Explored():
                self._explored[message.robot] = message
                self._put(_explored_view(message), message.robot)

    async def _take_setup(self, setup: FleetSetup) -> None:
        await asyncio.to_thread(self._costs.take_setup, setup)
        self._setup = setup
        self._setup_text = _text(setup_view(setup, self._costs.coverage))
        for page in self._pages:
            page.put(self._setup_text, "setup")

    def _take_snapshot(self, snapshot: FleetSnapshot) -> None:
        if self._setup is None:
            return
        self._snapshot = snapshot
        before = self._history.add(snapshot, time.monotonic())
        self._alarms = alarms(self._setup, snapshot, before)
        self._places_m = self._costs.follow(snapshot)
        self._paths.take(snapshot, self._places_m)
        self._new_snapshot.set()
        if self._problem:
            self._problem = ""
            self._put(self._ground_view())
        self._put(snapshot_view(self._setup, snapshot, self._alarms))
        for page in self._pages:
            self._put_detail(page)

    def _put_detail(self, page: Outbox) -> None:
        if self._snapshot is None or self._setup is None:
            return
        for row in rows(self._setup, self._snapshot, self._alarms):
            if row.robot.name == page.selected:
                page.put(_text(detail_view(row, self._snapshot, self._alarms)), "detail")

    async def compute(self) -> None:
        """Compute the newest snapshot's cost and cells, forever."""
        while True:
            await self._new_snapshot.wait()
            self._new_snapshot.clear()
            if self._snapshot is not None:
                await self._compute(self._snapshot, self._places_m)

    async def _compute(
        self, snapshot: FleetSnapshot, places_m: dict[str, tuple[float, float]]
    ) -> None:
        coverage = self._costs.coverage
        if coverage is None or not places_m:
            self._put({"kind": "coverage", "cost": None, "time_s": None, "cells": {}})
            return
        positions_m = positions_of(places_m)
        cost, cells_m = await asyncio.to_thread(
            lambda: (coverage.cost(positions_m), coverage.cells_m(positions_m))
        )
        if coverage is not self._costs.coverage:
            return
        evaluated, share = self._costs.cost(snapshot, places_m, cost), None
        time_s = self._costs.mission_s(snapshot)
        curve = self._curve_of(evaluated)
        if curve is not None and time_s is not None and evaluated.normalized is not None:
            share = round(evaluated.normalized, 4)
            curve.add(time_s, share)
        cells = {
            name: [[round(x_m, 2), round(y_m, 2)] for x_m, y_m in cell]
            for name, cell in zip(places_m, cells_m, strict=True)
        }
        self._put(
            {"kind": "coverage", "cost": cost, "share": share, "time_s": time_s, "cells": cells}
        )

    def _curve_of(self, cost: Cost) -> Curve | None:
        """The mission's curve; a new one, and its Lloyd's cost, are sent to the pages."""
        began_s, curve, lloyd = self._costs.began_s, self._curve, None
        if began_s is None:
            return None
        if cost.bound is not None and cost.initial:
            lloyd = round(cost.bound / cost.initial, 4)
        if curve is None or curve.began_s != began_s:
            self._paths.clear()
            self._curve = curve = Curve(cost.trial, began_s, self._costs.whole, lloyd)
        elif lloyd in (None, curve.lloyd):
            return curve
        curve.lloyd = lloyd
        self._put(curve.view())
        return curve

    def _put(self, view: Json, of: str = "") -> None:
        """Send to all pages, replacing an unsent message of the same kind."""
        if self._pages:
            text = _text(view)
            for page in self._pages:
                page.put(text, view["kind"] + of)

    def _ground_view(self) -> Json:
        return {"kind": "ground", "problem": self._problem}

    def _welcome(self, page: Outbox) -> None:
        """Send everything known to a new page."""
        page.put(_text({"kind": "hello", "fleet": self._fleet, "operate": self._operate}), "hello")
        page.put(_text(self._ground_view()), "ground")
        if self._setup is None:
            return
        page.put(self._setup_text, "setup")
        page.put(_text(self._paths.view()), "paths")
        for explored in self._explored.values():
            page.put(_text(_explored_view(explored)), "explored" + explored.robot)
        for event in self._events:
            page.put_each(_text(_event_view(event)))
        if self._curve is not None:
            page.put(_text(self._curve.view()), "curve")
        if self._snapshot is not None:
            view = snapshot_view(self._setup, self._snapshot, self._alarms)
            page.put(_text(view), "snapshot")

    @web.middleware
    async def _guard(
        self, request: web.Request, handler: Callable[[web.Request], Any]
    ) -> web.StreamResponse:
        if isinstance(request.protocol, Connection):
            request.protocol.asked()
        cookie = _cookie(request)
        query = request.query.get("token")
        refusal = self._access.refusal(
            request.headers.get("Host", ""),
            request.headers.get("Origin"),
            (request.cookies.get(cookie), query),
        )
        if refusal is not None:
            return web.Response(status=403, text=f"{refusal}\n", headers=_HEADERS)
        if query is not None and self._access.token is not None and request.path == "/":
            # Remove the token from the address, which others may see on the screen.
            response = web.Response(status=303, headers={**_HEADERS, "Location": "/"})
            response.set_cookie(
                cookie, self._access.token, httponly=True, samesite="Strict",
                secure=self._access.scheme == "https",
            )  # fmt: skip
            return response
        answer: web.StreamResponse = await handler(request)
        return answer

    async def _file(self, request: web.Request) -> web.Response:
        name, content_type = _FILES[request.path]
        return web.Response(
            body=(_PAGE / name).read_bytes(),
            content_type=content_type,
            charset="utf-8",
            headers=_HEADERS,
        )

    async def _live(self, request: web.Request) -> web.WebSocketResponse:
        stream = web.WebSocketResponse(heartbeat=_HEARTBEAT_S, max_msg_size=_MAX_REQUEST_BYTES)
        await stream.prepare(request)
        page = Outbox()
        self._welcome(page)
        self._pages.add(page)
        self._sockets.add(stream)
        writer = asyncio.create_task(_write(stream, page))
        try:
            async for message in stream:
                if message.type is WSMsgType.TEXT:
                    self._handle(page, message.data)
        finally:
            self._pages.discard(page)
            self._sockets.discard(stream)
            writer.cancel()
            with contextlib.suppress(asyncio.CancelledError, ConnectionError):
                await writer
        return stream

    async def _close(self, _: web.Application) -> None:
        for stream in tuple(self._sockets):
            await stream.close(code=1001)
        for task in tuple(self._tasks):
            task.cancel()

    def _handle(self, page: Outbox, text: str) -> None:
        """Handle {"select": name or null} or {"do": action, "robots": [names]}; ignore others."""
        try:
            request = json.loads(text)
        except (ValueError, RecursionError):
            return
        match request:
            case {"select": str() | None as name}:
                page.selected = name
                self._put_detail(page)
            case {"do": str(action), "robots": [*robots]} if all(
                isinstance(robot, str) for robot in robots
            ):
                self._start(self._act(page, action, tuple(robots)))

    async def _act(self, page: Outbox, action: str, robots: tuple[str, ...]) -> None:
        if not self._operate:
            text = "this map only shows the fleet: `lpac map --operate` can command"
            report = CommandReport(problem=Problem(ProblemCode.MAY_NOT, text))
        elif action not in _ACTIONS:
            text = "there is no such command here"
            report = CommandReport(problem=Problem(ProblemCode.NOT_UNDERSTOOD, text))
        else:
            try:
                report = await send(self._fleet, of_robots(action, robots))
            except (OSError, ValueError) as error:
                report = CommandReport(problem=Problem(ProblemCode.NO_GROUND, str(error)))
        page.put_each(_text(report_view(action, report)))

    def _start(self, work: Any) -> None:
        task = asyncio.create_task(work)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)


async def _write(stream: web.WebSocketResponse, page: Outbox) -> None:
    while not stream.closed:
        for text in await page.take():
            # Waits while the page has not taken earlier messages.
            await stream.send_str(text)


def _event_view(event: GroundEvent) -> Json:
    return {**dataclasses.asdict(event), "kind": "event", "what": event.kind}


def _explored_view(explored: Explored) -> Json:
    return {"kind": "explored", **dataclasses.asdict(explored)}


def _text(view: Json) -> str:
    return json.dumps(view, separators=(",", ":"), allow_nan=False)


def _cookie(request: web.Request) -> str:
    """Cookie name with the port, since browsers share cookies between ports."""
    port = request.transport.get_extra_info("sockname")[1] if request.transport else 0
    return f"lpac-map-{port}"


@contextlib.asynccontextmanager
async def serving(
    fleet: str,
    *,
    host: str,
    port: int,
    access: Access,
    operate: bool,
    tls: ssl.SSLContext | None = None,
) -> AsyncIterator[list[str]]:
    """Serve the map of a fleet within this context; gives its addresses.

    With `tls`, the scheme of `access` must be https. Port 0 takes a free one. Raises OSError if it
    cannot listen there.
    """
    live_map = LiveMap(fleet, access, operate=operate)
    runner = web.AppRunner(live_map.app(), access_log=None, shutdown_timeout=1.0)
    await runner.setup()
    assert runner.server is not None
    async with contextlib.AsyncExitStack() as parts:
        parts.push_async_callback(runner.cleanup)
        try:
            own, own_port = await parts.enter_async_context(
                accepting(runner.server, host, port, tls)
            )
        except OSError as error:
            reason = error.strerror or error
            raise OSError(f"--host {host} --port {port}: cannot serve there: {reason}") from None
        names = [f"[{name}]" if ":" in name else name for name in server_addresses(own)]
        query = "" if access.token is None else f"?token={access.token}"
        async with asyncio.TaskGroup() as group:
            tasks = [group.create_task(live_map.follow()), group.create_task(live_map.compute())]
            try:
                yield [f"{access.scheme}://{name}:{own_port}/{query}" for name in names]
            finally:
                for task in tasks:
                    task.cancel()
                # Close the pages' WebSockets before their connections end.
                await runner.shutdown()
