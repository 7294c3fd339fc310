"""The audit: signed margins of every limit, at the control samples and at the physics rate, and the verdicts.

    margin = min(value - lower, upper - value)    [negative beyond a bound; violated where it is below -tolerance]

A QP bounds the samples of a linear model; the audit of a flight's log reads the plant between the samples, too.  This
module alone defines margins, tolerances, violations, the worst finding, and the verdict on a flight.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated, Final, Literal, NamedTuple

import numpy as np
from annotated_types import doc
from numpy.typing import ArrayLike, NDArray

from quadsim.errors import ParameterError, UnknownNameError
from quadsim.fields import NonNegative, Number
from quadsim.flight.log import FlightLog, PeriodLog, PlantLog, Sampled
from quadsim.rotation import euler_to_body_rates
from quadsim.space import Constraining
from quadsim.state import (
    EULER,
    EULER_RATE,
    INDEX,
    POSITION,
    REFERENCE_NAMES,
    REFERENCE_STATES,
    STATE_NAMES,
    STATE_UNITS,
    Array,
    shown_unit,
    tilt,
)
from quadsim.ties import TIE_SHARE, first_smallest, tied
from quadsim.vehicle import N_ROTORS

Mask = NDArray[np.bool_]
Verdict = Literal["satisfied", "violated", "incomplete"]
"""On a constraint; `incomplete`: the flight has no value in its time window."""
VERDICT_TEXT: Final[dict[str, str]] = {"satisfied": "holds", "violated": "violated", "incomplete": "not reached"}
"""Display text of the verdicts on a constraint."""
FlightVerdict = Literal["satisfied", "violated", "lost", "aborted", "incomplete", "unaudited"]
"""On a flight, see `flight_verdict`."""
UNAUDITED_ADVICE: Final = (
    "no constraint was audited: the controller has no bounds and the scenario no [[constraints]]; add an entry, for "
    'example name = "tilt", signal = "tilt", upper = 30.0'
)
"""What to do about an unaudited flight."""
COMMAND_SIGNALS: Final = ("speed", "slew")
"""Signals that the controller sets itself."""
_TIME_ROUNDING: Final = 1e-9
"""Instants this close to the end of a time window [s] are within it."""


@dataclass(frozen=True, kw_only=True)
class Tolerance:
    """Default tolerances of a signal's limits, at the physics rate and at the control samples."""

    plant: float
    sampled: float
    of_band: bool = True  # whether they are shares of half the band; otherwise they are in the signal's unit

    def of(self, half_band: float) -> tuple[float, float]:
        """Return both in the signal's unit."""
        scale = 1.0
        if self.of_band:
            scale = half_band
        return self.plant * scale, self.sampled * scale


MOTION: Final = Tolerance(plant=0.01, sampled=0.002)
"""Tolerance of quantities that a controller bounds at its samples, and that overshoot between them."""
AT_SAMPLES: Final = Tolerance(plant=0.01, sampled=0.01)
"""Tolerance of quantities that exist only at the samples, and that no controller bounds."""
COMMAND_TOLERANCE: Final = Tolerance(plant=1e-6, sampled=1e-6, of_band=False)
"""Tolerance of commands [rad/s]."""
ZERO_TOLERANCE: Final = Tolerance(plant=0.0, sampled=0.0)
"""Tolerance of clearances."""


@dataclass(frozen=True, kw_only=True)
class Signal:
    """A quantity that can be limited: its unit in limits, and how to read it from a log."""

    unit: str  # unit of its limits, e.g. `deg`
    sampled: Callable[[Sampled], Array]  # log -> (K,) or (K, j) values at the control samples, in `unit`
    plant: Callable[[PlantLog], Array] | None
    """log -> (M,) or (M, j) values at the physics rate, or None for a quantity that exists only at samples."""
    tolerance: Tolerance = MOTION  # default tolerances of its limits
    gaps: bool = False  # whether it may be NaN at some instants, which limits then skip

    def finest(self, log: FlightLog | PeriodLog) -> tuple[Array, Array]:
        """Return times [s] and values at the plant's rate, or at the control samples if the plant has none."""
        if self.plant is None:
            return log.control.t, self.sampled(log.control)
        return log.plant.t, self.plant(log.plant)


