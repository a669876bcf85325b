"""The viewer's web server. Each browser has threads of its own, which nobody waits for.

Every request is let in by :mod:`aquaflow.access`, and only our own page may change anything.
"""

from __future__ import annotations

import json
import logging
import threading
from collections.abc import Callable, Sequence
from http.server import BaseHTTPRequestHandler
from typing import Any, TypeAlias

from aquaflow.access import Access, path_of
from aquaflow.bounded_server import BoundedServer
from aquaflow.config.viewer import ViewerConfig
from aquaflow.errors import InputError
from aquaflow.viewer.client import ClientFile, client_file
from aquaflow.viewer.exhibit import Exhibit

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
        handler = _handler(access, exhibit, ask)
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


def _handler(access: Access, exhibit: Exhibit, ask: Answer) -> type[BaseHTTPRequestHandler]:
    class Handler(BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"  # one connection for all chunks
        timeout = PATIENCE_S
        server_version, sys_version = "AquaFlow", ""
        disable_nagle_algorithm = True

        def do_GET(self) -> None:
            path = path_of(self.path) or ""
            if not access.allows(self.path, self._named(), self.client_address[0]):
                self._answer(403, TEXT, b"Give the token\n")
            elif access.by_query(self.path):  # into a cookie, and out of the address bar
                to = [("Location", _own(path)), ("Set-Cookie", access.cookie())]
                self._answer(303, TEXT, b"", to)
            elif (file := client_file(path)) is not None:
                self._send_file(file)
            elif path == "/scene.json":
                self._say(200, exhibit.scene())
            elif not self._send_data(path.split("/")[1:]):
                self._say(404, {"error": "there is nothing here"})

        def do_POST(self) -> None:
            """A tool: its name is the path, its arguments the JSON object in the body."""
            body = self._body()
            if not access.may_change(self._named(), self.client_address[0]):
                self._say(403, {"error": "open the viewer with its token, and ask from its page"})
                return
            try:
                given = json.loads(body) if body is not None else None
            except (ValueError, RecursionError):
                given = None
            if not isinstance(given, dict):
                self._say(400, {"error": "this is no request of the viewer's page"})
                return
            try:
                self._say(200, ask((path_of(self.path) or "").lstrip("/"), given))
            except InputError as error:
                self._say(422, {"error": str(error)})
            except Exception:  # whatever a browser asked for, the dive goes on
                log.exception("the viewer could not answer a request")
                self._say(500, {"error": "that failed; the log of the viewer says why"})

        def _send_file(self, file: ClientFile) -> None:
            kept = self.headers.get("If-None-Match") == file.tag
            headers = [("ETag", file.tag)]
            if kept:
                self._answer(304, file.kind, b"", headers, ASK_FIRST)
            else:
                self._answer(
                    200, file.kind, file.packed, [*headers, ("Content-Encoding", "gzip")], ASK_FIRST
                )

        def _send_data(self, parts: list[str]) -> bool:
            """False if there is nothing by this name."""
            if parts[0] == "map" and len(parts) == 3 and _is_number(parts[2]):
                packed = exhibit.chunk(parts[1], int(parts[2]))
                if packed is not None:
                    zipped = [("Content-Encoding", "gzip")]
                    self._answer(200, BINARY, packed, zipped, FOR_EVER)
                return packed is not None
            if parts[0] == "path" and len(parts) == 2:
                self._answer(200, BINARY, exhibit.path.astype("<f4").tobytes())
                return True
            if parts[0] == "picture" and len(parts) == 2:
                newest = parts[1] == "newest"
                jpeg = exhibit.newest_picture() if newest else None
                if _is_number(parts[1]):
                    jpeg = exhibit.picture(int(parts[1]))
                if jpeg is not None:
                    self._answer(200, JPEG, jpeg, (), NO_STORE if newest else ASK_FIRST)
                return jpeg is not None
            return False

        def _named(self) -> dict[str, str]:
            return {name.lower(): value for name, value in self.headers.items()}

        def _body(self) -> bytes | None:
            """What was posted; None if it is too long, and then not read."""
            length = self.headers.get("Content-Length", "0")
            if not _is_number(length) or int(length) > MOST_BYTES:
                self.close_connection = True
                return None
            return self.rfile.read(int(length))

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

    return Handler


def _own(path: str) -> str:
    """Where a browser is sent back to: on this server, and without what ends a header."""
    safe = path.startswith("/") and not path.startswith("//") and path.isprintable()
    return path if safe and "\\" not in path else "/"


def _is_number(text: str) -> bool:
    return text.isascii() and text.isdecimal() and len(text) < 10
