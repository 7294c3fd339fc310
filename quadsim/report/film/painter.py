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

_TEXTS: Final = 2048
"""Texts that are cached as pictures, of each size of font: a film shows most of its words in every frame."""
_SHADE: Final = (np.arange(256) * 0.24 + 12.0).astype(np.uint8)


class Painter:
    """Draws on one picture; lengths are design pixels, of `scale` real ones each."""

    def __init__(self, image: Image.Image, scale: float) -> None:
        self._canvas = ImageDraw.Draw(image)
        self._scale = scale

    def text(self, x: float, y: float, text: str, *, size: float = 15, colour: str = WHITE, anchor: str = "la") -> None:
        """Write at a place; `anchor` is Pillow's, `ra` for right-aligned."""
        font = _font(max(6, round(size * self._scale)))
        self._canvas.text((x * self._scale, y * self._scale), text, fill=colour, font=font, anchor=anchor)

    def box(self, x: float, y: float, width: float, height: float, colour: str) -> None:
        """Fill a rectangle; a negative width or height reaches to the left or up."""
        left, right = sorted((x * self._scale, (x + width) * self._scale))
        top, bottom = sorted((y * self._scale, (y + height) * self._scale))
        self._canvas.rectangle(
            (round(left), round(top), max(round(right) - 1, round(left)), max(round(bottom) - 1, round(top))),
            fill=colour,
        )


def shade(frame: Picture, x: float, y: float, width: float, height: float, *, scale: float) -> None:
    """Darken a rectangle of a frame, in place, so that text on it can be read."""
    rows = slice(round(y * scale), round((y + height) * scale))
    columns = slice(round(x * scale), round((x + width) * scale))
    frame[rows, columns] = _SHADE.take(frame[rows, columns])


@functools.lru_cache(maxsize=_TEXTS)
def text_width(text: str, size: float, *, scale: float) -> float:
    """How long a text is [design pixels]."""
    return _font(max(6, round(size * scale))).getlength(text) / scale


@functools.lru_cache(maxsize=32)
def _font(size: int) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    font = ImageFont.load_default(size)
    if isinstance(font, ImageFont.FreeTypeFont):  # else it is Pillow's own bitmap, which takes no time
        font.getmask2 = functools.lru_cache(maxsize=_TEXTS)(font.getmask2)  # type: ignore[assignment,method-assign]
    return font
