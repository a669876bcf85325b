"""The service's own web server: GET /health, /metrics, /register_service and one small page."""

from __future__ import annotations

import json
import logging
import threading
from collections.abc import Callable
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

from aquaflow import __version__
from aquaflow.access import Access, path_of
from aquaflow.config.service import ListenConfig
from aquaflow.errors import InputError
from aquaflow.service.health.page import PAGE
from aquaflow.service.health.prometheus import TYPE, exposition

log = logging.getLogger(__name__)

PATIENCE_S = 10.0
"""A client that sends or takes nothing for so long is disconnected."""
MOST_CLIENTS = 16
"""Requests at a time; more are turned away, so that threads stay bounded."""

JSON, HTML = "application/json", "text/html; charset=utf-8"
"""Content types of the answers."""

NOT_ALLOWED = {"error": "give the token, or ask on board by the name localhost"}
"""Answer to a request without the token."""

REGISTRATION = {
    "name": "AquaFlow",
    "description": "Maps the sea floor while the vehicle swims: trajectory, 3D map, water.",
    "icon": "mdi-map-marker-path",
    "company": "AquaFlow",
    "version": __version__,
    "webpage": "/",
    "api": "/health",
}
"""What BlueOS asks for to list an extension."""


class HealthServer:
    """Answers requests in its own threads, with the object that ``report`` returns."""

    def __init__(self, config: ListenConfig, report: Callable[[], dict[str, Any]]) -> None:
        """Listen at once.

        Raises:
            InputError: the address is taken, or the token file cannot be read.
            ConfigError: the token will not do.
        """
        access = Access(config)
        try:
            self._server = _Server((config.host, config.port), _handler(access, report))
        except OSError as error:
            raise InputError(
                f"cannot listen on {config.host}:{config.port}: {error.strerror}; choose another "
                "service.health.port"
            ) from error
        self.port = int(self._server.server_address[1])
        self._thread = threading.Thread(
            target=self._server.serve_forever, name="health", daemon=True
        )
        self._thread.start()

    def close(self) -> None:
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()


class _Server(ThreadingHTTPServer):
    daemon_threads = True
    block_on_close = False

    def __init__(self, address: tuple[str, int], handler: type[BaseHTTPRequestHandler]) -> None:
        self._room = threading.BoundedSemaphore(MOST_CLIENTS)
        super().__init__(address, handler)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """A client that disconnects during an answer is no error of the service."""
        log.debug("a request failed", exc_info=True)

    def process_request(self, request: Any, client_address: Any) -> None:
        if not self._room.acquire(blocking=False):
            self.shutdown_request(request)
            return
        try:
            super().process_request(request, client_address)
        except BaseException:  # no thread was started that would give the room back
            self._room.release()
            raise

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        try:
            super().process_request_thread(request, client_address)
        except Exception as error:  # a thread's own traceback would go to the terminal
            log.warning("a request was not answered: %s", error)
        finally:
            self._room.release()


def _handler(access: Access, report: Callable[[], dict[str, Any]]) -> type[BaseHTTPRequestHandler]:
    class Handler(BaseHTTPRequestHandler):
        timeout = PATIENCE_S
        server_version, sys_version = "AquaFlow", ""

        def do_GET(self) -> None:
            headers = {name.lower(): value for name, value in self.headers.items()}
            path = path_of(self.path)
            # BlueOS asks without a token, and hears nothing that is not on the package's page.
            if path is None:
                self._answer(400, JSON, json.dumps({"error": "this is no address"}))
            elif path == "/register_service":
                self._answer(200, JSON, json.dumps(REGISTRATION))
            elif not access.allows(self.path, headers):
                self._answer(403, JSON, json.dumps(NOT_ALLOWED))
            elif path == "/health":
                self._answer(200, JSON, json.dumps(report(), default=str))
            elif path == "/metrics":
                self._answer(200, TYPE, exposition(report()))
            elif path == "/":
                self._answer(200, HTML, PAGE)
            else:
                self._answer(404, JSON, json.dumps({"error": "there is nothing here"}))

        def _answer(self, code: int, kind: str, text: str) -> None:
            data = text.encode()
            self.send_response(code)
            self.send_header("Content-Type", kind)
            self.send_header("Content-Length", str(len(data)))
            self.send_header("Cache-Control", "no-store")
            self.send_header("X-Content-Type-Options", "nosniff")
            if access.by_query(self.path):
                self.send_header("Set-Cookie", access.cookie())
            self.end_headers()
            self.wfile.write(data)

        def log_message(self, format: str, *args: Any) -> None:
            """Addresses may carry the token: nothing of a request goes to a log."""

    return Handler
