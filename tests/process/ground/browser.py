"""The live map in a real browser: the machine's own Chromium, without a screen.

`python -m tests.process.ground.browser URL FILE` makes a picture of a map that runs; see --help.
"""

import argparse
import os
import shutil
import subprocess
import sys
import threading
from collections import deque
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal
from urllib.parse import urlsplit

import pytest
from playwright.sync_api import Page, sync_playwright

from tests.conftest import ROOT
from tests.needs import missing

CHROMIUM = shutil.which("chromium")
PATIENCE_S = 120.0
MOST_TRIES = 3
# Software rendering, and nothing that a browser does by itself on the network.
_ARGUMENTS = (
    "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage", "--disable-background-networking",
    "--disable-component-update", "--disable-sync", "--no-first-run", "--no-default-browser-check",
)  # fmt: skip


@dataclass
class Opened:
    """A page, and what it did: `errors` of its scripts and console, `hosts` that it asked."""

    page: Page
    errors: list[str] = field(default_factory=list)
    hosts: set[str] = field(default_factory=set)

    def state_of(self, robot: str) -> str:
        """The robot's state, as the page's list has it."""
        return self.page.locator(f"tr[data-robot='{robot}']").get_attribute("data-state") or ""

    def wait_for_states(self, robots: Mapping[str, str]) -> None:
        """Wait until the page's list shows these robots in these states. Raises TimeoutError."""
        for robot, state in robots.items():
            # The list is there, though not shown, while a drawer is open.
            self.page.wait_for_selector(
                f"tr[data-robot='{robot}'][data-state='{state}']", state="attached"
            )

    def act(self, action: str, *, sure: bool = False) -> None:
        """Click a command of the bar; `sure`: and yes in what it asks then."""
        self.page.click(f"#bar [data-do={action}]")
        if sure:
            self.page.click("#ask-yes")

    def act_in_the_end(self, action: str, *, sure: bool = False) -> None:
        """`act`, again as long as the page says that not all did it, as an operator would."""
        said = []
        for _ in range(MOST_TRIES):
            self.act(action, sure=sure)
            toast = self.page.wait_for_selector(".toast")
            assert toast is not None
            done = "good" in (toast.get_attribute("class") or "")
            said.append(toast.inner_text())
            toast.click()
            if done:
                return
        raise AssertionError(said)

    def screenshot(self, path: Path) -> None:
        """The page as it is now, PNG."""
        self.page.screenshot(path=path)


@contextmanager
def opened(
    address: str,
    size: tuple[int, int] = (1280, 800),
    theme: Literal["light", "dark"] = "light",
    *,
    shows: str = "#robots tr[data-robot]",
) -> Iterator[Opened]:
    """Open the map at `address`, and wait until it shows that.

    Skips the test where there is no Chromium.
    """
    if lacks := missing("chromium"):
        pytest.skip(lacks)
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(
            executable_path=CHROMIUM, args=[*_ARGUMENTS], timeout=PATIENCE_S * 1000.0
        )
        try:
            context = browser.new_context(
                viewport={"width": size[0], "height": size[1]}, color_scheme=theme
            )
            page = context.new_page()
            page.set_default_timeout(PATIENCE_S * 1000.0)
            seen = Opened(page)
            page.on("pageerror", lambda error: seen.errors.append(str(error)))
            page.on(
                "console",
                lambda said: seen.errors.append(said.text) if said.type == "error" else None,
            )
            page.on("request", lambda asked: seen.hosts.add(urlsplit(asked.url).hostname or ""))
            page.on("websocket", lambda asked: seen.hosts.add(urlsplit(asked.url).hostname or ""))
            page.goto(address)
            page.wait_for_selector(shows)
            yield seen
        finally:
            browser.close()


@contextmanager
def lpac(*arguments: str) -> Iterator[str]:
    """Run `lpac` with these arguments, until the context ends; gives the first line that it says.

    Raises RuntimeError if it says none.
    """
    program = subprocess.Popen(
        [sys.executable, "-m", "lpac.cli.main", *arguments],
        cwd=ROOT, env={**os.environ, "PYTHONPATH": str(ROOT)}, stdout=subprocess.PIPE, text=True,
    )  # fmt: skip
    with program:
        assert program.stdout is not None
        try:
            line = program.stdout.readline()
            if not line:
                raise RuntimeError(f"lpac {' '.join(arguments)} ended at once")
            # It must never wait for a reader.
            reader = threading.Thread(target=deque, args=(program.stdout, 0))
            reader.start()
            yield line.rstrip("\n")
        finally:
            program.terminate()
            program.wait(PATIENCE_S)
        reader.join()


@contextmanager
def live_map(fleet_toml: Path, *options: str) -> Iterator[str]:
    """Run `lpac map` of a fleet on a free port; gives its address."""
    with lpac("map", "--fleet", str(fleet_toml), "--port", "0", *options) as line:
        yield line.split()[-1]


def main() -> None:
    parser = argparse.ArgumentParser(description="Make a picture of a live map that runs.")
    parser.add_argument("address", help="what `lpac map` printed")
    parser.add_argument("file", type=Path)
    parser.add_argument("--size", default="1280x800")
    parser.add_argument("--theme", choices=("light", "dark"), default="light")
    parser.add_argument("--robot", help="whose drawer is open")
    parser.add_argument("--wait", type=float, default=3.0, help="s before the picture is taken")
    arguments = parser.parse_args()
    width, height = map(int, arguments.size.split("x"))
    with opened(arguments.address, (width, height), arguments.theme) as seen:
        if arguments.robot:
            seen.page.click(f"tr[data-robot='{arguments.robot}']")
        seen.page.wait_for_timeout(arguments.wait * 1000.0)
        seen.screenshot(arguments.file)


if __name__ == "__main__":
    main()
