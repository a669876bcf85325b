"""The viewer's web server. Each browser has threads of its own, which nobody waits for.

Every request is let in by :mod:`aquaflow.web.access`, and only our own page may change anything.
"""

from __future__ import annotations

import json
import logging
import threading
from collections.abc import Callable, Sequence
from functools import partial
from http.server import BaseHTTPRequestHandler
from typing import Any, TypeAlias

from aquaflow.base.errors import InputError
from aquaflow.config.viewer import ViewerConfig
from aquaflow.survey.viewer.client import ClientFile, client_file
from aquaflow.survey.viewer.exhibit import Exhibit
from aquaflow.web.access import Access, path_of
from aquaflow.web.bounded_server import BoundedServer

log = logging.getLogger(__name__)

PATIENCE_S = 10.0
"""A browser that sends or takes nothing for so long is disconnected; its page connects again."""
MOST_CONNECTIONS = 64
"""Open at a time; a browser opens six."""
MOST_BYTES = 65_536
"""Of a request's body: a measurement of a thousand points."""

JSON, BINARY, JPEG, TEXT = (
    *("application/json", "application/octet-stream", "image/jpeg", "text/plain; charset=utf-8"),
)
NO_STORE, FOR_EVER, ASK_FIRST = (
    "no-store",
    "private, max-age=31536000, immutable",
    "private, no-cache",
)
"""Of what changes; of a chunk, whose address names its content; of the page's files (RFC 9111)."""
POLICY = (
    "default-src 'none'; script-src 'self'; worker-src 'self'; style-src 'self'; "
    "img-src 'self' data: blob:; connect-src 'self'; form-action 'none'; base-uri 'none'"
)
"""What the page may load (Content Security Policy, Level 3): its own files."""

GZIPPED = ("Content-Encoding", "gzip")
Headers: TypeAlias = Sequence[tuple[str, str]]
Answer: TypeAlias = Callable[[str, dict[str, Any]], dict[str, Any]]
"""What a tool says to a request by its name and its JSON object; raises InputError."""


class ViewerServer:
    """Serves an exhibit and its tools at the configured address."""

    def __init__(self, config: ViewerConfig, exhibit: Exhibit, ask: Answer) -> None:
        """Listen at once.

        Raises:
            InputError: the address is taken, or the token file cannot be read.
            ConfigError: the token will not do.
        """
        access = Access(config)
        handler = partial(_Handler, access, exhibit, ask)
        try:
            self._server = BoundedServer((config.host, config.port), handler, MOST_CONNECTIONS)
        except OSError as error:
            raise InputError(
                f"cannot listen on {config.host}:{config.port}: {error.strerror}; choose another "
                "viewer.port"
            ) from error
        self.port = int(self._server.server_address[1])
        self._thread = threading.Thread(
            target=self._server.serve_forever, args=(0.1,), name="viewer server", daemon=True
        )
        self._thread.start()

    def close(self) -> None:
        """Stop listening."""
        self._server.shutdown()
        self._server.server_close()
        self._thread.join(PATIENCE_S)


