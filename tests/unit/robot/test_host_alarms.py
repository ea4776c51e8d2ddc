"""Operator alarms of a robot's computer: its descriptors, and floods of its port."""

import resource
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest

from edge.drivers.door import DoorStatus, allow_most_descriptors, descriptors_short
from edge.messages.codes import ReasonCode
from edge.robot.process import host_alarms

CALM = DoorStatus(flooded=False, refused=3, queue_full=False)


@pytest.fixture
def limits() -> Iterator[tuple[int, int]]:
    before = resource.getrlimit(resource.RLIMIT_NOFILE)
    yield before
    resource.setrlimit(resource.RLIMIT_NOFILE, before)


def test_each_has_its_code() -> None:
    assert list(host_alarms([CALM], "")) == []
    flooded = [CALM, DoorStatus(flooded=True, refused=70, queue_full=True)]
    alarms = list(host_alarms(flooded, "900 of 1024 descriptors are in use"))
    assert [alarm.code for alarm in alarms] == [
        ReasonCode.DESCRIPTORS_SHORT, ReasonCode.STRANGERS_FLOOD, ReasonCode.RADIO_QUEUE_FULL,
    ]  # fmt: skip
    assert "70 refused" in alarms[1].text and alarms[0].text.startswith("900 of 1024")


def test_descriptors_are_short_before_there_are_none(limits: tuple[int, int]) -> None:
    resource.setrlimit(resource.RLIMIT_NOFILE, (256, limits[1]))
    assert descriptors_short() == ""
    with ExitStack() as opened:
        while not descriptors_short():
            opened.enter_context(Path("/dev/null").open())
        assert descriptors_short().endswith("of 256 descriptors are in use")
        allow_most_descriptors()
        assert descriptors_short() == ""
        assert resource.getrlimit(resource.RLIMIT_NOFILE)[0] == limits[1]
