"""MAVLink by way of mavlink2rest, BlueOS's service: JSON on a websocket, or polled by HTTP.

Its messages become MAVLink packets again, so that all that is behind the link, and a recording of
it, is as on any other MAVLink link.
"""

from __future__ import annotations

import http.client
import json
import logging
import math
import struct
import time
from collections.abc import Iterator, Mapping
from itertools import cycle
from typing import Any, NamedTuple, Protocol, runtime_checkable
from urllib.parse import quote, urlsplit

from aquaflow.base.errors import load
from aquaflow.config.link import Mavlink2restConfig
from aquaflow.drivers.link import MAX_READ_BYTES, ByteLink, LinkLostError, about
from aquaflow.drivers.mavlink_dialect import dialect

log = logging.getLogger(__name__)

ANSWER_TIMEOUT_S = 3.0
"""The service runs on the vehicle's own network; it answers in milliseconds, or is not there."""
MALFORMED = (LookupError, TypeError, ValueError, AttributeError, struct.error)
"""What :func:`packet_of` raises for a report that is not as MAVLink has it."""


class Wanted(NamedTuple):
    """What a device wants to hear."""

    names: frozenset[str]
    """Messages, whoever sends them."""
    of: Mapping[tuple[int, int], frozenset[str]]
    """The same by system and component."""


@runtime_checkable
class Wants(Protocol):
    """A decoder that can say what it wants to hear."""

    @property
    def wanted(self) -> Wanted:
        """What a link need bring at the least."""
        ...


class RestClient:
    """Requests to the service, one after the other on one connection."""

    def __init__(self, url: str, device: str) -> None:
        parts = urlsplit(url)
        self.path = (
            parts.path.rstrip("/").removesuffix("/v1/ws/mavlink").removesuffix("/v1/mavlink")
        )
        self.dialect = dialect(f"the MAVLink device '{device}'")
        self._device, self._host = device, parts.netloc
        self._connection = http.client.HTTPConnection(parts.netloc, timeout=ANSWER_TIMEOUT_S)
        self._templates: dict[str, Mapping[str, Any]] = {}
        self._said_refused = False
        self._parser = self.dialect.MAVLink(None)

    def ask(self, method: str, path: str, body: str | None = None) -> tuple[int, str]:
        """Status and text of the answer; raises LinkLostError where nobody answers."""
        try:
            return self._request(method, path, body)
        except (OSError, http.client.HTTPException):
            self.close()  # a service closes connections that were idle for seconds
        try:
            return self._request(method, path, body)
        except (OSError, http.client.HTTPException) as error:
            self.close()
            raise LinkLostError(f"mavlink2rest at {self._host} is lost: {error}") from error

    def _request(self, method: str, path: str, body: str | None) -> tuple[int, str]:
        headers = {"Content-Type": "application/json"}
        self._connection.request(method, self.path + path, body, headers)
        answer = self._connection.getresponse()
        return answer.status, answer.read().decode("utf-8", "replace")

    def post(self, packets: bytes) -> None:
        """Send MAVLink packets; a warning names the first that the service refuses."""
        for message in self._parser.parse_buffer(bytearray(packets)) or []:
            template = self._template(message.get_type())
            if template is None:
                continue
            report = report_of(self.dialect, message, template)
            status, answer = self.ask("POST", "/v1/mavlink", json.dumps(report))
            if status != http.HTTPStatus.OK:
                self._log_refusal(message.get_type(), answer)

    def close(self) -> None:
        self._connection.close()

    def _template(self, name: str) -> Mapping[str, Any] | None:
        """The form of a message's fields, which differs between versions of the service."""
        if name not in self._templates:
            status, answer = self.ask("GET", f"/v1/helper/mavlink?name={name}")
            try:
                self._templates[name] = dict(json.loads(answer)["message"])
            except MALFORMED:
                self._log_refusal(name, answer if status != http.HTTPStatus.OK else "no template")
                return None
        return self._templates[name]

    def _log_refusal(self, name: str, answer: str) -> None:
        if not self._said_refused:
            self._said_refused = True
            words = " ".join(answer.split())[:160]
            log.warning(
                "%s: mavlink2rest does not send %s: %s", self._device, name, words,
                extra=about(self._device, "refused"),
            )  # fmt: skip


