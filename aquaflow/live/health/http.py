"""The service's own web server: its page, what the page asks for, and the pilot's requests."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from http import HTTPStatus
from typing import Any, Protocol, TypeAlias
from urllib.parse import parse_qs

from aquaflow import __version__
from aquaflow.config.service import ListenConfig
from aquaflow.live.control import Control
from aquaflow.live.health.exposition import TYPE
from aquaflow.live.health.page import page_file
from aquaflow.live.health.pilot_requests import MOST_BYTES, answered
from aquaflow.live.health.policies import policies
from aquaflow.live.health.prometheus import exposition
from aquaflow.web import Answer, Request, WebServer
from aquaflow.web.access import GUESSES_S, Access, path_of

JSON, JPEG, PNG = "application/json", "image/jpeg", "image/png"
"""Content types of all but the page and the metrics."""

NOT_ALLOWED = {"error": "give the token, or ask on board by the name localhost"}
"""Answer to a request without the token."""
WRONG_TOKEN = {"error": "this is not the token of this vehicle"}
"""Answer to a form with another token."""
WAIT = {"error": "too many wrong tokens came from this address: wait a minute"}
"""Answer to a form after them."""

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
        answers = _Answers(access, report, path, control or Control(), picture, coverage)
        self._server = WebServer(config, access, answers, "service.health", MOST_BYTES)
        self.port = self._server.port

    def close(self) -> None:
        """Stop listening."""
        self._server.close()


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

    def __call__(self, request: Request) -> Answer:
        """The answer with the headers that all have."""
        posted = request.method == "POST"
        answer = self.posted(request) if posted else self.looked(request)
        headers = [*policies(request.headers.get("host", "")), *answer.headers]
        shown = request.target, request.headers, request.peer
        if answer.status != HTTPStatus.FORBIDDEN and self.access.by_query(*shown):
            headers.append(("Set-Cookie", self.access.cookie()))
        return replace(answer, headers=headers)

    def looked(self, request: Request) -> Answer:
        """To a GET."""
        path = path_of(request.target)
        if path is None:
            return _json(400, {"error": "this is no address"})
        if (said := self.open_to_all(path)) is not None:
            return said
        if not self.access.allows(request.target, request.headers, request.peer):
            return _json(403, NOT_ALLOWED)
        return self.data(path)

    def posted(self, request: Request) -> Answer:
        """To a POST."""
        if request.body is None:
            return _json(413, {"error": "a request holds a token at most"})
        if path_of(request.target) == "/login":
            return self.log_in(request)
        dive = self.report().get("dive") or {}
        name, target, headers = dive.get("name"), request.target, request.headers
        return _json(*answered(self.control, self.access, target, headers, name, request.peer))

    def log_in(self, request: Request) -> Answer:
        """The cookie for a form with the token; a minute without an answer after ten others."""
        shown = request.headers, request.peer
        tokens = parse_qs((request.body or b"").decode("ascii", "replace")).get("token", [""])
        if self.access.must_wait(*shown):
            return replace(_json(429, WAIT), headers=[("Retry-After", str(int(GUESSES_S)))])
        if not self.access.logs_in(tokens[-1].strip(), *shown):
            return _json(403, WRONG_TOKEN)
        return replace(_json(200, {"ok": True}), headers=[("Set-Cookie", self.access.cookie())])

    def open_to_all(self, path: str) -> Answer | None:
        """The page holds no data, and BlueOS asks for both without a token."""
        if path == "/register_service":
            return _json(200, REGISTRATION)
        file = page_file(path)
        return None if file is None else Answer(200, file.kind, file.text.encode())

    def data(self, path: str) -> Answer:
        """What only those may have who are let in."""
        if path == "/health":
            return _json(200, self.report())
        if path == "/path.json" and self.plan is not None:
            return _json(200, self.plan())
        if path == "/metrics":
            return Answer(200, TYPE, exposition(self.report()).encode())
        if path == "/picture.jpg" and (jpeg := self.picture()) is not None:
            return Answer(200, JPEG, jpeg)
        if (png := _coverage_picture(path, self.coverage)) is not None:
            return Answer(200, PNG, png)
        return _json(404, {"error": "there is nothing here"})


def _json(code: int, said: dict[str, Any]) -> Answer:
    return Answer(code, JSON, json.dumps(said, default=str).encode())
