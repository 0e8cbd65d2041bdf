"""HTML from the templates in `templates/`, which escape every text that Python gives them."""

from __future__ import annotations

from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from wfsobs.app.display import NOTHING, number

ENVIRONMENT = Environment(
    loader=PackageLoader("wfsobs.app"), autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
)
ENVIRONMENT.policies["json.dumps_kwargs"] = {"allow_nan": False, "separators": (",", ":")}
ENVIRONMENT.filters["number"] = number
ENVIRONMENT.globals["NOTHING"] = NOTHING


def render(template: str, **values: Any) -> str:
    """Fill a template; every name that it uses must be among the values."""
    return ENVIRONMENT.get_template(template).render(values)


def macro(name: str, *values: Any) -> Markup:
    """Fill a macro of `macros.html`: a piece that goes into other templates as it is."""
    return getattr(ENVIRONMENT.get_template("macros.html").module, name)(*values)
