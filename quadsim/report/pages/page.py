"""Pages that open without a network: one template for their frame."""

from __future__ import annotations

import functools
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from quadsim.errors import printable

if TYPE_CHECKING:
    from jinja2 import Environment

PAGE_FILE: Final = "index.html"

_TEMPLATES: Final = Path(__file__).resolve().parent.parent / "templates"


def render_page(template: str, kind: str, **context: Any) -> str:
    """A page of a kind, e.g. `comparison`, from its template in `quadsim/report/templates` and the variables of that.

    Whatever these hold is printable text, unless the template states otherwise.
    """
    return _environment().get_template(template).render(kind=kind, **context)


@functools.cache  # it compiles each template once
def _environment() -> Environment:
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    return Environment(
        loader=FileSystemLoader(_TEMPLATES),
        autoescape=True,
        undefined=StrictUndefined,
        finalize=_shown,
        trim_blocks=True,
        lstrip_blocks=True,
    )


def _shown(value: Any) -> Any:
    """Text and paths without what steers a reader's eye, or what no file can hold; markup of ours as it is."""
    is_text = isinstance(value, str | Path) and not hasattr(value, "__html__")
    return printable(str(value), keep="\n") if is_text else value
