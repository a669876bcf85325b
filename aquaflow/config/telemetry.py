"""Settings of a vehicle's telemetry: its devices by their kind, its fusion, and known lengths."""

from __future__ import annotations

from itertools import combinations
from typing import Annotated, Any, Literal, TypeAlias

from pydantic import Field, field_validator, model_validator

from aquaflow.config.instruments import (
    DbcConfig,
    Nmea2000Config,
    NucleusConfig,
    Pd0Config,
    PingConfig,
    VectorNavConfig,
    WaterLinkedJsonConfig,
    WaterLinkedSerialConfig,
)
from aquaflow.config.link import EVERY_ADDRESS, ByteLinkConfig, MavlinkLinkConfig, UdpConfig
from aquaflow.config.stage import (
    Assumptions,
    Lab,
    MountingConfig,
    PositioningConfig,
    StageConfig,
    validate,
)


class LightsConfig(StageConfig):
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


class MavlinkSenderConfig(StageConfig):
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
    link: MavlinkLinkConfig
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
        if len(self.senders) < 1 + len(self.also):
            raise ValueError("'also' names each sender once, and not the autopilot itself")
        return self

    @property
    def senders(self) -> frozenset[tuple[int, int]]:
        """System and component of everybody whose messages are used."""
        also = {(each.system_id or self.system_id, each.component_id) for each in self.also}
        return frozenset({(self.system_id, self.component_id), *also})


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


AnyDevice: TypeAlias = Annotated[
    MavlinkConfig
    | NmeaConfig
    | WaterLinkedSerialConfig
    | WaterLinkedJsonConfig
    | Pd0Config
    | NucleusConfig
    | PingConfig
    | VectorNavConfig
    | Nmea2000Config
    | DbcConfig,
    Field(discriminator="kind"),
]


class TelemetryConfig(StageConfig):
    """Every telemetry device of a vehicle, by the name that its samples carry."""

    devices: dict[str, AnyDevice] = Field(default_factory=dict)

    @field_validator("devices")
    @classmethod
    def _tells_those_of_one_port_apart(cls, devices: dict[str, AnyDevice]) -> dict[str, AnyDevice]:
        for (name, one), (other_name, other) in combinations(devices.items(), 2):
            problem = _mixed_up(one, other)
            if problem is not None:
                raise ValueError(f"has '{name}' and '{other_name}' on one UDP port: {problem}")
        return devices


def _mixed_up(one: AnyDevice, other: AnyDevice) -> str | None:
    """Why nobody can say whose a datagram is; None if somebody can."""
    a, b = one.link, other.link
    if not (isinstance(a, UdpConfig) and isinstance(b, UdpConfig)) or a.port != b.port:
        return None
    if "send" in (a.mode, b.mode) or (a.host != b.host and not EVERY_ADDRESS & {a.host, b.host}):
        return None
    if a.host != b.host:
        return f"give both the same host, not '{a.host}' and '{b.host}'"
    if a.sender_address != b.sender_address or one.kind != other.kind:
        return None
    if isinstance(one, MavlinkConfig) and isinstance(other, MavlinkConfig):
        common = sorted(one.senders & other.senders)
        if not common:
            return None
        system, component = common[0]
        what = f"both use system {system}, component {component}"
    else:
        what = f"both speak {one.kind}"
    return f"{what}; state the address that one of them sends from as its link.sender"


def parse_telemetry(data: dict[str, Any], origin: str) -> TelemetryConfig:
    """Validate a mapping read from ``origin``.

    Raises:
        ConfigError: with the path of the first key that is unknown or out of range.
    """
    return validate(TelemetryConfig, data, origin)


# --------------------------------------------------------------------------------------------------
# Settings of the fusion of telemetry with the camera.

# --------------------------------------------------------------------------------------------------
# Settings of objects of known size that give the map its scale.

Dictionary: TypeAlias = Literal[
    "APRILTAG_16h5", "APRILTAG_25h9", "APRILTAG_36h10", "APRILTAG_36h11",
    "4X4_50", "4X4_100", "4X4_250", "4X4_1000", "5X5_50", "5X5_100", "5X5_250", "5X5_1000",
    "6X6_50", "6X6_100", "6X6_250", "6X6_1000", "7X7_50", "7X7_100", "7X7_250", "7X7_1000",
    "ARUCO_ORIGINAL", "ARUCO_MIP_36h12",
]  # fmt: skip
"""Names of OpenCV's predefined dictionaries, without DICT_."""


