"""The tab of a session's page with the controller's fields, and with other controllers that may take over."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

from quadsim.errors import InputError
from quadsim.features.live import readout
from quadsim.features.live.tunable_fields import MAIN_FIELDS, FieldValue, TunableField, tunable_fields
from quadsim.features.live.widgets import Widgets
from quadsim.scenarios.schema.controllers import AnyController
from quadsim.scenarios.schema.writing import plain


class ControllerTab:
    """The controller's fields, and other controllers that may take over.

    Args:
        others: these, by name.
        doing: returns a context in which an activity is shown.
    """

    def __init__(self, widgets: Widgets, others: Mapping[str, AnyController], doing: Callable[[str], Any]) -> None:
        self._widgets = widgets
        self._session = widgets.session
        self._doing = doing
        self._laws = {"initial": self._session.scenario.controller, **others}
        self._values: dict[str, FieldValue] = {}  # by path, as they fly
        self._groups: list[Any] = []  # folders of fields
        chosen = widgets.gui.add_dropdown("Controller", tuple(self._laws))
        widgets.button("Use this controller", lambda event: self._take(event, chosen.value))
        self._answer = widgets.gui.add_html("")
        self._folder = widgets.gui.add_folder(None)
        self._show(self._session.scenario.controller)

    def reset(self) -> None:
        """Show what a new flight starts with."""
        self._answer.content = ""
        self._show(self._session.scenario.controller)

    def _show(self, spec: AnyController) -> None:
        """Show the fields of a controller, with the most used ones first."""
        while self._groups:
            self._groups.pop().remove()
        fields = {field.path: field for field in tunable_fields(spec)}
        self._values = {path: field.value for path, field in fields.items()}
        for title, labels in MAIN_FIELDS.items():
            group = []
            for path, label in labels.items():
                if path in fields:
                    group.append((fields.pop(path), label))
            self._add_group(title, group, expanded=True)
        rest = [(field, field.path) for field in fields.values()]
        self._add_group("All fields", rest, expanded=False)

    def _add_group(self, title: str, group: Sequence[tuple[TunableField, str]], *, expanded: bool) -> None:
        """Add a folder of fields with their labels; none without fields."""
        if not group:
            return
        with self._folder:
            folder = self._widgets.gui.add_folder(title, expand_by_default=expanded)
        self._groups.append(folder)
        with folder:
            for field, label in group:
                self._widgets.on(self._input(field, label).on_update, partial(self._change_field, field.path))

    def _input(self, field: TunableField, label: str) -> Any:
        """The widget of a field."""
        gui = self._widgets.gui
        limits = {"min": field.minimum, "max": field.maximum}
        match field.value:
            case bool(value):
                return gui.add_checkbox(label, value, hint=field.about)
            case str(value):
                return gui.add_dropdown(label, field.choices, initial_value=value, hint=field.about)
            case tuple(value):
                limits_of_pair = {}
                for name, limit in limits.items():
                    if limit is not None:
                        limits_of_pair[name] = (limit, limit)
                return gui.add_vector2(label, value, step=0.1, hint=field.about, **limits_of_pair)
            case int(value):
                return gui.add_number(label, value, step=1, hint=field.about, **limits)
            case value:
                return gui.add_number(label, value, hint=field.about, **limits)

    async def _change_field(self, path: str, event: Any) -> None:
        """Let a controller with a changed field take over; show its value before if that fails."""
        widget = event.target
        value = widget.value
        before = self._values.get(path)
        if before is None or value == before:  # of a controller that was replaced meanwhile, or put back
            return
        if await self._replace(event, {path: value}, f"{path} = {value}, was {before}"):
            self._values[path] = value
        else:
            widget.value = before

    async def _take(self, event: Any, name: str) -> None:
        spec = self._laws[name]
        if await self._replace(event, plain(spec), name):
            self._show(spec)

    async def _replace(self, event: Any, fields: Mapping[str, Any], what: str) -> bool:
        """Build a controller in the background and let it take over; if that fails, report why."""
        with self._doing("building the controller"):
            try:
                successor = await asyncio.to_thread(self._session.successor, fields)
            except InputError as error:
                self._answer.content = readout.says(f"Refused, the previous controller stays active: {error}", "bad")
                event.client.add_notification("Refused", str(error), color="red", auto_close_seconds=8.0)
                return False
        self._session.submit({"type": "controller", "fields": dict(fields)}, successor=successor)
        self._answer.content = readout.says(f"Active from the next period on: {what}")
        return True
