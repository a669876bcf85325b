"""Settings of telemetry devices: what they speak, on which wire, and where they are mounted."""

from __future__ import annotations

from typing import Annotated, Any, Literal, TypeAlias

from pydantic import Field, model_validator

from aquaflow.config.link import ByteLinkConfig, CanConfig
from aquaflow.config.stage import Stage, validated


class MountingConfig(Stage):
    """Where a sensor sits in the body frame (forward, right, down)."""

    position_m: tuple[float, float, float] = Field(
        (0.0, 0.0, 0.0), description="of the sensor, from the body's origin"
    )
    roll_deg: float = Field(0.0, description="of the sensor's axes in the body, first roll")
    pitch_deg: float = Field(0.0, description="then pitch")
    yaw_deg: float = Field(
        0.0,
        description="then yaw; 180: a DVL that points backwards, unless it turns what it sends",
    )


class DeviceConfig(Stage):
    """What every device has."""

    mounting: MountingConfig = MountingConfig()
    silence_s: float | None = Field(
        10.0, gt=0, description="open the link anew after this long without a byte (None: never)"
    )


class PositioningConfig(DeviceConfig):
    """A device that may send fixes on the earth: GNSS, or an acoustic system of the vehicle."""

    position_lag_s: float = Field(
        0.0,
        ge=0,
        le=60,
        description="s that a fix is older than its message says. GNSS receivers: 0.1 to 0.25 "
        "(ArduPilot's GPS1_DELAY_MS ends at 250); acoustic systems more: 0.2 for the sound over "
        "300 m at 1500 m/s, the wait between two pulses, and their filter",
    )
    position_sigma_m: float | None = Field(
        None,
        gt=0,
        description="m, 1 sigma of each horizontal direction of every fix, such as an acoustic "
        "system's data sheet has it; None: as the device states it, else from HDOP",
    )


class Assumptions(Stage):
    """What may be assumed where a device measures only part of a quantity.

    A heading without roll and pitch is no attitude. With ``level`` it becomes one: true within the
    few degrees by which a passively stable ROV leans, wrong for gravity on any other vehicle.
    """

    level: bool = Field(False, description="roll and pitch are 0 where nothing measures them")
    no_side_slip: bool = Field(False, description="the vehicle moves only where it points")
    speed_sigma_m_s: float = Field(
        0.2, gt=0, description="m/s, 1 sigma of a velocity that only a speed log measures"
    )


class LightsConfig(Stage):
    """The servo or RC channel that dims the lamps (ardupilot.org/sub: 1100 us off, 1900 full)."""

    message: Literal["SERVO_OUTPUT_RAW", "RC_CHANNELS"] = "SERVO_OUTPUT_RAW"
    channel: int = Field(ge=1, le=16)
    off_us: int = Field(1100, ge=500, le=2500, description="us, pulse width")
    full_us: int = Field(1900, ge=500, le=2500, description="us, pulse width")

    @model_validator(mode="after")
    def _has_a_range(self) -> LightsConfig:
        if self.off_us == self.full_us:
            raise ValueError("off_us and full_us must differ")
        return self


MavlinkSource: TypeAlias = Literal[
    "ATTITUDE",
    "ATTITUDE_QUATERNION",
    "RAW_IMU",
    "SCALED_IMU2",
    "HIGHRES_IMU",
    "LOCAL_POSITION_NED",
    "VFR_HUD",
    "DISTANCE_SENSOR",
    "GPS_RAW_INT",
    "GPS2_RAW",
    "GLOBAL_POSITION_INT",
    "SYSTEM_TIME",
    "GPS_INPUT",
    "VISION_POSITION_DELTA",
]


class MavlinkSenderConfig(Stage):
    """Another component on the autopilot's link, such as the sonar service of BlueOS."""

    system_id: int | None = Field(None, ge=1, le=255, description="None: the autopilot's")
    component_id: int = Field(ge=0, le=255, description="194: a Ping1D by BlueOS's Ping service")
    messages: tuple[MavlinkSource, ...] = Field(
        ("DISTANCE_SENSOR",),
        min_length=1,
        description="used from it, stamped at their arrival: its clock is not the autopilot's",
    )


