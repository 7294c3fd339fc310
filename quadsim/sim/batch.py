"""Plants flown together, a control period per call of the core, by as many threads as are given."""

from __future__ import annotations

import ctypes
import itertools
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from quadsim.controller import LARGEST_SPEED, check_command
from quadsim.core.inner import CompiledLoop
from quadsim.core.mirror import Struct, core_library
from quadsim.core.structs import End, FlightStruct
from quadsim.errors import CommandError, FlightError
from quadsim.sim.margins import Margins
from quadsim.sim.physics import PhysicsSteps, inner_steps
from quadsim.sim.plant import Plant
from quadsim.state import INDEX, Array
from quadsim.vehicle import N_ROTORS

TARGET: Final = 8  # numbers of the longest command: a target with an attitude


@dataclass
class _Place:
    """What flies at a place of the batch; it keeps alive what the core points to."""

    plant: Plant
    loop: CompiledLoop | None
    struct: Struct | None  # of the loop
    margins: Margins | None


class PlantBatch:
    """Vehicles that fly at the same time, each with its parameters, inner loop, sensors and draws.

    The bits are those of single flights by `Plant.hold`, whatever their number and that of the threads.  A vehicle that
    diverges ends its own flight and no other's.

    Attributes:
        steps: physics steps of a control period.
        state: (N, 12) true states, yaw unwrapped, at the last control instant.
        acting: (N, 4) rotor speeds commanded last [rad/s].
        reference: (N, 4) x, y, z [m], yaw [rad] at the start of the period: tracking errors are measured from it.
        measured: (N, 12) states as measured at the start of the period.
        smallest: (N, m) smallest margins within the last period; see `quadsim.sim.margins.Margins.of_period`.
        at_end: (N, m) margins at its end.

    Examples:
        >>> import numpy as np
        >>> import quadsim
        >>> from quadsim.sim.batch import PlantBatch
        >>> from quadsim.sim.plant import Plant
        >>> vehicle = quadsim.load_vehicle("hummingbird")
        >>> batch = PlantBatch(2, steps=50)
        >>> for place in range(2):
        ...     batch.put(place, Plant(vehicle, integrator="rk4"), np.zeros(12), vehicle.hover_speeds)
        >>> ended = batch.fly(np.tile(1.01 * vehicle.hover_speeds, (2, 1)))
        >>> ended, bool(batch.state[0, 4] > 0.0), bool((batch.state[0] == batch.state[1]).all())
        ({}, True, True)
    """

    def __init__(self, count: int, *, steps: int, limits: int = 0, threads: int = 1) -> None:
        """Set up N empty places.

        Args:
            count: N.
            steps: physics steps of a control period.
            limits: m, how many margins each flight has.
            threads: how many fly it; the calling one alone where it is 1.
        """
        self._flights = (FlightStruct * count)()
        self._places: list[_Place | None] = [None] * count
        self.steps = steps
        self._count = count
        self._attended: set[int] = set()  # places where something changes or is drawn
        self._watched: set[int] = set()  # places where MuJoCo steps
        self._fields = _fields_of(self._flights)
        self.state = self._fields["state"]
        self.acting = self._fields["acting"]
        self.reference = self._fields["reference"]
        self.measured = self._fields["measured"]
        self.smallest, self.at_end = np.full((2, count, limits), np.inf)
        self._pool: ThreadPoolExecutor | None = None
        if threads > 1:
            self._pool = ThreadPoolExecutor(threads)
        self._ranges = _ranges(count, threads)

    def close(self) -> None:
        """Free native memory and end the threads."""
        for place in self._places:
            if place is not None:
                place.plant.close()
        self._places = [None] * self._count
        self._fields["steps"][:] = 0
        if self._pool is not None:
            self._pool.shutdown()

    def put(
        self,
        place: int,
        plant: Plant,
        state: Array,
        speeds: Array,
        *,
        loop: CompiledLoop | None = None,
        sensing: Struct | None = None,
        margins: Margins | None = None,
    ) -> None:
        """Start a flight at a place, with the plant reset to a state (12,) and rotor speeds (4,) [rad/s].

        Args:
            place: from 0 to N - 1.
            plant: what flies there; it may have been there before.
            state: (12,).
            speeds: (4,) of the rotors at t = 0, and the command before the first.
            loop: an inner loop that the core answers for, whose targets `fly` is given; rotor speeds without one.
            sensing: what takes samples after each step.
            margins: of m limits, all compiled.
        """
        plant.reset(state, speeds)
        before = self._places[place]
        if before is None or before.plant is not plant:
            plant.begin(self.steps)
        flight = self._flights[place]
        vehicle, rows = plant.structs
        flight.vehicle = ctypes.addressof(vehicle)
        flight.rows = ctypes.addressof(rows)
        struct: Struct | None = None
        flight.loop = None
        if loop is not None:
            struct = loop.engage(np.zeros(N_ROTORS), speeds)
            assert struct is not None
            struct.stride = inner_steps(loop.rate, plant.timestep)
            struct.until = 0
            flight.loop = ctypes.addressof(struct)
        rows.row = 0
        flight.period = self.steps
        if sensing is None:
            flight.sensing = None
        else:
            flight.sensing = ctypes.addressof(sensing)
        flight.bounds = None
        flight.bounded = 0
        if margins is not None:
            assert margins.compiled
            assert len(margins.limits) == self.smallest.shape[1]
            flight.bounds = ctypes.addressof(margins.bounds)
            flight.bounded = len(margins.limits)
            flight.smallest = self.smallest[place].ctypes.data
            flight.at_end = self.at_end[place].ctypes.data
            self.smallest[place], self.at_end[place] = margins.of_start(plant.physics, speeds)
        flight.yaw = flight.upright = float(state[INDEX["yaw"]])
        physics = plant.physics
        core_library().quadsim_observe(
            physics.ctypes.data,
            ctypes.addressof(flight) + FlightStruct.yaw.offset,
            ctypes.addressof(flight) + FlightStruct.upright.offset,
            ctypes.addressof(flight) + FlightStruct.state.offset,
        )
        self.acting[place] = speeds
        self.measured[place] = self.state[place]
        self._places[place] = _Place(plant, loop, struct, margins)
        for places, listed in ((self._attended, not plant.unattended), (self._watched, plant.watched)):
            places.discard(place)
            if listed:
                places.add(place)

    def sense(self, place: int, sensing: Struct) -> None:
        """Let this take samples at a place in the periods to come."""
        self._flights[place].sensing = ctypes.addressof(sensing)

    def plant(self, place: int) -> Plant:
        """Return the plant at a place."""
        at = self._places[place]
        assert at is not None
        return at.plant

    def flown(self, place: int) -> PhysicsSteps:
        """Return the physics steps (M,) of the last period at a place; the next period is written over them."""
        return self.plant(place).flown

    def fly(self, commands: Array, flying: NDArray[np.bool_] | None = None) -> dict[int, FlightError]:
        """Fly a control period.

        Args:
            commands: (N, 4) rotor speeds [rad/s], or (N, 4) or (N, 8) targets of the inner loops.
            flying: (N,) which places fly; absent: all.

        Returns:
            what ended a flight in this period, by place; such a period is not part of the flight.
        """
        fields = self._fields
        numbers = commands.shape[1]
        ended: dict[int, FlightError] = {}
        fields["command"][:, :numbers] = commands
        fields["numbers"][:] = numbers
        fields["steps"][:] = self.steps
        fields["why"][:] = End.DONE
        if flying is not None:
            fields["steps"][~flying] = 0
        self._refuse(commands, ended)
        left = self._stage_first(ended)
        self._call()
        self._check(ended)
        while left:
            self._fly_on(left, ended)
        return ended

    def _stage_first(self, ended: dict[int, FlightError]) -> dict[int, int]:
        """Stage the first part of the period where something changes or is drawn; return what is left of it."""
        left: dict[int, int] = {}
        for place in sorted(self._attended):
            if self._fields["steps"][place]:
                self.plant(place).structs[1].row = 0
                left[place] = self.steps
                self._stage(place, left, ended)
        return left

    def _stage(self, place: int, left: dict[int, int], ended: dict[int, FlightError]) -> None:
        """Stage the next part of a place's period."""
        self._fields["steps"][place] = 0
        try:
            staged = self.plant(place).stage(left[place])
        except FlightError as error:
            ended[place] = error
            del left[place]
            return
        self._fields["steps"][place] = staged
        left[place] -= staged
        if left[place] == 0:
            del left[place]

    def _fly_on(self, left: dict[int, int], ended: dict[int, FlightError]) -> None:
        """Fly the next part of the periods that changes or forces cut."""
        self._fields["steps"][:] = 0
        for place in list(left):
            if place in ended:
                del left[place]
            else:
                self._stage(place, left, ended)
        self._call()
        self._check(ended)

    def _check(self, ended: dict[int, FlightError]) -> None:
        """Note what ended a flight in the last call."""
        fields = self._fields
        suspects = np.flatnonzero(fields["why"] != End.DONE).tolist()
        for place in {*suspects, *self._watched}:
            at = self._places[place]
            if at is None or not fields["steps"][place]:
                continue
            flight = self._flights[place]
            try:
                at.plant.check(flight.why, at.struct, flight.complaint)
            except FlightError as error:
                ended[place] = error

    def _refuse(self, commands: Array, ended: dict[int, FlightError]) -> None:
        """End the flights whose rotor speeds are no valid command; inner loops answer for their targets."""
        if np.abs(commands).max(initial=0.0) <= LARGEST_SPEED:  # False for NaN
            return
        for place in np.flatnonzero(self._fields["steps"]).tolist():
            at = self._places[place]
            if at is None or at.loop is not None:
                continue
            problem = check_command(commands[place])
            if problem is not None:
                ended[place] = CommandError(problem, time=self.plant(place).time)
                self._fields["steps"][place] = 0

    def _call(self) -> None:
        fly = core_library().quadsim_fly_many
        if self._pool is None:
            fly(self._flights, 0, self._count)
            return
        submitted = [self._pool.submit(fly, self._flights, first, end) for first, end in self._ranges]
        for part in submitted:
            part.result()


def _fields_of(flights: Any) -> NDArray[np.void]:
    """Return the flights' structs as an array (N,) with their fields."""
    return np.frombuffer(flights, dtype=np.dtype(FlightStruct))


def _ranges(count: int, threads: int) -> list[tuple[int, int]]:
    """Return disjoint ranges of places, one for each thread that has any."""
    edges = np.linspace(0, count, min(threads, max(count, 1)) + 1).round().astype(int).tolist()
    return list(itertools.pairwise(edges))