def _state(i: int) -> Signal:
    unit, scale = shown_unit(STATE_UNITS[i])
    return Signal(unit=unit, sampled=lambda log: scale * log.truth[:, i], plant=lambda log: scale * log.state[:, i])


def _error(j: int) -> Signal:
    unit, scale = shown_unit(STATE_UNITS[REFERENCE_STATES[j]])
    return Signal(unit=unit, sampled=lambda log: scale * log.tracking_error[:, j], plant=None, tolerance=AT_SAMPLES)


def _estimate_error(i: int) -> Signal:
    unit, scale = shown_unit(STATE_UNITS[i])
    return Signal(unit=unit, sampled=lambda log: scale * log.measured_error[:, i], plant=None, tolerance=AT_SAMPLES)


def _body_rate(axis: int) -> Signal:
    def rates(states: Array) -> Array:
        return np.degrees(euler_to_body_rates(states[:, EULER], states[:, EULER_RATE])[:, axis])

    def plant(log: PlantLog) -> Array:
        if log.body_rates is None:
            return rates(log.state)
        return np.degrees(log.body_rates[:, axis])  # Euler rates lose precision near the vertical

    return Signal(unit="deg/s", sampled=lambda log: rates(log.truth), plant=plant)


def _climb_acceleration(t: Array, states: Array) -> Array:
    """(M,) mean vertical acceleration, world, from each of M states (M, 12) to the next [m/s^2]; NaN at the last.

    It is the change of velocity, whatever causes it: thrust, wind, contact.  It is 0 in hover; with gravity added it is
    the vertical part of the specific force, which an accelerometer measures.
    """
    return np.append(np.diff(states[:, INDEX["vz"]]) / np.diff(t), math.nan)


def _target_thrust(log: Sampled) -> Array:
    """(K,) collective thrust that the autopilot is to fly [N]; NaN without an autopilot."""
    if log.target is None:
        return np.full(log.t.shape, math.nan)
    return log.target[:, 0]


def _acting_thrust(log: PlantLog) -> Array:
    """(M,) collective thrust of the rotors [N]; NaN without an autopilot."""
    if log.thrust is None:
        return np.full(log.t.shape, math.nan)
    return log.thrust


def _signals_of_states() -> dict[str, Signal]:
    """Each state, its error against the reference, and the error of its estimate, by name."""
    signals = {}
    for name, i in INDEX.items():
        signals[name] = _state(i)
    for j, name in enumerate(REFERENCE_NAMES):
        signals[f"{name}_error"] = _error(j)
    for i in (*POSITION, *EULER):
        signals[f"{STATE_NAMES[i]}_estimate_error"] = _estimate_error(i)
    return signals


SIGNALS: Final[dict[str, Signal]] = {
    **_signals_of_states(),
    "tilt": Signal(
        unit="deg", sampled=lambda log: np.degrees(tilt(log.truth)), plant=lambda log: np.degrees(tilt(log.state))
    ),
    "body_rate_x": _body_rate(0),
    "body_rate_y": _body_rate(1),
    "body_rate_z": _body_rate(2),
    "climb_acceleration": Signal(
        unit="m/s^2",
        sampled=lambda log: _climb_acceleration(log.t, log.truth),
        plant=lambda log: _climb_acceleration(log.t, log.state),
        gaps=True,
    ),
    # Commanded at the samples, acting in between: the two differ when rotors saturate, or the mixer changes the thrust.
    "thrust": Signal(
        unit="N",
        sampled=_target_thrust,
        plant=_acting_thrust,
        gaps=True,  # it has no target on the ground
    ),
    "speed": Signal(
        unit="rad/s", sampled=lambda log: log.speeds, plant=lambda log: log.speeds, tolerance=COMMAND_TOLERANCE
    ),
    "slew": Signal(unit="rad/s", sampled=lambda log: log.slews, plant=None, tolerance=COMMAND_TOLERANCE),
}


