"""Wording of docstrings."""

import ast

from tests.conftest import ROOT

PARTS = ("bench", "edge", "export", "handbook", "lpac")
# Clauses like these name neither the thing nor its action.
OPENINGS = {"That", "What", "Where", "Which", "Who", "Whom", "Whose"}
DOCUMENTED = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)


def test_docstrings_open_with_an_imperative_or_a_noun() -> None:
    wrong = []
    for path in (path for part in PARTS for path in sorted((ROOT / part).rglob("*.py"))):
        for node in ast.walk(ast.parse(path.read_text())):
            text = ast.get_docstring(node) if isinstance(node, DOCUMENTED) else None
            if text and text.split(None, 1)[0].rstrip(",:;.") in OPENINGS:
                wrong.append(f"{path.relative_to(ROOT)}: {text.splitlines()[0]}")
    assert not wrong, "\n".join(wrong)
