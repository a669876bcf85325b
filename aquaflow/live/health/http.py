"""The service's own web server: its page, what the page asks for, and the pilot's requests."""

from __future__ import annotations

import http.client
import json
import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from http import HTTPStatus
from typing import Any, Protocol, TypeAlias
from urllib.parse import parse_qs, urlsplit

from aquaflow import __version__
from aquaflow.base.errors import ArgumentError, InputError, reason_of
from aquaflow.config.service import ListenConfig
from aquaflow.live.control import RefusedError, ServiceControl, ServiceRequest
from aquaflow.live.health.exposition import TYPE, device_lines, head, label, sample
from aquaflow.live.health.page import page_file
from aquaflow.live.health.state import ServiceState
from aquaflow.web import HttpRequest, HttpResponse, WebServer
from aquaflow.web.access import GUESSES_S, Access, name_of, path_of

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
        control: ServiceControl | None = None,
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
        answers = _Answers(access, report, path, control or ServiceControl(), picture, coverage)
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
    control: ServiceControl
    picture: Callable[[], bytes | None]
    coverage: CoveragePictures | None

    def __call__(self, request: HttpRequest) -> HttpResponse:
        """The answer with the headers that all have."""
        posted = request.method == "POST"
        answer = self.answer_post(request) if posted else self.answer_get(request)
        headers = [*policies(request.headers.get("host", "")), *answer.headers]
        shown = request.target, request.headers, request.peer
        if answer.status != HTTPStatus.FORBIDDEN and self.access.by_query(*shown):
            headers.append(("Set-Cookie", self.access.cookie()))
        return replace(answer, headers=headers)

    def answer_get(self, request: HttpRequest) -> HttpResponse:
        """To a GET."""
        path = path_of(request.target)
        if path is None:
            return _json(400, {"error": "this is no address"})
        if (said := self.open_to_all(path)) is not None:
            return said
        if not self.access.allows(request.target, request.headers, request.peer):
            return _json(403, NOT_ALLOWED)
        return self.data(path)

    def answer_post(self, request: HttpRequest) -> HttpResponse:
        """To a POST."""
        if request.body is None:
            return _json(413, {"error": "a request holds a token at most"})
        if path_of(request.target) == "/login":
            return self.log_in(request)
        dive = self.report().get("dive") or {}
        name, target, headers = dive.get("name"), request.target, request.headers
        return _json(*answer(self.control, self.access, target, headers, name, request.peer))

    def log_in(self, request: HttpRequest) -> HttpResponse:
        """The cookie for a form with the token; a minute without an answer after ten others."""
        shown = request.headers, request.peer
        tokens = parse_qs((request.body or b"").decode("ascii", "replace")).get("token", [""])
        if self.access.must_wait(*shown):
            return replace(_json(429, WAIT), headers=[("Retry-After", str(int(GUESSES_S)))])
        if not self.access.logs_in(tokens[-1].strip(), *shown):
            return _json(403, WRONG_TOKEN)
        return replace(_json(200, {"ok": True}), headers=[("Set-Cookie", self.access.cookie())])

    def open_to_all(self, path: str) -> HttpResponse | None:
        """The page holds no data, and BlueOS asks for both without a token."""
        if path == "/register_service":
            return _json(200, REGISTRATION)
        file = page_file(path)
        return None if file is None else HttpResponse(200, file.kind, file.text.encode())

    def data(self, path: str) -> HttpResponse:
        """What only those may have who are let in."""
        if path == "/health":
            return _json(200, self.report())
        if path == "/path.json" and self.plan is not None:
            return _json(200, self.plan())
        if path == "/metrics":
            return HttpResponse(200, TYPE, exposition(self.report()).encode())
        if path == "/picture.jpg" and (jpeg := self.picture()) is not None:
            return HttpResponse(200, JPEG, jpeg)
        if (png := _coverage_picture(path, self.coverage)) is not None:
            return HttpResponse(200, PNG, png)
        return _json(404, {"error": "there is nothing here"})


