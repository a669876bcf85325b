"""When a picture was exposed: what the device claims, checked, strictly increasing.

Device time synchronisation has been seen to jump by seconds (luxonis/depthai-ros#53), and vivid's
stamps lie up to 30 ms in the future; a wrong time costs more than a slightly late one.
"""

from __future__ import annotations

MAX_FUTURE_NS = 50_000_000
"""A stamp may lie this far after the arrival: vivid's do by up to 30 ms."""

MAX_LATENCY_NS = 2_000_000_000
"""An older stamp is rejected; the slowest live path seen is an RTSP camera with 1 s."""

MAX_SLEW = 0.01
"""The offset between device and host follows the claimed offset by at most this much per second of
device time: drift is 1e-4 at worst, so a jump of synchronisation is recognised."""

REPAIR_NS = 5_000_000
"""A time that differs by more than this from what was claimed counts as repaired; following the
drift of two clocks does not."""


class ExposureClock:
    """Turns claimed exposure times into reliable CLOCK_MONOTONIC times.

    Where the device also gives its own clock, time advances by that clock, and a jump of the
    host's idea of it is bridged. Otherwise an implausible claim is replaced by the arrival.
    """

    def __init__(self) -> None:
        self.repaired = 0
        """Stamps that were not what the device claimed."""
        self._last_ns = -1
        self._device_ns: int | None = None
        self._offset_ns = 0

    def stamp(self, claimed_ns: int | None, device_ns: int | None, arrival_ns: int) -> int:
        """Moment of exposure of a picture that arrived at ``arrival_ns``."""
        source_ns = claimed_ns if claimed_ns is not None else arrival_ns
        t_ns = source_ns
        if device_ns is not None and claimed_ns is not None:
            t_ns = self._bridged(claimed_ns, device_ns, arrival_ns)
        if not _plausible(t_ns, arrival_ns):
            t_ns = arrival_ns
        t_ns = max(t_ns, self._last_ns + 1)
        self.repaired += abs(t_ns - source_ns) > REPAIR_NS
        self._last_ns = t_ns
        return t_ns

    def _bridged(self, claimed_ns: int, device_ns: int, arrival_ns: int) -> int:
        """The device's clock plus an offset that follows the claimed one slowly."""
        wanted_ns = claimed_ns - device_ns
        known = self._device_ns is not None and _plausible(device_ns + self._offset_ns, arrival_ns)
        if not known:
            self._offset_ns = wanted_ns
        elif _plausible(claimed_ns, arrival_ns) and self._device_ns is not None:
            reach_ns = round(abs(device_ns - self._device_ns) * MAX_SLEW)
            self._offset_ns += max(-reach_ns, min(reach_ns, wanted_ns - self._offset_ns))
        self._device_ns = device_ns
        return device_ns + self._offset_ns


def _plausible(t_ns: int, arrival_ns: int) -> bool:
    return -MAX_FUTURE_NS <= arrival_ns - t_ns <= MAX_LATENCY_NS
