"""docs/troubleshooting.md has every check and alarm, in the words of the programs."""

import ast
import re
from collections.abc import Iterator

from edge.flight.transitions import TRANSITIONS
from edge.messages.codes import CheckCode, ReasonCode
from lpac.ground.alarms import AlarmCode
from tests.conftest import ROOT

# Before its first table of messages the page has what people see.
PAGE = (ROOT / "docs" / "troubleshooting.md").read_text().partition("## Not ready")[2]


def test_every_check_and_alarm_has_a_row() -> None:
    alarming = {row.code for row in TRANSITIONS if row.alarm}
    ordinary = {row.code for row in TRANSITIONS} - alarming
    reasons = set(ReasonCode) - ordinary - {ReasonCode.PROGRAM_STARTED}
    codes = {code.value for code in (*CheckCode, *reasons, *AlarmCode)} - {"other"}
    assert codes - set(re.findall(r"`([a-z0-9_]+)`", PAGE)) == set()


def test_rows_have_the_programs_words() -> None:
    """So that a search for a message finds its row; "…" stands for any text."""
    known = "\n".join(messages())
    missing = [
        words
        for words in symptoms()
        if not re.search(".*".join(map(re.escape, re.split(" *… *", words))), known)
    ]
    assert not missing, "no message of edge or lpac has these words"


def symptoms() -> Iterator[str]:
    """Yield the words of each symptom, without its codes."""
    for row in re.findall(r"^\| (.+?) \|", PAGE, re.M):
        for symptom in row.split("<br>"):
            words = re.sub(r"`[^`]+`", "", symptom).strip(" …")
            if words not in ("", "says", "---"):
                yield words


def messages() -> Iterator[str]:
    """Yield the string literals of the robot, the ground and the fleet's commands."""
    for folder in ("edge", "lpac/fleet", "lpac/ground"):
        for path in (ROOT / folder).rglob("*.py"):
            tree = ast.parse(path.read_text())
            docstrings = {node.value for node in ast.walk(tree) if isinstance(node, ast.Expr)}
            for node in ast.walk(tree):
                if isinstance(node, ast.JoinedStr):
                    parts = [n.value if isinstance(n, ast.Constant) else " " for n in node.values]
                    yield "".join(map(str, parts)).replace("\n", " ")
                elif isinstance(node, ast.Constant) and node not in docstrings:
                    yield str(node.value).replace("\n", " ")