class MarkersConfig(StageConfig):
    """AprilTag or ArUco markers that lie anywhere, each of the same size."""

    kind: Literal["markers"] = "markers"
    dictionary: Dictionary
    marker_m: float = Field(gt=0, description="m, side of the black square")
    sigma_m: float = Field(0.0005, gt=0, description="m, 1 sigma of marker_m (judgement: a ruler)")
    ids: tuple[int, ...] = Field((), description="of the markers in use; none: every one counts")


class CharucoConfig(StageConfig):
    """A ChArUco board: a chessboard with markers in its white squares."""

    kind: Literal["charuco"] = "charuco"
    dictionary: Dictionary
    columns: int = Field(ge=3, le=100, description="squares from left to right")
    rows: int = Field(ge=3, le=100, description="squares from top to bottom")
    square_m: float = Field(gt=0, description="m, side of a chessboard square")
    marker_m: float = Field(gt=0, description="m, side of a marker's black square")
    sigma_m: float = Field(0.0005, gt=0, description="m, 1 sigma of square_m (judgement: a ruler)")
    legacy: bool = Field(False, description="printed by OpenCV before 4.6 with an even row count")

    @model_validator(mode="after")
    def _markers_fit(self) -> CharucoConfig:
        if self.marker_m >= self.square_m:
            raise ValueError("marker_m must be smaller than square_m")
        return self


BoardConfig: TypeAlias = Annotated[MarkersConfig | CharucoConfig, Field(discriminator="kind")]


class LasersConfig(StageConfig):
    """Two laser dots, whose beams run parallel to the optical axis."""

    colour: Literal["red", "green", "blue"]
    spacing_m: float = Field(gt=0, description="m between the beams")
    sigma_m: float = Field(0.001, gt=0, description="m, 1 sigma of spacing_m (judgement: a ruler)")
    parallel_sigma_deg: float = Field(
        0.1,
        ge=0,
        description="deg, 1 sigma of each beam against the axis; at 2 m, 0.1 deg are 3.5 mm "
        "(judgement: set by eye on a wall)",
    )


class FusionConfig(StageConfig):
    """How telemetry gives the map its metres, its gravity and its north."""

    enabled: bool = Field(True, description="False: telemetry is recorded and nothing else")
    camera: MountingConfig | None = Field(
        None,
        description="of the camera in the body, which looks forward without angles, down with "
        "pitch_deg -90; None: as the recording states it, else unknown",
    )
    mounting_sigma_deg: float = Field(
        3.0,
        gt=0,
        le=45,
        description="deg, 1 sigma of every stated mounting: set by eye (judgement)",
    )
    heading: bool = Field(
        True, description="trust the attitude's heading as a compass's; False: x of the world is "
        "the vehicle's first heading"
    )  # fmt: skip
    declination: Literal["auto", "none"] | Annotated[float, Field(ge=-180, le=180)] = Field(
        "auto", description="deg from true to magnetic north, east positive, that the vehicle has "
        "not added to its heading. auto: that of the World Magnetic Model at the first position, "
        "if the date is known; 0 if the compass's own device states positions, as ArduPilot adds "
        "the declination by itself once it has a position, and not without one (COMPASS_AUTODEC "
        "is 1 by default, COMPASS_DEC 0; AP_Compass.cpp, qgroundcontrol issue 143). none: unknown, "
        "north is magnetic. A vehicle that was given COMPASS_DEC, or its position by hand, needs 0"
    )  # fmt: skip
    heading_sigma_deg: float = Field(
        5.0, gt=0, le=90, description="deg, 1 sigma of the compass's constant error in a vehicle "
        "(judgement: ArduSub's calibrated compass beside thrusters and lamps)"
    )  # fmt: skip
    dvl_scale_sigma: float = Field(
        0.001, ge=0, le=0.1, description="relative, 1 sigma of a DVL's long-term accuracy: Water "
        "Linked A50 Performance 0.1 %, Standard 1 %; speed of sound for a wrong salinity adds 1 %"
    )  # fmt: skip
    position_lag_sigma_s: Lab[float] = Field(
        0.3, ge=0, description="s, 1 sigma of how much older a position fix is than it states"
    )
    depth_change_sigma_m: Lab[float] = Field(
        0.2, gt=0, description="m, 1 sigma of the depth around its mean, taken as constant where "
        "positions are known and nothing measures down or depth: an AUV that follows even "
        "ground (judgement)"
    )  # fmt: skip
    every_keyframes: Lab[int] = Field(
        20, ge=1, description="keyframes after which telemetry straightens the keyframe graph"
    )
    boards: tuple[BoardConfig, ...] = Field(
        (), description="markers and boards of known size that may come into view"
    )
    lasers: LasersConfig | None = Field(None, description="two dots of known spacing, if mounted")
