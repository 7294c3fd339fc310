"""A live session from start to saved flight, with a page in a browser or a script.

`Pace` has the only clock of a session; `Guard` lets in who has its address.
"""

from __future__ import annotations

import contextlib
import errno
import ipaddress
import secrets
import socket
import sys
import threading
import time as clock
import webbrowser
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import replace
from http import HTTPStatus
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Final
from urllib.parse import parse_qs, urlsplit

from quadsim.controller import law_name
from quadsim.errors import MissingPackageError, ParameterError, QuadsimError
from scenarios import console
from scenarios.catalogue import scenario_names
from scenarios.flight import Flight, run_directory
from scenarios.live.look import ADMISSION
from scenarios.live.session import Frame, Session, read_script
from scenarios.loading import load_scenario
from scenarios.progress import reporting
from scenarios.results import EXIT_DONE, EXIT_FAILED, Document
from scenarios.schema.controllers import AnyController
from scenarios.schema.scenario import Scenario

LATE: Final = 0.25  # [s] beyond which lost time is given up: no period is dropped, the flight is behind real time
POSES: Final = 2  # drawn in each period
_IDLE: Final = 0.02  # [s] between looks for orders while nothing is flown
_HOW_TO_OPEN: Final = "Open the whole address that quadsim live printed, with ?token= and what follows."
LOOPBACK: Final = frozenset({"127.0.0.1", "localhost", "::1"})


class Pace:
    """Pause, single periods, speed; set from any thread, read between periods.

    Attributes:
        speed: simulated over real time that is aimed at.
        paused: whether only single periods are flown.
        waiting: whether it is paused until somebody looks.
        single: flies one period while paused.
        stop: ends the session after this period.
        order: calls a function of the session between two periods, in the flying thread.
    """

    def __init__(self, now: Callable[[], float] = clock.monotonic, *, waiting: bool = False) -> None:
        self._now, self._stop, self._single = now, threading.Event(), threading.Semaphore(0)
        self._orders: deque[Callable[[Session], None]] = deque()
        self.speed, self.paused, self.waiting = 1.0, waiting, waiting
        self.single, self.stop, self.order = self._single.release, self._stop.set, self._orders.append

    def drive(self, session: Session, view: Any, until: Callable[[Frame], bool] = lambda frame: False) -> None:
        """Fly until `stop` or the last frame, shown by a `Page`; a flight that ended waits for a reset."""
        due, recent = self._now(), deque[float](maxlen=round(2.0 / session.period) + 1)  # two seconds
        while not self._stop.is_set():
            while self._orders:
                self._orders.popleft()(session)
            if session.reason is not None or (self.paused and not self._single.acquire(blocking=False)):
                self._stop.wait(_IDLE)
                due = self._now()
                recent.clear()
                continue
            try:
                frame = session.advance()
            except QuadsimError as error:
                session.reason = str(error)
                view.ended(session.reason)
                continue
            recent.append(self._now())
            span = recent[-1] - recent[0]
            view.show(frame, (len(recent) - 1) * session.period / span if span > 0.0 else self.speed)
            for share in range(1, POSES + 1):
                view.pose(frame, share / POSES)
                due += session.period / self.speed / POSES
                if (late := self._now() - due) > LATE:
                    due += late
                self._stop.wait(max(0.0, -late))
            if session.reason is not None:
                view.ended(session.reason)
            if until(frame):
                return


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


def fly_live(
    scenario: Scenario,
    against: AnyController | None,
    script: str | Path | None,
    *,
    onward: bool,
    out: str | Path | None,
    overwrite: bool,
    video: bool,
    **place: Any,
) -> Document:
    """Fly a session and save it, whatever ended it; `onward`: from where the scenario, a finished run's, ended.

    The other arguments are those of `scenarios.live.commands.live`; `place` is the port, the host and the browser.
    """
    inputs = None if script is None else read_script(script)
    if inputs is None:
        _require_server(place["host"], place["port"])
    with (
        run_directory(f"{scenario.name}-live", out, overwrite=overwrite) as directory,
        closing(Session(scenario, against)) as session,
    ):
        replaced, refused, one = overwrite, list[str](), threading.Lock()

        def save(flight: Flight) -> str:
            nonlocal replaced
            with one, reporting(True) as report:  # one at a time
                flight.save(directory, overwrite=replaced, video=video, progress=report)
                replaced = True  # the next time it is this session's own
            return console.short_path(directory)

        try:
            while onward and session.reason is None and session.k < scenario.periods:
                session.advance()
            if inputs is None:
                _serve(session, save, **place)
            else:
                with reporting(True) as report:
                    refused = session.play(inputs, report)
                for reason in refused:
                    console.show(f"quadsim: refused: {script}: {reason}".split("\n"), console.stderr())
        except KeyboardInterrupt:  # what was flown is saved
            print(file=sys.stderr)
        text, seconds = "", session.k * session.period
        if session.k:
            flight = session.flight()
            save(flight)
            flight = replace(flight, directory=directory)
            text = "".join(f"{line}\n" for line in (next(iter(flight.shown())), *flight.outputs()))
        status = EXIT_DONE if session.reason is None and not refused else EXIT_FAILED
        facts = {"directory": str(directory), "duration": seconds, "reason": session.reason, "refused": refused}
        return Document(text, facts, status)


def _require_server(host: str, port: int) -> None:
    """Refuse before the flight if the page cannot be served."""
    if find_spec("viser") is None:
        raise MissingPackageError("quadsim live", "viser", extra="live")
    if not 0 <= port <= 65535:
        raise ParameterError("", "--port", port, "from 1 to 65535, or 0 for any that is free")
    try:
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        socket.create_server((host or "?", port), family=family).close()
    except (OSError, UnicodeError) as error:
        if getattr(error, "errno", None) in (errno.EADDRINUSE, errno.EACCES):
            raise ParameterError("", "--port", port, "a port that is free") from error
        raise ParameterError("", "--host", host, "an address of this machine") from error


def _serve(session: Session, save: Callable[[Flight], str], *, host: str, port: int, browser: bool) -> None:
    """Show the page and fly until Ctrl-C; controllers of the library for the same vehicle and period may take over."""
    from scenarios.live.page import Page

    if host not in LOOPBACK:
        console.say(
            f"listening on {host}: anyone on that network with the address below can fly this session; "
            "the connection is not encrypted"
        )
    scenario, others = session.scenario, dict[str, AnyController]()
    for name in scenario_names():
        other = load_scenario(name)
        same = (other.vehicle, other.control_period) == (scenario.vehicle, scenario.control_period)
        if same and other.controller not in [*others.values(), scenario.controller]:
            others[f"{name} ({law_name(other.controller.type)})"] = other.controller
    pace = Pace(waiting=True)
    with closing(Page(session, pace, save=save, host=host, port=port, others=others)) as page:
        print(f"Open {page.address}  (Ctrl-C ends the session and saves it)", flush=True)
        if browser:
            webbrowser.open(page.address)
        pace.drive(session, page)
