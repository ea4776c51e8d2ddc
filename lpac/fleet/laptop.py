"""The laptop before a day in the field: what would let the robots down; nothing is changed."""

import json
import os
import platform
import re
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path

from lpac.fleet.doctor import DoctorCheck, Finding, failed, ok, skipped, warning
from lpac.fleet.settings import FleetConfig

_LEAST_RSYNC = (3, 1)
_TIMEOUT_S = 10.0
_SLEEP_TARGETS = ("sleep.target", "suspend.target")


def examine_laptop(config: FleetConfig) -> tuple[DoctorCheck, ...]:
    """All checks of this machine; what cannot be known here is "skipped", with the reason."""
    return tuple(DoctorCheck(name, *check(config)) for name, check in _CHECKS.items())


def _tools(_: FleetConfig) -> Finding:
    missing = [program for program in ("ssh", "ssh-keygen", "rsync") if not shutil.which(program)]
    if missing:
        return failed(f"{', '.join(missing)} is missing", "install openssh-client and rsync")
    version = rsync_version(_output("rsync", "--version"))
    # Apple's own is not Samba's rsync, and says another name.
    if version is None or version < _LEAST_RSYNC:
        return failed("rsync is older than 3.1", "install rsync 3.1 or newer")
    ssh = _output("ssh", "-V").strip().partition(",")[0]
    return ok(f"{ssh}, rsync {'.'.join(map(str, version))}")


def rsync_version(text: str) -> tuple[int, int] | None:
    """Of what `rsync --version` prints."""
    match = re.match(r"rsync\s+version\s+v?(\d+)\.(\d+)", text)
    return (int(match[1]), int(match[2])) if match else None


def _keys(config: FleetConfig) -> Finding:
    """Keys that ssh can use without asking: robots are reached in batch mode."""
    agent = _output("ssh-add", "-l") if os.environ.get("SSH_AUTH_SOCK") else ""
    if held := re.findall(r"^\d+ ", agent, re.MULTILINE):
        return ok(f"the ssh agent holds {len(held)}")
    # What ssh itself would take for the first robot.
    robot = next(iter(config.robots.values()), None)
    host = robot.host if robot else "robot"
    options = ["-F", config.ssh.config] if config.ssh.config else []
    files = re.findall(r"^identityfile (.+)$", _output("ssh", *options, "-G", host), re.MULTILINE)
    there = [str(path) for path in (Path(file).expanduser() for file in files) if path.exists()]
    if not there:
        return failed("no agent, no key file", "ssh-keygen -t ed25519")
    for file in there:
        if _run("ssh-keygen", "-y", "-P", "", "-f", file)[0] == 0:
            return ok(f"{file}, no agent")
    fix = f"eval $(ssh-agent); ssh-add {there[0]}"
    return failed(f"{there[0]} has a passphrase, and no agent knows it", fix)


def _sleep(_: FleetConfig) -> Finding:
    if platform.system() == "Darwin":
        match = re.search(r"^\s*sleep\s+(\d+)", _output("pmset", "-g"), re.MULTILINE)
        if match is None:
            return skipped("pmset does not say")
        if match[1] == "0":
            return ok("it does not sleep by itself; a closed lid still counts")
        return warning(f"it sleeps after {match[1]} min", "caffeinate -dims while you fly")
    states = [_output("systemctl", "show", "-p", "LoadState", unit) for unit in _SLEEP_TARGETS]
    if not any(states):
        return skipped("not known: systemd does not answer here")
    if all("masked" in state for state in states):
        return ok("sleep.target and suspend.target are masked")
    if re.search(r"sleep\S*\s.*\bblock\b", _output("systemd-inhibit", "--list")):
        return ok("something inhibits it now (systemd-inhibit --list)")
    key = "org.gnome.settings-daemon.plugins.power"
    idle = [
        _output("gsettings", "get", key, f"sleep-inactive-{on}-type") for on in ("ac", "battery")
    ]
    if all("nothing" in each for each in idle):
        return ok("it does not sleep by itself (GNOME); a closed lid may count")
    found = "it may sleep when idle or when the lid is closed"
    found += "" if any(idle) else "; the desktop's own settings are not known"
    fix = "systemd-inhibit --what=sleep:idle:handle-lid-switch sleep 1d (in a terminal of its own)"
    return warning(found, fix)


def _clock(_: FleetConfig) -> Finding:
    if platform.system() == "Darwin":
        return skipped("not known on macOS: see Date & Time in the settings")
    shown = _output("timedatectl", "show", "-p", "NTPSynchronized", "--value").strip()
    if shown == "yes":
        return ok("set by a time server")
    if shown == "no":
        # In the field there is none; all robots take this clock.
        found = "no time server has set it since it was switched on: all robots will take it"
        return warning(found, "compare it with a watch")
    return skipped("not known: timedatectl does not say")


def _firewall(config: FleetConfig) -> Finding:
    """Whether this machine's connections to the robots may go out; nobody connects to it."""
    if platform.system() == "Darwin":
        return skipped("not known on macOS: see Network > Firewall")
    if os.geteuid() != 0:
        return skipped("only root sees the rules: run this with sudo")
    # Either is empty where the program is not here, or an old one.
    ruleset, rules = _output("nft", "--json", "list", "ruleset"), _output("iptables", "-S")
    if not ruleset and not rules:
        return skipped("neither nft nor iptables tells its rules")
    entries = json.loads(ruleset)["nftables"] if ruleset else []
    drops = "-P OUTPUT DROP" in rules or any(
        (chain.get("hook"), chain.get("policy")) == ("output", "drop")
        for chain in (entry.get("chain", {}) for entry in entries)
    )
    if not drops:
        return ok("what goes out is not dropped by default")
    ports = ", ".join(map(str, sorted({robot.zenoh_port for robot in config.robots.values()})))
    fix = f"let TCP and UDP to port {ports} out, for example: ufw allow out {ports}"
    return warning("it drops by default what goes out", fix)


_CHECKS: dict[str, Callable[[FleetConfig], Finding]] = {
    "tools": _tools,
    "keys": _keys,
    "sleep": _sleep,
    "clock": _clock,
    "firewall": _firewall,
}


def _output(*command: str) -> str:
    """Output of a program; empty if it is not here."""
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
