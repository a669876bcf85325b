"""What a synthetic dive is made from: every setting with its unit and where its default is from."""

from __future__ import annotations

import math
from typing import Any, Literal, TypeAlias

import numpy as np
import numpy.typing as npt
from pydantic import BaseModel, ConfigDict, Field, model_validator

from aquaflow.geometry.port import PortFile
from aquaflow.lab.synthetic.telemetry_noise import TelemetryNoise

# --------------------------------------------------------------------------------------------------
# What may have changed on a synthetic sea floor from one dive to a later visit.


class PlantedObject(BaseModel):
    """An object that stands on the floor besides those of the scene: added, removed or moved where
    two days differ in it."""

    model_config = ConfigDict(extra="forbid")

    kind: Literal["box", "ball"] = Field("box", description="a cube, or a sphere")
    at_m: tuple[float, float] = Field(description="m, x and y of its middle, survey frame")
    half_m: float = Field(0.1, gt=0.0, le=1.0, description="m, half an edge, or the radius")
    turn_deg: float = Field(20.0, description="degrees about the vertical")
    paint: tuple[float, float, float] = Field(
        (0.55, 0.40, 0.18), description="albedo RGB; a wooden crate"
    )
    pattern_m: float = Field(
        0.4, ge=0.0, description="m, where in the paint's texture it begins; stays with the object"
    )


class Bleached(BaseModel):
    """A round patch of the floor that has lost its colour."""

    model_config = ConfigDict(extra="forbid")

    at_m: tuple[float, float] = Field(description="m, x and y of its middle, survey frame")
    radius_m: float = Field(0.2, gt=0.0, le=2.0, description="m")
    share: float = Field(
        0.8, gt=0.0, le=1.0, description="of the way from its own colour to white of its shade"
    )


# --------------------------------------------------------------------------------------------------
# Light that the vehicle brings along.


class Lamps(BaseModel):
    """Lamps beside the camera that shine where it looks (lamps.py)."""

    model_config = ConfigDict(extra="forbid")

    ambient: float = Field(
        0.3, ge=0.0, le=1.0, description="daylight over that of a dive without lamps; 0: night"
    )
    even_m: float = Field(
        2.5,
        gt=0.1,
        le=10.0,
        description="m, where lamps and daylight together are as bright as a dive's daylight "
        "without lamps, on a surface that faces the lamps, through no water",
    )
    places_m: tuple[tuple[float, float, float], ...] = Field(
        ((-0.2, -0.1, 0.0), (0.2, -0.1, 0.0)),
        min_length=1,
        description="m right, down, forward of the camera; judgement: two lamps at the sides of a "
        "BlueROV2's frame",
    )
    half_angle_deg: float = Field(
        67.5,
        ge=10.0,
        lt=90.0,
        description="degrees off the axis where a lamp is half as bright; the Lumen light of a "
        "BlueROV2 is sold with a beam of 135 degrees in water",
    )
    colour: tuple[float, float, float] = Field(
        (1.0, 1.0, 1.0), description="of the lamps where daylight is white, RGB"
    )

    @property
    def cosine_power(self) -> float:
        """Power of the cosine by which the intensity falls off the axis."""
        return math.log(0.5) / math.log(math.cos(math.radians(self.half_angle_deg)))


# --------------------------------------------------------------------------------------------------
# What water does with range beyond the image formation.


class RangeEffects(BaseModel):
    """Blur and colours that change with range as no medium of water.py can (range_effects.py)."""

    model_config = ConfigDict(extra="forbid")

    blur_mrad: float = Field(
        3.0,
        ge=0.0,
        le=20.0,
        description="mrad, sigma of a point 1 m away; grows with the root of the range; judgement: "
        "1.2 px there at 480 px width, twice the lens's own, and twice that at 4 m",
    )
    band_spread: tuple[float, float, float] = Field(
        (0.6, 0.3, 0.3),
        description="standard deviation over mean of the attenuation within a channel's band, "
        "RGB; judgement: pure water's absorption goes from 0.2 to 0.6 per metre over the red band",
    )

    def blur_rad(
        self,
        z: npt.NDArray[np.float32],  # [...] m
    ) -> npt.NDArray[np.float32]:
        """[...] rad, sigma of a point at each range."""
        return np.float32(1e-3 * self.blur_mrad) * np.sqrt(z)


__all__ = [
    "FACED",
    "Display",
    "Lamps",
    "RangeEffects",
    "SceneKind",
    "SyntheticConfig",
    "TelemetryNoise",
    "Visit",
    "WaterType",
]


# --------------------------------------------------------------------------------------------------
# The settings of a synthetic dive.

SceneKind: TypeAlias = Literal["reef", "flat_sand", "wall", "pipe", "pool", "survey", "hull", "net"]
Display: TypeAlias = Literal["clock", "clock_and_crosshair", "panel"]
WaterType: TypeAlias = Literal[
    "clear", "oceanic_IB", "oceanic_II", "coastal_1C", "coastal_3C", "coastal_5C"
]

