"""The unit of a dive's lengths, and how well scale and vertical are known."""

from __future__ import annotations

from dataclasses import dataclass

from aquaflow.telemetry.world_frame import WorldFrame


@dataclass(frozen=True)
class Scale:
    """What multiplies all lengths of a dive together, and turns all of it."""

    unit: str
    """Of lengths: ``m`` or ``map units``."""
    sigma: float
    """Relative 1 sigma of the scale. 0 in map units: there is no other ruler that it could differ
    from."""
    tilt_sigma_rad: float
    """1 sigma of the direction of the vertical; 0 where it is a convention and not gravity."""

    @property
    def square_unit(self) -> str:
        """Of areas."""
        return "m\u00b2" if self.unit == "m" else f"square {self.unit}"


def scale_of(frame: WorldFrame) -> Scale:
    """Of the lengths in n of a sub-map."""
    return Scale(
        frame.unit,
        frame.scale_sigma if frame.metric else 0.0,
        frame.tilt_sigma_rad if frame.level else 0.0,
    )
