"""Text beside the curves of figures."""

import numpy as np
import pytest
from matplotlib.figure import Figure
from matplotlib.text import Text

from edge.messages.mission import FlightState
from lpac.analysis.coverage import Coverage
from lpac.analysis.figures import overview, snapshots_and_costs
from lpac.analysis.flight import FlightRecord, RobotRecord
from lpac.analysis.logs import LoggedStatus
from tests.said import reason


def flight(*x_m: float) -> FlightRecord:
    """A robot that moves along x in steps of a second; all importance is at 2 m."""
    importance = np.zeros((64, 64), np.float32)
    importance[30:34, 30:34] = 1.0
    time_s = np.arange(float(len(x_m)))
    said = LoggedStatus(
        time_s=0.0, boot_nonce=1, state=FlightState.MISSION, reason=reason(""), trial="t",
        armed=True, position_m=None, alarms=(), loops={}, message_counts={}, fence=None,
        battery=None, landing_point_m=(0.0, 0.0), bundle_id="", world_id="",
    )  # fmt: skip
    robot = RobotRecord(
        robot_id=0,
        name="0",
        time_s=time_s,
        position_m=np.array([(x, 2.0, 5.0) for x in x_m]),
        flying=np.ones(len(x_m), np.bool_),
        statuses=(said,) * len(x_m),
    )
    return FlightRecord(
        name="a flight",
        duration_s=time_s[-1],
        from_s=0.0,
        to_s=time_s[-1],
        robots=(robot,),
        coverage=Coverage(importance, 16.0),
        sensor_size=16,
        cost_time_s=time_s,
    )


def texts_of(figure: Figure) -> str:
    texts = [text.get_text() for text in figure.findobj(Text)]
    return " ".join(" ".join(texts).split())


WHY = "may rise at first: robots leave covered areas to explore others"


@pytest.mark.parametrize(
    ("x_m", "rises"), [((0.0, 0.5, 0.2, 1.9), True), ((0.0, 0.5, 1.0, 1.9), False)]
)
def test_a_cost_that_rises_is_explained_beside_it(x_m: tuple[float, ...], rises: bool) -> None:
    assert (f"The cost {WHY}" in texts_of(snapshots_and_costs({"LPAC": flight(*x_m)}))) is rises
    assert (f"The cost {WHY}" in texts_of(overview(flight(*x_m)))) is rises
