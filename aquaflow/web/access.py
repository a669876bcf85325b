"""Access control: open to this machine; other clients need the token, or a trusted address."""

from __future__ import annotations

import hmac
import ipaddress
import stat
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping
from pathlib import Path
from urllib.parse import parse_qs, urlsplit

from pydantic import IPvAnyNetwork

from aquaflow.base.errors import ConfigError, InputError, reason_of
from aquaflow.config.service import ListenConfig, is_loopback

COOKIE = "aquaflow_token"
"""Name of the cookie in which a browser keeps the token."""
COOKIE_S = 365 * 24 * 3600
"""s that a browser keeps the cookie: the token is asked for once a year."""
SHORTEST_TOKEN = 16
"""Characters; shorter ones can be guessed."""
MOST_GUESSES, GUESSES_S = 10, 60.0
"""Wrong tokens of one address in so many seconds, after which none of it is compared."""
MOST_ADDRESSES = 1000
"""Whose guesses are counted; the oldest are forgotten."""


def read_token(path: Path) -> str:
    """The token in a file that only its owner may read.

    Raises:
        InputError: the file cannot be read.
        ConfigError: others may read it, or the token is short.
    """
    try:
        token = path.read_text(encoding="ascii").strip()
        mode = path.stat().st_mode
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"cannot read the token file {path}: {reason_of(error)}") from error
    if mode & (stat.S_IRWXO | stat.S_IWGRP):
        raise ConfigError(f"others may read or change {path}; run: chmod 640 {path}")
    if len(token) < SHORTEST_TOKEN:
        raise ConfigError(f"the token in {path} is shorter than {SHORTEST_TOKEN} characters")
    return token


class Access:
    """The rule of one listening socket."""

    def __init__(self, config: ListenConfig, clock: Callable[[], float] = time.monotonic) -> None:
        """Raises what :func:`read_token` raises; ``clock``: seconds."""
        self.token = None if config.token_file is None else read_token(config.token_file)
        self._trusted, self._proxies = tuple(config.trusted), tuple(config.proxies)
        self._guesses = _Guesses(clock)

    def allows(self, target: str, headers: Mapping[str, str], peer: str = "") -> bool:
        """True if a request may be answered.

        Without a token the request must name this machine: else a web page that a name server
        leads here could read what is only for those on board. So must one from a trusted network
        name a machine of that network.

        Args:
            target: path and query, as the client wrote them.
            headers: by lower-case name.
            peer: the address that the connection comes from.
        """
        name = name_of(headers.get("host", ""))
        if self.token is None:
            return is_loopback(name)
        client = self._client(peer, headers)
        shown = self._accepts(_tokens(target, headers), client)
        return shown or (_is_local(name) and _within(client, self._trusted))

    def may_change(self, headers: Mapping[str, str], peer: str = "") -> bool:
        """True if a request may change something.

        The token must come in a header or in the cookie, which no other page's request carries: an
        address may be a link. A browser that names the page which asks must name one of ours.
        """
        return self.allows("", headers, peer) and _is_own_page(headers)

    def may_watch(
        self, target: str, headers: Mapping[str, str], peer: str, origins: list[str]
    ) -> bool:
        """True if a websocket may be opened.

        A browser lets every page open one, sends this machine's cookies along, and says only in
        Origin whose page it is (RFC 6455, 10.2). That must be none, our own, one of ``origins``, or
        a page that was told the token: it stands in the address or in Authorization.
        """
        if not self.allows(target, headers, peer):
            return False
        told = {name: value for name, value in headers.items() if name != "cookie"}
        listed = headers.get("origin") in origins
        return listed or _is_own_page(headers) or self.shows_token(target, told)

    def logs_in(self, given: str, headers: Mapping[str, str], peer: str) -> bool:
        """True if a form holds the token."""
        return self._accepts([given], self._client(peer, headers))

    def must_wait(self, headers: Mapping[str, str], peer: str) -> bool:
        """True if too many wrong tokens came from a client, whose next ones are not compared."""
        return self._guesses.too_many(self._client(peer, headers))

    def by_query(self, target: str, headers: Mapping[str, str], peer: str) -> bool:
        """True if the address itself carries the token: it belongs into a cookie then."""
        return self._accepts(_query_tokens(target), self._client(peer, headers))

    def shows_token(self, target: str, headers: Mapping[str, str]) -> bool:
        """True if a request shows the token: for its place in the queue, never for data."""
        return any(self._is_token(given) for given in _tokens(target, headers))

    def cookie(self) -> str:
        """The Set-Cookie header of a browser that showed the token."""
        return f"{COOKIE}={self.token}; HttpOnly; SameSite=Strict; Path=/; Max-Age={COOKIE_S}"

    def _accepts(self, tokens: list[str], client: str) -> bool:
        """True if one is right; wrong ones are counted, and too many make all of them wrong."""
        if not tokens or self._guesses.too_many(client):
            return False
        right = any(self._is_token(given) for given in tokens)
        self._guesses.note(client, right)
        return right

    def _is_token(self, given: str) -> bool:
        """Compare in constant time."""
        token = self.token
        return token is not None and hmac.compare_digest(
            given.encode(errors="replace"), token.encode()
        )

    def _client(self, peer: str, headers: Mapping[str, str]) -> str:
        """A proxy of the config, such as BlueOS's, states the address of the client that it serves;
        from elsewhere that header is only a claim."""
        stated = headers.get("x-real-ip", "")
        return stated if stated and _within(peer, self._proxies) else peer


