"""What travels to a robot, against the wheel that torch alone would add."""

import re
import tomllib
import urllib.request
import zlib
from pathlib import Path
from urllib.parse import urljoin

from bench import BUNDLE, ROOT
from bench.report import Report, Table, Target, progress
from lpac.fleet.image import measure as measure_image

IMAGE = ROOT / "out" / "image" / "arm64"
_INDEX = "https://pypi.org/simple/torch/"
_TIMEOUT_S = 30.0


def measure(image: Path = IMAGE) -> Report:
    """The release for arm64, and torch's wheel for the same Python as the package index has it.

    The notes say what is missing where there is no image or no network.
    """
    try:
        size = measure_image(image)
    except ValueError as error:
        return Report("release", {}, [], [], [str(error)])
    policy = [path.read_bytes() for path in BUNDLE.iterdir()]
    unpacked_mb = (size.unpacked_bytes + sum(map(len, policy))) / 1e6
    compressed_mb = (size.compressed_bytes + sum(len(zlib.compress(data)) for data in policy)) / 1e6
    torch = f"torch {_torch_version()}, its wheel for aarch64 alone"
    progress(f"release: the size of {torch}")
    notes = [
        "Release: Python, its libraries, the runtime and the policy, compressed with gzip. torch's "
        "wheel is the one that `pip install torch` takes on the robot, without what it depends on."
    ]
    try:
        torch_mb = _torch_wheel_bytes() / 1e6
    except OSError as error:
        torch_mb = None
        notes.append(f"torch's wheel could not be asked for at {_INDEX}: {error}")
    rows = [("release of a robot", f"{unpacked_mb:.0f}", f"{compressed_mb:.1f}")]
    rows += [(name, f"{count / 1e6:.0f}", "") for name, count in list(size.packages.items())[:5]]
    rows.append((torch, "", "no network" if torch_mb is None else f"{torch_mb:.1f}"))
    figures = {
        "unpacked_mb": unpacked_mb,
        "compressed_mb": compressed_mb,
        "packages_mb": {name: count / 1e6 for name, count in size.packages.items()},
        "torch_wheel_mb": torch_mb,
    }
    target = "compressed release over torch's wheel alone"
    return Report(
        "release",
        figures,
        [Table("A robot's release for arm64", ("", "unpacked, MB", "compressed, MB"), rows)],
        [] if torch_mb is None else [Target(target, compressed_mb / torch_mb, 1 / 4, False)],
        notes,
    )


def _torch_version() -> str:
    """The version that our exporter is pinned to."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    (pin,) = (r for r in project["optional-dependencies"]["export"] if r.startswith("torch=="))
    return str(pin.removeprefix("torch=="))


def _torch_wheel_bytes() -> int:
    """Its size as the package index has it now. Raises OSError if the index does not answer."""
    with urllib.request.urlopen(_INDEX, timeout=_TIMEOUT_S) as response:
        page = response.read().decode()
    name = rf"torch-{re.escape(_torch_version())}-cp311-cp311-manylinux\w+_aarch64\.whl"
    link = re.search(rf'href="([^"#]*/{name})[#"]', page)
    if link is None:
        raise OSError("it lists no such wheel")
    url = urljoin(_INDEX, link[1])
    request = urllib.request.Request(url, method="HEAD")
    with urllib.request.urlopen(request, timeout=_TIMEOUT_S) as response:
        return int(response.headers["Content-Length"])
