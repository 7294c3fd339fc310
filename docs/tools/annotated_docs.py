"""For the site: the `doc` of an annotated field as its description, for mkdocstrings; see `quadsim.fields`."""

from __future__ import annotations

import ast
import contextlib
from typing import Any

import griffe


class AnnotatedDocs(griffe.Extension):
    """Gives each attribute `name: Annotated[type, doc("text")]` its text and its type."""

    def on_attribute_instance(self, *, attr: griffe.Attribute, **_: Any) -> None:
        """See `griffe.Extension`."""
        parsed = ast.parse(str(attr.annotation), mode="eval").body if attr.annotation else None
        if not (isinstance(parsed, ast.Subscript) and ast.unparse(parsed.value) == "Annotated"):
            return
        kind, *notes = parsed.slice.elts if isinstance(parsed.slice, ast.Tuple) else [parsed.slice]
        for note in notes:
            if isinstance(note, ast.Call) and ast.unparse(note.func) == "doc":
                with contextlib.suppress(ValueError):  # of a text that is put together when it is imported
                    attr.docstring = griffe.Docstring(str(ast.literal_eval(note.args[0])), parent=attr)
                    attr.annotation = ast.unparse(kind)
