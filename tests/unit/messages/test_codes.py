"""Codes of a newer program, and texts that are longer than a message may carry."""

import dataclasses
import json

import pytest

from edge.core.position import PositionCause
from edge.messages.bounds import MOST_LETTERS
from edge.messages.codec import decode, encode
from edge.messages.codes import (
    CheckCode,
    FailedCheck,
    Reason,
    ReasonCode,
    Refusal,
    RefusalCode,
    texts,
)
from edge.messages.mission import OrderResult, RobotStatus
from tests.unit.ground.snapshots import status


@pytest.mark.parametrize("kind", [CheckCode, ReasonCode, RefusalCode])
def test_a_code_that_has_no_name_yet_is_some_other(
    kind: type[CheckCode | ReasonCode | RefusalCode],
) -> None:
    assert kind("of_tomorrow") is kind["OTHER"]


def test_a_newer_robots_status_is_understood() -> None:
    said = json.loads(encode(status(0, orders=(OrderResult("1"),))))
    tomorrow = {"code": "of_tomorrow", "text": "what nobody knows yet", "new": 1}
    said |= {"reason": tomorrow, "alarms": [tomorrow], "failed_checks": [tomorrow]}
    said["orders"][0]["refusal"] = tomorrow
    said["position_cause"] = "of_tomorrow"
    heard = decode(RobotStatus, json.dumps(said).encode())
    assert heard.reason == Reason(ReasonCode.OTHER, "what nobody knows yet")
    assert heard.alarms == (heard.reason,)
    assert heard.position_cause is PositionCause.UNKNOWN
    assert heard.failed_checks == (FailedCheck(CheckCode.OTHER, "what nobody knows yet"),)
    assert heard.orders[0].refusal == Refusal(RefusalCode.OTHER, "what nobody knows yet")


def test_too_long_texts_are_shortened() -> None:
    much = "x" * (MOST_LETTERS + 1)
    said = status(
        0,
        reason=Reason(ReasonCode.PX4, much),
        failed_checks=(FailedCheck(CheckCode.NOT_ARMABLE, much),),
        orders=(OrderResult("1", Refusal(RefusalCode.NOT_READY, much)),),
    )
    assert decode(RobotStatus, encode(said)) == said
    assert len(said.reason.text) == MOST_LETTERS
    assert said.reason.text.endswith("x ...")
    exact = Reason(ReasonCode.PX4, "x" * MOST_LETTERS)
    assert dataclasses.replace(exact).text == "x" * MOST_LETTERS
    assert texts((exact, Reason(ReasonCode.PX4, "y"))) == f"{exact.text}; y"
