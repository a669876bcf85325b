"""Which pictures of a stream are too old to be used, and when the others were taken."""

from __future__ import annotations

from collections import deque

from aquaflow.base.clocks.device import ClockMapping
from aquaflow.config.cameras import StreamConfig
from aquaflow.drivers.stream.address import has_stream_time

UNKNOWN = "the age of its pictures is not known yet"


class Ages:
    """Of the pictures of one connection."""

    def __init__(self, name: str, config: StreamConfig) -> None:
        """``name`` of the camera."""
        self._latency_ns = round(config.latency_s * 1e9)
        self._max_ns = None if config.max_age_s is None else round(config.max_age_s * 1e9)
        self._clock = StreamClock(f"stream '{name}'") if has_stream_time(config.url) else None

    def judge(self, stream_ns: int, arrival_ns: int) -> tuple[int, str]:
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


# --------------------------------------------------------------------------------------------------
# When a picture of a stream was taken, by the time that the stream itself carries.
#
# A picture's arrival says nothing of its age: what a broken connection, a server or a decoder held
# back arrives late, and looks fresh. The presentation time that RTP and MPEG-TS carry does tell:
# its distance to the arrival is smallest for the picture that was held back the least, and what
# another one has more, it was late. The least distance of two minutes, the drift of the two clocks
# taken out, is :class:`aquaflow.base.clocks.device.ClockMapping`'s.

PACED = 5
"""Pictures by whose pace a connection is judged: 0.13 s at 30 pictures/s."""
PACE = 0.8
"""A stream that is read as it is filmed takes as long between its pictures as their times differ;
what was held back comes as fast as it is decoded. Between five pictures at 30 a second, 20 ms of
jitter stay above this."""
MAX_FUTURE_NS = 50_000_000
"""No picture comes before it is taken; more is a jump of the stream's time, not jitter."""
MAX_DRIFT = 0.005
"""Some cameras count pictures instead of time: 30 a second stated, and 29.97 taken, are 0.1 %."""


class StreamClock:
    """The times of one connection on CLOCK_MONOTONIC."""

    def __init__(self, name: str) -> None:
        """``name`` of the stream, for the log."""
        self._mapping = ClockMapping(name, MAX_DRIFT)
        self._recent: deque[tuple[int, int]] = deque(maxlen=PACED)
        self._resets = 0
        self._settled = False

    def moment(self, stream_ns: int, arrival_ns: int) -> int | None:
        """When a picture with the time ``stream_ns`` would have arrived, had nothing held it back.

        None while that is not known: until pictures come at the pace at which they were taken, at
        the start and after a jump of the stream's time.
        """
        self._mapping.add(stream_ns, arrival_ns)
        if self._mapping.resets != self._resets:
            self._resets, self._settled = self._mapping.resets, False
            self._recent.clear()
        self._recent.append((stream_ns, arrival_ns))
        self._settled = self._settled or self._is_paced()
        t_ns = self._mapping.to_monotonic(stream_ns)
        if not self._settled or t_ns is None or t_ns > arrival_ns + MAX_FUTURE_NS:
            return None
        return min(t_ns, arrival_ns)

    def _is_paced(self) -> bool:
        (first_ns, since_ns), (last_ns, until_ns) = self._recent[0], self._recent[-1]
        taken_ns, came_ns = last_ns - first_ns, until_ns - since_ns
        return len(self._recent) == PACED and 0 < PACE * taken_ns <= came_ns
