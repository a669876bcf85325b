"""Settings of devices on a CAN bus."""

from __future__ import annotations

from typing import Literal

from pydantic import Field, model_validator

from aquaflow.config.device import Assumptions, PositioningConfig
from aquaflow.config.link import CanConfig
from aquaflow.config.stage import StageConfig


class Nmea2000Config(PositioningConfig):
    """Instruments on an NMEA 2000 bus."""

    kind: Literal["nmea2000"] = "nmea2000"
    link: CanConfig
    assume: Assumptions = Assumptions()


class DbcSignal(StageConfig):
    """Signals of one CAN message that make a sample."""

    message: str
    sample: Literal[
        "depth", "attitude", "euler", "angular_rate", "acceleration", "velocity", "altitude",
        "lights", "position",
    ] = Field(
        description="attitude: quaternion wxyz; euler: roll, pitch, yaw; position: latitude, "
        "longitude"
    )  # fmt: skip
    signals: tuple[str, ...]
    scale: tuple[float, ...] = Field(
        (1.0,),
        description="to metres, radians, seconds and the body's axes, of a position to degrees: "
        "one, or one each",
    )
    sigma_m_s: float = Field(0.1, gt=0, description="m/s, figure of merit of a velocity")

    @model_validator(mode="after")
    def _has_as_many_signals_as_the_sample_has_values(self) -> DbcSignal:
        counts = {"depth": 1, "altitude": 1, "lights": 1, "position": 2, "attitude": 4}
        count = counts.get(self.sample, 3)
        if len(self.signals) != count:
            raise ValueError(f"a sample '{self.sample}' is made of {count} signals")
        if len(self.scale) not in (1, count):
            raise ValueError(f"scale holds 1 or {count} values")
        return self


class DbcConfig(PositioningConfig):
    """Any CAN bus that a DBC file describes."""

    kind: Literal["dbc"] = "dbc"
    link: CanConfig
    database: str = Field(description="path of the .dbc file")
    samples: tuple[DbcSignal, ...] = Field(min_length=1)
