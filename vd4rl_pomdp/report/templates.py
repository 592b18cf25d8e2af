"""Render this package's HTML templates, which share one frame, base.html."""

from __future__ import annotations

from typing import Any

import jinja2

_ENVIRONMENT = jinja2.Environment(
    loader=jinja2.PackageLoader("vd4rl_pomdp.report", ""),
    autoescape=True,
    undefined=jinja2.StrictUndefined,
    trim_blocks=True,
)


def render(template: str, **values: Any) -> str:
    """The page that a template of this package makes of some values."""
    return _ENVIRONMENT.get_template(template).render(**values)
