"""What the clients of a live session's page may send: every message is checked before anything acts on it.

A message of a kind that this page has no use for, with a number that is not finite, or of another form is dropped;
what is no message of viser's at all ends that client's connection, and no other.  All pages share the widgets: only
the driver changes one, and only to a value that the widget itself offers.
"""

from __future__ import annotations

import math
from collections.abc import Awaitable, Callable, Sequence
from typing import Any, Final

from viser import _messages

from quadsim.features.live.readout import NOT_DRIVING

Handler = Callable[[int, Any], Awaitable[None]]
_LONGEST: Final = 1000  # characters of a text, or entries of a list
_LARGEST: Final = 1e9  # magnitude of a number

_NUMBER: Final = (int, float)
_FORMS: Final[dict[type, dict[str, Any]]] = {
    _messages.ViewerCameraMessage: {
        "wxyz": 4,
        "position": 3,
        "fov": _NUMBER,
        "near": _NUMBER,
        "far": _NUMBER,
        "image_height": _NUMBER,
        "image_width": _NUMBER,
        "look_at": 3,
        "up_direction": 3,
    },
    _messages.SceneNodeClickMessage: {"name": str, "ray_origin": 3, "ray_direction": 3, "screen_pos": 2},
    _messages.SceneNodeDragMessage: {"name": str, "start_position": 3, "end_position": 3},
    _messages.ScenePointerMessage: {"event_type": str, "ray_origin": 3, "ray_direction": 3},
    _messages.TransformControlsUpdateMessage: {"name": str, "wxyz": 4, "position": 3},
    _messages.TransformControlsDragStartMessage: {"name": str},
    _messages.TransformControlsDragEndMessage: {"name": str},
    _messages.CommandTriggerMessage: {"uuid": str},
    _messages.GuiUpdateMessage: {"uuid": str, "updates": dict},
}
"""The messages that this page's clients send; of their fields the type, or how many numbers they have."""
_DRIVER_ONLY: Final = (
    _messages.TransformControlsUpdateMessage,
    _messages.TransformControlsDragStartMessage,
    _messages.TransformControlsDragEndMessage,
)
"""Messages by which viser moves what all pages share before it calls anybody."""


class Incoming:
    """Checks the messages of a viser server's clients.

    Args:
        server: viser's.
        drives: whether a client, by its number, has the controls.
    """

    def __init__(self, server: Any, drives: Callable[[int], bool]) -> None:
        self._server = server
        self._drives = drives
        connection = server._websock_server
        self._guard(connection, self._check_shared)
        connection.on_client_connect(lambda client: self._guard(client, lambda number, message: True))

    def _guard(self, connection: Any, check: Callable[[int, Any], bool]) -> None:
        """Let a connection handle only messages of the right form that pass a check of its own."""
        handle: Handler = connection._handle_incoming_message

        async def checked(client: int, message: Any) -> None:
            if is_well_formed(message) and check(client, message):
                await handle(client, message)

        connection._handle_incoming_message = checked

    def _check_shared(self, client: int, message: Any) -> bool:
        """Return whether a message may act on what all pages share."""
        if isinstance(message, _DRIVER_ONLY):
            return self._drives(client)
        if not isinstance(message, _messages.GuiUpdateMessage):
            return True  # these change nothing by themselves: `Widgets.on` knows who drives
        widget = self._server.gui._gui_input_handle_from_uuid.get(message.uuid)
        if widget is None:
            return True  # of one client alone
        if not self._drives(client):
            self._refuse_watcher(client, widget)
            return False
        return set(message.updates) == {"value"} and offers(widget, message.updates["value"])

    def _refuse_watcher(self, client: int, widget: Any) -> None:
        """Tell a watching page that it watches, and show it the value that is in force."""
        page = self._server.get_clients().get(client)
        if page is None:
            return
        page.add_notification(*NOT_DRIVING)
        if not widget._impl.is_button:
            in_force = _messages.GuiUpdateMessage(widget._impl.uuid, {"value": widget.value})
            page._websock_connection.queue_message(in_force)


def is_well_formed(message: Any) -> bool:
    """Return whether a message is one that a page sends, with finite numbers and fields of the right form."""
    form = _FORMS.get(type(message))
    if form is None or not _is_plain(vars(message)):
        return False
    return all(_has_form(getattr(message, name, None), kind) for name, kind in form.items())


def _has_form(value: Any, kind: Any) -> bool:
    """Return whether a value is of a type, a number, or of so many numbers."""
    if isinstance(kind, int):
        return isinstance(value, list | tuple) and len(value) == kind and all(map(_is_number, value))
    if kind is _NUMBER:
        return _is_number(value)
    return isinstance(value, kind)


def offers(widget: Any, value: Any) -> bool:
    """Return whether a widget of viser's can be set to a value on its page: of its type and within its limits."""
    state = widget._impl
    props = state.props
    if getattr(props, "disabled", False):
        return False
    options = getattr(props, "options", None)
    if options is not None:
        return isinstance(value, str) and value in options
    present = state.value
    if state.is_button or isinstance(present, bool):
        return isinstance(value, bool)
    if isinstance(present, str):
        return isinstance(value, str)
    low = getattr(props, "min", None)
    high = getattr(props, "max", None)
    if isinstance(present, tuple):
        count = len(present)
        lows = low or [None] * count
        highs = high or [None] * count
        return isinstance(value, list | tuple) and len(value) == count and all(map(_is_within, value, lows, highs))
    if isinstance(present, int):
        return _is_within(value, low, high) and float(value).is_integer()
    return _is_within(value, low, high)


def _is_within(value: Any, low: float | None, high: float | None) -> bool:
    """Return whether a value is a number within limits."""
    if not _is_number(value):
        return False
    return (low is None or value >= low) and (high is None or value <= high)


def _is_number(value: Any) -> bool:
    if isinstance(value, bool) or not isinstance(value, int | float):
        return False
    return math.isfinite(value) and abs(value) <= _LARGEST


def _is_plain(value: Any) -> bool:
    """Return whether all numbers within a value are finite, and nothing is too long."""
    if value is None or isinstance(value, bool):
        return True
    if isinstance(value, int | float):
        return _is_number(value)
    if isinstance(value, str):
        return len(value) <= _LONGEST
    if isinstance(value, dict):
        return _is_plain(list(value)) and _is_plain(list(value.values()))
    if isinstance(value, Sequence) and not isinstance(value, bytes):
        return len(value) <= _LONGEST and all(map(_is_plain, value))
    return False
