"""Tables in a terminal."""

import pytest

from lpac.cli.printing import print_table


def test_names_that_people_type_again_are_never_broken(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "60")
    name, text = "program-dies-as-the-ground-does", "a program dies, and the ground with it " * 3
    print_table(("fault", "what happens", "promise"), [(name, text, text), ("none", "", "")])
    lines = capsys.readouterr().out.splitlines()
    assert lines[1].startswith(f"{name} ") and lines[-1].split() == ["none"]
    assert all(len(line) <= 60 for line in lines)
    # Whole sentences may be.
    print_table(("what", "promise"), [(text, text)])
    assert all(len(line) <= 60 for line in capsys.readouterr().out.splitlines())
