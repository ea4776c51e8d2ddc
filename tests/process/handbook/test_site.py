"""`make docs`: the documentation as a site."""

import os
import shutil
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote

import pytest
from playwright.sync_api import sync_playwright

from tests.conftest import ROOT
from tests.needs import needs


class _Page(HTMLParser):
    """A page of the site: what it loads when it is opened, its links, and their targets."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.loaded: list[str] = []
        self.links: list[str] = []
        self.ids: set[str] = set()
        self.feed(path.read_text())

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        values = {key: value for key, value in attrs if value}
        if tag in ("img", "script"):
            self.loaded += [values["src"]] if "src" in values else []
        elif "href" in values:
            (self.links if tag == "a" else self.loaded).append(values["href"])
        self.ids.update(values[key] for key in ("id", "name") if key in values)


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The site, built in strict mode: a broken link or a page without navigation fails."""
    out = tmp_path_factory.mktemp("docs") / "site"
    built = subprocess.run(
        [sys.executable, "-m", "handbook", "--out", str(out)],
        cwd=ROOT, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert built.returncode == 0, built.stderr
    assert built.stderr == "" and built.stdout == f"see {out}/index.html\n"
    return out


def test_every_page_can_be_read_from_disk(site: Path) -> None:
    """Each link is to a file and an anchor of it, and pages load nothing from elsewhere."""
    pages = {path: _Page(path) for path in site.rglob("*.html")}
    assert len(pages) > 100
    for path, page in pages.items():
        for link in [*page.loaded, *page.links]:
            if link.startswith(("https:", "data:")):
                assert link not in page.loaded or link.startswith("data:"), (path, link)
                continue
            name, _, anchor = link.partition("#")
            target = Path(os.path.normpath(path.parent / unquote(name))) if name else path
            assert target.is_file(), (path, link)
            if anchor and target in pages:
                assert unquote(anchor) in pages[target].ids, (path, link)


@needs("chromium")
def test_search_works_from_disk(site: Path) -> None:
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(
            executable_path=shutil.which("chromium"), args=["--no-sandbox"], timeout=120_000.0
        )
        page = browser.new_page()
        page.goto((site / "reference" / "commands.html").as_uri())
        page.keyboard.press("/")
        page.keyboard.type("Voronoi")
        page.wait_for_selector(".md-search-result__link[href*='pac-loop.html']")
        browser.close()
