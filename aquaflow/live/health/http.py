"""The service's own web server: its page, what the page asks for, and the pilot's requests."""

from __future__ import annotations

import json
import logging
import re
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from http.server import BaseHTTPRequestHandler
from typing import Any, Protocol, TypeAlias
from urllib.parse import parse_qs

from aquaflow import __version__
from aquaflow.base.errors import InputError
from aquaflow.config.service import ListenConfig
from aquaflow.live.control import Control
from aquaflow.live.health.exposition import TYPE
from aquaflow.live.health.page import page_file
from aquaflow.live.health.pilot_requests import MOST_BYTES, answered
from aquaflow.live.health.policies import policies
from aquaflow.live.health.prometheus import exposition
from aquaflow.web.access import Access, path_of
from aquaflow.web.bounded_server import BoundedServer

log = logging.getLogger(__name__)

PATIENCE_S = 10.0
"""A client that sends or takes nothing for so long is disconnected."""
MOST_CLIENTS = 16
"""Requests at a time; more are turned away, so that threads stay bounded."""

JSON, JPEG, PNG = "application/json", "image/jpeg", "image/png"
"""Content types of all but the page and the metrics."""

NOT_ALLOWED = {"error": "give the token, or ask on board by the name localhost"}
"""Answer to a request without the token."""
WRONG_TOKEN = {"error": "this is not the token of this vehicle"}
"""Answer to a form with another token."""

REGISTRATION = {
    "name": "AquaFlow",
    "description": "Maps the sea floor while the vehicle swims: trajectory, 3D map, water.",
    "icon": "mdi-map-marker-path",
    "company": "AquaFlow",
    "version": __version__,
    "webpage": "/",
    "api": "/health",
    "works_in_relative_paths": True,
}
"""What BlueOS asks for to list an extension. Every address in the page is relative, so that
BlueOS's own server can hand it on at /extensionv2/aquaflow/."""

Headers: TypeAlias = Sequence[tuple[str, str]]
CELLS = re.compile(r"/coverage/([0-9]{1,6})\.png")
"""Address of the cells of a sub-map."""


class CoveragePictures(Protocol):
    """PNG files of the coverage, made in the thread of a request."""

    def png(self) -> bytes | None:
        """The finished picture, for whoever looks on; None: there is none."""
        ...

    def cells(self, sub_map: int) -> bytes | None:
        """A pixel for each cell, for the page; None: there is none."""
        ...


Say: TypeAlias = Callable[[], dict[str, Any]]
"""What is answered as JSON; called in the thread of the request."""
Answer: TypeAlias = tuple[int, str, str | bytes]
"""Status, content type and body."""


class HealthServer:
    """Answers requests in its own threads, with the object that ``report`` returns."""

    def __init__(
        self,
        config: ListenConfig,
        report: Say,
        path: Say | None = None,
        control: Control | None = None,
        picture: Callable[[], bytes | None] = lambda: None,
        coverage: CoveragePictures | None = None,
    ) -> None:
        """Listen at once.

        Args:
            path: the plan view at /path.json, if there is one.
            control: gets the pilot's requests.
            picture: makes the JPEG file at /picture.jpg, if there is a picture.
            coverage: makes /coverage.png and /coverage/0.png, where there is a coverage.

        Raises:
            InputError: the address is taken, or the token file cannot be read.
            ConfigError: the token will not do.
        """
        access = Access(config)
        try:
            answers = _Answers(access, report, path, control or Control(), picture, coverage)
            handler = partial(_Handler, answers)
            self._server = BoundedServer((config.host, config.port), handler, MOST_CLIENTS)
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


def _coverage_picture(path: str, coverage: CoveragePictures | None) -> bytes | None:
    """What is at ``path``; None if that is no picture of the coverage, or there is none yet."""
    if coverage is None:
        return None
    if path == "/coverage.png":
        return coverage.png()
    of_cells = CELLS.fullmatch(path)
    return None if of_cells is None else coverage.cells(int(of_cells[1]))


