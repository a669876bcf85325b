"""A connection of uvicorn's, with limits: how many one client may hold, and for how long.

HTTP is parsed by h11. What is added here stands against clients that hold connections without
using them (slow heads, bodies and readers: "Slowloris"). A newcomer is not refused where there is
no room: the oldest connection that waits for its client goes. An ordinary request is complete as
it comes, so that a client that does the same with sixty sockets displaces its own.
"""

from __future__ import annotations

import asyncio
import ipaddress
from collections import Counter
from typing import Any

import h11
from uvicorn.protocols.http.h11_impl import H11Protocol

from aquaflow.config.service import is_loopback

REQUEST_S = 10.0
"""s within which a whole request, head and body, must have come."""
ANSWER_S, SLOWEST_BYTES_S = 10.0, 16_384
"""s within which an answer must be taken, and bytes/s of a long one: far below a tether's."""
MOST, MOST_STRANGERS, MOST_OF_ADDRESS = 64, 48, 16
"""Connections of one server: of all; of those neither from this machine nor with the token; and
of these, from one address. A browser opens six."""
MOMENT_S, MOST_FOR_A_MOMENT = 1.0, 256
"""s in which a newcomer may send its request before anybody is displaced, and how many may be there
in them: who connects anew as fast as it is cut off displaces nobody that has just come."""


class Connections:
    """Who is connected to one server, and whom a newcomer displaces."""

    def __init__(self) -> None:
        self._here: set[Connection] = set()

    def admit(self, newcomer: Connection) -> None:
        """Take it in; where a group is too large after a moment, its oldest goes."""
        self._here.add(newcomer)
        newcomer.loop.call_later(MOMENT_S, self._trim)
        if len(self._here) > MOST_FOR_A_MOMENT:
            self._trim()

    def leave(self, connection: Connection) -> None:
        """It was closed, or is no longer one of HTTP."""
        self._here.discard(connection)

    def end(self) -> None:
        """The server stops: nobody is waited for."""
        for each in self._here:
            each.transport.abort()

    def _trim(self) -> None:
        while group := self._too_large():
            oldest = min(group, key=lambda each: (each.answering, each.since))
            self.leave(oldest)
            oldest.transport.abort()

    def _too_large(self) -> list[Connection]:
        known = [each for each in self._here if each.known]
        others = [each for each in self._here if not each.known]
        for address, count in Counter(each.address for each in others).items():
            if count > MOST_OF_ADDRESS:
                return [each for each in others if each.address == address]
        if len(others) > MOST_STRANGERS:
            return others
        return known if len(self._here) > MOST else []


class Connection(H11Protocol):
    """One connection; ``known`` where it comes from this machine or has shown the token."""

    def __init__(self, connections: Connections, *args: Any, **named: Any) -> None:
        """``args`` and ``named``: what uvicorn hands over."""
        super().__init__(*args, **named)
        self.app_state = {**self.app_state, "connection": self}
        self._others = connections
        self._request_timer: asyncio.TimerHandle | None = None
        self._answer_timer: asyncio.TimerHandle | None = None
        self._heard = False
        self.known, self.address, self.since = False, "", 0.0

    @property
    def answering(self) -> bool:
        """True from the end of a request's head to the end of its answer."""
        return self.cycle is not None and not self.cycle.response_complete

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Admit the client, which displaces another where there is no room."""
        super().connection_made(transport)
        transport.set_write_buffer_limits(high=0)  # told whenever something waits to be taken
        peer = self.client[0] if self.client else ""
        self.address, self.known = group_of(peer), is_loopback(peer)
        self._await_request()
        self._others.admit(self)

    def connection_lost(self, exc: Exception | None) -> None:
        """Give the room back."""
        self._others.leave(self)
        self._forget_timers()
        super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        """The time for a request begins with its first byte, and ends with its last."""
        if not self._heard:
            self._heard = True
            self._await_request()
        super().data_received(data)
        self._look()

    def eof_received(self) -> bool:  # type: ignore[override]
        """A client that has said all it will still gets its answer."""
        return self.answering

    def on_response_complete(self) -> None:
        """The next request may begin; what came of it already counts."""
        self._heard = False
        super().on_response_complete()
        self._await_request()
        self._look()

    def pause_writing(self) -> None:
        """Something waits for the client to take it."""
        super().pause_writing()
        seconds = ANSWER_S + self.transport.get_write_buffer_size() / SLOWEST_BYTES_S
        self._answer_timer = self.loop.call_later(seconds, self.transport.abort)

    def resume_writing(self) -> None:
        """All was taken."""
        super().resume_writing()
        if self._answer_timer is not None:
            self._answer_timer.cancel()

    def handle_websocket_upgrade(self, event: h11.Request) -> None:
        """From here on another protocol has the connection, and the application its limits."""
        self._others.leave(self)
        self._forget_timers()
        super().handle_websocket_upgrade(event)

    def _await_request(self) -> None:
        self.since = self.loop.time()
        if self._request_timer is not None:
            self._request_timer.cancel()
        self._request_timer = self.loop.call_later(REQUEST_S, self.transport.abort)

    def _look(self) -> None:
        """No time is set while a whole request waits for us."""
        waits = self.conn.their_state in (h11.IDLE, h11.SEND_BODY)
        if not waits and self._request_timer is not None:
            self._request_timer.cancel()

    def _forget_timers(self) -> None:
        for timer in (self._request_timer, self._answer_timer):
            if timer is not None:
                timer.cancel()


def group_of(peer: str) -> str:
    """What counts as one address: of IPv6 its first 64 bits, as one host may have all the rest."""
    try:
        address = ipaddress.ip_address(peer)
    except ValueError:
        return peer
    if isinstance(address, ipaddress.IPv4Address):
        return peer
    if address.ipv4_mapped is not None:
        return str(address.ipv4_mapped)
    return str(ipaddress.ip_network((int(address), 64), strict=False))
