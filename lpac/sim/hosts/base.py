"""The operating system of a simulated robot computer, as a tree: built once, kept in a cache."""

import fcntl
import hashlib
import os
import platform
import shutil
import subprocess
import tempfile
import urllib.error
import urllib.request
from collections.abc import Callable
from pathlib import Path

# A VOXL2 runs the first; the second replaces it where Ubuntu's archive is out of reach.
SUITE, SECOND_SUITE = "bionic", "bookworm"
MIRRORS = {
    SUITE: "http://archive.ubuntu.com/ubuntu",
    SECOND_SUITE: "http://deb.debian.org/debian",
}
PACKAGES = (
    "systemd", "systemd-sysv", "dbus", "openssh-server", "rsync", "iproute2", "iputils-ping",
    "procps", "python3", "openssl",
)  # fmt: skip

# Program -> the Debian package that has it.
NEEDED = {
    "systemd-nspawn": "systemd-container",
    "mmdebstrap": "mmdebstrap",
    "ssh": "openssh-client",
    "rsync": "rsync",
    "ip": "iproute2",
}
# Debian lacks the keys of Ubuntu's archive.
_KEYRING_URL = (
    f"{MIRRORS[SUITE]}/pool/main/u/ubuntu-keyring/ubuntu-keyring_2018.09.18.1~18.04.2_all.deb"
)
_KEYRING_SHA256 = "5d8609563fb3074026b254d7d5248f90d393c7dbafcac48916f333bf3c90fed9"
_ANSWER_WITHIN_S = 10.0

# Hosts have neither internet nor screen.
_MASKED = (
    "apt-daily.timer", "apt-daily-upgrade.timer", "console-getty.service", "fstrim.timer",
    "getty@.service", "motd-news.timer", "systemd-resolved.service", "systemd-timesyncd.service",
    "e2scrub_all.timer",
)  # fmt: skip
# The names are those on a VOXL2; what they run is simulated outside.
_SERVICES = ("voxl-px4", "voxl-mavlink-server", "voxl-vision-hub")
_SERVICE = """\
[Unit]
Description=stands in for {name}
[Service]
ExecStart=/bin/sleep infinity
[Install]
WantedBy=multi-user.target
"""
_FILES = {
    "etc/hostname": "m0054\n",
    "etc/hosts": "127.0.0.1 localhost m0054\n",
    "etc/version": "1.4.1\n",
    "etc/modalai/voxl-vision-hub.conf": """\
{
    "en_localhost_mavlink_udp": true,
    "localhost_udp_port_number": 14551,
    "offboard_mode": "figure_eight"
}
""",
    "data/px4/param/parameters": "",
    "data/px4/log/.keep": "",
    **{
        f"etc/systemd/system/{name}.service": _SERVICE.format(name=name) for name in _SERVICES
    },
}  # fmt: skip


class NoHostsError(ValueError):
    """This machine cannot run robot hosts; the text says what is missing."""


def require_tools() -> None:
    """Raise NoHostsError unless this machine can run robot hosts."""
    packages = [package for program, package in NEEDED.items() if not shutil.which(program)]
    if packages:
        raise NoHostsError(f"robot hosts need: sudo apt install {' '.join(packages)}")
    if os.geteuid() != 0:
        raise NoHostsError("robot hosts need root: run this with sudo")
    if platform.machine() != "x86_64":
        raise NoHostsError(f"robot hosts need an x86-64 machine, this is {platform.machine()}")


def base_tree(report: Callable[[str], None]) -> Path:
    """The tree of `SUITE`, built if not cached; if that fails, the tree of `SECOND_SUITE`.

    Raises NoHostsError if neither can be built.
    """
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "lpac-edge/hosts"
    cache.mkdir(parents=True, exist_ok=True)
    recipe = hashlib.sha256(repr((PACKAGES, _MASKED, _FILES)).encode()).hexdigest()[:8]
    with (cache / "lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        reasons = []
        for suite in (SUITE, SECOND_SUITE):
            tree = cache / f"{suite}-{recipe}"
            if tree.exists():
                return tree
            report(f"making a base system of {suite} in {cache} (once, about half a minute)")
            try:
                _make(suite, tree)
            except OSError as error:
                report(f"no base system of {suite}: {error}")
                reasons.append(f"{suite}: {error}")
                continue
            for old in cache.glob(f"{suite}-*"):
                if old != tree:
                    shutil.rmtree(old)
            return tree
    raise NoHostsError(f"no base system for robot hosts: {'; '.join(reasons)}")


def _make(suite: str, tree: Path) -> None:
    """Build the tree of a suite. Raises OSError."""
    with tempfile.TemporaryDirectory(prefix="making-", dir=tree.parent) as name:
        making = Path(name)
        keys = [f"--keyring={_ubuntu_keys(making)}"] if suite == SUITE else []
        root = making / "root"
        # With updates, as on a VOXL2: the first openssl of bionic does not support Ed25519.
        suites = (suite, f"{suite}-updates")
        _run(
            "mmdebstrap", "--quiet", "--variant=minbase", f"--include={','.join(PACKAGES)}", *keys,
            suite, str(root), *(f"deb {MIRRORS[suite]} {each} main" for each in suites),
        )  # fmt: skip
        for path, text in _FILES.items():
            (root / path).parent.mkdir(parents=True, exist_ok=True)
            (root / path).write_text(text)
        units = root / "etc/systemd/system"
        for unit in _MASKED:
            (units / unit).unlink(missing_ok=True)
            (units / unit).symlink_to("/dev/null")
        for service in _SERVICES:
            (units / f"multi-user.target.wants/{service}.service").symlink_to(
                f"/etc/systemd/system/{service}.service"
            )
        # Each host gets its own keys.
        for key in (root / "etc/ssh").glob("ssh_host_*"):
            key.unlink()
        root.rename(tree)


def _ubuntu_keys(folder: Path) -> Path:
    try:
        with urllib.request.urlopen(_KEYRING_URL, timeout=_ANSWER_WITHIN_S) as answer:
            package: bytes = answer.read()
    except urllib.error.URLError as error:
        raise OSError(f"{MIRRORS[SUITE]} does not answer: {error.reason}") from None
    if hashlib.sha256(package).hexdigest() != _KEYRING_SHA256:
        raise OSError(f"{_KEYRING_URL}: wrong SHA-256: the file has changed")
    (folder / "keys.deb").write_bytes(package)
    _run("dpkg-deb", "--extract", str(folder / "keys.deb"), str(folder / "keys"))
    return folder / "keys/usr/share/keyrings/ubuntu-archive-keyring.gpg"


def _run(*command: str) -> None:
    done = subprocess.run(
        command, stdin=subprocess.DEVNULL, capture_output=True, text=True, check=False
    )
    if done.returncode:
        last = (done.stderr.strip() or "it printed nothing").splitlines()[-1]
        raise OSError(f"{command[0]} failed: {last}")
