"""Asking a running service how it is."""

from __future__ import annotations

import http.client
import json
from typing import Any
from urllib.parse import urlsplit

from aquaflow.errors import InputError

PATIENCE_S = 5.0


def ask(url: str, token: str | None = None) -> dict[str, Any]:
    """The report of the service at ``url``, such as http://127.0.0.1:8230.

    Raises:
        InputError: nobody answers there, or not with a report.
    """
    parts = urlsplit(url)
    if parts.scheme != "http" or not parts.hostname:
        raise InputError(f"{url} is no address such as http://127.0.0.1:8230")
    connection = http.client.HTTPConnection(parts.hostname, parts.port or 80, timeout=PATIENCE_S)
    headers = {} if token is None else {"Authorization": f"Bearer {token}"}
    try:
        connection.request("GET", "/health", headers=headers)
        answer = connection.getresponse()
        body = answer.read()
    except (OSError, http.client.HTTPException) as error:
        raise InputError(f"no service answers at {url}: {error}; is it running?") from error
    finally:
        connection.close()
    if answer.status == http.client.FORBIDDEN:
        raise InputError(f"{url} asks for a token; give --token-file")
    try:
        report: dict[str, Any] = json.loads(body)
        report["state"], report["reason"]
    except (ValueError, KeyError, TypeError) as error:
        raise InputError(f"what answers at {url} is no AquaFlow service") from error
    return report
