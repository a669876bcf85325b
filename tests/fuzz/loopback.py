"""A process that reaches no network beyond its own machine."""

from __future__ import annotations

import errno
import ipaddress
import socket
import sys
from typing import Any

REACHING = frozenset({"socket.connect", "socket.sendto", "socket.sendmsg"})
LOOKING_UP = frozenset({"socket.getaddrinfo", "socket.gethostbyname"})


HERE = ("", "localhost")


def only_loopback() -> None:
    """From now on, other addresses cannot be reached and other names are not known."""
    sys.addaudithook(_refuse_others)


def _refuse_others(event: str, arguments: tuple[Any, ...]) -> None:
    if event in REACHING:
        address = arguments[1]
        if isinstance(address, tuple) and not is_here(str(address[0])):
            raise OSError(errno.ENETUNREACH, "Network is unreachable")
    elif event in LOOKING_UP and _is_foreign_name(arguments[0]):
        raise socket.gaierror(socket.EAI_AGAIN, "Temporary failure in name resolution")


def _is_foreign_name(host: Any) -> bool:
    name = host.decode("ascii", "replace") if isinstance(host, bytes) else str(host or "")
    return name not in HERE and _address(name) is None


def is_here(host: str) -> bool:
    """True for this machine's own names and addresses."""
    address = _address(host)
    own = address is not None and (address.is_loopback or address.is_unspecified)
    return own or host in HERE


def _address(host: str) -> ipaddress.IPv4Address | ipaddress.IPv6Address | None:
    try:
        return ipaddress.ip_address(host)
    except ValueError:
        return None
