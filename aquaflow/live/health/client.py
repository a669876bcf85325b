"""Client for the status of a running service."""

from __future__ import annotations

import http.client
import json
from typing import Any
from urllib.parse import urlsplit

from aquaflow.base.errors import InputError, reason_of

PATIENCE_S = 5.0
"""Wait for an answer; the service answers within milliseconds or hangs."""
MOST_BYTES = 1 << 20
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
        body = answer.read(MOST_BYTES)
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
        InputError: it is no address of a service.
    """
    try:
        parts = urlsplit(url)
        host, port = parts.hostname, parts.port
        if parts.scheme == "http" and host and len(host) <= MOST_NAME and host.encode("idna"):
            return host, 80 if port is None else port
    except ValueError:
        pass
    raise InputError(f"'{url[:SHOWN]}' is no address such as http://127.0.0.1:8230")