class _Handler(BaseHTTPRequestHandler):
    """One browser's connection."""

    protocol_version = "HTTP/1.1"  # one connection for all chunks
    timeout = PATIENCE_S
    server_version, sys_version = "AquaFlow", ""
    disable_nagle_algorithm = True

    def __init__(self, access: Access, exhibit: Exhibit, ask: Answer, *request: Any) -> None:
        """``request``: what the web server hands over."""
        self._access, self._exhibit, self._ask = access, exhibit, ask
        super().__init__(*request)

    def do_GET(self) -> None:
        path = path_of(self.path) or ""
        if not self._access.allows(self.path, self._named(), self.client_address[0]):
            self._answer(403, TEXT, b"Give the token\n")
        elif self._access.by_query(self.path):  # into a cookie, and out of the address bar
            to = [("Location", _own(path)), ("Set-Cookie", self._access.cookie())]
            self._answer(303, TEXT, b"", to)
        elif (file := client_file(path)) is not None:
            self._send_file(file)
        elif path == "/scene.json":
            self._say(200, self._exhibit.scene())
        elif not self._send_data(path.split("/")[1:]):
            self._say(404, {"error": "there is nothing here"})

    def do_POST(self) -> None:
        """A tool: its name is the path, its arguments the JSON object in the body."""
        given = self._given()
        if not self._access.may_change(self._named(), self.client_address[0]):
            self._say(403, {"error": "open the viewer with its token, and ask from its page"})
        elif given is None:
            self._say(400, {"error": "this is no request of the viewer's page"})
        else:
            self._ask_tool((path_of(self.path) or "").lstrip("/"), given)

    def _ask_tool(self, name: str, given: dict[str, Any]) -> None:
        try:
            self._say(200, self._ask(name, given))
        except InputError as error:
            self._say(422, {"error": str(error)})
        except Exception:  # whatever a browser asked for, the dive goes on
            log.exception("the viewer could not answer a request")
            self._say(500, {"error": "that failed; the log of the viewer says why"})

    def _send_file(self, file: ClientFile) -> None:
        headers = [("ETag", file.tag)]
        if self.headers.get("If-None-Match") == file.tag:
            self._answer(304, file.kind, b"", headers, ASK_FIRST)
        else:
            self._answer(200, file.kind, file.packed, [*headers, GZIPPED], ASK_FIRST)

    def _send_data(self, parts: list[str]) -> bool:
        """False if there is nothing by this name."""
        name, rest = parts[0], parts[1:]
        if name == "map" and len(rest) == 2 and _is_number(rest[1]):
            packed = self._exhibit.chunk(rest[0], int(rest[1]))
            return self._send(BINARY, packed, [GZIPPED], FOR_EVER)
        if name == "path" and len(rest) == 1:
            return self._send(BINARY, self._exhibit.path.astype("<f4").tobytes())
        if name == "picture" and rest == ["newest"]:
            return self._send(JPEG, self._exhibit.newest_picture())
        if name == "picture" and len(rest) == 1 and _is_number(rest[0]):
            return self._send(JPEG, self._exhibit.picture(int(rest[0])), (), ASK_FIRST)
        return False

    def _send(
        self, kind: str, data: bytes | None, headers: Headers = (), keep: str = NO_STORE
    ) -> bool:
        """False if there is none."""
        if data is not None:
            self._answer(200, kind, data, headers, keep)
        return data is not None

    def _named(self) -> dict[str, str]:
        return {name.lower(): value for name, value in self.headers.items()}

    def _given(self) -> dict[str, Any] | None:
        """The JSON object that was posted; None for anything else. What is too long is not read."""
        length = self.headers.get("Content-Length", "0")
        if not _is_number(length) or int(length) > MOST_BYTES:
            self.close_connection = True
            return None
        try:
            given = json.loads(self.rfile.read(int(length)))
        except (ValueError, RecursionError):
            return None
        return given if isinstance(given, dict) else None

    def _say(self, code: int, said: dict[str, Any]) -> None:
        self._answer(code, JSON, json.dumps(said).encode())

    def _answer(
        self, code: int, kind: str, data: bytes, headers: Headers = (), keep: str = NO_STORE
    ) -> None:
        self.send_response(code)
        always = (
            ("Content-Type", kind), ("Cache-Control", keep),
            ("Content-Security-Policy", POLICY), ("X-Content-Type-Options", "nosniff"),
            ("Referrer-Policy", "no-referrer"), ("Cross-Origin-Resource-Policy", "same-origin"),
        )  # fmt: skip
        for name, value in [*always, *headers]:
            self.send_header(name, value)
        if code != 304:
            self.send_header("Content-Length", str(len(data)))
        self.end_headers()
        self.wfile.write(data)

    def log_message(self, format: str, *args: Any) -> None:
        """Addresses may carry the token: nothing of a request goes to a log."""


def _own(path: str) -> str:
    """Where a browser is sent back to: on this server, and without what ends a header."""
    safe = path.startswith("/") and not path.startswith("//") and path.isprintable()
    return path if safe and "\\" not in path else "/"


def _is_number(text: str) -> bool:
    return text.isascii() and text.isdecimal() and len(text) < 10
