"""Who may open the page of a live session: whoever has its address."""

from __future__ import annotations

import contextlib
import ipaddress
import secrets
from collections.abc import Callable, Iterator
from http import HTTPStatus
from typing import Any, Final
from urllib.parse import parse_qs, urlsplit

from quadsim.features.live.look import ADMISSION

_HOW_TO_OPEN: Final = "Open the whole address that quadsim live printed, with ?token= and what follows."
LOOPBACK: Final = frozenset({"127.0.0.1", "localhost", "::1"})


class Guard:
    """Checks requests to a server that listens on a host; the address has to have its `token`.

    A browser lets any site connect to servers on the loopback interface, so that each request is checked: `Host`
    against names that a foreign site may have bound to this machine, `Origin` against pages of others, and a token,
    which stands in the address that is printed and is stored as a cookie.
    """

    def __init__(self, host: str) -> None:
        self._host, self.token = host, secrets.token_urlsafe(24)

    def refusal(self, headers: Any, path: str, port: int) -> str | None:
        """Return why a request with these headers, path and query, to this port, is refused, or None."""
        hosts, origins = _values(headers, "Host"), _values(headers, "Origin")
        if len(hosts) > 1 or len(origins) > 1:
            return "a header is there twice"
        host, origin = next(iter(hosts), ""), next(iter(origins), None)
        if not self._is_ours(host, port):
            return "this server goes by another name"
        if origin is not None and not self._is_ours(origin.partition("://")[2], port):
            return "a page of another site may not connect"
        # Other programs on this host set cookies too, whose form is theirs: only ours is looked at.
        cookies = [pair.strip().partition("=") for line in _values(headers, "Cookie") for pair in line.split(";")]
        tokens = [value for name, _, value in cookies if name == f"quadsim-{port}"]
        tokens += parse_qs(path.partition("?")[2]).get("token", [])
        if not any(secrets.compare_digest(token.encode(errors="replace"), self.token.encode()) for token in tokens):
            return "the token is missing, or another session's; where it was given, the browser keeps no cookie for it"
        return None

    @contextlib.contextmanager
    def installed(self, dress: Callable[[str], str]) -> Iterator[None]:
        """Make a server that viser starts in this block check its requests, and change its page."""
        from viser.infra import _infra

        library = _infra.websockets.asyncio.server
        serve = library.serve

        def guarded(*args: Any, process_request: Callable[[Any, Any], Any], **options: Any) -> Any:
            def check(connection: Any, request: Any) -> Any:
                port = connection.local_address[1]
                if refused := self.refusal(request.headers, request.path, port):
                    return connection.respond(HTTPStatus.FORBIDDEN, f"quadsim: {refused}. {_HOW_TO_OPEN}\n")
                if request.path == ADMISSION:
                    return connection.respond(HTTPStatus.OK, "")
                request.headers.pop("Accept-Encoding", None)  # the page is packed as it is
                response = process_request(connection, request)
                if response is None:  # a WebSocket
                    return None
                if response.headers.get("Content-Type", "").startswith("text/html"):
                    response.body = dress(response.body.decode()).encode()
                    del response.headers["Content-Length"]
                    response.headers["Content-Length"] = str(len(response.body))
                if "token" in parse_qs(request.path.partition("?")[2]):
                    cookie = f"quadsim-{port}={self.token}"  # its name has the port, which cookies ignore
                    response.headers["Set-Cookie"] = f"{cookie}; HttpOnly; SameSite=Strict; Path=/"
                return response

            return serve(*args, process_request=check, **options)

        library.serve = guarded
        try:
            yield
        finally:
            library.serve = serve

    def _is_ours(self, netloc: str, port: int) -> bool:
        """Whether `HOST:PORT` is this server."""
        try:
            parts = urlsplit(f"//{netloc}")
            host, its_port = parts.hostname or "", parts.port
        except ValueError:
            return False
        if its_port != port or host in LOOPBACK or host == self._host:
            return its_port == port
        with contextlib.suppress(ValueError):  # no site can be bound to the name of an address
            return self._host not in LOOPBACK and bool(ipaddress.ip_address(host))
        return False


def _values(headers: Any, name: str) -> list[str]:
    """Return every value of a header, of the library's headers or of a mapping."""
    if hasattr(headers, "get_all"):
        return list(headers.get_all(name))
    return [headers[name]] if name in headers else []
