"""Declared bounds: one line for what lies outside; what lies inside is taken."""

import math
import re
from dataclasses import dataclass, field, make_dataclass
from enum import StrEnum
from typing import Annotated, Any, Literal

import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec import Meta

from edge.core.schema import (
    MAX_FLOAT,
    AtLeastOne,
    Bounded,
    ConfigError,
    Finite,
    NonNegative,
    PointXY,
    Positive,
    Share,
    bounds_of,
    from_mapping,
    in_words,
)


class Colour(StrEnum):
    RED = "red"
    BLUE = "blue"


@dataclass(frozen=True, slots=True)
class Part(Bounded):
    length_m: Positive = 1.0
    share: Share | None = None

    def check_rules(self) -> None:
        if self.share is not None and self.share > self.length_m:
            raise ValueError(f"share = {self.share}: must be at most length_m = {self.length_m}")


@dataclass(frozen=True, slots=True)
class Whole(Bounded):
    count: AtLeastOne
    size: Annotated[int, Meta(ge=2, le=64, multiple_of=2)] = 2
    offset_m: Finite = 0.0
    lag_s: NonNegative = 0.0
    jitter: Annotated[float, Meta(ge=0.0, lt=0.5)] = 0.0
    name: Annotated[
        str, Meta(pattern=r"\A[a-z]{1,8}\Z", description="1 to 8 letters, such as 'abc'")
    ] = "abc"
    place_m: PointXY = (0.0, 0.0)
    pair: tuple[Positive, Share] = (1.0, 0.5)
    periods_s: Annotated[tuple[Positive, ...], Meta(min_length=1)] = (1.0,)
    colour: Colour = Colour.RED
    mode: Literal["on", "off"] = "on"
    part: Part = field(default_factory=Part)
    parts: tuple[Part, ...] = ()
    shares: dict[Annotated[str, Meta(max_length=3)], Share] = field(default_factory=dict)
    anything: object = None
    table: dict = field(default_factory=dict)  # type: ignore[type-arg]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"counts": 1}, "f: unknown key 'counts'; known are count, size, "),
        ({"parts": [{}, {"x": 1}]}, "f: parts[1]: unknown key 'x'; known are length_m, share"),
        ({"count": 0}, "f: count = 0: must be at least 1"),
        ({"count": True}, "f: count = True: must be a whole number"),
        ({"count": 1.0}, "f: count = 1.0: must be a whole number"),
        ({"size": 65}, "f: size = 65: must be from 2 to 64"),
        ({"size": 3}, "f: size = 3: must be from 2 to 64 and a multiple of 2"),
        ({"offset_m": math.nan}, "f: offset_m = nan: must be finite"),
        ({"offset_m": -math.inf}, "f: offset_m = -inf: must be finite"),
        ({"lag_s": math.inf}, "f: lag_s = inf: must be at least 0 and finite"),
        ({"lag_s": "1"}, "f: lag_s = '1': must be a number"),
        ({"lag_s": 10**400}, "f: lag_s: is too large a number"),
        ({"name": 16**5000}, "f: name = a number of too many digits: must be text in quotes"),
        ({"jitter": 0.5}, "f: jitter = 0.5: must be at least 0 and below 0.5"),
        ({"name": "Abc"}, "f: name = 'Abc': must be 1 to 8 letters, such as 'abc'"),
        ({"name": "abc\n"}, r"f: name = 'abc\n': must be 1 to 8 letters, such as 'abc'"),
        ({"place_m": [1.0]}, "f: place_m = [1.0]: must be [x, y]"),
        ({"place_m": [1.0, math.nan]}, "f: place_m[1] = nan: must be finite"),
        ({"pair": [1.0]}, "f: pair = [1.0]: must be a list of 2"),
        ({"pair": [1, 2]}, "f: pair[1] = 2: must be from 0 to 1"),
        ({"periods_s": []}, "f: periods_s = []: must be at least 1 long"),
        ({"periods_s": [1, 0]}, "f: periods_s[1] = 0: must be above 0 and finite"),
        ({"periods_s": 3}, "f: periods_s = 3: must be a list"),
        ({"colour": "green"}, "f: colour = 'green': allowed are 'red', 'blue'"),
        ({"mode": 3}, "f: mode = 3: allowed are 'on', 'off'"),
        ({"part": [{}]}, "f: part: expected a table, got [{}]"),
        ({"part": {"length_m": -1.0}}, "f: part: length_m = -1.0: must be above 0 and finite"),
        (
            {"parts": [{}, {"length_m": 0.1, "share": 0.5}]},
            "f: parts[1]: share = 0.5: must be at most length_m = 0.1",
        ),
        ({"shares": {"a": 1, "b": 2}}, "f: shares: b = 2: must be from 0 to 1"),
        ({"shares": {"long": 1}}, "f: shares: key = 'long': must be at most 3 long"),
        ({"table": 3}, "f: table = 3: must be a table"),
    ],
)
def test_a_mistake_names_the_key_the_value_and_what_is_allowed(
    change: dict[str, Any], message: str
) -> None:
    with pytest.raises(ConfigError, match=f"^{re.escape(message)}"):
        from_mapping(Whole, {"count": 1} | change, "f")


