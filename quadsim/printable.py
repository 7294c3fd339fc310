"""Text from outside, as one line that a terminal, a page or a CI server shows and never obeys."""

from __future__ import annotations

import unicodedata
from typing import Final

_HIDDEN: Final = frozenset({"Cc", "Cf", "Cs", "Co", "Cn", "Zl", "Zp"})
"""Unicode categories that steer what is shown, or show nothing: controls, formats such as direction, surrogates."""


def printable(text: str, *, keep: str = "") -> str:
    r"""A text with every character that steers a terminal written as an escape, e.g. `\x1b`.

    Args:
        text: any text, also one that no file can hold.
        keep: such characters that stay.
    """
    if text.isprintable():
        return text
    return "".join(
        each if each in keep or unicodedata.category(each) not in _HIDDEN else ascii(each)[1:-1] for each in text
    )
