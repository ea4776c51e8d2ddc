"""`lpac foxglove live`: a real server, ground and client; who leaves harms nobody."""

import asyncio
import socket
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager
from pathlib import Path

import aiohttp
import pytest

from lpac.ground.foxglove.live import serving
from lpac.ground.station.client import command
from lpac.ground.station.protocol import SetOrigin
from tests.foxglove_client import SUBPROTOCOL, FoxgloveClient
from tests.live import ORIGIN, FlownFleet
from tests.process.ground.browser import PATIENCE_S, lpac
from tests.process.ground.conftest import wait_for_snapshot

FIXED = {"/tf", "/robots", "/cells", "/fence", "/density", "/seen", "/log", "/fleet", "/cost"}


@pytest.fixture(autouse=True, scope="module")
def _own_sockets(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_RUNTIME_DIR", str(tmp_path_factory.mktemp("run")))
        yield


@asynccontextmanager
async def connected(port: int) -> AsyncIterator[FoxgloveClient]:
    async with (
        asyncio.timeout(PATIENCE_S),
        aiohttp.ClientSession() as session,
        session.ws_connect(
            f"ws://127.0.0.1:{port}/", protocols=[SUBPROTOCOL], max_msg_size=0
        ) as stream,
    ):
        yield FoxgloveClient(stream)


def test_a_fleet_is_shown_to_whoever_comes_and_goes(tmp_path: Path) -> None:
    async def look(port: int) -> None:
        async with connected(port) as client:
            robots = {"/robot/r0", "/robot/r1"}
            await client.until(lambda: FIXED | robots <= client.channels.keys())
            table = await client.hear(lambda h: h.topic == "/fleet")
            assert [row["name"] for row in table.message["robots"]] == ["r0", "r1"]
            moved = await client.hear(lambda h: h.topic == "/tf")
            (transform,) = moved.message["transforms"]
            assert transform["child_frame_id"] in ("r0", "r1")
            # They stand at (2, 2) and (6, 2) m.
            assert transform["translation"]["y"] == pytest.approx(2.0, abs=0.5)
            await client.hear(lambda h: h.topic == "/cost" and h.message["cost"] > 0.0)
        # Others, after the first has left, while one is cut off in the middle of a word.
        _, writer = await asyncio.open_connection("127.0.0.1", port)
        writer.write(b"GET / HTTP/1.1\r\nUpgrade: webso")
        async with connected(port) as client, connected(port) as other:
            writer.close()
            assert (await client.hear(lambda h: h.topic == "/density")).message["data"]
            assert (await other.hear(lambda h: h.topic == "/fence")).message["entities"]

    with (
        FlownFleet(tmp_path, 2) as fleet,
        lpac("ground", "--fleet", str(fleet.fleet_toml), "--name", "alice"),
    ):
        wait_for_snapshot(fleet.name)
        assert command(fleet.name, SetOrigin(ORIGIN)).done
        toml = str(fleet.fleet_toml)
        with lpac("foxglove", "live", "--fleet", toml, "--port", "0") as says:
            asyncio.run(look(int(says.rpartition(":")[2])))
        # The ground has noticed nothing.
        assert wait_for_snapshot(fleet.name).commander == "alice"


def test_without_a_ground_it_says_so_in_foxglove() -> None:
    async def look() -> None:
        async with serving("nobody", host="127.0.0.1", port=0) as port, connected(port) as client:
            await client.until(lambda: bool(client.statuses))
            assert "no ground station runs for fleet nobody" in client.statuses[0]
            assert client.channels.keys() == FIXED

    asyncio.run(look())


def test_a_port_that_is_taken_is_told_in_one_line() -> None:
    async def serve() -> None:
        with socket.create_server(("127.0.0.1", 0)) as taken:
            port = taken.getsockname()[1]
            with pytest.raises(OSError, match=f"--port {port}: cannot serve there: .*in use"):
                async with serving("nobody", host="127.0.0.1", port=port):
                    pass

    asyncio.run(serve())