FACED: tuple[SceneKind, ...] = ("wall", "hull", "net")
"""Scenes that the vehicle faces: they stand upright, and its lanes go up and down."""

SCENE_DEFAULTS: dict[str, dict[str, object]] = {
    # A small vehicle in a test tank, filmed at 1 picture/s: 0.25 m and 6 degrees from one to the
    # next, four laps. The forward view sees floor, walls and no surface.
    "pool": {
        "frames": 220, "fps": 1.0, "speed_m_s": 0.25, "altitude_m": 1.1, "altitude_swing_m": 0.1,
        "camera_pitch_deg": 10.0, "roll_deg": 2.0, "pitch_deg": 2.0, "yaw_deg": 5.0,
        "floor_depth_m": 3.2, "water": "oceanic_IB", "snow_per_m3": 2.0,
    },
    # An AUV that looks straight down: 2 m up at 1 picture/s, two thirds of each picture in the
    # next (the shared IMOS surveys: 60 to 75 %).
    "survey": {
        "frames": 9, "fps": 1.0, "speed_m_s": 0.5, "altitude_m": 2.0, "altitude_swing_m": 0.1,
        "camera_pitch_deg": 90.0, "roll_deg": 2.0, "pitch_deg": 2.0, "yaw_deg": 4.0,
    },
    # A hull inspection: 1.2 m from the plates, looking a little down along them.
    "hull": {
        "altitude_m": 1.2, "altitude_swing_m": 0.15, "camera_pitch_deg": 70.0, "speed_m_s": 0.4,
        "floor_depth_m": 5.0, "snow_per_m3": 20.0,
    },
    # A net cage's side from inside, with water behind it.
    "net": {
        "altitude_m": 1.2, "altitude_swing_m": 0.15, "camera_pitch_deg": 75.0, "speed_m_s": 0.3,
        "floor_depth_m": 8.0, "water": "oceanic_II", "snow_per_m3": 20.0,
    },
}  # fmt: skip
"""What differs from the fields' defaults where nothing else is asked for."""


class Visit(BaseModel):
    """A dive over the sea floor of another dive, which keeps its seed, water and path to itself."""

    model_config = ConfigDict(extra="forbid")

    over: SyntheticConfig = Field(
        description="the dive whose sea floor it is; its margin_m must hold what this one sees"
    )
    heading_deg: float = Field(
        0.0, ge=-180, le=180, description="by which this way is turned, seen from above, clockwise"
    )
    offset_m: tuple[float, float] = Field(
        (0.0, 0.0), description="m in x and y from the middle of that dive's way to that of this"
    )
    light: tuple[float, float, float] = Field(
        (1.0, 1.0, 1.0),
        description="daylight over that of the water's table, red, green, blue: time of day, "
        "clouds, white balance",
    )

    @model_validator(mode="after")
    def _over_a_first_visit(self) -> Visit:
        if self.over.visit is not None:
            raise ValueError("over must be a dive with a sea floor of its own, without a visit")
        if min(self.light) <= 0.0:
            raise ValueError("light must be above 0 in every channel")
        return self


