"""Network cameras that answer to ONVIF's discovery (WS-Discovery 1.0, Probe by multicast)."""

from __future__ import annotations

import re
import uuid
from collections.abc import Sequence
from urllib.parse import urlsplit

from aquaflow.drivers.network_discovery.conversation import Address, answers_to
from aquaflow.sources.discovery import FoundDevice

GROUP = ("239.255.255.250", 3702)
"""Of WS-Discovery."""
PROBE = """<?xml version="1.0" encoding="utf-8"?>
<e:Envelope xmlns:e="http://www.w3.org/2003/05/soap-envelope"
 xmlns:a="http://schemas.xmlsoap.org/ws/2004/08/addressing"
 xmlns:d="http://schemas.xmlsoap.org/ws/2005/04/discovery"
 xmlns:n="http://www.onvif.org/ver10/network/wsdl">
<e:Header><a:MessageID>urn:uuid:{number}</a:MessageID>
<a:To>urn:schemas-xmlsoap-org:ws:2005:04:discovery</a:To>
<a:Action>http://schemas.xmlsoap.org/ws/2005/04/discovery/Probe</a:Action></e:Header>
<e:Body><d:Probe><d:Types>n:NetworkVideoTransmitter</d:Types></d:Probe></e:Body>
</e:Envelope>"""
"""Asks for transmitters of video."""
ADDRESSES = re.compile(r"<(?:\w+:)?XAddrs>([^<]*)</")
MODEL = re.compile(r"onvif://www\.onvif\.org/(?:hardware|name)/([^\s<]+)")
"""Parts of an answer; the answers of many makers are no valid XML."""


def onvif_cameras(hosts: Sequence[str], group: Address = GROUP) -> list[FoundDevice]:
    """Cameras that answer; a camera tells its streams only to who knows its password."""
    if not hosts:
        return []
    probe = PROBE.format(number=uuid.uuid4()).encode()
    found: dict[str, FoundDevice] = {}
    for answer, sender in answers_to(probe, group):
        text = answer.decode("utf-8", "replace")
        addresses, model = ADDRESSES.search(text), MODEL.search(text)
        if addresses is None or not addresses[1].split():
            continue
        service = addresses[1].split()[0]
        host = _host_of(service) or sender
        name = f"ONVIF camera {model[1] if model else ''}".strip()
        detail = f"its service is {service}; the path of its stream stands on its page"
        url = f"rtsp://{f'[{host}]' if ':' in host else host}:554/"
        config = {"kind": "stream", "url": url}
        found[host] = FoundDevice("stream", service, f"{name} at {host}", detail, config)
    return list(found.values())


def _host_of(url: str) -> str | None:
    try:
        return urlsplit(url).hostname
    except ValueError:
        return None
