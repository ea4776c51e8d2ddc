"""The laptop before a day in the field: what would let the robots down; nothing is changed."""

import json
import os
import platform
import re
import shutil
import subprocess
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from lpac.fleet.doctor import DoctorCheck
from lpac.fleet.settings import FleetConfig

_LEAST_RSYNC = (3, 1)
_TIMEOUT_S = 10.0
_SLEEP_TARGETS = ("sleep.target", "suspend.target")


def examine_laptop(config: FleetConfig) -> tuple[DoctorCheck, ...]:
    """All checks of this machine; what cannot be known here is "skipped", with the reason."""
    ports = sorted({robot.zenoh_port for robot in config.robots.values()})
    return tuple(_checks(config, ports))


def _checks(config: FleetConfig, ports: Sequence[int]) -> Iterator[DoctorCheck]:
    yield _tools()
    yield _keys(config)
    yield _sleep()
    yield _clock()
    yield _firewall(ports)


def _tools() -> DoctorCheck:
    missing = [program for program in ("ssh", "ssh-keygen", "rsync") if not shutil.which(program)]
    if missing:
        fix = "install openssh-client and rsync"
        return DoctorCheck("tools", "FAILED", f"{', '.join(missing)} is missing", fix)
    version = rsync_version(_output("rsync", "--version"))
    # Apple's own is not Samba's rsync, and says another name.
    if version is None or version < _LEAST_RSYNC:
        return DoctorCheck(
            "tools", "FAILED", "rsync is older than 3.1", "install rsync 3.1 or newer"
        )
    ssh = _output("ssh", "-V").strip().partition(",")[0]
    return DoctorCheck("tools", "ok", f"{ssh}, rsync {'.'.join(map(str, version))}")


def rsync_version(text: str) -> tuple[int, int] | None:
    """Of what `rsync --version` prints."""
    match = re.match(r"rsync\s+version\s+v?(\d+)\.(\d+)", text)
    return (int(match[1]), int(match[2])) if match else None


def _keys(config: FleetConfig) -> DoctorCheck:
    """Keys that ssh can use without asking: robots are reached in batch mode."""
    agent = _output("ssh-add", "-l") if os.environ.get("SSH_AUTH_SOCK") else ""
    held = [line for line in agent.splitlines() if re.match(r"\d+ ", line)]
    if held:
        return DoctorCheck("keys", "ok", f"the ssh agent holds {len(held)}")
    # What ssh itself would take for the first robot.
    robot = next(iter(config.robots.values()), None)
    host = robot.host if robot else "robot"
    options = ["-F", config.ssh.config] if config.ssh.config else []
    files = re.findall(r"^identityfile (.+)$", _output("ssh", *options, "-G", host), re.MULTILINE)
    there = [str(path) for path in map(_expanded, files) if path.exists()]
    if not there:
        return DoctorCheck("keys", "FAILED", "no agent, no key file", "ssh-keygen -t ed25519")
    free = [file for file in there if _run("ssh-keygen", "-y", "-P", "", "-f", file)[0] == 0]
    if not free:
        return DoctorCheck("keys", "FAILED", f"{there[0]} has a passphrase, and no agent knows it",
                     f"eval $(ssh-agent); ssh-add {there[0]}")  # fmt: skip
    return DoctorCheck("keys", "ok", f"{free[0]}, no agent")


def _expanded(file: str) -> Path:
    return Path(file).expanduser()


def _sleep() -> DoctorCheck:
    name = "sleep"
    if platform.system() == "Darwin":
        match = re.search(r"^\s*sleep\s+(\d+)", _output("pmset", "-g"), re.MULTILINE)
        if match is None:
            return DoctorCheck(name, "skipped", "pmset does not say")
        if match[1] == "0":
            return DoctorCheck(name, "ok", "it does not sleep by itself; a closed lid still counts")
        fix = "caffeinate -dims while you fly"
        return DoctorCheck(name, "warning", f"it sleeps after {match[1]} min", fix)
    states = [_output("systemctl", "show", "-p", "LoadState", unit) for unit in _SLEEP_TARGETS]
    if not any(states):
        return DoctorCheck(name, "skipped", "not known: systemd does not answer here")
    if all("masked" in state for state in states):
        return DoctorCheck(name, "ok", "sleep.target and suspend.target are masked")
    fix = "systemd-inhibit --what=sleep:idle:handle-lid-switch sleep 1d (in a terminal of its own)"
    inhibited = re.search(r"sleep\S*\s.*\bblock\b", _output("systemd-inhibit", "--list"))
    if inhibited:
        return DoctorCheck(name, "ok", "something inhibits it now (systemd-inhibit --list)")
    key = "org.gnome.settings-daemon.plugins.power"
    idle = [
        _output("gsettings", "get", key, f"sleep-inactive-{on}-type") for on in ("ac", "battery")
    ]
    if all("nothing" in each for each in idle):
        found = "it does not sleep by itself (GNOME); a closed lid may count"
        return DoctorCheck(name, "ok", found)
    found = "it may sleep when idle or when the lid is closed"
    found += "" if any(idle) else "; the desktop's own settings are not known"
    return DoctorCheck(name, "warning", found, fix)


