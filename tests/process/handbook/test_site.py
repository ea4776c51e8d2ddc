"""`make docs`: the documentation as a site."""

import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path

from tests.conftest import ROOT


class _Loaded(HTMLParser):
    """Resources that a page loads when it is opened."""

    def __init__(self) -> None:
        super().__init__()
        self.addresses: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        name = {"img": "src", "script": "src", "link": "href"}.get(tag)
        self.addresses += [value for key, value in attrs if key == name and value]


def test_the_site_is_built_without_a_warning(tmp_path: Path) -> None:
    """In strict mode: a broken link or anchor, or a page without navigation, fails."""
    out = tmp_path / "site"
    built = subprocess.run(
        [sys.executable, "-m", "handbook", "--out", str(out)],
        cwd=ROOT, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert built.returncode == 0, built.stderr
    assert built.stderr == "" and built.stdout.startswith(f"see {out}/index.html")
    for page in ("index", "start", "safety", "reference/commands", "reference/messages"):
        loaded = _Loaded()
        loaded.feed((out / f"{page}.html").read_text())
        assert not [each for each in loaded.addresses if each.startswith(("http", "//"))], page
