"""Which pictures of a stream are too old to be used, and when the others were taken."""

from __future__ import annotations

from aquaflow.config.cameras import StreamConfig
from aquaflow.drivers.stream.address import has_stream_time
from aquaflow.drivers.stream.stream_clock import StreamClock

UNKNOWN = "the age of its pictures is not known yet"


class Ages:
    """Of the pictures of one connection."""

    def __init__(self, name: str, config: StreamConfig) -> None:
        """``name`` of the camera."""
        self._latency_ns = round(config.latency_s * 1e9)
        self._max_ns = None if config.max_age_s is None else round(config.max_age_s * 1e9)
        self._clock = StreamClock(f"stream '{name}'") if has_stream_time(config.url) else None

    def judged(self, stream_ns: int, arrival_ns: int) -> tuple[int, str]:
        """When a picture was taken, and why it is too old; empty: it is not.

        ``stream_ns`` is the stream's own time, of no meaning where it carries none.
        """
        if self._clock is None or self._max_ns is None:
            return arrival_ns - self._latency_ns, ""
        t_ns = self._clock.moment(stream_ns, arrival_ns)
        if t_ns is None:
            return arrival_ns - self._latency_ns, UNKNOWN
        age_ns = arrival_ns - t_ns + self._latency_ns
        is_old = age_ns > self._max_ns
        said = f"its pictures are {age_ns * 1e-9:.1f} s old" if is_old else ""
        return t_ns - self._latency_ns, said
