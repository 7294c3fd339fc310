"""Headers of trajectory files as planners write them, and what their columns are.

A format is a list of column names by quantity.  Its columns may stand in any order, and some may be absent; those that
the course does not use, such as jerk or rotor thrusts, are known so that a header with them is recognised.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

POSITION_QUANTITIES: Final = ("x", "y", "z")
VELOCITY_QUANTITIES: Final = ("vx", "vy", "vz")
ACCELERATION_QUANTITIES: Final = ("ax", "ay", "az")
QUATERNION_QUANTITIES: Final = ("qw", "qx", "qy", "qz")
POLYNOMIAL_AXES: Final = ("x", "y", "z", "yaw")
POLYNOMIAL_DEGREE: Final = 7  # of the polynomials of a piece
PIECE_DURATION: Final = "duration"


@dataclass(frozen=True, kw_only=True)
class TableFormat:
    """A kind of table, with its column of each quantity."""

    name: str  # as messages call it
    columns: Mapping[str, str]  # quantity -> column
    needed: tuple[str, ...] = ("t", *POSITION_QUANTITIES)  # quantities that must be there
    groups: tuple[tuple[str, ...], ...] = ()  # quantities that are there together or not at all
    unused: tuple[str, ...] = ()  # further columns that it may have

    @property
    def header(self) -> str:
        """Its columns as a header, those that may be absent in brackets."""
        parts = self._columns_of(self.needed)
        for group in self.groups:
            columns = ",".join(self._columns_of(group))
            parts.append(f"[{columns}]")
        return ",".join(parts)

    def _columns_of(self, quantities: Sequence[str]) -> list[str]:
        return [self.columns[quantity] for quantity in quantities]

    def known(self) -> set[str]:
        """Return every column that it may have."""
        return {*self.columns.values(), *self.unused}

    def quantities(self, header: Sequence[str]) -> dict[str, int] | None:
        """Return the place of each quantity in a header; None if the header is not of this format."""
        if len(set(header)) < len(header) or not set(header) <= self.known():
            return None
        places = {}
        for quantity, column in self.columns.items():
            if column in header:
                places[quantity] = header.index(column)
        if not all(quantity in places for quantity in self.needed):
            return None
        for group in self.groups:
            present = [quantity in places for quantity in group]
            if any(present) and not all(present):
                return None
        return places

    def distance(self, header: Sequence[str]) -> tuple[int, int]:
        """Return how many columns a header has and should not, and how many it lacks: (0, 0) for one of this format."""
        return self.foreign(header), len(self.missing(header))

    def foreign(self, header: Sequence[str]) -> int:
        """Return how many columns a header has that this format does not know."""
        known = self.known()
        return sum(column not in known for column in header)

    def missing(self, header: Sequence[str]) -> list[str]:
        """Return the columns that a header lacks, those of a group of which it has some included."""
        missing = _absent(self._columns_of(self.needed), header)
        for group in self.groups:
            columns = self._columns_of(group)
            absent = _absent(columns, header)
            if len(absent) < len(columns):
                missing += absent
        return missing


def _absent(columns: Sequence[str], header: Sequence[str]) -> list[str]:
    return [column for column in columns if column not in header]


def _named(pattern: str, quantities: Sequence[str], axes: Sequence[str] = ("x", "y", "z")) -> dict[str, str]:
    """Return the columns of quantities, by a pattern of their axes."""
    return {quantity: pattern.format(axis) for quantity, axis in zip(quantities, axes, strict=True)}


def _with_yaw(
    name: str, *, position: str, velocity: str, acceleration: str, unused: tuple[str, ...] = ()
) -> TableFormat:
    """Return a format with yaw as a column, by the patterns of its columns per axis."""
    return TableFormat(
        name=name,
        columns={
            "t": "t",
            **_named(position, POSITION_QUANTITIES),
            "yaw": "yaw",
            **_named(velocity, VELOCITY_QUANTITIES),
            **_named(acceleration, ACCELERATION_QUANTITIES),
        },
        groups=(("yaw",), VELOCITY_QUANTITIES, ACCELERATION_QUANTITIES),
        unused=unused,
    )


def _coefficients(axis: str) -> tuple[str, ...]:
    """Return the columns of an axis' polynomial, from the constant up."""
    return tuple(f"{axis}^{i}" for i in range(POLYNOMIAL_DEGREE + 1))


def _components(names: Sequence[str], separator: str = "") -> tuple[str, ...]:
    """Return the columns of vectors, one per axis."""
    columns = []
    for name in names:
        for axis in POSITION_QUANTITIES:
            columns.append(f"{name}{separator}{axis}")
    return tuple(columns)


_POSITION_COEFFICIENTS: Final = (*_coefficients("x"), *_coefficients("y"), *_coefficients("z"))
_YAW_COEFFICIENTS: Final = _coefficients("yaw")
POLYNOMIALS: Final = TableFormat(
    name="polynomials by piece, as of uav_trajectories",
    columns={column: column for column in (PIECE_DURATION, *_POSITION_COEFFICIENTS, *_YAW_COEFFICIENTS)},
    needed=(PIECE_DURATION, *_POSITION_COEFFICIENTS),
    groups=(_YAW_COEFFICIENTS,),
)
TABLE_FORMATS: Final = (
    _with_yaw("quadsim", position="{}", velocity="v{}", acceleration="a{}"),
    TableFormat(
        name="pmm_uav_planner, Agilicious",
        columns={
            "t": "t",
            **_named("p_{}", POSITION_QUANTITIES),
            **_named("q_{}", QUATERNION_QUANTITIES, ("w", "x", "y", "z")),
            **_named("v_{}", VELOCITY_QUANTITIES),
            **_named("a_{}", ACCELERATION_QUANTITIES),
        },
        groups=(QUATERNION_QUANTITIES, VELOCITY_QUANTITIES, ACCELERATION_QUANTITIES),
        unused=(*_components(("w", "a_lin", "a_rot", "j", "s"), "_"), "u_1", "u_2", "u_3", "u_4"),
    ),
    _with_yaw(
        "uav_trajectories, sampled",
        position="pos{}",
        velocity="vel{}",
        acceleration="acc{}",
        unused=_components(("jerk", "snap")),
    ),
    POLYNOMIALS,
)
"""The known formats; of equally near ones the first is named."""


def table_format(header: Sequence[str]) -> tuple[TableFormat, dict[str, int]] | None:
    """Return the format of a header and the places of its quantities; None if it is of none."""
    for entry in TABLE_FORMATS:
        places = entry.quantities(header)
        if places is not None:
            return entry, places
    return None


def nearest_format(header: Sequence[str]) -> str:
    """Say which known format a header comes nearest, and what it lacks of it.

    A header is not quoted: the author of a scenario may not own the file that it names.
    """
    nearest = min(TABLE_FORMATS, key=lambda entry: entry.distance(header))
    text = f"the nearest known format is {nearest.name}: {nearest.header}"
    missing = nearest.missing(header)
    if nearest is POLYNOMIALS:
        text = f"the nearest known format is {nearest.name}: duration,x^0,...,x^7,y^0,...,z^7[,yaw^0,...,yaw^7]"
    if missing:
        text += f"; missing: {','.join(missing[:6])}"
        if len(missing) > 6:
            text += ", ..."
    foreign = nearest.foreign(header)
    if foreign == 1:
        text += "; 1 column is not of it"
    elif foreign:
        text += f"; {foreign} columns are not of it"
    if len(set(header)) < len(header):
        text += "; a column occurs twice"
    return text
