"""What the viewer's web server answers, in threads that nobody waits for.

Every request is let in by :mod:`aquaflow.web.access`, and only our own page may change anything.
"""

from __future__ import annotations

import json
import logging
from collections.abc import Callable, Sequence
from typing import Any, TypeAlias

from aquaflow.base.errors import InputError
from aquaflow.config.service import ViewerConfig
from aquaflow.survey.viewer.client import ClientFile, client_file
from aquaflow.survey.viewer.viewer_content import ViewerContent
from aquaflow.web import HttpRequest, HttpResponse, WebServer
from aquaflow.web.access import Access, path_of

log = logging.getLogger(__name__)

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
    "img-src 'self' data: blob:; connect-src 'self'; form-action 'none'; base-uri 'none'; "
    "frame-ancestors 'none'"
)
"""What the page may load (Content Security Policy, Level 3): its own files; and who may show it in
a frame: nobody."""
POLICIES = (
    ("Content-Security-Policy", POLICY), ("X-Content-Type-Options", "nosniff"),
    ("Referrer-Policy", "no-referrer"), ("Cross-Origin-Resource-Policy", "same-origin"),
)  # fmt: skip

GZIPPED = ("Content-Encoding", "gzip")
Headers: TypeAlias = Sequence[tuple[str, str]]
Ask: TypeAlias = Callable[[str, dict[str, Any]], dict[str, Any]]
"""What a tool says to a request by its name and its JSON object; raises InputError."""


class ViewerServer:
    """Serves an exhibit and its tools at the configured address."""

    def __init__(self, config: ViewerConfig, exhibit: ViewerContent, ask: Ask) -> None:
        """Listen at once.

        Raises:
            InputError: the address is taken, or the token file cannot be read.
            ConfigError: the token will not do.
        """
        self._access, self._exhibit, self._ask = Access(config), exhibit, ask
        self._server = WebServer(config, self._access, self._answer, "viewer", MOST_BYTES)
        self.port = self._server.port

    def close(self) -> None:
        """Stop listening."""
        self._server.close()

    def _answer(self, request: HttpRequest) -> HttpResponse:
        return self._tool(request) if request.method == "POST" else self._answer_get(request)

    def _answer_get(self, request: HttpRequest) -> HttpResponse:
        path = path_of(request.target) or ""
        shown = request.target, request.headers, request.peer
        if not self._access.allows(*shown):
            return _of(403, TEXT, b"Give the token\n")
        if self._access.by_query(*shown):  # into a cookie, and out of the address bar
            to = [("Location", _own(path)), ("Set-Cookie", self._access.cookie())]
            return _of(303, TEXT, b"", to)
        if (file := client_file(path)) is not None:
            return _file(file, request.headers.get("if-none-match"))
        if path == "/scene.json":
            return _reply(200, self._exhibit.scene())
        return self._data(path.split("/")[1:]) or _reply(404, {"error": "there is nothing here"})

    def _tool(self, request: HttpRequest) -> HttpResponse:
        """Its name is the path, its arguments the JSON object in the body."""
        given = _parse_body(request.body)
        if not self._access.may_change(request.headers, request.peer):
            return _reply(403, {"error": "open the viewer with its token, and ask from its page"})
        if given is None:
            return _reply(400, {"error": "this is no request of the viewer's page"})
        try:
            return _reply(200, self._ask((path_of(request.target) or "").lstrip("/"), given))
        except InputError as error:
            return _reply(422, {"error": str(error)})
        except Exception:  # whatever a browser asked for, the dive goes on
            log.exception("the viewer could not answer a request")
            return _reply(500, {"error": "that failed; the log of the viewer says why"})

    def _data(self, parts: list[str]) -> HttpResponse | None:
        """None if there is nothing by this name."""
        name, rest = parts[0], parts[1:]
        if name == "map" and len(rest) == 2 and _is_number(rest[1]):
            packed = self._exhibit.chunk(rest[0], int(rest[1]))
            return None if packed is None else _of(200, BINARY, packed, [GZIPPED], FOR_EVER)
        if name == "path" and len(rest) == 1:
            return _of(200, BINARY, self._exhibit.path.astype("<f4").tobytes())
        if name == "picture" and rest == ["newest"]:
            newest = self._exhibit.newest_picture()
            return None if newest is None else _of(200, JPEG, newest)
        if name == "picture" and len(rest) == 1 and _is_number(rest[0]):
            kept = self._exhibit.picture(int(rest[0]))
            return None if kept is None else _of(200, JPEG, kept, (), ASK_FIRST)
        return None


def _file(file: ClientFile, known: str | None) -> HttpResponse:
    """``known``: the tag that the browser has."""
    headers = [("ETag", file.tag)]
    if known == file.tag:
        return _of(304, file.kind, b"", headers, ASK_FIRST)
    return _of(200, file.kind, file.packed, [*headers, GZIPPED], ASK_FIRST)


def _parse_body(body: bytes | None) -> dict[str, Any] | None:
    """The JSON object that was posted; None for anything else."""
    try:
        given = json.loads(body or b"")
    except (ValueError, RecursionError):
        return None
    return given if isinstance(given, dict) else None


def _reply(code: int, said: dict[str, Any]) -> HttpResponse:
    return _of(code, JSON, json.dumps(said).encode())


def _of(
    code: int, kind: str, data: bytes, headers: Headers = (), keep: str = NO_STORE
) -> HttpResponse:
    always = [("Cache-Control", keep), *POLICIES]
    return HttpResponse(code, kind, data, [*always, *headers])


def _own(path: str) -> str:
    """Where a browser is sent back to: on this server, and without what ends a header."""
    safe = path.startswith("/") and not path.startswith("//") and path.isprintable()
    return path if safe and "\\" not in path else "/"


def _is_number(text: str) -> bool:
    return text.isascii() and text.isdecimal() and len(text) < 10
