"""What robots say in tests: words for which nothing needs a code."""

from collections.abc import Iterable, Iterator
from contextlib import contextmanager

import structlog
from structlog.testing import LogCapture
from structlog.typing import EventDict

from edge.messages.codes import CheckCode, FailedCheck, Reason, ReasonCode, Refusal, RefusalCode
from edge.messages.mission import OrderResult
from lpac.ground.station.protocol import CommandReport, ProblemCode, ResultCode


def reason(text: str, code: ReasonCode = ReasonCode.OTHER) -> Reason:
    return Reason(code, text)


def reasons(*texts: str) -> tuple[Reason, ...]:
    return tuple(reason(text) for text in texts)


def checks(*texts: str) -> tuple[FailedCheck, ...]:
    return tuple(FailedCheck(CheckCode.OTHER, text) for text in texts)


def refusal(text: str) -> Refusal | None:
    """None if there is nothing to say."""
    return Refusal(RefusalCode.OTHER, text) if text else None


@contextmanager
def lines_said() -> Iterator[list[EventDict]]:
    """The log lines of this process, as they come; the logger is then as it was before."""
    before, lines = structlog.get_config(), LogCapture()
    structlog.configure([lines], structlog.make_filtering_bound_logger("info"))
    try:
        yield lines.entries
    finally:
        structlog.configure(**before)


def codes(said: Iterable[FailedCheck | Reason]) -> list[CheckCode | ReasonCode]:
    return [each.code for each in said]


def why(answer: OrderResult) -> RefusalCode | None:
    """Why an order was refused; None if it was obeyed."""
    return None if answer.refusal is None else answer.refusal.code


def problem(report: CommandReport) -> ProblemCode | None:
    """Why nothing of a command was done."""
    return None if report.problem is None else report.problem.code


def not_done(report: CommandReport) -> dict[str, ResultCode]:
    """By robot, why it did not do it."""
    return {result.robot: result.code for result in report.results if not result.done}
