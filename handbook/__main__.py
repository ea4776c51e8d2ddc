"""Builds the site; warnings, such as a broken link, are errors."""

import argparse
import logging
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

from mkdocs.commands.build import build
from mkdocs.config import load_config
from mkdocs.exceptions import Abort, ConfigurationError

from handbook.pages import ROOT, PageError, write_pages


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m handbook", description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("out/site"), help="folder of the site")
    out: Path = parser.parse_args().out
    logging.basicConfig(level=logging.WARNING, format="%(message)s")
    with TemporaryDirectory() as folder:
        try:
            write_pages(Path(folder))
            build(
                load_config(
                    str(ROOT / "mkdocs.yml"),
                    docs_dir=folder,
                    site_dir=str(out.resolve()),
                    strict=True,
                )
            )
        except (PageError, Abort, ConfigurationError) as error:
            sys.exit(f"handbook: {error}")
    # Its links start at a server's root; nothing links to it.
    (out / "404.html").unlink()
    print(f"see {out}/index.html")


if __name__ == "__main__":
    main()
