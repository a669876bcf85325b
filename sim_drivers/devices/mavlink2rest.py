"""BlueOS's mavlink2rest between a simulated autopilot and its clients: websockets, GET and POST.

As src/html/llm of github.com/mavlink/mavlink2rest describes version 1, and its README version 0.11.
"""

from __future__ import annotations

import base64
import contextlib
import hashlib
import json
import math
import queue
import re
import socket
import struct
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib import import_module
from typing import Any
from urllib.parse import parse_qs, urlsplit

HANDSHAKE = b"258EAFA5-E914-47DA-95CA-C5AB0DC85B11"
"""Of RFC 6455, section 1.3."""
TEXT, CLOSE, PING, PONG = 0x81, 0x88, 0x89, 0x8A
"""First bytes of a websocket's frames."""
NEWER_FIELDS = {"TIMESYNC": {"target_system": 0, "target_component": 0}}
"""Fields that the service's dialect has and pymavlink's has not."""


class Mavlink2restWire:
    """The autopilot's end: packets in, packets out; JSON for everybody who asks at ``port``."""

    def __init__(self, version_1: bool = True, prefix: str = "") -> None:
        self.version_1 = version_1
        self.dialect: Any = import_module("pymavlink.dialects.v20.ardupilotmega")
        self.refused: list[str] = []
        """What was posted and is no message."""
        self._parser = self.dialect.MAVLink(None)
        self._parser.robust_parsing = True
        self._posted: queue.SimpleQueue[bytes] = queue.SimpleQueue()
        self._stored: dict[str, dict[str, Any]] = {}
        self._clients: dict[socket.socket, re.Pattern[str]] = {}
        self._changing = threading.Lock()
        handler = type("Handler", (_Handler,), {"wire": self, "prefix": prefix})
        self._server = ThreadingHTTPServer(("127.0.0.1", 0), handler)
        self._server.daemon_threads = True
        threading.Thread(target=self._server.serve_forever, args=(0.05,), daemon=True).start()

    @property
    def port(self) -> int:
        """The port that it listens on."""
        return int(self._server.server_address[1])

    @property
    def clients(self) -> int:
        """Websockets that are open."""
        return len(self._clients)

    def send(self, packet: bytes) -> None:
        for message in self._parser.parse_buffer(bytearray(packet)) or []:
            sender = {"system_id": message.get_srcSystem()}
            sender |= {"component_id": message.get_srcComponent(), "sequence": message.get_seq()}
            self.say({"header": sender, "message": self.body(message)})

    def say(self, report: dict[str, Any]) -> None:
        """Store and stream one report."""
        header, name = report["header"], str(report["message"]["type"])
        path = f"vehicles/{header['system_id']}/components/{header['component_id']}/messages/{name}"
        count = self._stored.get(path, {}).get("count", 0) + 1
        self._stored[path] = {"message": report["message"], "count": count}
        self.say_text(json.dumps(report, indent=2), name)

    def say_text(self, text: str, name: str = "ATTITUDE") -> None:
        """Stream a text as if it were message ``name``."""
        with self._changing:
            for client, wanted in [*self._clients.items()]:
                if wanted.search(name):
                    try:
                        client.sendall(_frame(text.encode()))
                    except OSError:
                        self._clients.pop(client, None)

    def receive(self) -> bytes | None:
        try:
            return self._posted.get_nowait()
        except queue.Empty:
            return None

    def unplug(self) -> None:
        """End all websockets."""
        with self._changing:
            for client in self._clients:
                with contextlib.suppress(OSError):
                    client.sendall(bytes([CLOSE, 0]))
                    client.shutdown(socket.SHUT_RDWR)
            self._clients.clear()

    def close(self) -> None:
        self.unplug()
        self._server.shutdown()
        self._server.server_close()

    def join(self, client: socket.socket, wanted: str) -> None:
        """Stream to one more websocket."""
        with self._changing:
            self._clients[client] = re.compile(wanted)

    def leave(self, client: socket.socket) -> None:
        """The client has left."""
        with self._changing:
            self._clients.pop(client, None)

    def last_message(self, path: str) -> dict[str, Any] | None:
        """The last message below ``path`` with its count."""
        found = self._stored.get(path)
        if found is None:
            return None
        time = {"counter": found["count"], "frequency": 10.0, "last_update": "2026-11-23T09:00:00Z"}
        return {"message": found["message"], "status": {"time": time}}

    def body(self, message: Any) -> dict[str, Any]:
        """A message in JSON."""
        fields = {"type": message.get_type()}
        for name, value in message.to_dict().items():
            if name != "mavpackettype":
                fields["mavtype" if name == "type" else name] = self._value(message, name, value)
        return {**fields, **NEWER_FIELDS.get(message.get_type(), {})}

    def _value(self, message: Any, name: str, value: Any) -> Any:
        enumeration = message.fieldenums_by_name.get(name)
        if isinstance(value, str):
            return value if self.version_1 else [*value.ljust(50, "\0")]
        if message.fielddisplays_by_name.get(name) == "bitmask":
            names = self.dialect.enums[enumeration]
            flags = [names[1 << bit].name for bit in range(32) if value >> bit & 1]
            return " | ".join(flags) if self.version_1 else {"bits": value}
        if enumeration is not None:
            return {"type": self.dialect.enums[enumeration][value].name}
        if isinstance(value, float) and not math.isfinite(value):
            return None
        return value

    def template(self, name: str) -> dict[str, Any]:
        """A message of zeros."""
        message = getattr(self.dialect, f"MAVLink_{name.lower()}_message")
        counts = dict(zip(message.ordered_fieldnames, message.array_lengths, strict=True))
        empty: dict[str, Any] = {name: [0] * n if n else 0 for name, n in counts.items()}
        kinds = zip(message.fieldnames, message.fieldtypes, strict=True)
        made = message(**{name: b"" if kind == "char" else empty[name] for name, kind in kinds})
        return {"header": {"system_id": 255}, "message": self.body(made)}

    def post(self, text: str) -> bool:
        """Send a report on to the autopilot; False if a field is missing or wrong."""
        try:
            report = json.loads(text)
            body = report["message"]
            if {*body} != {*self.template(body["type"])["message"]}:
                raise ValueError("every field, and no other")
            message = getattr(self.dialect, f"MAVLink_{body['type'].lower()}_message")
            keys = [("mavtype" if name == "type" else name) for name in message.fieldnames]
            kinds = dict(zip(keys, message.fieldtypes, strict=True))
            made = message(*[self._number(body[key], kind) for key, kind in kinds.items()])
            header = report["header"]
            wire = self.dialect.MAVLink(None, header["system_id"], header["component_id"])
            wire.seq = header["sequence"]
            self._posted.put(bytes(made.pack(wire)))
        except (KeyError, ValueError, TypeError, AttributeError, struct.error) as error:
            self.refused.append(f"{error}: {text}")
            return False
        return True

    def _number(self, value: Any, kind: str) -> Any:
        if kind == "char":
            return "".join(value).rstrip("\0").encode()
        if isinstance(value, dict):
            return value["bits"] if "bits" in value else getattr(self.dialect, value["type"])
        if isinstance(value, str):
            return sum(getattr(self.dialect, flag) for flag in value.split(" | ") if flag)
        return value


