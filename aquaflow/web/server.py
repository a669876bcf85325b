"""A web server in a thread of its own: uvicorn, with limits for each client and connection.

Kept libraries do the protocol: h11 reads HTTP/1.1, uvicorn serves it. Imported when a server begins
to listen, so that the command line does not wait for them.
"""

from __future__ import annotations

import asyncio
import ipaddress
import logging
import socket
import threading
from collections import Counter
from collections.abc import Awaitable, Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from typing import Any, TypeAlias

import h11
from uvicorn.protocols.http.h11_impl import H11Protocol

from aquaflow.base.errors import InputError
from aquaflow.config.service import ListenConfig, is_loopback
from aquaflow.web.access import Access

log = logging.getLogger(__name__)

MOST_THREADS = 16
"""Answers that are made at a time; more wait."""
LARGEST_HEAD = 32_768
"""Bytes of a request's head: cookies of every service of a vehicle fit."""
CLOSING_S = 1
"""s that answers may still take when the server stops."""
BACKLOG = 128
"""Connections that the kernel holds until they are accepted."""
LARGEST_MESSAGE = 65_536
"""Bytes of a websocket's message from a client."""


@dataclass(frozen=True)
class HttpRequest:
    """What a client asks."""

    method: str
    """GET also for HEAD, whose answer is sent without its body."""
    target: str
    """Path and query, as the client wrote them."""
    headers: Mapping[str, str]
    """By lower-case name."""
    peer: str
    """Address that the connection comes from."""
    body: bytes | None = b""
    """None: longer than the server reads."""


@dataclass(frozen=True)
class HttpResponse:
    """What a client gets."""

    status: int
    kind: str
    """Content type."""
    body: bytes
    headers: Sequence[tuple[str, str]] = ()


Application: TypeAlias = Callable[[HttpRequest], HttpResponse]
"""Called in a thread of its own; may block."""
Watcher: TypeAlias = Callable[[HttpRequest, dict[str, Any], Any, Any], Awaitable[None]]
"""Serves one websocket in the server's thread: its request; scope, receive and send of ASGI."""


