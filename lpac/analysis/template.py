"""Render templates of jinja2: HTML is escaped, other text is not.

A package has its own in `templates`; all may extend and import this package's, such as the layout
of a page that holds everything and opens without a network (`page.html`).
"""

import base64
import re
from functools import cache
from typing import Any

from jinja2 import ChoiceLoader, Environment, PackageLoader, StrictUndefined, select_autoescape
from markupsafe import Markup, escape


def render(package: str, name: str, /, **told: Any) -> str:
    """Render a package's template."""
    return _environment(package).get_template(name).render(told)


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
    """As HTML; what is between backticks is code."""
    return Markup(re.sub(r"`([^`]+)`", r"<code>\1</code>", str(escape(text))))