def _clock() -> DoctorCheck:
    name = "clock"
    if platform.system() == "Darwin":
        return DoctorCheck(name, "skipped", "not known on macOS: see Date & Time in the settings")
    shown = _output("timedatectl", "show", "-p", "NTPSynchronized", "--value").strip()
    if shown == "yes":
        return DoctorCheck(name, "ok", "set by a time server")
    if shown == "no":
        # In the field there is none; all robots take this clock.
        found = "no time server has set it since it was switched on: all robots will take it"
        return DoctorCheck(name, "warning", found, "compare it with a watch")
    return DoctorCheck(name, "skipped", "not known: timedatectl does not say")


def _firewall(ports: Sequence[int]) -> DoctorCheck:
    name = "firewall"
    many = ", ".join(map(str, ports))
    fix = f"let TCP port {many} in and out, for example: ufw allow {many}/tcp"
    if platform.system() == "Darwin":
        return DoctorCheck(name, "skipped", "not known on macOS: see Network > Firewall")
    if os.geteuid() != 0:
        unit = _output("systemctl", "is-active", "ufw", "firewalld", "nftables").split()
        if "active" in unit:
            found = "one is active; only root sees its rules: run this with sudo"
            return DoctorCheck(name, "warning", found, fix)
        return DoctorCheck(name, "skipped", "only root sees the rules: run this with sudo")
    # Either is empty where the program is not here, or an old one.
    ruleset, rules = _output("nft", "--json", "list", "ruleset"), _output("iptables", "-S")
    if not ruleset and not rules:
        return DoctorCheck(name, "skipped", "neither nft nor iptables tells its rules")
    blocked = nft_blocks(json.loads(ruleset), ports) if ruleset else []
    blocked += iptables_blocks(rules, ports)
    if blocked:
        return DoctorCheck(
            name, "FAILED", f"it blocks {' and '.join(sorted({*blocked}))} of TCP port {many}", fix
        )
    return DoctorCheck(name, "ok", f"nothing that blocks TCP port {many} was found")


def iptables_blocks(text: str, ports: Sequence[int]) -> list[str]:
    """Which of "input" and "output" the rules of `iptables -S` block for one of the TCP ports.

    Rules for certain interfaces, addresses or modules are taken for such that do not apply.
    """
    blocked = []
    for chain, word in (("INPUT", "input"), ("OUTPUT", "output")):
        if any(_iptables_verdict(text, chain, port) != "ACCEPT" for port in ports):
            blocked.append(word)
    return blocked


def _iptables_verdict(text: str, chain: str, port: int) -> str:
    for line in text.splitlines():
        if not line.startswith(f"-A {chain} "):
            continue
        if re.search(r" -(i|o|s|d) | --(ctstate|state|icmp-type|sports?) ", line):
            continue
        protocol = re.search(r" -p (\S+)", line)
        if protocol and protocol[1] not in ("tcp", "all"):
            continue
        wanted = re.search(r" --dports? (\S+)", line)
        if wanted and not _covers(wanted[1], port):
            continue
        target = re.search(r" -j (\S+)", line)
        if target and target[1] in ("ACCEPT", "DROP", "REJECT"):
            return target[1]
        if target:
            inner = _iptables_verdict(text, target[1], port)
            if inner in ("ACCEPT", "DROP", "REJECT"):
                return inner
    policy = re.search(rf"^-P {re.escape(chain)} (\S+)", text, re.MULTILINE)
    return policy[1] if policy else "RETURN" if chain not in ("INPUT", "OUTPUT") else "ACCEPT"


