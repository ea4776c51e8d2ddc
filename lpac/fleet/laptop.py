"""Read-only checks of the laptop before a day in the field."""

import json
import os
import platform
import re
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path

from edge.core.counted import counted
from lpac.fleet.doctor import DoctorCheck, Finding, failed, ok, skipped, warning
from lpac.fleet.settings import FleetConfig

_MIN_RSYNC = (3, 1)
_TIMEOUT_S = 10.0
_SLEEP_TARGETS = ("sleep.target", "suspend.target")


def examine_laptop(config: FleetConfig) -> tuple[DoctorCheck, ...]:
    """Run all checks of this machine; "skipped" is one that cannot be done here."""
    return tuple(DoctorCheck(name, *check(config)) for name, check in _CHECKS.items())


def _tools(_: FleetConfig) -> Finding:
    missing = [program for program in ("ssh", "ssh-keygen", "rsync") if not shutil.which(program)]
    if missing:
        return failed(f"{', '.join(missing)} is missing", "install openssh-client and rsync")
    version = rsync_version(_output("rsync", "--version"))
    # Apple's openrsync has another version string.
    if version is None or version < _MIN_RSYNC:
        return failed("rsync is older than 3.1", "install rsync 3.1 or newer")
    ssh = _output("ssh", "-V").strip().partition(",")[0]
    return ok(f"{ssh}, rsync {'.'.join(map(str, version))}")


def rsync_version(text: str) -> tuple[int, int] | None:
    """Parse `rsync --version`."""
    match = re.match(r"rsync\s+version\s+v?(\d+)\.(\d+)", text)
    return (int(match[1]), int(match[2])) if match else None


def _keys(config: FleetConfig) -> Finding:
    """Whether ssh has a key that it can use without a prompt."""
    agent = _output("ssh-add", "-l") if os.environ.get("SSH_AUTH_SOCK") else ""
    if held := re.findall(r"^\d+ ", agent, re.MULTILINE):
        return ok(f"{counted(len(held), 'key')} in the ssh agent")
    # The files that ssh itself would use for the first robot.
    robot = next(iter(config.robots.values()), None)
    host = robot.host if robot else "robot"
    options = ["-F", config.ssh.config] if config.ssh.config else []
    files = re.findall(r"^identityfile (.+)$", _output("ssh", *options, "-G", host), re.MULTILINE)
    there = [str(path) for path in (Path(file).expanduser() for file in files) if path.exists()]
    if not there:
        return failed("no ssh agent and no key file", "ssh-keygen -t ed25519")
    for file in there:
        if _run("ssh-keygen", "-y", "-P", "", "-f", file)[0] == 0:
            return ok(f"{file}, no agent")
    fix = f"eval $(ssh-agent); ssh-add {there[0]}"
    return failed(f"{there[0]} has a passphrase and is not in an ssh agent", fix)


def _sleep(_: FleetConfig) -> Finding:
    if platform.system() == "Darwin":
        match = re.search(r"^\s*sleep\s+(\d+)", _output("pmset", "-g"), re.MULTILINE)
        if match is None:
            return skipped("not known: pmset does not tell")
        if match[1] == "0":
            return ok("does not sleep when idle, but may when the lid is closed")
        return warning(f"sleeps after {match[1]} min", "caffeinate -dims while you fly")
    states = [_output("systemctl", "show", "-p", "LoadState", unit) for unit in _SLEEP_TARGETS]
    if not any(states):
        return skipped("not known: systemd does not answer")
    if all("masked" in state for state in states):
        return ok("sleep.target and suspend.target are masked")
    if re.search(r"sleep\S*\s.*\bblock\b", _output("systemd-inhibit", "--list")):
        return ok("inhibited now (systemd-inhibit --list)")
    key = "org.gnome.settings-daemon.plugins.power"
    idle = [
        _output("gsettings", "get", key, f"sleep-inactive-{on}-type") for on in ("ac", "battery")
    ]
    if all("nothing" in each for each in idle):
        return ok("does not sleep when idle (GNOME), but may when the lid is closed")
    found = "may sleep when idle or when the lid is closed"
    found += "" if any(idle) else "; the desktop's settings are not known"
    fix = "systemd-inhibit --what=sleep:idle:handle-lid-switch sleep 1d (in a terminal of its own)"
    return warning(found, fix)


def _clock(_: FleetConfig) -> Finding:
    if platform.system() == "Darwin":
        return skipped("not known on macOS: check Date & Time in the settings")
    shown = _output("timedatectl", "show", "-p", "NTPSynchronized", "--value").strip()
    if shown == "yes":
        return ok("set by a time server")
    if shown == "no":
        found = "not set by a time server since boot, and all robots are set to this clock"
        return warning(found, "compare it with a watch")
    return skipped("not known: timedatectl does not tell")


def _firewall(config: FleetConfig) -> Finding:
    """Whether outgoing connections are allowed; robots do not connect to the laptop."""
    if platform.system() == "Darwin":
        return skipped("not known on macOS: check Network > Firewall")
    if os.geteuid() != 0:
        return skipped("only root can read the rules: run this with sudo")
    # Empty if the program is missing or too old.
    ruleset, rules = _output("nft", "--json", "list", "ruleset"), _output("iptables", "-S")
    if not ruleset and not rules:
        return skipped("not known: neither nft nor iptables prints its rules")
    entries = json.loads(ruleset)["nftables"] if ruleset else []
    drops = "-P OUTPUT DROP" in rules or any(
        (chain.get("hook"), chain.get("policy")) == ("output", "drop")
        for chain in (entry.get("chain", {}) for entry in entries)
    )
    if not drops:
        return ok("outgoing connections are allowed by default")
    ports = ", ".join(map(str, sorted({robot.zenoh_port for robot in config.robots.values()})))
    fix = f"allow outgoing TCP and UDP to port {ports}, for example: ufw allow out {ports}"
    return warning("outgoing connections are dropped by default", fix)


_CHECKS: dict[str, Callable[[FleetConfig], Finding]] = {
    "tools": _tools,
    "keys": _keys,
    "sleep": _sleep,
    "clock": _clock,
    "firewall": _firewall,
}


def _output(*command: str) -> str:
    """Output of a program; empty if it is missing."""
    return _run(*command)[1]


def _run(*command: str) -> tuple[int, str]:
    try:
        done = subprocess.run(
            command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT if command[0] == "ssh" else subprocess.DEVNULL,
            text=True, timeout=_TIMEOUT_S, check=False, env=os.environ | {"LC_ALL": "C"},
        )  # fmt: skip
    except (OSError, subprocess.TimeoutExpired):
        return -1, ""
    return done.returncode, done.stdout