class WebsocketLink:
    """Every message that the filter lets through, as it comes."""

    def __init__(self, name: str, client: RestClient, socket: Any) -> None:
        self.name = name
        self._client, self._socket = client, socket
        self._closed: type[Exception] = load("websockets.exceptions", name).ConnectionClosed

    def read(self, timeout_s: float) -> bytes:
        try:
            text = self._socket.recv(timeout=timeout_s)
        except TimeoutError:
            return b""
        except (self._closed, OSError) as error:
            raise LinkLostError(f"the websocket was closed: {error}") from error
        return binary(self._client.dialect, text)

    def write(self, data: bytes) -> None:
        self._client.post(data)

    def close(self) -> None:
        self._socket.close()
        self._client.close()


class PollingLink:
    """Asks for one message after the other; each new one is read once."""

    def __init__(self, name: str, client: RestClient, wanted: Wanted, poll_hz: float) -> None:
        self.name = name
        self._client = client
        # The service keeps the last TIMESYNC only: a request of the autopilot hides its answer.
        asked = [(who, message) for who, names in wanted.of.items()
                 for message in sorted(names - {"TIMESYNC"})]  # fmt: skip
        self._turn: Iterator[tuple[tuple[int, int], str]] = cycle(asked)
        self._pause_s = 1.0 / (poll_hz * len(asked))
        self._due_s = time.monotonic()
        self._counted: dict[tuple[tuple[int, int], str], object] = {}

    def read(self, timeout_s: float) -> bytes:
        left_s = self._due_s - time.monotonic()
        if left_s > timeout_s:
            time.sleep(timeout_s)
            return b""
        time.sleep(max(left_s, 0.0))
        self._due_s = max(self._due_s + self._pause_s, time.monotonic() - self._pause_s)
        (system, component), name = asked = next(self._turn)
        path = f"/v1/mavlink/vehicles/{system}/components/{component}/messages/{name}"
        status, answer = self._client.ask("GET", path)
        if status not in (http.HTTPStatus.OK, http.HTTPStatus.NOT_FOUND):
            raise LinkLostError(f"mavlink2rest answers {status} to {path}")
        try:
            report = json.loads(answer)
            counter = report["status"]["time"]["counter"]
        except MALFORMED:
            return b""  # nobody has sent it yet
        last = self._counted.get(asked)
        self._counted[asked] = counter
        # What was there before the first question may be old.
        if last is None or counter == last:
            return b""
        header = {"system_id": system, "component_id": component}
        return binary(self._client.dialect, json.dumps({**report, "header": header}))

    def write(self, data: bytes) -> None:
        self._client.post(data)

    def close(self) -> None:
        self._client.close()


def binary(definitions: Any, text: str | bytes) -> bytes:
    """The packet of a report. One that is not as MAVLink has it stays text, which the decoder
    counts as garbage; what is no report, such as the answer to what was sent, is nothing."""
    try:
        report = json.loads(text)
    except (ValueError, RecursionError):
        return b""
    if not (isinstance(report, dict) and "message" in report):
        return b""
    try:
        return packet_of(definitions, report)
    except MALFORMED:
        return json.dumps(report).encode("ascii")[:MAX_READ_BYTES]


