"""Attitude and velocity from instruments that measure only a part of them."""

from __future__ import annotations

from aquaflow.config.stage import Assumptions
from aquaflow.drivers.fixes import from_euler
from aquaflow.types import AngularRate, Attitude, TelemetrySample, Velocity

TILT_LIFE_NS = 500_000_000
"""Roll and pitch older than this are not used: an ROV rocks within a second."""


class PartialMotion:
    """Completes one instrument's values from the others on its link or from ``assume``.

    What stays unknown makes no sample: a heading that pretended to know roll and pitch would turn
    gravity.
    """

    def __init__(self, assume: Assumptions) -> None:
        self._assume = assume
        self._tilt: tuple[int, float, float] | None = None

    def attitude(
        self, t_ns: int, source: str, roll: float, pitch: float, yaw: float
    ) -> list[TelemetrySample]:
        """All three angles are known."""
        self.tilt(t_ns, roll, pitch)
        return [Attitude(t_ns, t_ns, source, from_euler(roll, pitch, yaw))]

    def tilt(self, t_ns: int, roll: float, pitch: float) -> None:
        """Roll and pitch are known."""
        self._tilt = (t_ns, roll, pitch)

    def heading(self, t_ns: int, source: str, yaw: float) -> list[TelemetrySample]:
        """Only the heading is known, clockwise from true north."""
        tilt = self._tilt
        if tilt is not None and t_ns - tilt[0] <= TILT_LIFE_NS:
            return [Attitude(t_ns, t_ns, source, from_euler(tilt[1], tilt[2], yaw))]
        if self._assume.level:
            return [Attitude(t_ns, t_ns, source, from_euler(0.0, 0.0, yaw))]
        return []

    def turn(self, t_ns: int, source: str, rate_rad_s: float) -> list[TelemetrySample]:
        """Only the rate of turn about the vertical is known, positive to starboard."""
        if not self._assume.level:
            return []
        return [AngularRate(t_ns, t_ns, source, (0.0, 0.0, rate_rad_s))]

    def speed(
        self, t_ns: int, source: str, forward_m_s: float, right_m_s: float | None
    ) -> list[TelemetrySample]:
        """Speed over ground is known ahead, and perhaps sideways."""
        if not self._assume.level or (right_m_s is None and not self._assume.no_side_slip):
            return []
        velocity = (forward_m_s, right_m_s or 0.0, 0.0)
        return [Velocity(t_ns, t_ns, source, velocity, self._assume.speed_sigma_m_s)]
