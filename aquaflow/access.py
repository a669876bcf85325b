"""Access control: open to this machine; other clients need the token."""

from __future__ import annotations

import hmac
import stat
from collections.abc import Mapping
from http.cookies import CookieError, SimpleCookie
from pathlib import Path
from urllib.parse import parse_qs, urlsplit

from aquaflow.config.service import ListenConfig, is_loopback
from aquaflow.errors import ConfigError, InputError, reason_of

COOKIE = "aquaflow_token"
"""Name of the cookie in which a browser keeps the token."""
SHORTEST_TOKEN = 16
"""Characters; shorter ones can be guessed."""


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

    def __init__(self, config: ListenConfig) -> None:
        """Raises what :func:`read_token` raises."""
        self.token = None if config.token_file is None else read_token(config.token_file)

    def allows(self, target: str, headers: Mapping[str, str]) -> bool:
        """True if a request may be answered; ``headers`` by lower-case name.

        Without a token the request must name this machine: else a web page that a name server
        leads here could read what is only for those on board.
        """
        if self.token is None:
            return is_loopback(_name_of(headers.get("host", "")))
        return any(hmac.compare_digest(given, self.token) for given in _tokens(target, headers))

    def by_query(self, target: str) -> bool:
        """True if the address itself carries the token: it belongs into a cookie then."""
        given = _asked(target)
        return self.token is not None and any(
            hmac.compare_digest(each.encode(), self.token.encode()) for each in given
        )

    def cookie(self) -> str:
        """The Set-Cookie header of a browser that showed the token."""
        return f"{COOKIE}={self.token}; HttpOnly; SameSite=Strict; Path=/"


def _name_of(host: str) -> str:
    """Without port and brackets."""
    return host[1:].partition("]")[0] if host.startswith("[") else host.partition(":")[0]


def _tokens(target: str, headers: Mapping[str, str]) -> list[str]:
    """What the request shows as token: header, cookie or query, as ASCII."""
    given = _asked(target)
    scheme, _, value = headers.get("authorization", "").partition(" ")
    if scheme.lower() == "bearer":
        given.append(value.strip())
    try:
        cookie = SimpleCookie(headers.get("cookie", "")).get(COOKIE)
    except CookieError:
        cookie = None
    if cookie is not None:
        given.append(cookie.value)
    return [each for each in given if each.isascii()]


def path_of(target: str) -> str | None:
    """The path of a request's target; None if it is no address at all."""
    try:
        return urlsplit(target).path
    except ValueError:
        return None


def _asked(target: str) -> list[str]:
    """Tokens in the query of a request's target."""
    try:
        return parse_qs(urlsplit(target).query).get("token", [])
    except ValueError:
        return []
