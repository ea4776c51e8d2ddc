"""`lpac.api`: what it promises of its names."""

import ast
import inspect
import re
import types
import typing

import pytest

import lpac.api
from tests.conftest import ROOT

PAGE = (ROOT / "docs" / "api.md").read_text()
CONSTANTS = {"BASELINES", "FIELD_SCALE", "SET_UPS", "SHIPPED_BUNDLE", "VERDICT_RULE"}


def public(name: str) -> object:
    return getattr(lpac.api, name)


def test_types_and_values_come_from_the_same_places() -> None:
    tree = ast.parse(inspect.getsource(lpac.api))
    typed = {
        alias.name: node.module
        for node in ast.walk(tree)
        if isinstance(node, ast.ImportFrom) and node.module and node.col_offset
        for alias in node.names
    }
    assert sorted(typed) == lpac.api.__all__ == dir(lpac.api)
    assert typed == lpac.api._MODULE_OF


@pytest.mark.parametrize("name", lpac.api.__all__)
def test_each_name_says_what_it_is(name: str) -> None:
    value = public(name)
    if name in CONSTANTS:
        assert f"`{name}`" in (lpac.api.__doc__ or "")
        return
    assert isinstance(value, type | types.FunctionType)
    # A dataclass without a docstring has its signature for one.
    assert value.__doc__ and not value.__doc__.startswith(f"{name}(")
    for function in functions(value):
        inspected = inspect.signature(function)
        hints = typing.get_type_hints(function)
        untyped = [p for p in inspected.parameters if p not in (*hints, "self", "cls")]
        assert not untyped and "return" in hints, (function, untyped)


def functions(value: type | types.FunctionType) -> list[types.FunctionType]:
    """It, or the methods of its own that anybody may call."""
    if isinstance(value, types.FunctionType):
        return [value]
    return [
        member
        for name, member in vars(value).items()
        if isinstance(member, types.FunctionType) and not name.startswith("_")
    ]


@pytest.mark.parametrize("name", lpac.api.__all__)
def test_the_page_names_it(name: str) -> None:
    in_text = re.sub(r"^```python\n.*?^```$", "", PAGE, flags=re.MULTILINE | re.DOTALL)
    in_code = "\n".join(re.findall(r"^```python\n(.*?)^```$", PAGE, re.MULTILINE | re.DOTALL))
    assert f"`{name}`" in in_text or re.search(rf"\b{name}\b", in_code), name


def test_another_name_is_refused() -> None:
    with pytest.raises(AttributeError, match="no attribute 'land'"):
        public("land")
