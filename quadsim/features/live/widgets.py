"""Widgets of a session's page that only the driving client may use.  Handles are viser's; nothing here imports it."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from typing import Any, Final, NamedTuple

from quadsim.features.live import readout
from quadsim.features.live.session import Disturbances, Session

BREAKS: Final = "red"
"""Colour of a button that breaks something, or throws something away."""
_Input = Callable[[Any, Disturbances], Mapping[str, Any]]  # of a widget's value, and what acts on the vehicle


class _Shown(NamedTuple):
    """A widget that shows what acts on the vehicle."""

    widget: Any
    value: Callable[[Disturbances], Any]  # what it shows
    table: _Input  # the input that a person's change of it gives


class Widgets:
    """Widgets that only the driving client may use.

    Args:
        gui: viser's.
        drives: whether a client, by its number, has the controls.
    """

    def __init__(self, gui: Any, session: Session, drives: Callable[[int], bool]) -> None:
        self.gui = gui
        self.session = session
        self._drives = drives
        self._starts: list[tuple[Any, Any]] = []  # widgets, and what they are at the start of a flight
        self._shown: dict[str, _Shown] = {}  # by label: see `shows`
        self._given: dict[str, int] = {}  # likewise, the period in which a person changed it last

    def on(self, register: Callable[[Any], Any], act: Callable[[Any], Any]) -> None:
        """Call a function for changes by the driving client, not for changes by Python, which have no client."""

        async def called(event: Any) -> None:  # a plain function would run in one of many threads
            if event.client is None:
                return
            if not self._drives(event.client.client_id):
                event.client.add_notification(*readout.NOT_DRIVING)
                return
            result = act(event)
            if inspect.isawaitable(result):
                await result

        register(called)

    def reset(self) -> None:
        """Show what a new flight starts with."""
        for widget, value in self._starts:
            widget.value = value
        self._given.clear()
        self.follow()

    def follow(self) -> None:
        """Show what acts on the vehicle, whether a person, an event of the scenario or a refusal has changed it."""
        acting = self.session.disturbances
        for label, shown in self._shown.items():
            is_pending = self.session.k < self._given.get(label, -2) + 2  # what was typed acts in the period after
            value = shown.value(acting)
            if not is_pending and shown.widget.value != value:
                shown.widget.value = value

    def button(self, label: str, act: Callable[[Any], Any], **look: Any) -> Any:
        """A button."""
        button = self.gui.add_button(label, **look)
        self.on(button.on_click, act)
        return button

    def event(self, label: str, table: Callable[[], Mapping[str, Any]], refused: str = "", **look: Any) -> None:
        """A button that submits an event, if this scenario can have it."""
        self.button(label, lambda event: self.session.submit(table()), disabled=bool(refused), **look)

    def group(self, label: str, actions: Mapping[str, Callable[[Any], Any]], **look: Any) -> Any:
        """Buttons in a row."""
        buttons = self.gui.add_button_group(label, tuple(actions), **look)
        self.on(buttons.on_click, lambda event: actions[event.target.value](event))
        return buttons

    def value(self, widget: Any, act: Callable[[Any], Any]) -> Any:
        """Call a function of each value that the driving client gives; a new flight starts with the present one."""
        self._starts.append((widget, widget.value))
        self.on(widget.on_update, lambda event: act(event.target.value))
        return widget

    def submits(self, widget: Any, table: Callable[[Any], Mapping[str, Any]]) -> Any:
        """Submit an input made of a widget's value, likewise."""
        return self.value(widget, lambda value: self.session.submit(table(value), subject=widget.label))

    def shows(self, widget: Any, value: Callable[[Disturbances], Any], table: _Input) -> Any:
        """Show a value that acts, and submit an input made of what a person changes it to and of what else acts."""
        self._shown[widget.label] = _Shown(widget, value, table)
        self.on(widget.on_update, lambda event: self._submit(widget))
        return widget

    def give(self, widget: Any, value: Any) -> None:
        """Change such a widget's value as a person does."""
        widget.value = value
        self._submit(widget)

    def explain(self, refused: str) -> None:
        """Say why this scenario cannot have an event; nothing if it can."""
        self.gui.add_html(readout.says(refused, "why"))

    def _submit(self, widget: Any) -> None:
        label = widget.label
        self._given[label] = self.session.k
        table = self._shown[label].table(widget.value, self.session.disturbances)
        self.session.submit(table, subject=label)