@dataclass(frozen=True)
class _Answers:
    """What the server says to whom; called in the threads of requests."""

    access: Access
    report: Say
    plan: Say | None
    control: Control
    picture: Callable[[], bytes | None]
    coverage: CoveragePictures | None

    def open_to_all(self, path: str) -> Answer | None:
        """The page holds no data, and BlueOS asks for both without a token."""
        if path == "/register_service":
            return _json(200, REGISTRATION)
        file = page_file(path)
        return None if file is None else (200, file.kind, file.text)

    def data(self, path: str) -> Answer:
        """What only those may have who are let in."""
        if path == "/health":
            return _json(200, self.report())
        if path == "/path.json" and self.plan is not None:
            return _json(200, self.plan())
        if path == "/metrics":
            return 200, TYPE, exposition(self.report())
        if path == "/picture.jpg" and (jpeg := self.picture()) is not None:
            return 200, JPEG, jpeg
        if (png := _coverage_picture(path, self.coverage)) is not None:
            return 200, PNG, png
        return _json(404, {"error": "there is nothing here"})


def _json(code: int, said: dict[str, Any]) -> Answer:
    return code, JSON, json.dumps(said, default=str)


class _Handler(BaseHTTPRequestHandler):
    """One request."""

    timeout = PATIENCE_S
    server_version, sys_version = "AquaFlow", ""

    def __init__(self, answers: _Answers, *request: Any) -> None:
        """``request``: what the web server hands over."""
        self._answers, self._access = answers, answers.access
        super().__init__(*request)

    def do_GET(self) -> None:
        path = path_of(self.path)
        if path is None:
            self._answer(_json(400, {"error": "this is no address"}))
        elif (said := self._answers.open_to_all(path)) is not None:
            self._answer(said)
        elif not self._access.allows(self.path, self._named_headers(), self.client_address[0]):
            self._answer(_json(403, NOT_ALLOWED))
        else:
            self._answer(self._answers.data(path))

    def do_POST(self) -> None:
        body = self._body()
        if body is None:
            self._answer(_json(413, {"error": "a request holds a token at most"}))
        elif path_of(self.path) == "/login":
            self._log_in(body)
        else:
            dive = self._answers.report().get("dive") or {}
            peer, headers = self.client_address[0], self._named_headers()
            control, name = self._answers.control, dive.get("name")
            said = answered(control, self._access, self.path, headers, name, peer)
            self._answer(_json(*said))

    def _log_in(self, form: str) -> None:
        tokens = parse_qs(form).get("token", [""])
        if self._access.is_token(tokens[-1].strip()):
            self._answer(_json(200, {"ok": True}), [("Set-Cookie", self._access.cookie())])
        else:
            self._answer(_json(403, WRONG_TOKEN))

    def _named_headers(self) -> dict[str, str]:
        return {name.lower(): value for name, value in self.headers.items()}

    def _body(self) -> str | None:
        """What was posted; None if it is too long, and then not read."""
        length = self.headers.get("Content-Length", "0")
        if not length.isdecimal() or int(length) > MOST_BYTES:
            return None
        return self.rfile.read(int(length)).decode("ascii", "replace")

    def _answer(self, answer: Answer, headers: Headers = ()) -> None:
        code, kind, text = answer
        data = text if isinstance(text, bytes) else text.encode()
        host = self.headers.get("Host", "")
        self.send_response(code)
        for name, value in [("Content-Type", kind), *policies(host), *headers]:
            self.send_header(name, value)
        self.send_header("Content-Length", str(len(data)))
        if self._access.by_query(self.path):
            self.send_header("Set-Cookie", self._access.cookie())
        self.end_headers()
        self.wfile.write(data)

    def log_message(self, format: str, *args: Any) -> None:
        """Addresses may carry the token: nothing of a request goes to a log."""