def _covers(text: str, port: int) -> bool:
    """Whether a list such as "22,7000:7999" has the port."""
    for part in text.split(","):
        first, _, last = part.partition(":")
        if first.isdigit() and int(first) <= port <= int(last or first):
            return True
    return False


def nft_blocks(ruleset: dict[str, Any], ports: Sequence[int]) -> list[str]:
    """Which of "input" and "output" base chains of `nft --json list ruleset` block TCP ports.

    A chain that drops by default counts as blocking unless one of its rules, or one of a chain that
    it jumps to, names the port or accepts everything. Tables with rules that only iptables can tell
    are left to `iptables_blocks`.
    """
    entries = ruleset.get("nftables", [])
    chains = [entry["chain"] for entry in entries if "chain" in entry]
    sets = {
        f"@{entry['set']['name']}": entry["set"].get("elem", [])
        for entry in entries
        if "set" in entry
    }
    rules = [_with_sets(entry["rule"], sets) for entry in entries if "rule" in entry]
    foreign = {_table(rule) for rule in rules if any("xt" in each for each in rule["expr"])}
    blocked = []
    for hook in ("input", "output"):
        bases = [c for c in chains if c.get("hook") == hook and _table(c) not in foreign]
        if any(not _nft_accepts(chain, rules, port) for chain in bases for port in ports):
            blocked.append(hook)
    return blocked


def _table(part: Mapping[str, Any]) -> tuple[str, str]:
    return str(part["family"]), str(part["table"])


def _with_sets(rule: dict[str, Any], sets: Mapping[str, list[Any]]) -> dict[str, Any]:
    """The rule with the elements of the sets that it names."""
    expressions = []
    for each in rule["expr"]:
        match = each.get("match")
        named = match is not None and isinstance(match["right"], str) and match["right"] in sets
        expressions.append(
            {"match": match | {"right": {"set": sets[match["right"]]}}} if named else each
        )
    return rule | {"expr": expressions}


def _nft_accepts(chain: dict[str, Any], rules: Sequence[dict[str, Any]], port: int) -> bool:
    verdict = _nft_verdict(chain["family"], chain["table"], chain["name"], rules, port)
    return (verdict or chain.get("policy", "accept")) == "accept"


def _nft_verdict(
    family: str, table: str, name: str, rules: Sequence[dict[str, Any]], port: int
) -> str | None:
    for rule in rules:
        if (*_table(rule), rule["chain"]) != (family, table, name):
            continue
        matches = [each["match"] for each in rule["expr"] if "match" in each]
        if not all(_nft_matches(match, port) for match in matches):
            continue
        for each in rule["expr"]:
            if "accept" in each:
                return "accept"
            if "drop" in each or "reject" in each:
                return "drop"
            target = each.get("jump") or each.get("goto")
            if target:
                inner = _nft_verdict(family, table, target["target"], rules, port)
                if inner is not None:
                    return inner
    return None


def _nft_matches(match: dict[str, Any], port: int) -> bool:
    """Whether a new TCP connection to the port, from anywhere, matches for certain."""
    left = match["left"]
    field = left.get("payload", {}) if isinstance(left, dict) else {}
    if field.get("field") == "dport" and field.get("protocol") in ("tcp", "th"):
        right = match["right"]
        values = right.get("set", []) if isinstance(right, dict) and "set" in right else [right]
        hit = any(
            value == port
            if not isinstance(value, dict)
            else "range" in value and value["range"][0] <= port <= value["range"][1]
            for value in values
        )
        return bool(hit == (match["op"] != "!="))
    if isinstance(left, dict) and left.get("meta", {}).get("key") == "l4proto":
        return bool(match["right"] == "tcp")
    return False


def _output(*command: str) -> str:
    """Output of a program; empty if it is not here."""
    return _run(*command)[1]


def _run(*command: str) -> tuple[int, str]:
    try:
        done = subprocess.run(
            command,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT if command[0] == "ssh" else subprocess.DEVNULL,
            text=True,
            timeout=_TIMEOUT_S,
            check=False,
            env=os.environ | {"LC_ALL": "C"},
        )
    except (OSError, subprocess.TimeoutExpired):
        return -1, ""
    return done.returncode, done.stdout
