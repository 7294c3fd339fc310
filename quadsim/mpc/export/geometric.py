"""The C files of a geometric controller."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

from quadsim.errors import ExportError
from quadsim.mpc.export.ctext import CText
from quadsim.mpc.export.follower import BODY_AHEAD_FILES, CFollower
from quadsim.mpc.export.source import SHARED_FILES
from quadsim.mpc.guard.numbers import fallback_numbers
from quadsim.mpc.guard.settings import USUAL_FALLBACK
from quadsim.mpc.laws.geometric import Geometric, GeometricController
from quadsim.vehicle import N_ROTORS


@dataclass(frozen=True, kw_only=True)
class CGeometric(CFollower):
    """A geometric controller of thrust and body rates as C source; it solves no problem, so it has no active rows.

    Raises:
        ExportError: it commands something else.
    """

    table: Geometric

    law_name = "quadsim_geometric"
    law_files = (
        *(*SHARED_FILES, *BODY_AHEAD_FILES),
        *("quadsim_ramp.h", "quadsim_ramp.c", "quadsim_geometric.h", "quadsim_geometric.c"),
    )
    motion_row = "position, quaternion, and ten that do not count"
    tolerances = ("1e-9", "5e-2")  # in floats, positions show a snap of several m/s^4 that is none
    changes = "(void)law, 0"
    rows = 0

    def __post_init__(self) -> None:
        if self.table.commands != "rates":
            raise ExportError(f'it is \'geometric\' with commands = "{self.table.commands}"; exported is "rates"')

    @cached_property
    def law(self) -> GeometricController:
        """The controller, of whose numbers these are."""
        return GeometricController(self.vehicle, self.control_period, self.table)

    @property
    def reals(self) -> int:
        """See `CSource`: as counted by `quadsim_geometric_reals`."""
        return 2 * self.horizon * N_ROTORS

    def numbers(self, text: CText) -> list[str]:
        """See `CSource`."""
        law = self.law
        prefix = text.prefix
        settings = USUAL_FALLBACK.within({})
        fallback = fallback_numbers(law.model, law.bounds, settings)
        blocks = [text.array(name, array) for name, array in law.pointed.items()]
        blocks.append(text.struct("quadsim_fallback", f"{prefix}fallback", **text.values(fallback)))
        addresses = {name: f"{prefix}{name}" for name in law.pointed}
        addresses["fallback"] = f"&{prefix}fallback"
        if law.delay is not None:
            blocks += self.delay_blocks(text, law.delay, law.delay_bodies)
            addresses["delay"] = f"&{prefix}delay"
        if law.observer is not None:
            blocks.append(text.struct("quadsim_ramp_numbers", f"{prefix}ramp", **text.mirrored(law.observer.numbers)))
            addresses["ramp"] = f"&{prefix}ramp"
        members = text.mirrored(law.numbers, addresses, motion=int(self.motion_rows > 0))
        return [*blocks, text.struct("quadsim_geometric_numbers", "QUADSIM_CONTROLLER", **members)]