class SyntheticConfig(BaseModel):
    """One synthetic dive; the same config gives the same files, byte for byte."""

    model_config = ConfigDict(extra="forbid")

    seed: int = Field(0, ge=0, description="of every random draw in the dive")
    frames: int = Field(90, ge=2, le=5000, description="pictures; 9 s at 10 fps closes one loop")
    width: int = Field(480, ge=32, le=4096, description="px")
    height: int = Field(360, ge=24, le=4096, description="px")
    fps: float = Field(10.0, gt=0, description="pictures per second")
    focal_widths: float = Field(
        0.85,
        gt=0.3,
        le=3.0,
        description="focal length / width; geometric mean of the shared clips (geometry.camera)",
    )
    lens: Literal["pinhole", "fisheye"] = Field(
        "pinhole",
        description="fisheye: r = f theta; 0.44 focal_widths see 130 degrees",
    )
    port: PortFile | None = Field(
        None,
        description="measures of a flat port or a dome as in camera.yaml; focal_widths are then of "
        "air: 0.77 see 48 degrees of water through a flat port",
    )
    scene: SceneKind = Field("reef", description="what the sea floor is made of")
    water: WaterType = Field(
        "coastal_1C", description="row of water.WATER_TYPES; blue-green, visibility about 8 m"
    )
    directional_attenuation: float = Field(
        0.0,
        ge=0,
        lt=1,
        description="relative change of beta_a with the heading: that much more looking north, as "
        "much less looking south; 0: the same all round, as in the water's table",
    )
    range_effects: RangeEffects | None = Field(
        None,
        description="blur and colour that the image formation cannot say; None: none; with them "
        "beta_a is that of the first centimetres",
    )
    supersampling: int = Field(2, ge=1, le=4, description="rays per pixel and axis; 2 is 4 rays")
    speed_m_s: float = Field(
        0.6,
        gt=0,
        le=3.0,
        description="m/s over ground; with 10 fps, 6 to 20 px a picture at 480 px width",
    )
    altitude_m: float = Field(
        1.45, gt=0.5, le=20.0, description="m above the smoothed relief; ROV survey height"
    )
    altitude_swing_m: float = Field(
        0.35, ge=0, description="m, amplitude: lowest at the far end of each lane"
    )
    rises: int | None = Field(
        None, ge=1, description="how often it rises and falls along the way; None: every other lane"
    )
    camera_pitch_deg: float = Field(
        42.0,
        ge=5,
        le=90,
        description="degrees below the horizon; oblique, so that ranges span 1:3 in a picture",
    )
    camera_position_m: tuple[float, float, float] = Field(
        (0.2, 0.0, 0.05),
        description="m forward, right, down of the body's origin; judgement: the front dome of a "
        "BlueROV2, whose frame is 0.46 m long",
    )
    mounting_error_deg: float = Field(
        0.0,
        ge=0,
        le=45,
        description="degrees by which the true mounting of the camera, and that of the DVL, is "
        "turned from the stated one, about a random axis; by eye about 3",
    )
    lane_spacing_m: float = Field(0.6, gt=0, description="m; half a footprint at 1.5 m altitude")
    lane_length_m: float = Field(4.0, gt=0, description="m, longest lane before one is added")
    turns: bool = Field(
        False, description="true: the vehicle points along its way; false: it holds its heading"
    )
    roll_deg: float = Field(3.0, ge=0, le=20, description="degrees, sway amplitude of an ROV")
    pitch_deg: float = Field(3.0, ge=0, le=20, description="degrees, sway amplitude of an ROV")
    yaw_deg: float = Field(8.0, ge=0, le=60, description="degrees, heading-hold wander")
    floor_depth_m: float = Field(12.0, gt=3, description="m below the surface, mean sea floor")
    max_range_m: float = Field(
        14.0,
        gt=2,
        le=40,
        description="m; in the default water under 3 % of any channel gets further",
    )
    snow_per_m3: float = Field(
        40.0, ge=0, le=2000, description="particles per m3 large enough to see; 0 is none"
    )
    vignette: float = Field(
        0.2, ge=0, lt=1, description="fraction of light that is missing in the corners"
    )
    lamps: Lamps | None = Field(None, description="of the vehicle; None: daylight alone")
    noise_sigma: float = Field(
        0.005, ge=0, le=0.2, description="sensor noise, of full scale; 1.3 grey levels"
    )
    display: Display | None = Field(
        None, description="what the recorder burns into the pictures; none by default"
    )
    fish: int = Field(
        0, ge=0, le=200, description="fish that cross the view, each at a time of its own"
    )
    arm: bool = Field(False, description="true: an arm of the vehicle reaches into the picture")
    telemetry: TelemetryNoise = TelemetryNoise.model_validate({})
    placed: tuple[PlantedObject, ...] = Field((), description="objects besides those of the scene")
    bleached: tuple[Bleached, ...] = Field((), description="patches without colour")
    margin_m: float | None = Field(
        None, gt=0, le=20, description="m of sea floor beyond what is seen, for visits; None: 0"
    )
    visit: Visit | None = Field(
        None, description="swim over the sea floor of another dive; None: over one of its own"
    )

    @model_validator(mode="before")
    @classmethod
    def _scene_defaults(cls, data: Any) -> Any:
        scene = data.get("scene") if isinstance(data, dict) else None
        own = SCENE_DEFAULTS.get(scene) if isinstance(scene, str) else None
        return data if own is None else {**own, **data}

    @model_validator(mode="after")
    def _wall_is_faced(self) -> SyntheticConfig:
        if self.scene in FACED and self.turns:
            raise ValueError(
                f"a vehicle at a {self.scene} faces it; turns must be false for this scene"
            )
        return self

    @model_validator(mode="after")
    def _effects_by_daylight(self) -> SyntheticConfig:
        if self.range_effects is not None and self.lamps is not None:
            raise ValueError("range_effects are of daylight; leave them or lamps out")
        return self

    @model_validator(mode="after")
    def _visits_the_same_scene(self) -> SyntheticConfig:
        if self.visit is not None and self.visit.over.scene != self.scene:
            raise ValueError(f"the dive that is visited has the scene {self.visit.over.scene}")
        return self

    @property
    def home(self) -> SyntheticConfig:
        """The dive whose sea floor this one swims over: itself, but for a visit."""
        return self if self.visit is None else self.visit.over

    @property
    def duration_s(self) -> float:
        """Time to travel the whole loop; the frame after the last would be the first again (but a
        survey's line is open)."""
        return self.frames / self.fps

    @property
    def focal_px(self) -> float:
        """Focal length, px."""
        return self.focal_widths * self.width