def _rotor(i: int) -> Signal:
    return Signal(
        unit="rad/s",
        sampled=lambda log: log.speeds[:, i],
        plant=lambda log: log.speeds[:, i],
        tolerance=COMMAND_TOLERANCE,
    )


def _term_signals() -> dict[str, Signal]:
    """Each state, and each rotor's speed, by name."""
    signals = {}
    for name in STATE_NAMES:
        signals[name] = SIGNALS[name]
    for i in range(N_ROTORS):
        signals[f"speed_{i + 1}"] = _rotor(i)
    return signals


TERM_SIGNALS: Final[dict[str, Signal]] = _term_signals()
"""The terms allowed in a sum."""
SUM: Final = "sum"  # the signal of a limit on a sum of terms
CLEARANCE: Final = "clearance"  # the signal of a limit in space: clearance of the vehicle's bounding ball [m]


def sum_signal(terms: Mapping[str, float]) -> Signal:
    """Return the signal of a sum of terms: names in `TERM_SIGNALS` with their factors."""
    summands = [(factor, TERM_SIGNALS[name]) for name, factor in terms.items()]
    units = {signal.unit for _, signal in summands}
    if len(units) == 1:
        unit = units.pop()
    else:
        unit = "-"
    if all(signal.tolerance is COMMAND_TOLERANCE for _, signal in summands):
        tolerance = COMMAND_TOLERANCE
    else:
        tolerance = MOTION

    def sampled(log: Sampled) -> Array:
        return np.sum([factor * signal.sampled(log) for factor, signal in summands], axis=0)

    def plant(log: PlantLog) -> Array:
        parts = []
        for factor, signal in summands:
            assert signal.plant is not None
            parts.append(factor * signal.plant(log))
        return np.sum(parts, axis=0)

    return Signal(unit=unit, sampled=sampled, plant=plant, tolerance=tolerance)


_SIGNALS_WITH_UNITS: Final = ", ".join(f"{name} [{signal.unit}]" for name, signal in SIGNALS.items())


