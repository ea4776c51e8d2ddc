"""The drill's tables in docs/faults.md."""

from handbook.faults import tables
from tests.conftest import ROOT


def test_the_page_has_the_tables_that_the_declarations_print() -> None:
    text = (ROOT / "docs" / "faults.md").read_text()
    for name, table in tables().items():
        assert f"\n{table}\n" in text, f"{name}: python -m handbook.faults prints it anew"
