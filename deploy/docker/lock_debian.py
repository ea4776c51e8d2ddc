"""Write debian.lock: the newest versions of the image's Debian packages, with their hashes."""

import lzma
import sys
import urllib.request
from pathlib import Path

ARCHIVE = "http://deb.debian.org/debian"
ARCHITECTURES = ("amd64", "arm64")
# Python, and what the wheels link; gcc-12-base holds a licence. libssl, libsqlite and the like stay
# out, with the modules of the standard library that need them.
PACKAGES = (
    "gcc-12-base", "libbz2-1.0", "libc6", "libexpat1", "libffi8", "libgcc-s1", "liblzma5",
    "libpython3.11-minimal", "libpython3.11-stdlib", "libstdc++6", "python3.11-minimal", "zlib1g",
)  # fmt: skip
HEAD = """\
# Debian packages of the image, written by `make lock`: architecture, package, version, sha256.
# Of bookworm's main archive, whose last point release does not change any more; the security
# archive drops the version of yesterday, and a lock on it would soon not build.
"""


def main() -> None:
    """Look the packages up. apt checks the archive's signature when the image is built."""
    lines = []
    for architecture in ARCHITECTURES:
        url = f"{ARCHIVE}/dists/bookworm/main/binary-{architecture}/Packages.xz"
        with urllib.request.urlopen(url, timeout=60.0) as response:
            index = lzma.decompress(response.read()).decode()
        for stanza in index.split("\n\n"):
            fields = dict(line.split(": ", 1) for line in stanza.split("\n") if ": " in line)
            if fields.get("Package") in PACKAGES:
                keys = ("Package", "Version", "SHA256")
                lines.append(" ".join([architecture, *(fields[key] for key in keys)]))
    if len(lines) != len(ARCHITECTURES) * len(PACKAGES):
        sys.exit(f"lock: {url}: not each package is there once")
    Path(__file__).with_name("debian.lock").write_text(HEAD + "\n".join(sorted(lines)) + "\n")


if __name__ == "__main__":
    main()
