"""Foxglove's websocket server with the topics of a dive.

The protocol is Foxglove's own (github.com/foxglove/ws-protocol), of which a server
that only shows needs four messages. It is spoken here because foxglove-sdk's server lets every
web page in: it looks at neither Host nor Origin, and knows no token.
"""

from __future__ import annotations

import asyncio
import json
import logging
import struct
import threading
import uuid
from collections import deque
from contextlib import suppress
from importlib.util import find_spec
from typing import Any

from aquaflow.base.errors import InputError
from aquaflow.config.service import FoxgloveConfig
from aquaflow.dive.ros.topics import (
    MESSAGE_ENCODING,
    OF_FINISHED_DIVES,
    SCHEMA_ENCODING,
    TYPES,
    definition,
    encode,
    require_rosbags,
)
from aquaflow.web import HttpRequest, HttpResponse, WebServer
from aquaflow.web.access import Access

log = logging.getLogger(__name__)

BACKLOG = 32
"""Messages that wait for one client, a few MB; of more its oldest are dropped: it sees less, and
nobody waits."""
MOST_CLIENTS = 8
"""Foxglove in some windows, and a node of ROS."""
MOST_SUBSCRIPTIONS = 256
"""Of one client; there are some twenty topics."""
PROTOCOLS = ("foxglove.sdk.v1", "foxglove.websocket.v1")
"""Names of the protocol, the newer first; what is sent here is the same in both."""
MESSAGE_DATA, MESSAGE_HEADER = 1, struct.Struct("<BIQ")
"""Opcode; opcode, subscription and time (ns) before a message's bytes."""
TAKING_S, SLOWEST_BYTES_S = 10.0, 16_384
"""s within which a client must take a message, and bytes/s of a large one."""


class FoxgloveServer:
    """Sends messages to whoever has subscribed; ``send`` never waits for a client."""

    def __init__(self, config: FoxgloveConfig, name: str) -> None:
        """Begin to listen.

        Raises:
            InputError: a library is missing, the address is taken, or no token can be read.
            ConfigError: the token will not do.
        """
        require_rosbags()
        if find_spec("websockets") is None:
            raise InputError(
                "service.foxglove.enabled needs websockets; install it: pip install "
                "'aquaflow[foxglove,recording]'"
            )
        self._access, self._origins = Access(config), config.origins
        self._numbers = {
            topic: number
            for number, topic in enumerate(
                (each for each in TYPES if each not in OF_FINISHED_DIVES), 1
            )
        }
        self._greeting = [_server_info(name), self._advertisement()]
        self._clients: set[_Client] = set()
        self._lock = threading.Lock()
        key = "service.foxglove"
        self._server = WebServer(config, self._access, _no_page, key, watcher=self._watch)
        self.port = self._server.port

    def is_wanted(self, topic: str) -> bool:
        """True while a client has subscribed to it."""
        return bool(self._wanting(topic))

    def send(self, topic: str, t_ns: int, message: Any) -> None:
        """Queue a message for every client that has subscribed."""
        wanting = self._wanting(topic)
        if wanting:
            data = encode(message)
            for client, subscription in wanting:
                client.put(MESSAGE_HEADER.pack(MESSAGE_DATA, subscription, t_ns), data)

    def close(self) -> None:
        """Let the clients go."""
        self._server.close()

    def _wanting(self, topic: str) -> list[tuple[_Client, int]]:
        number = self._numbers[topic]
        with self._lock:
            return [
                (client, subscription)
                for client in self._clients
                for subscription, channel in list(client.subscriptions.items())
                if channel == number
            ]

    def _advertisement(self) -> str:
        channels = [
            {
                "id": number, "topic": topic, "encoding": MESSAGE_ENCODING,
                "schemaName": TYPES[topic], "schemaEncoding": SCHEMA_ENCODING,
                "schema": definition(TYPES[topic]).decode(),
            }
            for topic, number in self._numbers.items()
        ]  # fmt: skip
        return json.dumps({"op": "advertise", "channels": channels})

    async def _watch(
        self, request: HttpRequest, scope: dict[str, Any], receive: Any, send: Any
    ) -> None:
        """One client, in the thread of the web server."""
        await receive()  # that it wants to be connected
        protocol = next((each for each in PROTOCOLS if each in scope["subprotocols"]), None)
        origin = request.headers.get("origin", "")
        shown = request.target, request.headers, request.peer
        allowed = self._access.may_watch(*shown, self._origins)
        if not allowed and origin:
            log.warning(
                "a page of %.100r was kept from Foxglove's socket; service.foxglove.origins lists "
                "pages that may read it, and an address with ?token= serves every page", origin,
            )  # fmt: skip
        if not allowed or protocol is None or len(self._clients) >= MOST_CLIENTS:
            await send({"type": "websocket.close"})  # before it was accepted: 403
            return
        await send({"type": "websocket.accept", "subprotocol": protocol})
        client = _Client(send, scope["state"]["connection"].transport)
        for text in self._greeting:
            await client.hand_over({"text": text}, len(text))
        with self._lock:
            self._clients.add(client)
        sending = asyncio.create_task(client.send_waiting())
        try:
            while (message := await receive())["type"] == "websocket.receive":
                client.handle_text(message.get("text") or "")
        finally:
            with self._lock:
                self._clients.discard(client)
            sending.cancel()
            client.cut_off()
            with suppress(asyncio.CancelledError, OSError):
                await sending