def _json(code: int, said: dict[str, Any]) -> HttpResponse:
    return HttpResponse(code, JSON, json.dumps(said, default=str).encode())


# --------------------------------------------------------------------------------------------------
# Headers that tell a browser what other sites may do with the answers: nothing.

OWN_PAGES = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:; "
    "connect-src 'self'; form-action 'self'; base-uri 'none'; "
)
"""What the page may load (Content Security Policy, Level 3): its own files."""
NAME = re.compile(r"[A-Za-z0-9.-]{1,253}")
"""Host names and IPv4 addresses; a policy cannot name others."""


def policies(host: str) -> list[tuple[str, str]]:
    """Headers of every answer to a request with this Host header.

    The page may be framed by the same machine alone, whatever the port: BlueOS does so.
    """
    name = name_of(host)
    framing = f"'self' http://{name}:* https://{name}:*" if NAME.fullmatch(name) else "'self'"
    return [
        ("Cache-Control", "no-store"),
        ("X-Content-Type-Options", "nosniff"),
        ("Referrer-Policy", "no-referrer"),
        ("Cross-Origin-Resource-Policy", "same-site"),
        ("Content-Security-Policy", f"{OWN_PAGES}frame-ancestors {framing}"),
    ]


# --------------------------------------------------------------------------------------------------
# The report as Prometheus reads it.

COUNTERS = {
    "frames": "Frames that were looked at.",
    "failures": "Frames that raised, each costing itself.",
    "overtaken": "Frames that a newer one overtook.",
    "mapping_failures": "Requests to the map that raised.",
    "steps_down": "Steps down to a lower degradation level.",
    "steps_up": "Steps back up.",
    "telemetry_samples": "Telemetry samples received.",
}
"""Metrics that only grow: name and help."""
GAUGES = {
    "fps": "Frames per second, lately.",
    "mapping_waits": "Requests that wait for mapping.",
    "keyframes": "Keyframes of the dive.",
    "gaussians": "Gaussians of all maps.",
}
"""Metrics that rise and fall: name and help."""
QUANTILES = {"p50": "0.5", "p95": "0.95"}
"""Of the lag: the report's keys and Prometheus' labels."""


def exposition(report: Mapping[str, Any]) -> str:
    """The metrics of one report."""
    return "".join(f"{line}\n" for line in _lines(report))


def _lines(report: Mapping[str, Any]) -> Iterator[str]:
    states = {state.value: int(report["state"] == state.value) for state in ServiceState}
    yield from label("state", "state", states, "1 for the state that the service is in.", "gauge")
    yield from head("ok", "gauge", "1 while nothing is to be done about it.")
    yield sample("ok", int(report["ok"]))
    for name, help_text in COUNTERS.items():
        yield from head(f"{name}_total", "counter", help_text)
        yield sample(f"{name}_total", report[name])
    for name, help_text in GAUGES.items():
        yield from head(name, "gauge", help_text)
        yield sample(name, report[name])
    lags = {quantile: report["lag_ms"][key] for key, quantile in QUANTILES.items()}
    lags_s = {quantile: lag_ms / 1e3 for quantile, lag_ms in lags.items() if lag_ms is not None}
    yield from label(
        "lag_seconds", "quantile", lags_s, "From a frame's arrival to its pose, last minute.",
        "gauge",
    )  # fmt: skip
    yield from label("frames_by_class_total", "class", report["classes"], "Frames by result.")
    yield from label(
        "left_out_total", "reason", report["left_out_of_the_map"], "Frames that the map never saw."
    )
    yield from label("state_visits_total", "state", report["visits"], "Times in each state.")
    yield from head("stage_failures_total", "counter", "Failures of a stage, by exception.")
    for kind in report["stage_failures"]:
        labels = {key: kind[key] for key in ("stage", "error", "place")}
        yield sample("stage_failures_total", kind["count"], **labels)
    poses = report["pose_output"]
    if poses is not None:
        yield from head("poses_sent_total", "counter", "Poses sent to the autopilot.")
        yield sample("poses_sent_total", poses["sent"])
        yield from label(
            "poses_withheld_total", "reason", poses["withheld"], "Poses not sent to the autopilot."
        )
    yield from label(
        "stage_share", "stage", report["stage_shares"], "Seconds per second in a stage.", "gauge"
    )
    yield from device_lines(report["devices"])