@dataclass(frozen=True, kw_only=True)
class Limit:
    """Bounds on a signal of the flight.

    `slew` is the command's step per period; `speed` and `slew` apply to every rotor.  An infinite bound means no bound.
    An entry without bounds takes the controller's, which `quadsim.scenarios.limits` fills in.

    Examples:
        >>> import numpy as np
        >>> from quadsim.flight.audit import Limit
        >>> roll = Limit(name="roll", signal="roll", lower=-5.0, upper=5.0)
        >>> roll.unit, roll.margin(np.array([0.0, 4.0, 6.0])).tolist()
        ('deg', [5.0, 1.0, -1.0])
    """

    name: Annotated[str, doc("name in reports")] = field(metadata={"pattern": "^[A-Za-z0-9_.-]+$"})
    signal: Annotated[
        str,
        doc(f"bounded quantity: {_SIGNALS_WITH_UNITS}, or sum"),
    ] = field(metadata={"json_schema_extra": {"enum": [*SIGNALS, SUM]}})
    terms: Annotated[
        dict[str, Number] | None,
        doc(
            'where signal = "sum": the factors of states and rotor speeds by name, for example {x = 1.0, vx = 0.5}, in '
            "their units in limits"
        ),
    ] = None
    lower: Annotated[Number, doc("[unit of the signal] lower bound; both absent: the controller's")] = -math.inf
    upper: Annotated[Number, doc("[unit of the signal] upper bound; both absent: the controller's")] = math.inf
    tolerance: Annotated[
        NonNegative | None,
        doc("[unit of the signal] violation accepted at the physics rate; absent: the signal's default"),
    ] = None
    tolerance_sampled: Annotated[
        NonNegative | None,
        doc("[unit of the signal] violation accepted at the control samples; absent: in proportion to tolerance"),
    ] = None
    required: Annotated[bool, doc("false: reported only, without effect on the verdict")] = True
    start: Annotated[Number, doc("[s] start of the time window")] = 0.0
    stop: Annotated[Number, doc("[s] end of the time window; absent: the end of the flight")] = math.inf

    def __post_init__(self) -> None:
        self._check_signal()
        owner = f"constraints.{self.name}"
        if not self.lower < self.upper:
            raise ParameterError(owner, "lower", self.lower, f"below upper = {self.upper}")
        if self.tolerance is not None and (self.tolerance_sampled or 0.0) > self.tolerance:
            rule = f"at most tolerance = {self.tolerance}"
            raise ParameterError(owner, "tolerance_sampled", self.tolerance_sampled, rule)
        if not self.start <= self.stop:
            raise ParameterError(owner, "stop", self.stop, f"at least start = {self.start}")

    def _check_signal(self) -> None:
        """Raise if the signal or a term is unknown, or terms and signal do not fit together."""
        owner = f"constraints.{self.name}"
        if self.signal == SUM and not self.terms:
            raise ParameterError(owner, "terms", self.terms, "the factors of a sum")
        if self.signal != SUM and self.terms:
            raise ParameterError(owner, "terms", self.terms, f'absent where signal is not "{SUM}"')
        if self.signal not in (*SIGNALS, SUM):
            raise UnknownNameError("signal", self.signal, [*SIGNALS, SUM])
        for name in self.terms or ():
            if name not in TERM_SIGNALS:
                raise UnknownNameError("signal", name, TERM_SIGNALS)

    @property
    def source(self) -> Signal:
        """The bounded quantity."""
        if self.terms:
            return sum_signal(self.terms)
        return SIGNALS[self.signal]

    @property
    def unit(self) -> str:
        """Unit of the bounds, tolerances and margins."""
        return self.source.unit

    @property
    def has_bounds(self) -> bool:
        """Whether it states its own bounds."""
        return math.isfinite(self.lower) or math.isfinite(self.upper)

    @property
    def half_band(self) -> float:
        """Half the gap between the bounds; the magnitude of a single bound, or 1 if that is 0."""
        if math.isfinite(self.lower) and math.isfinite(self.upper):
            return 0.5 * (self.upper - self.lower)
        bound = self.upper
        if math.isfinite(self.lower):
            bound = self.lower
        return abs(bound) or 1.0

    @property
    def tie(self) -> float:
        """Window within which margins are tied, in the limit's unit; see `quadsim.ties`."""
        return TIE_SHARE * self.half_band

    @property
    def tolerances(self) -> tuple[float, float]:
        """Violations accepted at the physics rate and at the control samples, stated or by default.

        If only `tolerance` is stated, the two are in the proportion of the defaults.  If only `tolerance_sampled` is
        stated, the one at the physics rate is the default, or the stated one if that is larger.
        """
        default, default_sampled = self.source.tolerance.of(self.half_band)
        if self.tolerance is not None and self.tolerance_sampled is not None:
            return self.tolerance, self.tolerance_sampled
        if self.tolerance_sampled is not None:
            return max(default, self.tolerance_sampled), self.tolerance_sampled
        if self.tolerance is not None:
            proportion = 1.0  # of defaults that are 0
            if default:
                proportion = default_sampled / default
            return self.tolerance, self.tolerance * proportion
        return default, default_sampled

    def with_tolerances(self) -> Limit:
        """Return the limit with both tolerances stated."""
        plant, sampled = self.tolerances
        return replace(self, tolerance=plant, tolerance_sampled=sampled)

    def holds_at(self, t: Array) -> Mask:
        """Return (K,) whether it applies at times (K,) [s]."""
        return (t >= self.start - _TIME_ROUNDING) & (t <= self.stop + _TIME_ROUNDING)

    def margin(self, values: Array) -> Array:
        """Return (K,) the signed distance to the nearer bound, the smallest over rotors; negative = beyond it."""
        margin = np.minimum(values - self.lower, self.upper - values)
        if margin.ndim == 1:
            return margin
        return margin.min(axis=1)

    def excess(self, margin: ArrayLike, *, sampled: bool = False) -> Array:
        """Return how far margins are beyond bound and tolerance, in the limit's unit: positive where it is violated.

        Args:
            margin: signed margins, of any shape; NaN outside the time window, where the excess is NaN too.
            sampled: whether they are at the control samples; otherwise they are at the physics rate.
        """
        tolerance, tolerance_sampled = self.tolerances
        if sampled:
            tolerance = tolerance_sampled
        return np.asarray(-tolerance - np.asarray(margin, float))

    def violated(self, margin: ArrayLike, *, sampled: bool = False) -> Mask:
        """Return whether margins violate the limit; arguments as `excess`."""
        return np.asarray(self.excess(margin, sampled=sampled) > 0.0)


