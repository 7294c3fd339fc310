"""A figure of matplotlib's that is saved, at whatever later time, with the fonts that it was drawn with."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

from matplotlib import rc_context, rcParams
from matplotlib.figure import Figure

if TYPE_CHECKING:
    from matplotlib.typing import RcKeyType

_FONTS: Final[tuple[RcKeyType, ...]] = ("pdf.fonttype", "ps.fonttype")
"""Settings that matplotlib reads when it saves; its default is Type 3."""


class JournalFigure(Figure):
    """A figure that a user of pyplot saves with fonts that journals accept."""

    def __init__(self, *args: Any, **options: Any) -> None:
        super().__init__(*args, **options)
        self._fonts: dict[RcKeyType, Any] = {name: rcParams[name] for name in _FONTS}

    def savefig(self, *args: Any, **options: Any) -> None:
        """See `matplotlib.figure.Figure.savefig`."""
        with rc_context(self._fonts):
            super().savefig(*args, **options)
