"""`lpac map`: the live map, a page for the browser."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

import typer

from lpac.cli.apps import new_app
from lpac.cli.fields import options_of
from lpac.cli.options import DEFAULT_FLEET, Fleet

if TYPE_CHECKING:
    import ssl

    from lpac.fleet.settings import FleetConfig
    from lpac.ground.map.access import Access

app = new_app()


@dataclass(frozen=True, slots=True, kw_only=True)
class MapOptions:
    """Options of `lpac map`: address, and whether the page may command."""

    fleet: Fleet = DEFAULT_FLEET
    port: Annotated[int, typer.Option("--port", min=0, max=65535, help="0: any free port.")] = 8300
    host: Annotated[str, "Address to serve; on a network the page needs a token."] = "127.0.0.1"
    operate: Annotated[bool, "Also command the fleet from the page."] = False
    token: Annotated[str | None, "The token; by default one is made if needed."] = None
    over_tls: Annotated[
        bool, typer.Option("--tls", help="Serve over TLS, from the laptop with the authority.")
    ] = False
    open_page: Annotated[bool, typer.Option("--open", help="Open it in the browser.")] = False


@app.command("map")
@options_of(MapOptions)
def live_map(page: MapOptions) -> None:
    """Show the fleet on a live map, in a browser; needs `lpac ground`, and no internet.

    It only observes, unless --operate is given; it then needs a token, which is part of the
    address. Without --tls anybody who listens on the network can read the token; with it, each
    browser has to import the authority once.
    """
    import asyncio

    from edge.core.address import require_host
    from lpac.fleet.settings import load_fleet
    from lpac.ground.map.server import serving
    from lpac.ground.serve import serve

    require_host("--host", page.host)
    config = load_fleet(page.fleet)
    # With "::" asyncio serves IPv6 alone, and a field's network has no IPv6 addresses.
    host = "0.0.0.0" if page.host == "::" else page.host
    access = _access(host, page)
    tls = _tls(config, host) if page.over_tls else None
    server = serving(
        config.fleet, host=host, port=page.port, operate=page.operate, access=access, tls=tls
    )
    asyncio.run(serve(server, lambda addresses: _on_ready(config.fleet, addresses, page)))


def _access(host: str, page: MapOptions) -> "Access":
    """Decide access to the page. Raises ValueError for an invalid --token."""
    import re
    import secrets

    from edge.core.address import is_loopback
    from lpac.ground.map.access import Access

    token, local = page.token, is_loopback(host)
    if token is not None and re.fullmatch(r"[A-Za-z0-9_-]+", token) is None:
        raise ValueError("--token: must be letters, digits, '-' and '_'")
    if token is None and (page.operate or not local):
        token = secrets.token_urlsafe(16)
    return Access(local, token, "https" if page.over_tls else "http")


def _tls(config: "FleetConfig", host: str) -> "ssl.SSLContext":
    """TLS with a certificate of the fleet's authority. Raises AuthorityError."""
    import datetime
    import ssl

    from lpac.fleet.members import open_authority
    from lpac.fleet.web_certificate import web_certificate
    from lpac.ground.map.access import server_addresses

    addresses = ["127.0.0.1" if a == "localhost" else a for a in server_addresses(host)]
    files = web_certificate(open_authority(config), addresses, datetime.datetime.now(datetime.UTC))
    context = ssl.create_default_context(ssl.Purpose.CLIENT_AUTH)
    context.load_cert_chain(files.certificate, files.key)
    typer.echo(f"browsers import {files.authority}")
    return context


def _on_ready(fleet: str, addresses: list[str], page: MapOptions) -> None:
    import webbrowser

    from lpac.ground.station.client import subscribe

    for address in addresses:
        typer.echo(f"map of {fleet}: {address}")
    typer.echo("commands the fleet" if page.operate else "only observes; --operate commands")
    typer.echo("Ctrl-C ends it, and nothing else")
    try:
        with subscribe(fleet):
            pass
    except OSError as error:
        typer.echo(f"{error}; until then the map shows nothing")
    if page.open_page:
        webbrowser.open(addresses[0])