@dataclass(frozen=True, kw_only=True)
class SpaceLimit(Limit):
    """An obstacle to avoid, or a region to stay in."""

    signal: str = CLEARANCE
    lower: float = 0.0
    shape: Constraining  # the obstacle or region
    radius: float  # radius of the vehicle's bounding ball [m]

    def _check_signal(self) -> None:
        """Do nothing: the signal is a distance."""

    @property
    def source(self) -> Signal:
        """The bounded quantity."""
        return Signal(
            unit="m",
            sampled=lambda log: self.shape.clearance(log.t, log.truth[:, POSITION]) - self.radius,
            plant=lambda log: self.shape.clearance(log.t, log.state[:, POSITION]) - self.radius,
            tolerance=ZERO_TOLERANCE,
        )


@dataclass(frozen=True, kw_only=True, repr=False)
class Finding:
    """The audit's result for one limit; margins and peaks in the limit's unit.

    Examples:
        >>> import quadsim
        >>> finding = quadsim.fly(quadsim.load("hover", {"duration": 1.0})).audit[0]
        >>> finding.limit.name, finding.verdict, finding.satisfied
        ('roll', 'satisfied', True)
    """

    limit: Limit  # the limit audited
    peak_sampled: float  # value at the control samples that is closest to a bound, or furthest beyond it
    peak_plant: float  # the same at the physics rate; NaN for signals that exist only at samples
    worst_margin_sampled: float  # smallest signed margin at the control samples
    worst_margin: float  # smallest signed margin at the physics rate, or at the samples if the signal exists only there
    worst_time: float  # first time at which the margin is within `Limit.tie` of the smallest [s]
    time_violated: float  # time spent beyond bound plus tolerance [s]

    def __repr__(self) -> str:
        if self.verdict == "incomplete":
            return f"<Finding {self.limit.name}: {VERDICT_TEXT[self.verdict]}>"
        margin, tolerance = self.deciding
        judged = f"margin {margin:.4g} {self.limit.unit}, tolerance {tolerance:.3g}"
        return f"<Finding {self.limit.name}: {VERDICT_TEXT[self.verdict]}, {judged}, at {self.worst_time:.2f} s>"

    @property
    def verdict(self) -> Verdict:
        """Whether the limit held, within its tolerances, at the samples and between them.

        `incomplete` if the flight has no value in the limit's time window, for example because it ended earlier.  The
        plant decides a window that lies between two samples.
        """
        if math.isnan(self.worst_time):
            return "incomplete"
        margin, tolerance = self.deciding
        if margin >= -tolerance:
            return "satisfied"
        return "violated"  # also where the margin is NaN

    @property
    def satisfied(self) -> bool:
        """Whether the limit was reached and held."""
        return self.verdict == "satisfied"

    @property
    def margin(self) -> float:
        """The smallest signed margin, at the samples or between them; NaN if there is none."""
        if math.isnan(self.worst_margin):
            return math.nan
        return float(np.fmin(self.worst_margin, self.worst_margin_sampled))

    @property
    def share(self) -> float:
        """`margin` as a share of half the band: 1 in its middle, 0 at a bound, negative beyond it."""
        return self.margin / self.limit.half_band

    @property
    def deciding(self) -> tuple[float, float]:
        """The margin that decides the verdict, and its tolerance.

        It is taken at the physics rate, unless only the samples violate the limit.
        """
        tolerance, tolerance_sampled = self.limit.tolerances
        violated_at_samples = self.limit.violated(self.worst_margin_sampled, sampled=True)
        if violated_at_samples and self.worst_margin >= -tolerance:
            return self.worst_margin_sampled, tolerance_sampled
        return self.worst_margin, tolerance


