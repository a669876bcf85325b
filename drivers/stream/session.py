"""What RTP packets at a port carry: by a session description (SDP, RFC 8866), or by the config.

RTP packets (RFC 3550) do not say it themselves.
"""

from __future__ import annotations

import base64
import binascii
import re
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import urlsplit

from aquaflow.config.cameras import StreamConfig
from aquaflow.drivers.stream.udp_port import Port

RTP_VERSION = 2
"""In the upper two bits of an RTP packet's first byte."""
FIRST_DYNAMIC = 96
"""Payload types from here on mean what the session says (RFC 3551)."""

MEDIA = re.compile(r"^m=video (\d+)(?:/\d+)? RTP/\S+ ([\d ]+)", re.MULTILINE)
ADDRESS = re.compile(r"^c=IN IP4 ([\d.]+)", re.MULTILINE)
CODEC = re.compile(r"^a=rtpmap:(\d+) ([\w-]+)/", re.MULTILINE)
PARAMETERS = re.compile(r"^a=fmtp:(\d+) .*sprop-parameter-sets=([^;\s]+)", re.MULTILINE)
"""Lines of an SDP: port and payload types of the video; the address that it is sent to; what a
payload type is; H.264's parameters (RFC 6184, 8.1)."""


@dataclass(frozen=True)
class Session:
    """What is sent to a port."""

    port: Port
    payload_types: tuple[int, ...] | None
    """That its packets may have; None: any."""
    codecs: dict[int, str]
    """In lower letters, of each payload type that the description explains."""
    codec: str
    """Of the others."""
    parameters: tuple[bytes, ...] = ()
    """H.264's, where the description holds them."""
    text: str = ""
    """The description itself, if there is one."""

    def payload_type(self, packet: bytes) -> int:
        """Of a packet that came.

        Raises:
            ConnectionError: it is no RTP, or has another payload type than it should.
        """
        if packet[0] >> 6 != RTP_VERSION:
            where = f"UDP port {self.port.number}"
            raise ConnectionError(f"what comes to {where} is neither RTP nor MPEG-TS")
        found = packet[1] & 0x7F
        if self.payload_types is not None and found not in self.payload_types:
            wanted = " or ".join(str(each) for each in self.payload_types)
            raise ConnectionError(
                f"packets on UDP port {self.port.number} have the RTP payload type {found}, not "
                f"{wanted}; change the payload type here, or in the camera"
            )
        return found

    def is_h264(self, payload_type: int) -> bool:
        """False for what FFmpeg has to read."""
        return payload_type >= FIRST_DYNAMIC and self._codec(payload_type) == "h264"

    def data_url(self, payload_type: int) -> str:
        """The description, as FFmpeg opens it."""
        text = self.text or self._description(payload_type)
        return "data:application/sdp;base64," + base64.b64encode(text.encode()).decode()

    def _codec(self, payload_type: int) -> str:
        return self.codecs.get(payload_type, self.codec)

    def _description(self, payload_type: int) -> str:
        lines = [
            *("v=0", "o=- 0 0 IN IP4 127.0.0.1", "s=camera", "t=0 0"),
            f"c=IN IP4 {self.port.group or '127.0.0.1'}",
            f"m=video {self.port.number} RTP/AVP {payload_type}",
        ]
        if payload_type >= FIRST_DYNAMIC:
            lines.append(f"a=rtpmap:{payload_type} {self._codec(payload_type).upper()}/90000")
        return "".join(f"{line}\r\n" for line in lines)


def session_of(config: StreamConfig) -> Session:
    """Of a stream at a port.

    Raises:
        ConnectionError: the description is none of a video.
        FileNotFoundError: there is no such SDP file.
    """
    if is_session(config.url):
        return _describe(_text(config.url), config.codec)
    parts = urlsplit(config.url)
    expected = None if config.payload_type is None else (config.payload_type,)
    return Session(Port(parts.hostname or "", parts.port or 0), expected, {}, config.codec)


def _text(url: str) -> str:
    if url.startswith("v=0"):
        return url
    try:
        return Path(url).read_text()
    except OSError as error:
        raise FileNotFoundError(f"cannot read the session description {url}: {error}") from error


def _describe(text: str, codec: str) -> Session:
    media, address = MEDIA.search(text), ADDRESS.search(text)
    if media is None:
        raise ConnectionError("the session description (SDP) holds no line 'm=video PORT RTP/AVP'")
    port = Port("" if address is None else address[1], int(media[1]))
    payload_types = tuple(int(each) for each in media[2].split())
    codecs = {int(number): name.lower() for number, name in CODEC.findall(text)}
    stated = dict(PARAMETERS.findall(text)).get(str(payload_types[0]), "")
    return Session(port, payload_types, codecs, codec, _parameters(stated), text)


def _parameters(stated: str) -> tuple[bytes, ...]:
    """None where they are damaged: the stream itself brings them, too."""
    try:
        sets = tuple(base64.b64decode(each, validate=True) for each in stated.split(",") if each)
    except binascii.Error:
        return ()
    return sets if all(sets) else ()


# --------------------------------------------------------------------------------------------------
# What the address of a stream says about it.

TIMED = frozenset({"rtsp", "rtsps", "rtp", "udp"})
"""Schemes of RTP and MPEG-TS, which carry the time of each picture. Motion JPEG over HTTP has none,
and bare H.264 over TCP neither: FFmpeg invents 25 pictures/s for both."""


def is_session(url: str) -> bool:
    """True for a session description (SDP): its file, or its text."""
    return url.startswith("v=0") or "://" not in url


def is_at_a_port(url: str) -> bool:
    """True for packets that are sent to a UDP port of this computer."""
    return is_session(url) or urlsplit(url).scheme in {"udp", "rtp"}


def has_stream_time(url: str) -> bool:
    """True if pictures come with the time at which they were taken, on the sender's clock."""
    return is_session(url) or urlsplit(url).scheme in TIMED


def for_logs(url: str) -> str:
    """Without the password, with which cameras are often addressed; an SDP's text by its name."""
    if url.startswith("v=0"):
        return "the session description"
    parts = urlsplit(url)
    if parts.username is None and parts.password is None:
        return url
    return parts._replace(netloc=parts.netloc.rpartition("@")[2]).geturl()
