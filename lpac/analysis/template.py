"""Renders templates of jinja2. HTML is escaped, other text is not.

A package's templates are in its folder `templates`. All may extend and import this package's, such
as the layout of a self-contained page (`page.html`).
"""

import base64
import re
from functools import cache
from typing import Any

from jinja2 import ChoiceLoader, Environment, PackageLoader, StrictUndefined, select_autoescape
from markupsafe import Markup, escape


def render(package: str, name: str, /, **values: Any) -> str:
    """Render a package's template."""
    return _environment(package).get_template(name).render(values)


@cache
def _environment(package: str) -> Environment:
    made = Environment(
        loader=ChoiceLoader([PackageLoader(package), PackageLoader("lpac.analysis")]),
        autoescape=select_autoescape(), undefined=StrictUndefined,
        trim_blocks=True, lstrip_blocks=True, keep_trailing_newline=True,
    )  # fmt: skip
    made.filters["base64"] = lambda content: base64.b64encode(content).decode("ascii")
    made.filters["code"] = _code
    return made


def _code(text: str) -> Markup:
    """Convert to HTML; text between backticks becomes code."""
    return Markup(re.sub(r"`([^`]+)`", r"<code>\1</code>", str(escape(text))))
