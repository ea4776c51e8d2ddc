"""Generates the reference of messages, topics and logs."""

import dataclasses
import inspect
import types
import typing
from enum import StrEnum
from typing import Any, Literal

from msgspec import Meta

from edge.core import wire
from edge.core.fence import Fence
from edge.core.schema import in_words
from edge.drivers import flight_log
from edge.identity import envelope, group, members
from edge.messages import beacon, topics
from edge.messages.codes import CheckCode, FailedCheck, Reason, ReasonCode, Refusal, RefusalCode
from edge.messages.mission import (
    Echo,
    FlightState,
    GroundState,
    Hold,
    LoopStatus,
    Order,
    OrderResult,
    Origin,
    Place,
    RadioCounts,
    RobotStatus,
    SafetyRequest,
)
from handbook.markdown import cell, table
from lpac.ground import record

MESSAGES = (
    RobotStatus, GroundState, Hold, Order, OrderResult, FailedCheck, Reason, Refusal, Origin, Fence,
    Place, Echo, LoopStatus, RadioCounts, SafetyRequest,
)  # fmt: skip
CODES = (FlightState, CheckCode, ReasonCode, RefusalCode)
_LAYOUTS = {
    "The beacon": beacon, "The policy's message": wire, "The envelope": envelope,
    "What goes to all robots at once": group, "The list of members": members,
}  # fmt: skip
_LOGS = {"A robot's log": flight_log, "The ground's log": record}


def page() -> str:
    """Reference of topics, messages, layouts, codes and logs."""
    return "\n\n".join(
        [
            "# Messages and topics",
            "## Topics",
            _rest(topics),
            table(
                ("key below `lpac/FLEET/`", "content", "rate", "most bytes", "priority",
                 "in the flight log"),
                [
                    (
                        f"`{topic.pattern.replace('*', 'ID')}`",
                        cell(topic.content),
                        f"{topic.rate_hz:g} Hz",
                        f"{topic.limit_bytes:,}",
                        topic.priority,
                        f"`{topic.logged}`" if topic.logged else "",
                    )
                    for topic in topics.TOPICS
                ],
            ),
            "Beacon and policy's message are binary. All others are raw deflate streams "
            "(RFC 1951): `explored` of bits, `world` of the file's text, the rest of JSON with the "
            "fields below. Each is in one signed envelope. Fields with a default are optional, and "
            "unknown fields are ignored.",
            "## Messages",
            *(part for message in MESSAGES for part in _message(message)),
            "## Layouts in bytes",
            *(f"### {title}\n\n{_rest(module)}" for title, module in _LAYOUTS.items()),
            "## Codes",
            "Codes are for machines; the text beside a code is for people and may change.",
            *(part for codes in CODES for part in _codes(codes)),
            "## Logs",
            *(f"### {title}\n\n{_rest(module)}" for title, module in _LOGS.items()),
        ]
    )  # fmt: skip


def _rest(module: types.ModuleType) -> str:
    """A module's docstring without its first line."""
    return (inspect.getdoc(module) or "").partition("\n")[2].strip()


def _message(cls: type[Any]) -> list[str]:
    hints = typing.get_type_hints(cls, include_extras=True)
    rows = []
    for field in dataclasses.fields(cls):
        has_default = (
            field.default is not dataclasses.MISSING
            or field.default_factory is not dataclasses.MISSING
        )
        kind, bounds = _kind(hints[field.name])
        rows.append((f"`{field.name}`", cell(kind), cell(bounds), "" if has_default else "yes"))
    return [
        f"### {cls.__name__}",
        inspect.getdoc(cls) or "",
        table(("field", "type", "bounds", "required"), rows),
    ]


def _codes(codes: type[StrEnum]) -> list[str]:
    return [
        f"### {codes.__name__}",
        inspect.getdoc(codes) or "",
        ", ".join(f"`{code}`" for code in codes),
    ]


def _kind(hint: Any) -> tuple[str, str]:
    """A field's type as text, and its bounds."""
    metadata = getattr(hint, "__metadata__", ())
    if metadata:
        kind, within = _kind(hint.__origin__)
        own = " and ".join(in_words(meta) for meta in metadata if isinstance(meta, Meta))
        return kind, "; each ".join(filter(None, [own, within]))
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin is Literal:
        return " or ".join(f"`{each}`" for each in arguments), ""
    if origin in (types.UnionType, typing.Union):
        (kind, bounds), *_ = (_kind(each) for each in arguments if each is not type(None))
        return f"{kind} or `null`", bounds
    if origin is tuple:
        kind, bounds = _kind(arguments[0])
        many = "list" if Ellipsis in arguments else f"{len(arguments)}"
        return f"{many} of {kind}", bounds
    if origin is dict:
        return f"object of {_kind(arguments[1])[0]}", _kind(arguments[1])[1]
    names = {float: "number", int: "whole number", str: "text", bool: "`true` or `false`"}
    return names.get(hint, f"`{getattr(hint, '__name__', hint)}`"), ""
