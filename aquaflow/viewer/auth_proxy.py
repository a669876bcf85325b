"""Token-checking TCP proxy for viser, which has no authentication.

A connection is let through when its first request may be answered (:mod:`aquaflow.access`); from
then on bytes go both ways, web socket included. The server itself is bound to loopback.
"""

from __future__ import annotations

import contextlib
import logging
import socket
import threading

from aquaflow.access import Access, path_of
from aquaflow.config.viewer import ViewerConfig
from aquaflow.errors import InputError

log = logging.getLogger(__name__)

PATIENCE_S = 10.0
"""A client that sends no request for so long is disconnected."""
LONGEST_HEAD = 16_384
"""Bytes of a request until its empty line."""
MOST_CONNECTIONS = 64
"""Open at a time; a browser opens six."""
BYTES = 65_536
"""Read at a time."""

CLOSING = b"Connection: close\r\n\r\n"
"""Headers of an answer after which the connection ends."""
REFUSED = b"HTTP/1.1 403 Forbidden\r\nContent-Length: 15\r\n" + CLOSING + b"Give the token\n"
"""Answer to a request without the token."""


class AuthProxy:
    """Listens at the configured address and forwards connections to ``port`` on this machine."""

    def __init__(self, config: ViewerConfig, port: int) -> None:
        """Listen at once.

        Raises:
            InputError: the address is taken, or the token file cannot be read.
            ConfigError: the token will not do.
        """
        self._access, self._inside = Access(config), port
        family = socket.AF_INET6 if ":" in config.host else socket.AF_INET
        try:
            self._listening = socket.create_server((config.host, config.port), family=family)
        except OSError as error:
            raise InputError(
                f"cannot listen on {config.host}:{config.port}: {error.strerror}; choose another "
                "viewer.port"
            ) from error
        self.port = int(self._listening.getsockname()[1])
        self._room = threading.BoundedSemaphore(MOST_CONNECTIONS)
        self._closing = False
        self._thread = threading.Thread(target=self._run, name="viewer proxy", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop listening."""
        self._closing = True
        with contextlib.suppress(OSError):
            self._listening.shutdown(socket.SHUT_RDWR)
        self._listening.close()
        self._thread.join(PATIENCE_S)

    def _run(self) -> None:
        while not self._closing:
            try:
                client, _ = self._listening.accept()
            except OSError:
                return
            if self._room.acquire(blocking=False):
                threading.Thread(target=self._serve, args=(client,), daemon=True).start()
            else:
                client.close()

    def _serve(self, client: socket.socket) -> None:
        try:
            with client:
                client.settimeout(PATIENCE_S)
                self._forward(client)
        except OSError:
            log.debug("a viewer's connection ended", exc_info=True)
        finally:
            self._room.release()

    def _forward(self, client: socket.socket) -> None:
        request = _head(client)
        target, headers = _parsed(request)
        if not self._access.allows(target, headers, client.getpeername()[0]):
            client.sendall(REFUSED)
            return
        if self._access.by_query(target):  # into a cookie, and out of the address bar
            head = f"Location: {_path(target)}\r\nSet-Cookie: {self._access.cookie()}\r\n"
            see_other = b"HTTP/1.1 303 See Other\r\nContent-Length: 0\r\n"
            client.sendall(see_other + head.encode() + CLOSING)
            return
        with socket.create_connection(("127.0.0.1", self._inside), PATIENCE_S) as inside:
            for each in (client, inside):
                each.settimeout(None)
            inside.sendall(request)
            back = threading.Thread(target=_copy_bytes, args=(inside, client), daemon=True)
            back.start()
            _copy_bytes(client, inside)
            back.join()


def _head(client: socket.socket) -> bytes:
    """What came until the end of the request's head."""
    data = b""
    while b"\r\n\r\n" not in data and len(data) < LONGEST_HEAD:
        more = client.recv(BYTES)
        if not more:
            break
        data += more
    return data


def _parsed(request: bytes) -> tuple[str, dict[str, str]]:
    """Target and headers, by lower-case name."""
    lines = request.partition(b"\r\n\r\n")[0].decode("latin-1").split("\r\n")
    parts = lines[0].split(" ")
    pairs = (line.partition(":") for line in lines[1:])
    return parts[1] if len(parts) > 1 else "", {n.strip().lower(): v.strip() for n, _, v in pairs}


def _path(target: str) -> str:
    """Where a browser is sent back to: on this server, and without what ends a header."""
    path = path_of(target) or "/"
    safe = path.startswith("/") and not path.startswith("//") and path.isprintable()
    return path if safe else "/"


def _copy_bytes(source: socket.socket, sink: socket.socket) -> None:
    """Bytes from one to the other until either ends; then both do."""
    with contextlib.suppress(OSError):
        while data := source.recv(BYTES):
            sink.sendall(data)
    for each in (source, sink):
        with contextlib.suppress(OSError):
            each.shutdown(socket.SHUT_RDWR)