class WebServer:
    """Listens at one address until it is closed."""

    def __init__(
        self,
        config: ListenConfig,
        access: Access,
        answer: Application,
        key: str,
        most_bytes: int = 0,
        watcher: Watcher | None = None,
    ) -> None:
        """Listen at once.

        Args:
            access: tells who shows the token, for whom room is kept.
            key: of the port in the config, for the error.
            most_bytes: of a request's body.
            watcher: serves websockets, where there are some; needs the package websockets.

        Raises:
            InputError: nobody can listen at the address.
        """
        self._access, self._reply, self._most_bytes = access, answer, most_bytes
        self._watcher = watcher
        family = socket.AF_INET6 if ":" in config.host else socket.AF_INET
        try:
            self._socket = socket.create_server(
                (config.host, config.port), family=family, backlog=BACKLOG,
                dualstack_ipv6=family == socket.AF_INET6 and socket.has_dualstack_ipv6(),
            )  # fmt: skip
        except OSError as error:
            reason = str(error.strerror).partition(" (while")[0]  # the address once more
            raise InputError(
                f"cannot listen on {config.host}:{config.port}: {reason}; choose another port (in "
                f"a config {key}.port)"
            ) from error
        self.port = int(self._socket.getsockname()[1])
        self.loop = asyncio.new_event_loop()
        self.loop.set_exception_handler(_note)
        self._server = self._uvicorn()
        self._thread = threading.Thread(target=self._run, name=key, daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop listening, and let the clients go."""
        self._server.should_exit = True
        self._thread.join()

    def _uvicorn(self) -> Any:
        import uvicorn

        self._threads, self._connections = asyncio.Semaphore(MOST_THREADS), Connections()
        limited: Any = partial(Connection, self._connections)  # uvicorn calls it, as a class
        return uvicorn.Server(
            uvicorn.Config(
                self._serve,
                http=limited,
                lifespan="off",
                ws="none" if self._watcher is None else "websockets-sansio",
                ws_max_size=LARGEST_MESSAGE,
                ws_per_message_deflate=False,
                log_config=None,
                log_level="critical",  # addresses may carry the token
                access_log=False,
                proxy_headers=False,
                server_header=False,
                interface="asgi3",
                headers=[("Server", "AquaFlow")],
                backlog=BACKLOG,
                timeout_graceful_shutdown=CLOSING_S,
                h11_max_incomplete_event_size=LARGEST_HEAD,
            )
        )

    def _run(self) -> None:
        asyncio.set_event_loop(self.loop)
        try:
            self.loop.run_until_complete(self._server.serve(sockets=[self._socket]))
            self._connections.end()
            for task in (left := asyncio.all_tasks(self.loop)):
                task.cancel()
            self.loop.run_until_complete(asyncio.gather(*left, return_exceptions=True))
        except Exception:
            log.exception("a web server ended")
        finally:
            self._socket.close()
            self.loop.close()

    async def _serve(self, scope: dict[str, Any], receive: Any, send: Any) -> None:
        """The application, as ASGI calls it."""
        headers = _headers_by_name(scope["headers"])
        query = scope["query_string"].decode("latin-1")
        target = scope["raw_path"].decode("latin-1") + (f"?{query}" if query else "")
        peer = scope["client"][0] if scope["client"] else ""
        connection = scope["state"]["connection"]
        connection.known = connection.known or self._access.shows_token(target, headers)
        if scope["type"] == "websocket":
            assert self._watcher is not None
            await self._watcher(HttpRequest("GET", target, headers, peer), scope, receive, send)
            return
        ambiguous = "transfer-encoding" in headers and "content-length" in headers
        if ambiguous or not target.startswith("/"):
            await _send(send, HttpResponse(400, "text/plain", b"This is no request\n"), last=True)
            return
        method = "GET" if scope["method"] == "HEAD" else scope["method"]
        body = await _body(receive, self._most_bytes)
        if method not in ("GET", "POST"):
            answer = HttpResponse(
                405, "text/plain", b"GET, HEAD or POST\n", [("Allow", "GET, POST")]
            )
        else:
            answer = await self._in_thread(HttpRequest(method, target, headers, peer, body))
        await _send(send, answer, last=body is None)

    async def _in_thread(self, request: HttpRequest) -> HttpResponse:
        """The answer, made where it may block; of daemon threads, for which no exit waits."""
        async with self._threads:
            made: asyncio.Future[HttpResponse] = self.loop.create_future()

            def work() -> None:
                try:
                    answer = self._reply(request)
                except Exception:  # whatever a client asked for, the dive goes on
                    log.exception("a request could not be answered")
                    answer = HttpResponse(500, "text/plain", b"That failed; the log says why\n")
                with suppress(RuntimeError):  # the server has stopped meanwhile
                    self.loop.call_soon_threadsafe(_hand_over, made, answer)

            threading.Thread(target=work, name="web answer", daemon=True).start()
            return await made


def _hand_over(made: asyncio.Future[HttpResponse], answer: HttpResponse) -> None:
    if not made.done():
        made.set_result(answer)


def _headers_by_name(pairs: Iterable[tuple[bytes, bytes]]) -> dict[str, str]:
    """Headers by lower-case name; those that came twice are joined (RFC 9110, 5.3)."""
    named: dict[str, str] = {}
    for raw, value in pairs:
        name, text = raw.decode("latin-1").lower(), value.decode("latin-1")
        between = "; " if name == "cookie" else ", "
        named[name] = named[name] + between + text if name in named else text
    return named


async def _body(receive: Any, most: int) -> bytes | None:
    """What was sent with the request; None as soon as it is too long."""
    body = bytearray()
    while True:
        message = await receive()
        body += message.get("body", b"")
        if len(body) > most:
            return None
        if not message.get("more_body", False):
            return bytes(body)


async def _send(send: Any, answer: HttpResponse, last: bool) -> None:
    """``last``: the connection is closed behind it."""
    headers = [("Content-Type", answer.kind), *answer.headers]
    if answer.status != 304:
        headers.append(("Content-Length", str(len(answer.body))))
    if last:
        headers.append(("Connection", "close"))
    raw = [(name.encode("latin-1"), value.encode("latin-1")) for name, value in headers]
    await send({"type": "http.response.start", "status": answer.status, "headers": raw})
    await send({"type": "http.response.body", "body": answer.body})


def _note(_: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
    """A client that breaks off is no error of ours."""
    log.debug("a connection failed: %s", context.get("message"), exc_info=context.get("exception"))


# --------------------------------------------------------------------------------------------------
# A connection of uvicorn's, with limits: how many one client may hold, and for how long.
#
# HTTP is parsed by h11. What is added here stands against clients that hold connections without
# using them (slow heads, bodies and readers: "Slowloris"). A newcomer is not refused where there is
# no room: the oldest connection that waits for its client goes. An ordinary request is complete as
# it comes, so that a client that does the same with sixty sockets displaces its own.

REQUEST_S = 10.0
"""s within which a whole request, head and body, must have come."""
ANSWER_S, SLOWEST_BYTES_S = 10.0, 16_384
"""s within which an answer must be taken, and bytes/s of a long one: far below a tether's."""
MOST, MOST_STRANGERS, MOST_OF_ADDRESS = 64, 48, 16
"""Connections of one server: of all; of those neither from this machine nor with the token; and
of these, from one address. A browser opens six."""
MOMENT_S, MOST_FOR_A_MOMENT = 1.0, 256
"""s in which a newcomer may send its request before anybody is displaced, and how many may be there
in them: who connects anew as fast as it is cut off displaces nobody that has just come."""


class Connections:
    """Who is connected to one server, and whom a newcomer displaces."""

    def __init__(self) -> None:
        self._here: set[Connection] = set()

    def admit(self, newcomer: Connection) -> None:
        """Take it in; where a group is too large after a moment, its oldest goes."""
        self._here.add(newcomer)
        newcomer.loop.call_later(MOMENT_S, self._trim)
        if len(self._here) > MOST_FOR_A_MOMENT:
            self._trim()

    def leave(self, connection: Connection) -> None:
        """It was closed, or is no longer one of HTTP."""
        self._here.discard(connection)

    def end(self) -> None:
        """The server stops: nobody is waited for."""
        for each in self._here:
            each.transport.abort()

    def _trim(self) -> None:
        while group := self._too_large():
            oldest = min(group, key=lambda each: (each.answering, each.since))
            self.leave(oldest)
            oldest.transport.abort()

    def _too_large(self) -> list[Connection]:
        known = [each for each in self._here if each.known]
        others = [each for each in self._here if not each.known]
        for address, count in Counter(each.address for each in others).items():
            if count > MOST_OF_ADDRESS:
                return [each for each in others if each.address == address]
        if len(others) > MOST_STRANGERS:
            return others
        return known if len(self._here) > MOST else []


class Connection(H11Protocol):
    """One connection; ``known`` where it comes from this machine or has shown the token."""

    def __init__(self, connections: Connections, *args: Any, **named: Any) -> None:
        """``args`` and ``named``: what uvicorn hands over."""
        super().__init__(*args, **named)
        self.app_state = {**self.app_state, "connection": self}
        self._others = connections
        self._request_timer: asyncio.TimerHandle | None = None
        self._answer_timer: asyncio.TimerHandle | None = None
        self._heard = False
        self.known, self.address, self.since = False, "", 0.0

    @property
    def answering(self) -> bool:
        """True from the end of a request's head to the end of its answer."""
        return self.cycle is not None and not self.cycle.response_complete

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Admit the client, which displaces another where there is no room."""
        super().connection_made(transport)
        transport.set_write_buffer_limits(high=0)  # told whenever something waits to be taken
        peer = self.client[0] if self.client else ""
        self.address, self.known = group_of(peer), is_loopback(peer)
        self._await_request()
        self._others.admit(self)

    def connection_lost(self, exc: Exception | None) -> None:
        """Give the room back."""
        self._others.leave(self)
        self._forget_timers()
        super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        """The time for a request begins with its first byte, and ends with its last."""
        if not self._heard:
            self._heard = True
            self._await_request()
        super().data_received(data)
        self._look()

    def eof_received(self) -> bool:  # type: ignore[override]
        """A client that has said all it will still gets its answer."""
        return self.answering

    def on_response_complete(self) -> None:
        """The next request may begin; what came of it already counts."""
        self._heard = False
        super().on_response_complete()
        self._await_request()
        self._look()

    def pause_writing(self) -> None:
        """Something waits for the client to take it."""
        super().pause_writing()
        seconds = ANSWER_S + self.transport.get_write_buffer_size() / SLOWEST_BYTES_S
        self._answer_timer = self.loop.call_later(seconds, self.transport.abort)

    def resume_writing(self) -> None:
        """All was taken."""
        super().resume_writing()
        if self._answer_timer is not None:
            self._answer_timer.cancel()

    def handle_websocket_upgrade(self, event: h11.Request) -> None:
        """From here on another protocol has the connection, and the application its limits."""
        self._others.leave(self)
        self._forget_timers()
        super().handle_websocket_upgrade(event)

    def _await_request(self) -> None:
        self.since = self.loop.time()
        if self._request_timer is not None:
            self._request_timer.cancel()
        self._request_timer = self.loop.call_later(REQUEST_S, self.transport.abort)

    def _look(self) -> None:
        """No time is set while a whole request waits for us."""
        waits = self.conn.their_state in (h11.IDLE, h11.SEND_BODY)
        if not waits and self._request_timer is not None:
            self._request_timer.cancel()

    def _forget_timers(self) -> None:
        for timer in (self._request_timer, self._answer_timer):
            if timer is not None:
                timer.cancel()


def group_of(peer: str) -> str:
    """What counts as one address: of IPv6 its first 64 bits, as one host may have all the rest."""
    try:
        address = ipaddress.ip_address(peer)
    except ValueError:
        return peer
    if isinstance(address, ipaddress.IPv4Address):
        return peer
    if address.ipv4_mapped is not None:
        return str(address.ipv4_mapped)
    return str(ipaddress.ip_network((int(address), 64), strict=False))
