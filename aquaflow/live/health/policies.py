"""Headers that tell a browser what other sites may do with the answers: nothing."""

from __future__ import annotations

import re

from aquaflow.web.access import name_of

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