class _Client:
    """A connection that messages wait for."""

    def __init__(self, send: Any, transport: Any) -> None:
        """``send``: of ASGI."""
        self._send, self._transport = send, transport
        self._loop, self._some = asyncio.get_running_loop(), asyncio.Event()
        self._waiting: deque[tuple[bytes, bytes]] = deque(maxlen=BACKLOG)
        self.subscriptions: dict[int, int] = {}
        """Channels by the client's own numbers."""

    def put(self, header: bytes, data: bytes) -> None:
        """From any thread."""
        self._waiting.append((header, data))
        with suppress(RuntimeError):  # the server has stopped
            self._loop.call_soon_threadsafe(self._some.set)

    async def send_waiting(self) -> None:
        """One message at a time, until the client is gone."""
        while True:
            await self._some.wait()
            self._some.clear()
            while self._waiting:
                header, data = self._waiting.popleft()
                await self.hand_over({"bytes": header + data}, len(data))

    async def hand_over(self, message: dict[str, Any], size: int) -> None:
        """Wait until the client can take it; one that does not take what came before is cut off."""
        limit = TAKING_S + size / SLOWEST_BYTES_S
        try:
            await asyncio.wait_for(self._send({"type": "websocket.send", **message}), limit)
        except asyncio.TimeoutError:
            self.cut_off()

    def cut_off(self) -> None:
        """Wait for nothing that it has not taken."""
        self._transport.abort()

    def handle_text(self, text: str) -> None:
        """What is no request of the protocol is passed over."""
        try:
            said = json.loads(text)
            if said["op"] == "subscribe":
                new = {int(each["id"]): int(each["channelId"]) for each in said["subscriptions"]}
                both = {**self.subscriptions, **{k: v for k, v in new.items() if 0 <= k < 1 << 32}}
                if len(both) <= MOST_SUBSCRIPTIONS:
                    self.subscriptions = both
            elif said["op"] == "unsubscribe":
                gone = set(said["subscriptionIds"])
                kept = {k: v for k, v in self.subscriptions.items() if k not in gone}
                self.subscriptions = kept
        except (ValueError, TypeError, KeyError, RecursionError):
            log.debug("a client of Foxglove's socket said %.100r", text)


def _server_info(name: str) -> str:
    said = {
        "op": "serverInfo", "name": name, "capabilities": [], "supportedEncodings": [],
        "metadata": {}, "sessionId": uuid.uuid4().hex,
    }  # fmt: skip
    return json.dumps(said)


def _no_page(_: HttpRequest) -> HttpResponse:
    return HttpResponse(426, "text/plain", b"Open this address in Foxglove, as ws://\n")