class _Handler(BaseHTTPRequestHandler):
    wire: Mavlink2restWire
    prefix: str
    protocol_version = "HTTP/1.1"

    def do_GET(self) -> None:
        parts = urlsplit(self.path)
        path, query = parts.path.removeprefix(self.prefix), parse_qs(parts.query)
        if not parts.path.startswith(self.prefix):
            self._answer(404, "nothing here")
        elif path == "/v1/ws/mavlink":
            self._stream(query.get("filter", [".*"])[0])
        elif path == "/v1/helper/mavlink":
            name = query["name"][0]
            known = hasattr(self.wire.dialect, f"MAVLink_{name.lower()}_message")
            template = json.dumps(self.wire.template(name)) if known else ""
            self._answer(200 if known else 404, template or "Invalid message name.")
        else:
            stored = self.wire.last_message(path.removeprefix("/v1/mavlink/"))
            self._answer(200, "None" if stored is None else json.dumps(stored, indent=2))

    def do_POST(self) -> None:
        text = self.rfile.read(int(self.headers["Content-Length"])).decode()
        if self.wire.post(text):
            self._answer(200, "Ok.")
        else:
            self._answer(404, "Failed to parse message, not a valid MAVLinkMessage.")

    def log_message(self, format: str, *arguments: object) -> None:
        """Requests are not logged."""

    def _answer(self, status: int, text: str) -> None:
        body = text.encode()
        self.send_response(status)
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)

    def _stream(self, wanted: str) -> None:
        """Shake hands, and stay until the client leaves."""
        key = self.headers["Sec-WebSocket-Key"].encode()
        accepted = base64.b64encode(hashlib.sha1(key + HANDSHAKE).digest()).decode()
        self.send_response(101)
        for name, value in (("Upgrade", "websocket"), ("Connection", "Upgrade")):
            self.send_header(name, value)
        self.send_header("Sec-WebSocket-Accept", accepted)
        self.end_headers()
        self.wire.join(self.connection, wanted)
        self.close_connection = True
        with contextlib.suppress(OSError):
            while len(head := self.rfile.read(2)) == 2 and head[0] != CLOSE:
                mask, payload = self.rfile.read(4), self.rfile.read(head[1] & 0x7F)
                if head[0] == PING:
                    plain = bytes(byte ^ mask[k % 4] for k, byte in enumerate(payload))
                    self.wfile.write(bytes([PONG, len(plain)]) + plain)
        self.wire.leave(self.connection)


def _frame(payload: bytes) -> bytes:
    if len(payload) < 126:
        return bytes([TEXT, len(payload)]) + payload
    return bytes([TEXT, 126]) + len(payload).to_bytes(2, "big") + payload
