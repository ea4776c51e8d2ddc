"""What of the radio is looked at, whatever anybody sends."""

from hypothesis import given
from hypothesis import strategies as st

from edge.messages.admission import Admission
from edge.messages.topics import MESSAGE, ORDER, STATUS, TOPICS, Topic


@given(
    topic=st.sampled_from(TOPICS),
    gaps_s=st.lists(st.floats(0.0, 0.05), min_size=1, max_size=300),
)
def test_a_key_is_looked_at_so_often_and_no_more(topic: Topic, gaps_s: list[float]) -> None:
    admission, now_s = Admission(), 100.0
    admitted = 0
    for gap_s in gaps_s:
        now_s += gap_s
        admitted += admission.admits(topic, "robot/1/x", 100, now_s)
    most = topic.most_hz * (now_s - 100.0 + 2.0)
    assert admitted <= most + 1
    assert admitted == len(gaps_s) or admitted >= most - 2
    assert admission.refused == len(gaps_s) - admitted


def test_a_flood_leaves_other_keys_their_budget() -> None:
    admission, heard = Admission(most_keys=100), 0
    for tick in range(600):
        now_s = tick * 0.1
        heard += admission.admits(STATUS, "robot/1/status", 2000, now_s)
        for flood in range(30):
            admission.admits(STATUS, f"robot/{tick * 30 + flood + 2}/status", 2000, now_s)
            admission.admits(MESSAGE, "robot/7/message", 64, now_s)
    assert heard == 600


def test_a_new_key_is_admitted_after_a_flood() -> None:
    admission = Admission(most_keys=100)
    for each in range(1000):
        admission.admits(STATUS, f"robot/{each}/status", 2000, 0.0)
    assert not admission.admits(STATUS, "robot/2000/status", 2000, 5.0)
    assert admission.admits(STATUS, "robot/2000/status", 2000, 12.0)


def test_sizes_and_names_are_bounded() -> None:
    admission = Admission()
    assert admission.admits(ORDER, "ground/order", ORDER.limit_bytes, 0.0)
    assert not admission.admits(ORDER, "ground/order", ORDER.limit_bytes + 1, 0.0)
    assert not admission.admits(MESSAGE, f"robot/{'9' * 4300}/message", 64, 0.0)
    assert admission.refused == 2