def worst_finding(findings: Iterable[Finding]) -> Finding | None:
    """Return the finding with the smallest margin as a share of half its band; None if none counts.

    Limits that were not reached do not count, and limits of the commands only once they are violated: a command at its
    own bound is no near miss.  Of the others the required ones count, or all if none is required.  Of findings whose
    shares are tied (`quadsim.ties`), the violated ones come first, then the first in order.
    """
    counted = _counted(findings)
    if not counted:
        return None
    shares = [finding.share for finding in counted]
    nearest = [counted[i] for i in tied(shares)]
    violated = [finding for finding in nearest if finding.verdict == "violated"]
    return (violated or nearest)[0]


def worst_share(findings: Iterable[Finding]) -> float | None:
    """Return the smallest margin as a share of half its band, of the findings that count for `worst_finding`."""
    return min((finding.share for finding in _counted(findings)), default=None)


def _counted(findings: Iterable[Finding]) -> list[Finding]:
    """Return the findings that count for `worst_finding`, in order."""
    counted = []
    for finding in findings:
        reached = math.isfinite(finding.margin)
        if reached and (finding.verdict == "violated" or finding.limit.signal not in COMMAND_SIGNALS):
            counted.append(finding)
    required = [finding for finding in counted if finding.limit.required]
    return required or counted


def flight_verdict(findings: Sequence[Finding], *, aborted: bool, lost: bool, failed: bool) -> FlightVerdict:
    """Return the verdict on a flight in one word.

    Args:
        findings: its audit.
        aborted: whether the user or an exception ended it.
        lost: whether anything else ended it early, or it left its course, see `quadsim.flight.departure`.
        failed: whether it failed apart from its audit, see `quadsim.flight.metrics.failure`.

    Returns:
        `aborted` or `lost`, where it ended early or left its course; `violated`, where it failed or a required limit is
        violated; `incomplete`, where it ended before a required limit was reached; `unaudited`, where it has no limit;
        otherwise `satisfied`.
    """
    if aborted:
        return "aborted"
    if lost:
        return "lost"
    verdicts = {finding.verdict for finding in findings if finding.limit.required}
    if failed or "violated" in verdicts:
        return "violated"
    if "incomplete" in verdicts:
        return "incomplete"
    if findings:
        return "satisfied"
    return "unaudited"


_COMPARED: Final = ("signal", "terms", "lower", "upper", "start", "stop", "tolerances", "shape")
"""Attributes that may differ between the limits of two audits."""


def limit_differences(first: Sequence[Limit], second: Sequence[Limit], *, demands: bool = True) -> list[str]:
    """Return how the limits of two audits differ, a line per difference: absent ones, bounds, windows and tolerances.

    Args:
        first: limits of one audit, paired with the others by their names.
        second: those of the other.
        demands: whether to compare, too, which limits are required, on which the verdict on a flight depends.
    """
    compared = [*_COMPARED]
    if demands:
        compared.append("required")
    a = {limit.name: limit for limit in first}
    b = {limit.name: limit for limit in second}
    lines = [f"{name} only in the first" for name in a if name not in b]
    lines += [f"{name} only in the second" for name in b if name not in a]
    for name, limit in a.items():
        if name in b:
            lines += _field_differences(limit, b[name], compared)
    return lines


def _field_differences(limit: Limit, other: Limit, compared: Sequence[str]) -> list[str]:
    """Return in which of the compared attributes two limits of one name differ, a line per difference."""
    lines = []
    for attribute in compared:
        value = getattr(limit, attribute, None)
        other_value = getattr(other, attribute, None)
        if value != other_value:
            lines.append(f"{limit.name}: {attribute} {_shown(value)} and {_shown(other_value)}")
    return lines


def _shown(value: object) -> str:
    """Return an attribute of a limit for a message."""
    if isinstance(value, tuple):  # the two tolerances
        return " / ".join(f"{number:.4g}" for number in value)
    if isinstance(value, float):
        return f"{value:.6g}"
    return str(value)


