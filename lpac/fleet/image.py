"""How large the robot's image is, and what dominates.

`python -m lpac.fleet.image out/image/arm64` prints it.
"""

import sys
from collections import Counter
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

_SITE = PurePosixPath("usr/lib/python3/dist-packages")
_PYTHON = ("usr/lib/python3.11", "usr/bin/python3.11")


@dataclass(frozen=True, slots=True)
class ImageSize:
    """Bytes of the unpacked tree, of its archive, and of each package, the largest first."""

    unpacked_bytes: int
    compressed_bytes: int
    packages: dict[str, int]


def measure(folder: Path) -> ImageSize:
    """Size of the image that `make image` put into `folder`, and its archive beside it.

    Raises ValueError if there is none.
    """
    root, archive = folder / "root", _archive(folder)
    if not root.is_dir() or not archive.is_file():
        raise ValueError(f"{folder}: no image is there: run `make image`")
    packages: Counter[str] = Counter()
    for path in root.rglob("*"):
        if path.is_file() and not path.is_symlink():
            packages[package_of(PurePosixPath(path.relative_to(root)))] += path.stat().st_size
    return ImageSize(packages.total(), archive.stat().st_size, dict(packages.most_common()))


def package_of(path: PurePosixPath) -> str:
    """Package that a file belongs to, from its path in the tree."""
    if path.is_relative_to(_SITE):
        name = path.relative_to(_SITE).parts[0]
        return name.split("-")[0].removesuffix(".libs")
    if any(path.is_relative_to(place) for place in _PYTHON):
        return "Python"
    return "libraries of Debian"


def table(folder: Path, size: ImageSize, rows: int = 8) -> str:
    """The sizes for people, with that many of the largest packages."""
    lines = [
        f"{folder}: {size.unpacked_bytes / 1e6:.1f} MB unpacked, "
        f"{size.compressed_bytes / 1e6:.1f} MB as {_archive(folder)}"
    ]
    shown = list(size.packages.items())[:rows]
    shown.append(("all else", size.unpacked_bytes - sum(count for _, count in shown)))
    lines += [
        f"  {name:20} {count / 1e6:6.1f} MB {count / size.unpacked_bytes:5.0%}"
        for name, count in shown
    ]
    return "\n".join(lines)


def _archive(folder: Path) -> Path:
    return folder.parent / f"lpac-edge-{folder.name}.tar.gz"


def main() -> None:
    """Print the table of the image in the folder that the command line names."""
    (folder,) = map(Path, sys.argv[1:])
    try:
        print(table(folder, measure(folder)))
    except ValueError as error:
        sys.exit(f"image: {error}")


if __name__ == "__main__":
    main()