class MavlinkConfig(PositioningConfig):
    """An autopilot that speaks MAVLink 1 or 2 (ArduSub)."""

    kind: Literal["mavlink"] = "mavlink"
    link: ByteLinkConfig
    system_id: int = Field(1, ge=1, le=255)
    component_id: int = Field(1, ge=0, le=255)
    also: tuple[MavlinkSenderConfig, ...] = Field(
        (), description="further systems and components whose messages are used"
    )
    talk: bool = Field(True, description="send heartbeats and TIMESYNC; False: only listen")
    messages: tuple[MavlinkSource, ...] = Field(
        (
            *("ATTITUDE", "RAW_IMU", "HIGHRES_IMU", "DISTANCE_SENSOR"),
            *("GPS_RAW_INT", "SYSTEM_TIME"),
        ),
        description="converted to samples, in addition to pressure and lights; with the default "
        "only the angular rate arrives twice from an ArduSub. GPS_RAW_INT is the receiver's fix, "
        "also where an acoustic system sends GPS_INPUT, which is the same once more; "
        "GLOBAL_POSITION_INT is the output of the autopilot's filter, which holds it too",
    )
    external_pressure: Literal["SCALED_PRESSURE", "SCALED_PRESSURE2", "SCALED_PRESSURE3"] | None = (
        Field(
            "SCALED_PRESSURE2",
            description="the sensor in the water: on an ArduSub the Bar30 is the second, the "
            "first sits inside the hull (None: no depth from pressure)",
        )
    )
    water_density_kg_m3: float = Field(
        1029.0, ge=950, le=1300, description="kg/m^3: salt water 1029, fresh 997 (ms5837-python)"
    )
    surface_pressure_pa: float = Field(
        101_325.0, ge=50_000, le=120_000, description="Pa; read it at the surface before diving"
    )
    local_velocity_sigma_m_s: float = Field(
        0.1,
        gt=0,
        description="m/s, 1 sigma of LOCAL_POSITION_NED and VISION_POSITION_DELTA, which have none "
        "(judgement)",
    )
    lights: LightsConfig | None = None

    @model_validator(mode="after")
    def _names_each_sender_once(self) -> MavlinkConfig:
        senders = [(self.system_id, self.component_id)]
        senders += [(each.system_id or self.system_id, each.component_id) for each in self.also]
        if len(set(senders)) < len(senders):
            raise ValueError("'also' names each sender once, and not the autopilot itself")
        return self


class NmeaConfig(PositioningConfig):
    """An echo sounder, compass, AHRS, or a receiver or acoustic system that sends positions, if it
    speaks NMEA 0183."""

    kind: Literal["nmea0183"] = "nmea0183"
    link: ByteLinkConfig
    require_checksum: bool = Field(True, description="refuse sentences that carry none")
    depth_sentences: tuple[Literal["DBT", "DPT", "DBS"], ...] = Field(
        ("DBS",),
        description="those that measure the vehicle's own depth, from a pressure sensor; "
        "the others measure the distance to the bottom",
    )
    variation_deg: float | None = Field(
        None,
        ge=-180,
        le=180,
        description="deg from true to magnetic north, east positive, added to a heading that is "
        "magnetic and states none (HDM, HDG); None: it stays magnetic (fusion.declination)",
    )
    assume: Assumptions = Assumptions()


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
    """A Teledyne DVL that sends PD0 ensembles, in instrument or ship coordinates."""

    kind: Literal["pd0"] = "pd0"
    link: ByteLinkConfig
    velocity_of: Literal["bottom", "vehicle"] = Field(
        "bottom",
        description="whose velocity it sends: PD0 has that of the bottom past the instrument; some "
        "firmware negates it",
    )
    sigma_m_s: float = Field(
        0.01, gt=0, description="m/s, 1 sigma at zero error velocity (data sheets: 0.3-1 cm/s)"
    )


class Nmea2000Config(PositioningConfig):
    """Instruments on an NMEA 2000 bus."""

    kind: Literal["nmea2000"] = "nmea2000"
    link: CanConfig
    assume: Assumptions = Assumptions()


class DbcSignal(Stage):
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


AnyDevice: TypeAlias = Annotated[
    MavlinkConfig
    | NmeaConfig
    | WaterLinkedSerialConfig
    | WaterLinkedJsonConfig
    | Pd0Config
    | Nmea2000Config
    | DbcConfig,
    Field(discriminator="kind"),
]


class TelemetryConfig(Stage):
    """Every telemetry device of a vehicle, by the name that its samples carry."""

    devices: dict[str, AnyDevice] = Field(default_factory=dict)
    queue_samples: int = Field(
        10_000, ge=1, description="kept until fetched, then the oldest go (a minute at 160/s)"
    )


def parse_telemetry(data: dict[str, Any], origin: str) -> TelemetryConfig:
    """Validate a mapping read from ``origin``.

    Raises:
        ConfigError: with the path of the first key that is unknown or out of range.
    """
    return validated(TelemetryConfig, data, origin)