class _Guesses:
    """Wrong tokens by the client's address.

    One that has shown the right token is not made to wait: else whoever shares its address, as
    behind a proxy, could lock the pilot out.
    """

    def __init__(self, clock: Callable[[], float]) -> None:
        self._clock, self._lock = clock, threading.Lock()
        self._wrong: dict[str, deque[float]] = {}
        self._right: dict[str, None] = {}

    def too_many(self, client: str) -> bool:
        """True until the first of the last ten wrong ones is a minute old."""
        with self._lock:
            times = self._wrong.get(client)
            if times is None or len(times) < MOST_GUESSES or client in self._right:
                return False
            return self._clock() - times[0] < GUESSES_S

    def note(self, client: str, right: bool) -> None:
        """A token came."""
        with self._lock:
            if right:
                self._right[client] = None
                self._wrong.pop(client, None)
            else:
                times = self._wrong.pop(client, deque(maxlen=MOST_GUESSES))
                times.append(self._clock())
                self._wrong[client] = times
            for kept in (self._right, self._wrong):
                if len(kept) > MOST_ADDRESSES:
                    del kept[next(iter(kept))]


def _within(address: str, networks: tuple[IPvAnyNetwork, ...]) -> bool:
    try:
        plain = ipaddress.ip_address(address)
    except ValueError:
        return False
    mapped = getattr(plain, "ipv4_mapped", None)
    return any((mapped or plain) in network for network in networks)


def _is_own_page(headers: Mapping[str, str]) -> bool:
    """False for what a browser sends on behalf of another site's page (Fetch Metadata, Origin)."""
    if headers.get("sec-fetch-site", "none") not in ("same-origin", "none"):
        return False
    origin = headers.get("origin")
    return origin is None or origin.partition("://")[2] == headers.get("host", "")


def name_of(host: str) -> str:
    """The name in a Host header, without port and brackets."""
    return host[1:].partition("]")[0] if host.startswith("[") else host.partition(":")[0]


def _is_local(name: str) -> bool:
    """True of an address, and of a name that no name server of the Internet answers."""
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return "." not in name or name.lower().endswith(".local")
    return True


def _tokens(target: str, headers: Mapping[str, str]) -> list[str]:
    """What the request shows as token: header, cookie or query."""
    given = _query_tokens(target)
    scheme, _, value = headers.get("authorization", "").partition(" ")
    if scheme.lower() == "bearer":
        given.append(value.strip())
    # Not by http.cookies, which gives up at the first cookie that it does not understand; and a
    # browser sends those of every service of the vehicle, whatever its port.
    for pair in headers.get("cookie", "").split(";"):
        name, _, value = pair.strip().partition("=")
        if name == COOKIE:
            given.append(value)
    return given


def path_of(target: str) -> str | None:
    """The path of a request's target; None if it is no address at all."""
    try:
        return urlsplit(target).path
    except ValueError:
        return None


def _query_tokens(target: str) -> list[str]:
    """Tokens in the query of a request's target."""
    try:
        return parse_qs(urlsplit(target).query).get("token", [])
    except ValueError:
        return []
