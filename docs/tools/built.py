"""Check the built site: each block of code or output of a page is in its HTML, and none stands there twice in a row.

python docs/tools/built.py
"""

from __future__ import annotations

import html
import itertools
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Final

ROOT: Final = Path(__file__).resolve().parents[2]
_FENCED: Final = re.compile(r"^```\w*[^\n]*\n(.*?)^```$", re.DOTALL | re.MULTILINE)
_SHOWN: Final = re.compile(r"<pre[^>]*>(.*?)</pre>", re.DOTALL)
_TAG: Final = re.compile(r"<[^>]*>")


def shown_blocks(built: str) -> list[str]:
    """The texts of a built page's preformatted blocks, in order."""
    return [html.unescape(_TAG.sub("", block)).strip() for block in _SHOWN.findall(built)]


def mistakes(page: str, built: str) -> Iterator[str]:
    """What a built page fails to show of its Markdown, or shows twice."""
    shown = shown_blocks(built)
    for block in _FENCED.findall(page):
        if block.strip() not in shown:
            yield f"a block is missing: {block.strip().splitlines()[0]}"
    for before, after in itertools.pairwise(shown):
        if before == after:
            yield f"a block is shown again in place of what should follow: {after.splitlines()[0]}"


def main() -> None:
    """Print the mistakes of every page; exit status 1 if there are any."""
    found = []
    for path in sorted((ROOT / "docs").glob("*.md")):
        built = (ROOT / "site" / f"{path.stem}.html").read_text(encoding="utf-8")
        found += [f"{path.name}: {mistake}" for mistake in mistakes(path.read_text(encoding="utf-8"), built)]
    if found:
        sys.exit("\n".join(found))


if __name__ == "__main__":
    main()
