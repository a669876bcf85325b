"""What the address of a stream says about it."""

from __future__ import annotations

from urllib.parse import urlsplit

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
