"""A web server in a thread of its own: uvicorn, with limits for each client.

Kept libraries do the protocol: h11 reads HTTP/1.1, uvicorn serves it. Imported when a server begins
to listen, so that the command line does not wait for them.
"""

from __future__ import annotations

import asyncio
import logging
import socket
import threading
from collections.abc import Awaitable, Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from typing import Any, TypeAlias

from aquaflow.base.errors import InputError
from aquaflow.config.service import ListenConfig
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
            raise InputError(
                f"cannot listen on {config.host}:{config.port}: {error.strerror}; choose another "
                f"{key}.port"
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

        from aquaflow.web.connection import Connection, Connections

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
