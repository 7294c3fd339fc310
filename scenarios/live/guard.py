"""Access to a session's page: with its address, from this machine, in a page that it served itself.

A browser lets any site connect to servers on the loopback interface, so that each request is checked: `Host` against
names that a foreign site may have bound to this machine, `Origin` against pages of others, and a token, which stands in
the address that is printed and is stored as a cookie.
"""

from __future__ import annotations

import contextlib
import ipaddress
import secrets
from collections.abc import Iterator
from http import HTTPStatus
from http.cookies import CookieError, SimpleCookie
from typing import Any, Final
from urllib.parse import parse_qs, urlsplit

LOOPBACK: Final = frozenset({"127.0.0.1", "localhost", "::1"})


class Guard:
    """Checks requests to a server that listens on a host; the address has to have its `token`."""

    def __init__(self, host: str) -> None:
        self._host, self.token = host, secrets.token_urlsafe(24)

    def refusal(self, headers: Any, path: str, port: int) -> str | None:
        """Why a request with these headers, this path and query, to this port, is refused; None where it is let in."""
        try:
            host, origin = headers.get("Host", ""), headers.get("Origin")
        except LookupError:  # of the library's headers, where one is there twice
            return "a header is there twice"
        if not self._is_ours(host, port):
            return "this server goes by another name"
        if origin is not None and not self._is_ours(origin.partition("://")[2], port):
            return "a page of another site may not connect"
        given = parse_qs(path.partition("?")[2]).get("token", [])
        with contextlib.suppress(CookieError, LookupError):
            given.append(SimpleCookie(headers.get("Cookie", ""))[f"quadsim-{port}"].value)
        if not any(secrets.compare_digest(each.encode(), self.token.encode()) for each in given):
            return "open the address that quadsim live printed: it has a token"
        return None

    def cookie(self, port: int) -> str:
        """The header that keeps the token in the browser; cookies ignore ports, hence its name."""
        return f"quadsim-{port}={self.token}; HttpOnly; SameSite=Strict; Path=/"

    @contextlib.contextmanager
    def installed(self) -> Iterator[None]:
        """Have the server that viser starts meanwhile check its requests."""
        from viser.infra import _infra

        library = _infra.websockets.asyncio.server
        serve = library.serve

        def guarded(*args: Any, process_request: Any = None, **options: Any) -> Any:
            def check(connection: Any, request: Any) -> Any:
                port = connection.local_address[1]
                refused = self.refusal(request.headers, request.path, port)
                if refused is not None:
                    return connection.respond(HTTPStatus.FORBIDDEN, f"quadsim: {refused}\n")
                response = None if process_request is None else process_request(connection, request)
                if response is not None and "token" in parse_qs(request.path.partition("?")[2]):
                    response.headers["Set-Cookie"] = self.cookie(port)
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
            host, given = parts.hostname or "", parts.port
        except ValueError:
            return False
        if given != port or host in LOOPBACK or host == self._host:
            return given == port
        with contextlib.suppress(ValueError):  # no site can be bound to the name of an address
            return self._host not in LOOPBACK and bool(ipaddress.ip_address(host))
        return False
