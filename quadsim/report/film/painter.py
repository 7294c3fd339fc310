"""Drawing primitives of the captions, and the ink that has no meaning.  Pillow alone."""

from __future__ import annotations

import functools
from typing import Any, Final

import numpy as np
from PIL import Image, ImageDraw, ImageFont

Picture = np.ndarray[Any, np.dtype[np.uint8]]

WHITE: Final = "#f0f3f6"
GREY: Final = "#9ea8b2"
FAINT: Final = "#4a525c"

_MOST_CACHED: Final = 2048
"""Texts that are cached as pictures, of each size of font: a film shows most of its words in every frame."""
_SHADED: Final = (np.arange(256) * 0.24 + 12.0).astype(np.uint8)
"""What each brightness becomes behind a text."""


class Painter:
    """Draws on one picture; lengths are design pixels, of `scale` real ones each."""

    def __init__(self, image: Image.Image, scale: float) -> None:
        self._canvas = ImageDraw.Draw(image)
        self._scale = scale

    def text(self, x: float, y: float, text: str, *, size: float = 15, colour: str = WHITE, anchor: str = "la") -> None:
        """Write at a place; `anchor` is Pillow's, `ra` for right-aligned."""
        font = _font(_real_size(size, self._scale))
        self._canvas.text((x * self._scale, y * self._scale), text, fill=colour, font=font, anchor=anchor)

    def box(self, x: float, y: float, width: float, height: float, colour: str) -> None:
        """Fill a rectangle; a negative width or height reaches to the left or up."""
        left, right = sorted((round(x * self._scale), round((x + width) * self._scale)))
        top, bottom = sorted((round(y * self._scale), round((y + height) * self._scale)))
        corners = (left, top, max(right - 1, left), max(bottom - 1, top))
        self._canvas.rectangle(corners, fill=colour)


def shade(frame: Picture, x: float, y: float, width: float, height: float, *, scale: float) -> None:
    """Darken a rectangle of a frame, in place, so that text on it can be read."""
    rows = slice(round(y * scale), round((y + height) * scale))
    columns = slice(round(x * scale), round((x + width) * scale))
    frame[rows, columns] = _SHADED.take(frame[rows, columns])


@functools.lru_cache(maxsize=_MOST_CACHED)
def text_width(text: str, size: float, *, scale: float) -> float:
    """How long a text is [design pixels]."""
    return _font(_real_size(size, scale)).getlength(text) / scale


def _real_size(size: float, scale: float) -> int:
    """The size of a font [pixels], large enough to be read."""
    return max(6, round(size * scale))


@functools.lru_cache(maxsize=32)
def _font(size: int) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    font = ImageFont.load_default(size)
    if isinstance(font, ImageFont.FreeTypeFont):  # else it is Pillow's own bitmap, which takes no time
        font.getmask2 = functools.lru_cache(maxsize=_MOST_CACHED)(font.getmask2)  # type: ignore[assignment,method-assign]
    return font
