"""Video of BlueOS, as its camera manager lists it (mavlink-camera-manager, GET /streams).

What goes out by RTSP is there for whoever asks. What goes out by UDP reaches one address, by
default that of the surface, where nothing on board can read it.
"""

from __future__ import annotations

import socket
from collections.abc import Sequence
from contextlib import closing
from functools import partial
from ipaddress import ip_address
from typing import Any
from urllib.parse import SplitResult, urlsplit

from aquaflow.drivers.network_discovery.conversation import json_of, of_each
from aquaflow.sources.discovery import FoundDevice

PORT = 6020
"""Of its interface; BlueOS's extensions with the vehicle's network reach it too."""
SCHEMES = ("rtsp", "rtspt", "rtspu", "rtsph", "rtsps")
"""By which GStreamer also names a transport; for FFmpeg the setting ``transport`` does."""
RTSP_PORT = 554
"""Where the address names none."""
FREE_PORT = 5610
"""Port that the advice names; BlueOS numbers its own from 5600."""
HERE = ("127.0.0.1", "localhost", "0.0.0.0")
"""Hosts of an endpoint that the manager's own computer receives."""


def blueos_streams(hosts: Sequence[str], port: int = PORT) -> list[FoundDevice]:
    """Streams of the managers at ``hosts``, with what to do where none of it can be read."""
    found = of_each(hosts, partial(_of_host, port=port))
    return list({each.id: each for each in reversed(found)}.values())[::-1]


def rtsp_ports(host: str, port: int = PORT) -> set[int]:
    """Ports of ``host`` whose streams its manager names."""
    urls = [urlsplit(each.id) for each in _of_host(host, port)]
    return {each.port or RTSP_PORT for each in urls if each.scheme.startswith("rtsp")}


def netloc(host: str, port: int) -> str:
    """Of a URL."""
    return f"[{host}]:{port}" if ":" in host else f"{host}:{port}"


def _of_host(host: str, port: int) -> list[FoundDevice]:
    found, listed = [], json_of((host, port), "/streams")
    for status in listed if isinstance(listed, list) else []:
        try:
            stream = status["video_and_stream"]
            information = stream["stream_information"]
            urls = [urlsplit(str(url)) for url in information["endpoints"]]
            ports = [url.port for url in urls]  # ValueError: it is none
            picture, name = _picture(information["configuration"]), str(stream["name"])
            picture += "" if status.get("running", True) else ", not running"
        except (KeyError, TypeError, AttributeError, ValueError):
            continue  # of another version than those that are known
        served = [_serve(host, url, name, picture) for url in urls if url.scheme in SCHEMES]
        sent = ports and all(url.scheme == "udp" for url in urls)
        found += [_send(host, urls, name, picture)] if sent else served
    return found


def _picture(configuration: dict[str, Any]) -> str:
    """Codec and size, as far as the manager knows them; of a redirected stream it does not."""
    codec = str(configuration.get("encode", "video"))
    size = [configuration.get(side) for side in ("width", "height")]
    return f"{codec}, {size[0]} x {size[1]}" if all(size) else codec


def _serve(host: str, url: SplitResult, name: str, picture: str) -> FoundDevice:
    """By RTSP. The manager names the interface that it listens on, which may be any."""
    scheme = "rtsps" if url.scheme == "rtsps" else "rtsp"
    there = url._replace(scheme=scheme, netloc=netloc(host, url.port or RTSP_PORT)).geturl()
    config = {"kind": "stream", "url": there}
    return FoundDevice("stream", there, f"BlueOS: {name}", picture, config)


def _send(host: str, urls: list[SplitResult], name: str, picture: str) -> FoundDevice:
    """By UDP, to this computer or, until an endpoint is added, to others only."""
    own = _own_address(host)
    ours = (own, *HERE) if _is_loopback(own) else (own,)
    ports = [url.port for url in urls if url.hostname in ours and url.port]
    sent = ", ".join(url.geturl() for url in urls)
    endpoint = f"udp://{netloc(own, FREE_PORT)}"
    advice = f"; not here yet: in BlueOS, Video Streams, add the endpoint {endpoint}"
    config = {"kind": "stream", "url": f"udp://0.0.0.0:{ports[0] if ports else FREE_PORT}"}
    detail = f"{picture} to {sent}{'' if ports else advice}"
    return FoundDevice("stream", sent, f"BlueOS: {name}", detail, config)


def _own_address(host: str) -> str:
    """Of this computer, as ``host`` sees it."""
    with closing(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) as towards:
        try:
            towards.connect((host, PORT))  # sends nothing
            return str(towards.getsockname()[0])
        except (OSError, ValueError):
            return "127.0.0.1"


def _is_loopback(address: str) -> bool:
    return ip_address(address).is_loopback