def margins_sampled(limit: Limit, log: FlightLog) -> Array:
    """Return (K,) signed margins of a limit at the control samples, NaN outside its time window."""
    return margins_at(limit, log.control.t, limit.source.sampled(log.control))


def margins_at(limit: Limit, t: Array, values: Array) -> Array:
    """Return (K,) signed margins of a limit for its signal's values at times t (K,), NaN outside its time window."""
    return np.where(limit.holds_at(t), limit.margin(values), np.nan)


def smallest_margins(log: FlightLog | PeriodLog, limits: Sequence[Limit]) -> dict[str, float]:
    """Smallest signed margin of each limit, by name, at the highest available rate; NaN outside its window."""
    margins = {}
    for limit in limits:
        t, values = limit.source.finest(log)
        margins[limit.name] = _nearest(limit, t, values).margin
    return margins


def audit(log: FlightLog, limits: Sequence[Limit]) -> tuple[Finding, ...]:
    """Audit a flight, its plant rows at the physics rate, against its limits: one finding per limit, in order.

    Examples:
        >>> import quadsim
        >>> from quadsim.flight.audit import Limit, audit
        >>> flight = quadsim.fly(quadsim.load("hover", {"duration": 1.0}))
        >>> height = Limit(name="height", signal="z", lower=0.5, upper=1.5)
        >>> (finding,) = audit(flight.log, [height])
        >>> finding.satisfied, round(finding.worst_margin, 6)
        (True, 0.5)
    """
    return tuple(_find(log, limit.with_tolerances()) for limit in limits)


def _find(log: FlightLog, limit: Limit) -> Finding:
    """Return the finding on a limit with stated tolerances."""
    t = log.control.t
    values = limit.source.sampled(log.control)
    sampled = _nearest(limit, t, values)
    has_periods = t.size > 0
    if has_periods:  # a flight that ends before its first period is not judged, though the plant has a row
        t, values = limit.source.finest(log)
    finest = _nearest(limit, t, values)
    peak_plant = finest.value
    if limit.source.plant is None:
        peak_plant = math.nan
    beyond = limit.holds_at(t) & limit.violated(limit.margin(values))
    end = log.plant.t[-1:]
    durations = np.diff(t, append=end)  # a value lasts until the next, or until the flight's end
    time_violated = round(float(durations[beyond].sum()), 9)
    return Finding(
        limit=limit,
        peak_sampled=sampled.value,
        peak_plant=peak_plant,
        worst_margin_sampled=sampled.margin,
        worst_margin=finest.margin,
        worst_time=finest.time,
        time_violated=time_violated + 0.0,  # -0.0 becomes 0.0
    )


class _Nearest(NamedTuple):
    """Where a signal comes nearest to a bound of its limit, or is furthest beyond it."""

    value: float
    margin: float
    time: float  # [s]


def _nearest(limit: Limit, t: Array, values: Array) -> _Nearest:
    """Return value, margin and time of the smallest margin; NaN if the window is empty.

    Of tied instants (`Limit.tie`) the first gives the time, and the bound and rotor whose extreme is the value.
    """
    inside = limit.holds_at(t)
    if limit.source.gaps:
        inside &= np.isfinite(values)
    if not inside.any():
        return _Nearest(math.nan, math.nan, math.nan)
    columns = values[inside].reshape(np.count_nonzero(inside), -1)  # one, or one per rotor
    margins = limit.margin(columns)
    smallest = margins.min()
    row = first_smallest(margins, limit.tie)
    to_upper = limit.upper - columns[row]
    to_lower = columns[row] - limit.lower
    distances = np.concatenate([to_upper, to_lower])
    first = first_smallest([*distances, smallest], limit.tie)  # not the last: one of the distances is tied with it
    column = first % to_upper.size
    if first < to_upper.size:
        value = columns[:, column].max()
    else:
        value = columns[:, column].min()
    return _Nearest(value=float(value), margin=float(smallest), time=float(t[inside][row]))
