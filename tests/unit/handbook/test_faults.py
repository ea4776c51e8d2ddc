"""The reference of the drill's faults."""

from handbook.faults import page
from lpac.sim.drill.faults import ADRIFT, FAULTS, SHARED_BOUNDS


def test_the_page_has_every_fault_with_its_promise_and_bounds() -> None:
    text = page()
    for fault in FAULTS.values():
        (row,) = (line for line in text.splitlines() if line.startswith(f"| {fault.name} "))
        assert f"<br>*{fault.promise}* | " in row
        assert not row.endswith("|  |"), "no bounds"
        assert not fault.uncovered or fault.uncovered in row or "`adrift`" in row
    for name in (*SHARED_BOUNDS, "adrift"):
        assert f"\n| `{name}` | " in text
    assert ADRIFT in text
