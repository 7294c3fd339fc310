"""Limit how far the built site's search corrects a word: without it, "font" finds "for" and "from".

The theme looks for words within two edits of one that no page has, however short it is.  Here a word of four letters or
fewer is taken as it is, one of up to seven may have one edit, a longer one two.

python docs/tools/site_search.py
"""

from __future__ import annotations

import re
import sys
from pathlib import Path
from typing import Final

WORKERS: Final = Path(__file__).resolve().parents[2] / "site" / "assets" / "javascripts" / "workers"
_COMPARED: Final = re.compile(
    r'(?P<edits>\w+)=\w+\(\w+\.terms\[\w+\],(?P<word>\w+)\);typeof (?P=edits)<"u"&&(?!(?P=edits)<=)'
)
"""Where the worker compares the word with one of the pages', and takes it."""


def limited(worker: str) -> str:
    """Return the search's script with fewer edits for short words.

    Raises:
        ValueError: it is not the script that this was written for.
    """
    changed, count = _COMPARED.subn(r"\g<0>\g<edits><=(\g<word>.length<5?0:\g<word>.length<8?1:2)&&", worker)
    if count != 1:
        raise ValueError(f"the search must compare words in one place to be limited; found {count}")
    return changed


def main() -> None:
    """Change the script in place; exit status 1 if it is another."""
    (path,) = WORKERS.glob("search.*.js")
    try:
        path.write_text(limited(path.read_text(encoding="utf-8")), encoding="utf-8")
    except ValueError as error:
        sys.exit(f"{path.name}: {error}")


if __name__ == "__main__":
    main()
