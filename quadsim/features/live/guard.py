"""Who may open the page of a live session: whoever has its address.

Viser has no hook for this, and a second server in front of it would leave its own port open to every page that finds
it.  So the guard stands where viser's server is made, in the function `serve` of the public module
`websockets.asyncio.server`, which checks each request before viser sees it.  A viser that makes its server in another
way would be unguarded: `RequestGuard.require_closed` therefore tests it, with requests without the token, before
anything is shown.
"""

from __future__ import annotations

import contextlib
import ipaddress
import secrets
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from http import HTTPStatus
from http.client import HTTPConnection, HTTPException
from typing import Any, Final
from urllib.parse import parse_qs, urlsplit

from quadsim.errors import InputError
from quadsim.features.live.look import ADMISSION

_HOW_TO_OPEN: Final = "Open the whole address that quadsim live printed, with ?token= and what follows."
_UPGRADE: Final = {
    "Connection": "Upgrade",
    "Upgrade": "websocket",
    "Sec-WebSocket-Version": "13",
    "Sec-WebSocket-Key": "AAAAAAAAAAAAAAAAAAAAAA==",
}
"""What makes of a request one for a WebSocket."""
_ANSWER_TIME: Final = 10.0  # [s] for an answer of this process
LOOPBACK: Final = frozenset({"127.0.0.1", "localhost", "::1"})


class RequestGuard:
    """Checks requests to a server that listens on a host; the address has to have its `token`.

    A browser lets any site connect to servers on the loopback interface, so that each request is checked: `Host`
    against names that a foreign site may have bound to this machine, `Origin` against pages of others, and a token,
    which stands in the address that is printed and is stored as a cookie.
    """

    def __init__(self, host: str) -> None:
        self._host = host
        self.token = secrets.token_urlsafe(24)

    def refusal(self, headers: Any, path: str, port: int) -> str | None:
        """Return why a request with these headers, path and query, to this port, is refused, or None."""
        hosts = _values(headers, "Host")
        origins = _values(headers, "Origin")
        if len(hosts) > 1 or len(origins) > 1:
            return "a header is there twice"
        if not hosts or not self._is_ours(hosts[0], port):
            return "this server goes by another name"
        if origins and not self._is_ours(origins[0].partition("://")[2], port):
            return "a page of another site may not connect"
        tokens = _cookies(headers, f"quadsim-{port}") + _tokens(path)
        if not any(secrets.compare_digest(token.encode(errors="replace"), self.token.encode()) for token in tokens):
            return "the token is missing, or another session's; where it was given, the browser keeps no cookie for it"
        return None

    @contextlib.contextmanager
    def installed(self, adapt: Callable[[str], str]) -> Iterator[None]:
        """Make a server of `websockets` that is started in this block check its requests, and change its page."""
        import websockets.asyncio.server  # of the extra `live`, as viser

        library: Any = websockets.asyncio.server
        serve = library.serve

        def guarded(*args: Any, process_request: Callable[[Any, Any], Any], **options: Any) -> Any:
            check = partial(self._answer, process_request, adapt)
            return serve(*args, process_request=check, **options)

        library.serve = guarded
        try:
            yield
        finally:
            library.serve = serve

    def _answer(
        self, process_request: Callable[[Any, Any], Any], adapt: Callable[[str], str], connection: Any, request: Any
    ) -> Any:
        """Return the response to a request: a refusal, or that of the server, its page adapted; None: a WebSocket."""
        port = connection.local_address[1]
        refusal = self.refusal(request.headers, request.path, port)
        if refusal:
            return connection.respond(HTTPStatus.FORBIDDEN, f"quadsim: {refusal}. {_HOW_TO_OPEN}\n")
        if request.path == ADMISSION:
            return connection.respond(HTTPStatus.OK, "")
        request.headers.pop("Accept-Encoding", None)  # the page is packed as it is
        response = process_request(connection, request)
        if response is None:
            return None
        if response.headers.get("Content-Type", "").startswith("text/html"):
            response.body = adapt(response.body.decode()).encode()
            del response.headers["Content-Length"]
            response.headers["Content-Length"] = str(len(response.body))
        if _tokens(request.path):
            cookie = f"quadsim-{port}={self.token}"  # its name has the port, which cookies ignore
            response.headers["Set-Cookie"] = f"{cookie}; HttpOnly; SameSite=Strict; Path=/"
        return response

    def require_closed(self, port: int) -> None:
        """Request the page and a WebSocket of the server on this port without the token, which it has to refuse.

        Raises:
            InputError: it does not refuse both, so that anyone who finds the port could fly.
        """
        address = {"0.0.0.0": "127.0.0.1", "::": "::1"}.get(self._host, self._host)
        of_page = _status(address, port, {})
        of_websocket = _status(address, port, _UPGRADE)
        if of_page != HTTPStatus.FORBIDDEN or of_websocket != HTTPStatus.FORBIDDEN:
            raise InputError(
                "quadsim live needs a viser whose server can be guarded: without the token, this one answers "
                f"{of_page or 'nothing'} and {of_websocket or 'nothing'} in place of {HTTPStatus.FORBIDDEN:d}; "
                "install another version of viser or websockets"
            )

    def _is_ours(self, netloc: str, port: int) -> bool:
        """Whether `HOST:PORT` is this server."""
        try:
            parts = urlsplit(f"//{netloc}")
            host = parts.hostname or ""
            its_port = parts.port
        except ValueError:
            return False
        if its_port != port:
            return False
        if host in LOOPBACK or host == self._host:
            return True
        with contextlib.suppress(ValueError):  # no site can be bound to the name of an address
            return self._host not in LOOPBACK and bool(ipaddress.ip_address(host))
        return False


def _values(headers: Any, name: str) -> list[str]:
    """Return every value of a header, of the library's headers or of a mapping."""
    if hasattr(headers, "get_all"):
        return list(headers.get_all(name))
    if name in headers:
        return [headers[name]]
    return []


def _cookies(headers: Any, wanted: str) -> list[str]:
    """Return the values of a cookie; other programs on this host set cookies too, in any form."""
    values = []
    for line in _values(headers, "Cookie"):
        for pair in line.split(";"):
            name, _, value = pair.strip().partition("=")
            if name == wanted:
                values.append(value)
    return values


def _tokens(path: str) -> list[str]:
    """Return the tokens in the query of a path."""
    query = path.partition("?")[2]
    return parse_qs(query).get("token", [])


def _status(address: str, port: int, headers: Mapping[str, str]) -> int | None:
    """Return how the server at an address answers a request for its page, or None without an answer."""
    connection = HTTPConnection(address, port, timeout=_ANSWER_TIME)
    try:
        connection.request("GET", "/", headers=headers)
        return connection.getresponse().status
    except (OSError, HTTPException):
        return None
    finally:
        connection.close()
