r"""Formulas of the pages, `$...$` in a line and `$$...$$` in lines of their own, as MathML: no script, no network."""

from __future__ import annotations

import re
from xml.etree import ElementTree

from latex2mathml.converter import convert
from markdown import Markdown
from markdown.extensions import Extension
from markdown.inlinepatterns import InlineProcessor
from markdown.preprocessors import Preprocessor

INLINE = r"(?<![\\$\w])\$(?=\S)([^$\n]+?)(?<=\S)\$(?![\w$])"
BLOCK = re.compile(r"^\$\$\n(.*?)\n\$\$$", re.MULTILINE | re.DOTALL)


def mathml(latex: str, display: str) -> str:
    """The formula as one `<math>` element, whose text begins with the LaTeX for those who read it aloud."""
    return convert(latex, display=display).replace("<math ", f"<math alttext={_quoted(latex)} ", 1)


def _quoted(text: str) -> str:
    return '"' + text.replace("&", "&amp;").replace('"', "&quot;").replace("<", "&lt;").replace("\n", " ") + '"'


class Inline(InlineProcessor):
    """`$...$` within a paragraph."""

    def handleMatch(  # type: ignore[override]
        self, m: re.Match[str], data: str
    ) -> tuple[str | ElementTree.Element, int, int]:
        """The formula, put aside as the Markdown library does with HTML, and its place."""
        return self.md.htmlStash.store(mathml(m.group(1), "inline")), m.start(0), m.end(0)


class Block(Preprocessor):
    """`$$` alone on a line before and after a formula."""

    def run(self, lines: list[str]) -> list[str]:
        """The lines with each formula put aside, as the Markdown library does with HTML."""

        def stored(match: re.Match[str]) -> str:
            return "\n" + self.md.htmlStash.store(mathml(match.group(1), "block")) + "\n"

        return BLOCK.sub(stored, "\n".join(lines)).split("\n")


class Formulas(Extension):
    """Both, of which code takes precedence."""

    def extendMarkdown(self, md: Markdown) -> None:
        """Register both."""
        md.preprocessors.register(Block(md), "mathml-block", 24)  # after fenced code, 25
        md.inlinePatterns.register(Inline(INLINE, md), "mathml", 185)  # after code in backticks, 190


def makeExtension(**settings: object) -> Formulas:
    """The extension, as the Markdown library asks for it."""
    return Formulas(**settings)