def open_mavlink2rest(name: str, config: Mavlink2restConfig, wanted: Wanted) -> ByteLink:
    """Connect.

    Raises:
        LinkLostError: no service answers there.
        InputError: pymavlink or websockets is not installed.
    """
    client = RestClient(config.url, name)
    if config.url.startswith("http:"):
        return PollingLink(name, client, wanted, config.poll_hz)
    websockets = load("websockets.sync.client", f"the MAVLink device '{name}'")
    only = quote(f"^({'|'.join(sorted(wanted.names))})$")
    url = f"ws://{urlsplit(config.url).netloc}{client.path}/v1/ws/mavlink?filter={only}"
    try:
        # proxy: the vehicle's own network has none, whatever the environment says.
        socket = websockets.connect(
            url, open_timeout=ANSWER_TIMEOUT_S, close_timeout=0.5, proxy=None, compression=None
        )
    except (OSError, load("websockets.exceptions", name).WebSocketException) as error:
        raise LinkLostError(f"no mavlink2rest at {config.url}: {error}") from error
    return WebsocketLink(name, client, socket)


# --------------------------------------------------------------------------------------------------
# MAVLink packets to and from the JSON of mavlink2rest (github.com/mavlink/mavlink2rest).
#
# A report has a ``header`` with ``system_id``, ``component_id`` and ``sequence``, and a ``message``
# whose ``type`` is the message's name. Its fields are those of MAVLink, but ``type`` is called
# ``mavtype``, an enumeration is ``{"type": NAME}``, and flags are ``"NAME | NAME"``. Version 0.11
# has ``{"bits": number}`` for flags and a list of letters for text. What is not finite is null.

Report = Mapping[str, Any]


def packet_of(dialect: Any, report: Report) -> bytes:
    """The MAVLink 2 packet of a report.

    Raises:
        LookupError, TypeError, ValueError, struct.error: no such message, or its fields are not as
            MAVLink has them.
    """
    header, body = report["header"], report["message"]
    message = getattr(dialect, f"MAVLink_{body['type'].lower()}_message")
    fields = {}
    for name, kind in zip(message.fieldnames, message.fieldtypes, strict=True):
        key = "mavtype" if name == "type" else name
        if key in body:  # what is missing may be an extension
            fields[name] = _binary(dialect, body[key], kind)
    wire = dialect.MAVLink(None, header["system_id"], header["component_id"])
    wire.seq = header.get("sequence", 0) % 256
    return bytes(message(**fields).pack(wire))


def report_of(dialect: Any, message: Any, template: Report) -> dict[str, Any]:
    """The report of a pymavlink message, in the form that ``template`` shows for its fields; a
    newer service knows more fields, and wants them all."""
    body = dict(template)
    for name in message.fieldnames:
        key = "mavtype" if name == "type" else name
        if key in template:
            names = dialect.enums.get(message.fieldenums_by_name.get(name), {})
            body[key] = _write_value(getattr(message, name), template[key], names)
    header = message.get_header()
    sender = {"system_id": header.srcSystem, "component_id": header.srcComponent}
    return {"header": {**sender, "sequence": header.seq}, "message": body}


def _binary(dialect: Any, value: Any, kind: str) -> Any:
    """A field's value as pymavlink takes it."""
    if kind == "char":
        return "".join(value).encode("ascii", "replace")
    if isinstance(value, list):
        return [_binary(dialect, each, kind) for each in value]
    if value is None:
        return math.nan
    if isinstance(value, dict):
        value = value["bits"] if "bits" in value else value["type"]
    if isinstance(value, str):
        flags = (getattr(dialect, flag.strip()) for flag in value.split("|") if flag.strip())
        return sum(int(flag) for flag in flags)
    return value


def _write_value(value: Any, form: Any, names: Mapping[int, Any]) -> Any:
    """A field's value in the form of ``form``; ``names`` are those of its enumeration."""
    if isinstance(form, list):
        if isinstance(value, str | bytes):
            text = value if isinstance(value, str) else value.decode("ascii", "replace")
            return list(text.ljust(len(form), "\0"))
        return [_write_value(each, 0, names) for each in value]
    if isinstance(form, dict):
        return {"bits": value} if "bits" in form else {"type": names[value].name}
    if isinstance(form, str):
        if isinstance(value, str | bytes):
            return value if isinstance(value, str) else value.decode("ascii", "replace")
        return " | ".join(entry.name for flag, entry in names.items() if value & flag)
    return value
