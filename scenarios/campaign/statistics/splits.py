"""The one threshold on a drawn number that best tells flights with an event from those without, and how sure it is.

Fisher's exact test chooses the threshold.  Its p-value there is too good, since the best of many was taken; the chance
that the best of all thresholds is as good where the event has nothing to do with the number is found exactly, by
following all orders of the flights at once.

Source: Boulesteix, Biometrical Journal 48 (2006), with Fisher's p-value in place of chi-squared.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from quadsim.state import Array
from scenarios.campaign.results.events import Flags
from scenarios.campaign.statistics.inference import Proportion, proportion

Counts = np.ndarray[Any, np.dtype[np.int_]]

_ROUNDING: Final = 1.0 + 1e-7  # p-values of which one is no larger than this times the other are the same


@dataclass(frozen=True, kw_only=True)
class Split:
    """A threshold on a drawn number."""

    threshold: float  # a round number from `below` to `above`: flights up to it are on the low side
    below: float  # the largest value on the low side
    above: float  # the smallest value on the high side
    low: Proportion  # how often the event happened on the low side
    high: Proportion  # how often on the high side
    p_there: float  # Fisher's two-sided p-value at this threshold, as if it had been chosen beforehand
    p: float  # probability that the best threshold is as good by chance


def best_splits(columns: Mapping[str, Array], happened: Flags) -> dict[str, Split | None]:
    """The best threshold on each of several drawn numbers, (K,) by name, for an event that happened (K,) or not.

    None of a number that is always the same or not always there, and of an event that happened never or always.
    """
    if happened.all() or not happened.any():
        return dict.fromkeys(columns)
    varying = {name: values for name, values in columns.items() if np.isfinite(values).all() and np.ptp(values) > 0.0}
    if not varying:
        return dict.fromkeys(columns)
    flights = happened.size
    rare = happened if 2 * happened.sum() <= flights else ~happened  # the same test, and fewer counts to follow
    count = int(rare.sum())
    orders = {name: np.argsort(values, kind="stable") for name, values in varying.items()}
    ranked = np.stack([varying[name][order] for name, order in orders.items()])  # (D, K)
    counts = np.stack([np.cumsum(rare[order], dtype=np.int_) for order in orders.values()])[:, :-1]  # (D, K - 1)
    allowed = np.diff(ranked) > 0.0
    chances = np.where(allowed, _fisher(counts, flights, count), np.inf)
    cuts = np.argmin(chances, axis=1)
    best = chances[np.arange(cuts.size), cuts]
    p_values = _chances_of_as_good(best, allowed, flights, count)
    found: dict[str, Split | None] = dict.fromkeys(columns)
    for i, name in enumerate(varying):
        size = int(cuts[i]) + 1
        low = happened[orders[name]][:size]
        below, above = float(ranked[i, size - 1]), float(ranked[i, size])
        found[name] = Split(
            threshold=_round_number(below, above),
            below=below,
            above=above,
            low=proportion(int(low.sum()), size),
            high=proportion(int(happened.sum() - low.sum()), flights - size),
            p_there=float(best[i]),
            p=float(p_values[i]),
        )
    return found


def _fisher(counts: Counts, flights: int, count: int) -> Array:
    """(D, K - 1) p-values at each cut, of so many events among the first 1, 2, ... flights."""
    found = np.empty(counts.shape)
    for size, tails in enumerate(_tails(flights, count)):
        found[:, size] = tails[counts[:, size]]
    return found


def _chances_of_as_good(best: Array, allowed: Flags, flights: int, count: int) -> Array:
    """(D,) probability that any allowed cut has a p-value as small as the best, when all orders are equally likely.

    The number of events among the first flights is a Markov chain.  Loop invariant: `alive[:, j]` is the probability
    of j events among the first `size` flights, with no cut so far as good as the best.
    """
    alive = np.zeros((best.size, count + 1))
    alive[:, 0] = 1.0
    as_good = np.zeros(best.size)
    j = np.arange(count + 1)
    for size, tails in enumerate(_tails(flights, count), start=1):
        next_has_it = (count - j) / (flights - size + 1.0)
        moved = alive * next_has_it
        alive -= moved
        alive[:, 1:] += moved[:, :-1]
        beyond = (tails <= best[:, None] * _ROUNDING) & allowed[:, size - 1, None]
        as_good += np.sum(alive, axis=1, where=beyond)
        alive[beyond] = 0.0
    return np.minimum(as_good, 1.0)


def _tails(flights: int, count: int) -> Iterator[Array]:
    """(count + 1,) Fisher's two-sided p-value of each count among the first 1, 2, ..., flights - 1 flights."""
    chance = np.zeros(count + 1)  # hypergeometric, from one size to the next
    chance[0] = 1.0
    j = np.arange(count + 1)
    for size in range(1, flights):
        moved = chance * ((count - j) / (flights - size + 1.0))
        chance -= moved
        chance[1:] += moved[:-1]
        at_most, at_least = np.cumsum(chance), np.cumsum(chance[::-1])[::-1]
        yield np.minimum(1.0, 2.0 * np.minimum(at_most, at_least))


def _round_number(below: float, above: float) -> float:
    """The number of the fewest digits that is at least `below` and less than `above`."""
    middle = 0.5 * (below + above)
    candidates = (float(f"{middle:.{digits}g}") for digits in range(1, 17))
    return next((number for number in candidates if below <= number < above), below)
