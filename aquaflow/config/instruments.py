"""Settings of instruments: velocity logs, echo sounders, AHRS, and devices on a CAN bus."""

from __future__ import annotations

from typing import Literal, TypeAlias

from pydantic import Field, model_validator

from aquaflow.config.link import ByteLinkConfig, CanConfig
from aquaflow.config.stage import Assumptions, DeviceConfig, PositioningConfig, StageConfig


class WaterLinkedSerialConfig(DeviceConfig):
    """A Water Linked DVL (A50, A125) on its serial port."""

    kind: Literal["waterlinked_serial"] = "waterlinked_serial"
    link: ByteLinkConfig
    attitude: bool = Field(
        False, description="use its roll, pitch, yaw; yaw counts from power-on, not from north"
    )


class WaterLinkedJsonConfig(DeviceConfig):
    """A Water Linked DVL on TCP, port 16171."""

    kind: Literal["waterlinked_json"] = "waterlinked_json"
    link: ByteLinkConfig
    attitude: bool = Field(
        False, description="use its roll, pitch, yaw; yaw counts from power-on, not from north"
    )


class Pd0Config(DeviceConfig):
    """A Teledyne DVL that sends PD0 ensembles, in any coordinates."""

    kind: Literal["pd0"] = "pd0"
    link: ByteLinkConfig
    velocity_of: Literal["bottom", "vehicle"] = Field(
        "bottom",
        description="whose velocity it sends: PD0 has that of the bottom past the instrument; some "
        "firmware negates it",
    )
    beam_angle_deg: float | None = Field(
        None,
        gt=0,
        lt=60,
        description="deg between a beam and the head's axis, for beam coordinates; None: as the "
        "DVL states it, 15, 20 or 30",
    )
    sigma_m_s: float = Field(
        0.01, gt=0, description="m/s, 1 sigma at zero error velocity (data sheets: 0.3-1 cm/s)"
    )


NucleusPacket: TypeAlias = Literal["bottom_track", "altimeter", "ahrs", "imu", "fast_pressure"]


class NucleusConfig(DeviceConfig):
    """A Nortek Nucleus, on its serial port or on TCP, port 9000."""

    kind: Literal["nucleus"] = "nucleus"
    link: ByteLinkConfig
    packets: tuple[NucleusPacket, ...] = Field(
        ("bottom_track", "altimeter", "ahrs", "imu"),
        min_length=1,
        description="used of those that it is set to send; the depth is that of fast_pressure, "
        "where that is listed, else that of ahrs, for which the instrument was told the water",
    )
    start: bool = Field(
        True, description="tell it to START where it connects and sends nothing for 3 s"
    )
    password: str = Field("nortek", description="asked for on TCP; the maker's by default")
    water_density_kg_m3: float = Field(
        1029.0, ge=950, le=1300, description="kg/m^3, for fast_pressure: salt water 1029, fresh 997"
    )
    surface_pressure_pa: float = Field(
        101_325.0, ge=50_000, le=120_000, description="Pa, for fast_pressure; read at the surface"
    )


class VectorNavConfig(PositioningConfig):
    """A VectorNav (VN-100, VN-200, VN-300) that sends binary or ASCII messages by itself; which
    ones is set in the instrument."""

    kind: Literal["vectornav"] = "vectornav"
    link: ByteLinkConfig


class PingConfig(DeviceConfig):
    """A Ping echo sounder of Blue Robotics (Ping1D) by its own protocol, on its serial port or on
    the UDP port where BlueOS bridges it. Where BlueOS's Ping service owns it, use what that sends
    as MAVLink instead (component 194)."""

    kind: Literal["ping"] = "ping"
    link: ByteLinkConfig
    ask_for: Literal["distance", "distance_simple", "profile", "stream"] | None = Field(
        "distance",
        description="message that is asked for again and again; stream: profiles that it sends by "
        "itself; None: only listen, another program asks",
    )
    interval_s: float = Field(
        0.05, ge=0, le=10, description="s, least time between two requests; a link adds up to 0.1"
    )
    min_confidence: int = Field(
        50,
        ge=0,
        le=100,
        description="%, of a distance that is used; a sounder without an echo says 0 (judgement)",
    )


# --------------------------------------------------------------------------------------------------
# Settings of devices on a CAN bus.


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
