"""Pages of the site, and the targets of the repository's links on it.

Pages are written for the repository, with paths as links. On the site `docs/` is the root,
README.md the front page, and each linked file of code gets a page of its own.
"""

import json
import posixpath
import re
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path

from handbook import commands, configuration, faults, interfaces, messages

ROOT = Path(__file__).resolve().parent.parent
# Pages outside of docs/. Files that are linked from pages are added.
_OTHERS = ("README.md", "CHANGELOG.md", "CONTRIBUTING.md", "policies/README.md", "tests/README.md")
_GENERATED: dict[str, Callable[[], str]] = {
    "docs/reference/commands.md": commands.page,
    "docs/reference/robot-toml.md": configuration.robot,
    "docs/reference/fleet-toml.md": configuration.fleet,
    "docs/reference/ground-files.md": configuration.ground,
    "docs/reference/training.md": configuration.training,
    "docs/reference/study.md": configuration.study,
    "docs/reference/ablation.md": configuration.ablation,
    "docs/reference/messages.md": messages.page,
    "docs/reference/faults.md": faults.page,
    "docs/reference/manifest.md": configuration.manifest,
    "docs/reference/api.md": interfaces.python_api,
    "docs/reference/interfaces.md": interfaces.page,
}
_CODE_BLOCK = re.compile(r"^(`{3,}|~{3,}).*?^\1", re.S | re.M)
_LINK = re.compile(r"(!?\[(?:[^\[\]]|\[[^\]]*\])*\])\(([^()\s]+)\)")
_ASSETS = ("site.css", "iframe-worker.js")
# Copied without change.
_COPIED = (".png", ".svg")
# Code would bury the pages in search results.
_UNSEARCHED = "---\nsearch:\n  exclude: true\n---\n\n"


class PageError(ValueError):
    """A page has a broken link; the text names both."""


def generated() -> list[str]:
    """Paths of the generated pages, as in links of the repository."""
    return list(_GENERATED)


def hand_written() -> list[str]:
    """Paths of the hand-written pages."""
    return [*_OTHERS, *sorted(f"docs/{path.name}" for path in (ROOT / "docs").glob("*.md"))]


def links(text: str) -> Iterator[str]:
    """Yield the targets of a page's links and pictures, without code blocks."""
    yield from (match[2] for match in _LINK.finditer(_CODE_BLOCK.sub("", text)))


def target(link: str, page: str) -> str | None:
    """The repository path of a page's link; None for other sites and links within the page."""
    path = link.partition("#")[0]
    if not path or re.match(r"[a-z]+:", path):
        return None
    return posixpath.normpath(posixpath.join(posixpath.dirname(page), path))


def place(path: str) -> str:
    """Path of a repository's file in the site's sources."""
    folder, name = posixpath.split(path)
    if path.endswith(".md"):
        name = "index.md" if name == "README.md" else name
    elif not path.endswith(_COPIED):
        return f"source/{path}.md"
    return posixpath.join(re.sub(r"^docs(/|$)", "", folder), name)


def write_pages(folder: Path) -> None:
    """Write the site's sources. Raises PageError for a broken link."""
    for name in _ASSETS:
        shutil.copyfile(ROOT / "handbook" / name, folder / name)
    waiting = [*hand_written(), *_GENERATED]
    known = set(waiting)
    while waiting:
        path = waiting.pop()
        file = folder / place(path)
        file.parent.mkdir(parents=True, exist_ok=True)
        if path.endswith(_COPIED):
            shutil.copyfile(ROOT / path, file)
            continue
        text = page_text(path)
        for link in links(text):
            linked = target(link, path)
            if linked is None:
                continue
            if linked not in _GENERATED and not (ROOT / linked).exists():
                raise PageError(f"{path}: {link}: there is no such file")
            if linked not in known:
                known.add(linked)
                waiting.append(linked)
        file.write_text(_with_links_of_the_site(text, path))


def page_text(path: str) -> str:
    """Markdown of a page, of another file, or of a folder's list of files."""
    if path in _GENERATED:
        return _GENERATED[path]()
    if (ROOT / path).is_dir():
        files = sorted(file.name for file in (ROOT / path).iterdir() if file.is_file())
        name = posixpath.basename(path)
        return "\n".join([f"# {path}\n", *(f"- [{file}]({name}/{file})" for file in files)])
    text = (ROOT / path).read_text()
    if path.endswith(".md"):
        return text
    if path.endswith(".ipynb"):
        return _notebook(text)
    return _UNSEARCHED + f"# {path}\n\n````text\n{text}````\n"


def _notebook(text: str) -> str:
    """Text and code of a notebook, without outputs."""
    cells = ((cell["cell_type"], "".join(cell["source"])) for cell in json.loads(text)["cells"])
    return "\n\n".join(
        source if kind == "markdown" else f"```python\n{source}\n```" for kind, source in cells
    )


def _with_links_of_the_site(text: str, page: str) -> str:
    here = posixpath.dirname(place(page))

    def mended(match: re.Match[str]) -> str:
        linked = target(match[2], page)
        if linked is None:
            return match[0]
        _, hash_, anchor = match[2].partition("#")
        return f"{match[1]}({posixpath.relpath(place(linked), here or '.')}{hash_}{anchor})"

    done, end = [], 0
    for block in _CODE_BLOCK.finditer(text):
        done += [_LINK.sub(mended, text[end : block.start()]), block[0]]
        end = block.end()
    return "".join([*done, _LINK.sub(mended, text[end:])])
