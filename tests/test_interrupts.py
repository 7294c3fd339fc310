"""Signals between the end of a flight and its tables."""

from __future__ import annotations

import signal
from collections.abc import Iterator

import pytest

from quadsim.interrupts import STOPS, SignalHold, current_hold


@pytest.fixture(autouse=True)
def listening() -> Iterator[None]:
    """Ctrl-C as Python has it, whatever this process was started with; SIGTERM is ignored."""
    before = [signal.getsignal(stop) for stop in STOPS]
    signal.signal(signal.SIGINT, signal.default_int_handler)
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    yield
    for stop, handler in zip(STOPS, before, strict=True):
        signal.signal(stop, handler)


def test_before_and_in_the_flight_a_signal_acts_at_once() -> None:
    with SignalHold(), pytest.raises(KeyboardInterrupt):
        signal.raise_signal(signal.SIGINT)


def test_from_its_end_on_a_signal_waits_until_the_tables_are_written() -> None:
    with SignalHold() as hold:
        hold.flown = True
        signal.raise_signal(signal.SIGINT)
        signal.raise_signal(signal.SIGINT)
        signal.raise_signal(signal.SIGTERM)
        with pytest.raises(KeyboardInterrupt):
            current_hold().release()
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    assert signal.getsignal(signal.SIGTERM) is signal.SIG_IGN


def interrupted() -> None:
    with SignalHold() as hold:
        hold.flown = True
        signal.raise_signal(signal.SIGINT)


def test_a_signal_that_waits_acts_where_the_block_ends() -> None:
    with pytest.raises(KeyboardInterrupt):
        interrupted()


def test_a_hold_within_another_hands_its_signal_on() -> None:
    with SignalHold() as outer:
        outer.flown = True
        interrupted()
        with pytest.raises(KeyboardInterrupt):
            current_hold().release()


def test_without_a_hold_a_signal_acts_at_once() -> None:
    assert current_hold() is not current_hold()
    with pytest.raises(KeyboardInterrupt):
        signal.raise_signal(signal.SIGINT)