def test_a_missing_key_is_named() -> None:
    with pytest.raises(ConfigError, match=r"^f: count is missing$"):
        from_mapping(Whole, {}, "f")
    with pytest.raises(ConfigError, match=r"^f: expected a table, got 3$"):
        from_mapping(Whole, 3, "f")


def test_what_is_written_becomes_the_declared_types() -> None:
    written = {
        "count": 3, "lag_s": 1, "place_m": [1, 2], "pair": [1, 1], "colour": "blue",
        "part": {"share": 0}, "parts": [{}], "anything": [1, {"a": 2}], "table": {"b": [1]},
    }  # fmt: skip
    whole = from_mapping(Whole, written, "f")
    assert whole == Whole(
        3, lag_s=1.0, place_m=(1.0, 2.0), pair=(1.0, 1.0), colour=Colour.BLUE,
        part=Part(share=0.0), parts=(Part(),), anything=[1, {"a": 2}], table={"b": [1]},
    )  # fmt: skip
    assert type(whole.lag_s) is float
    assert whole.colour is Colour.BLUE


def test_bounds_can_be_read() -> None:
    bounds = bounds_of(Whole)
    assert bounds["count"].ge == 1
    assert bounds["jitter"] == Meta(ge=0.0, lt=0.5)
    assert bounds_of(Part)["share"] == Meta(ge=0.0, le=1.0)
    assert "mode" not in bounds


# What a float may be, what it must not be, and whether that is so.
METAS = st.builds(
    lambda low, high, opens: Meta(
        **{"gt" if opens[0] else "ge": low, "lt" if opens[1] else "le": high}
    ),
    st.just(-MAX_FLOAT) | st.integers(-100, 0).map(float),
    st.just(MAX_FLOAT) | st.integers(1, 100).map(float),
    st.tuples(st.booleans(), st.booleans()),
)


def is_inside(meta: Meta, value: float) -> bool:
    low = value > meta.gt if meta.ge is None else value >= meta.ge  # type: ignore[operator]
    high = value < meta.lt if meta.le is None else value <= meta.le  # type: ignore[operator]
    return low and high


@given(
    meta=METAS,
    value=st.floats() | st.floats(-101.0, 101.0) | st.integers(-101, 101),
    shape=st.sampled_from(["number", "list", "table", "pair"]),
)
def test_files_and_python_are_bound_alike(meta: Meta, value: float, shape: str) -> None:
    number = Annotated[float, meta]

    types: dict[str, Any] = {
        "number": number | None, "list": tuple[number, ...], "table": dict[str, number],
        "pair": tuple[str, number],
    }  # fmt: skip
    bounded: Any = make_dataclass("Of", [(shape, types[shape])], bases=(Bounded,))
    written: Any = {"number": value, "list": [value], "pair": ["", value], "table": {"k": value}}
    made = {**written, "list": (value,), "pair": ("", value)}
    if is_inside(meta, value):
        assert getattr(from_mapping(bounded, {shape: written[shape]}, "f"), shape) == made[shape]
        bounded(**{shape: made[shape]})
        return
    at = {"number": "number", "list": "list[0]", "pair": "pair[1]", "table": "table: k"}[shape]
    refusal = f"{at} = {value!r}: must be {in_words(meta)}"
    with pytest.raises(ConfigError) as of_file:
        from_mapping(bounded, {shape: written[shape]}, "f")
    with pytest.raises(ValueError, match="must be ") as of_python:
        bounded(**{shape: made[shape]})
    assert str(of_file.value) == f"f: {refusal}"
    assert str(of_python.value) == refusal


VALUES: st.SearchStrategy[Any] = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=8), inner),
    max_leaves=4,
)


@given(key=st.sampled_from(sorted(Whole.__dataclass_fields__)), value=VALUES)
def test_whatever_is_written_is_taken_or_refused_in_one_line(key: str, value: Any) -> None:
    try:
        from_mapping(Whole, {"count": 1} | {key: value}, "f")
    except ConfigError as error:
        assert str(error).startswith(f"f: {key}")
        assert "\n" not in str(error)