# --------------------------------------------------------------------------------------------------
# POST /dive/start, stop, finish and new: what a pilot asks for over HTTP, and the answers.

PATHS = {f"/dive/{request.value}": request for request in ServiceRequest}
"""The address of each request."""
MOST_BYTES = 4096
"""Of a request's body, which means nothing and is read only to be rid of it."""

REQUEST_NOT_ALLOWED = {
    "error": "give the token in a header or from the service's own page; a link to another page, "
    "and an address with a token, do not do"
}
"""Answer to who may not ask."""


def answer(
    control: ServiceControl,
    access: Access,
    target: str,
    headers: Mapping[str, str],
    dive: str | None,
    peer: str = "",
) -> tuple[int, dict[str, Any]]:
    """Status and JSON of the answer to a POST; ``headers`` by lower-case name, ``dive``: the
    present one's name, ``peer``: the address that the request comes from."""
    request = PATHS.get(path_of(target) or "")
    if request is None:
        return HTTPStatus.NOT_FOUND, {"error": "there is nothing here"}
    if not access.may_change(headers, peer):
        return HTTPStatus.FORBIDDEN, REQUEST_NOT_ALLOWED
    try:
        phase = control.ask(request)
    except RefusedError as refused:
        return HTTPStatus.CONFLICT, {"error": str(refused)}
    return HTTPStatus.ACCEPTED, {"state": phase.value, "dive": dive}


# --------------------------------------------------------------------------------------------------
# Client for the status of a running service.

PATIENCE_S = 5.0
"""Wait for an answer; the service answers within milliseconds or hangs."""
MOST_ANSWER_BYTES = 1 << 20
"""Of an answer; a report has a few thousand."""
MOST_NAME = 253
"""Letters of a host's name, as in DNS."""
SHOWN = 100
"""Letters of what is no address that a sentence shows."""


def ask(url: str, token: str | None = None) -> dict[str, Any]:
    """The report of the service at ``url``, such as http://127.0.0.1:8230.

    Raises:
        InputError: no service answers there, or not with a report.
    """
    host, port = _address(url)
    connection = http.client.HTTPConnection(host, port, timeout=PATIENCE_S)
    headers = {} if token is None else {"Authorization": f"Bearer {token}"}
    try:
        connection.request("GET", "/health", headers=headers)
        answer = connection.getresponse()
        body = answer.read(MOST_ANSWER_BYTES)
    except (OSError, http.client.HTTPException, UnicodeError) as error:
        raise InputError(
            f"no service answers at {url}: {reason_of(error)}; is it running?"
        ) from error
    finally:
        connection.close()
    if answer.status == http.client.FORBIDDEN:
        raise InputError(f"{url} asks for a token; give --token-file")
    try:
        report: dict[str, Any] = json.loads(body)
        known = isinstance(report["state"], str) and isinstance(report["reason"], str)
        for change in report.get("changes", []):
            float(change["ago_s"]), change["before"], change["after"], change["reason"]
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError):
        known = False
    if not known:
        raise InputError(f"what answers at {url} is no AquaFlow service; look at its --url")
    return report


def _address(url: str) -> tuple[str, int]:
    """Host and port.

    Raises:
        ArgumentError: it is no address of a service.
    """
    try:
        parts = urlsplit(url)
        host, port = parts.hostname, parts.port
        if parts.scheme == "http" and host and len(host) <= MOST_NAME and host.encode("idna"):
            return host, 80 if port is None else port
    except ValueError:
        pass
    raise ArgumentError(f"'{url[:SHOWN]}' is no address such as http://127.0.0.1:8230")
