"""Python on the pages is run as the site is built: blocks marked ```` ```python exec ```` get their output and plots.

The blocks of a page share their names, as cells of a notebook do.  Elsewhere they read, and highlight, as plain Python.
The page on the library gets its table.
"""

from __future__ import annotations

import ast
import base64
import contextlib
import io
import os
import re
import tempfile
from html import escape
from typing import Any

import matplotlib as mpl
from markdown import Markdown
from markdown.extensions import Extension
from markdown.preprocessors import Preprocessor

from docs.tools import library

BLOCK = re.compile(r"^```python exec\n(.*?)^```\n", re.MULTILINE | re.DOTALL)


def run(source: str, names: dict[str, Any]) -> str:
    """A block's output as HTML: what it prints, its last expression, the figures that it draws."""
    import matplotlib.pyplot as plt

    tree = ast.parse(source)
    last = ast.Expression(tree.body.pop().value) if tree.body and isinstance(tree.body[-1], ast.Expr) else None
    with contextlib.redirect_stdout(io.StringIO()) as printed, contextlib.redirect_stderr(io.StringIO()):
        exec(compile(tree, "<page>", "exec"), names)
        value = None if last is None else eval(compile(last, "<page>", "eval"), names)
    text = "\n".join(line.rstrip() for line in printed.getvalue().splitlines()).rstrip()
    parts = [f"<pre><code>{escape(text)}</code></pre>"] if text else []
    for number in plt.get_fignums():
        image = io.BytesIO()
        plt.figure(number).savefig(image, format="png", dpi=120)
        parts.append(f'<img alt="plot" src="data:image/png;base64,{base64.b64encode(image.getvalue()).decode()}">')
    plt.close("all")
    if value is not None and not parts:
        html = getattr(value, "_repr_html_", None)
        parts.append(html() if html else f"<pre><code>{escape(repr(value))}</code></pre>")
    return f'<div class="output">{"".join(parts)}</div>' if parts else ""


class Executed(Preprocessor):
    """Runs the blocks of one page in a folder of its own."""

    def run(self, lines: list[str]) -> list[str]:
        """The page with each block's output after it."""
        names: dict[str, Any] = {"__name__": "__main__"}

        def shown(match: re.Match[str]) -> str:
            output = run(match[1], names)
            return f"```python\n{match[1]}```\n\n{self.md.htmlStash.store(output) if output else ''}\n"

        text = "\n".join(lines) + "\n"
        if library.PLACE in text:
            text = text.replace(library.PLACE, self.md.htmlStash.store(library.html()))
        if not BLOCK.search(text):
            return text.split("\n")
        mpl.use("agg")
        here = os.getcwd()  # noqa: PTH109
        with tempfile.TemporaryDirectory() as folder:
            os.chdir(folder)
            try:
                return BLOCK.sub(shown, text).split("\n")
            finally:
                os.chdir(here)


class Execution(Extension):
    """The extension."""

    def extendMarkdown(self, md: Markdown) -> None:
        """Register it before fenced code."""
        md.preprocessors.register(Executed(md), "executed", 30)


def makeExtension(**settings: object) -> Execution:
    """The extension, as the Markdown library asks for it."""
    return Execution(**settings)
