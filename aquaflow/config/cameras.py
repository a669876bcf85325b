"""Settings of live cameras, by the ``kind`` of their driver, and of a source's pictures."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal, TypeAlias

from pydantic import AfterValidator, Field, model_validator

from aquaflow.config.stage import MountingConfig, StageConfig


class LiveCameraConfig(StageConfig):
    """What all live cameras have in common."""

    calibration: Path | None = Field(
        None,
        description="camera.yaml, made in water, or in air with its port's measures; None: the "
        "device's own, or a guess",
    )
    stall_s: float = Field(
        3.0,
        gt=0,
        description="without a picture for so long, the device is opened anew; an auto exposure in "
        "the dark makes 2 s pauses on UVC cameras",
    )
    first_retry_s: float = Field(0.5, gt=0, description="wait before a lost device is looked for")
    last_retry_s: float = Field(
        8.0, gt=0, description="the wait doubles up to this; a tether is plugged in within minutes"
    )


class V4l2Config(LiveCameraConfig):
    """A USB or CSI camera of the Linux kernel."""

    kind: Literal["v4l2"]
    device: str | None = Field(
        None,
        description="an id as `aquaflow doctor devices` prints it: a name in /dev/v4l/by-id, a USB "
        "serial number, or the bus; never videoN, which changes. None: the only camera there is",
    )
    width: int = Field(1280, ge=16, description="px; the camera may choose another size")
    height: int = Field(720, ge=16, description="px")
    fps: float = Field(30.0, gt=0, description="pictures/s asked for")
    pixels: Literal["YUYV", "UYVY", "NV12", "NM12", "MJPG", "H264", "GREY"] = Field(
        "MJPG",
        description="measured at 720p on one core: YUYV 2 ms a picture, MJPG 19 ms; USB 2 carries "
        "YUYV up to 640x480 at 30 pictures/s. Boards' own cameras have NV12 or, in two pieces of "
        "memory, NM12; H264 is decoded picture by picture, whether or not one is used",
    )
    exposure_s: float | None = Field(
        None, gt=0, description="fixed exposure: lamps on a vehicle confuse the automatic; None: it"
    )
    gain: int | None = Field(None, ge=0, description="in the camera's own units; None: automatic")
    white_balance_k: int | None = Field(
        None, ge=1000, le=20000, description="kelvin; fixed, or colours change with the view"
    )
    buffers: int = Field(
        4, ge=4, le=32, description="one waits, one is decoded, two stay with the kernel"
    )


class OakConfig(LiveCameraConfig):
    """A Luxonis OAK camera."""

    kind: Literal["oak"]
    device: str | None = Field(None, description="its id or IP address; None: the first found")
    socket: Literal["CAM_A", "CAM_B", "CAM_C", "CAM_D"] = Field(
        "CAM_A", description="CAM_A is the colour camera of an OAK-D, B and C its stereo pair"
    )
    width: int = Field(1280, ge=16, description="px")
    height: int = Field(720, ge=16, description="px")
    fps: float = Field(15.0, gt=0, description="pictures/s; a mapper uses no more")
    encoding: Literal["auto", "bgr", "nv12", "mjpeg"] = Field(
        "auto",
        description="of pictures on their way from the camera; auto: the best that its USB or "
        "network carries. 1280x720 at 15 pictures/s are 41 MB/s as BGR, 21 as NV12",
    )
    exposure_s: float | None = Field(
        None, gt=0, le=0.033, description="fixed exposure, needs iso; None: automatic"
    )
    iso: int | None = Field(None, ge=100, le=1600, description="fixed sensitivity, needs exposure")
    white_balance_k: int | None = Field(None, ge=1000, le=12000, description="kelvin, fixed")
    imu_rate_hz: int = Field(
        200, ge=0, le=400, description="accelerometer and gyroscope readings/s; 0: none"
    )
    mounting: MountingConfig = Field(
        MountingConfig(),
        description="of the camera; without it, the IMU counts as that of one that looks forward, "
        "and how the camera sits as unknown",
    )

    @model_validator(mode="after")
    def _exposure_and_iso_go_together(self) -> OakConfig:
        if (self.exposure_s is None) != (self.iso is None):
            raise ValueError("exposure_s and iso are set together or not at all")
        return self


class StreamConfig(LiveCameraConfig):
    """A video stream from the network, for vehicles whose pilot owns the camera."""

    kind: Literal["stream"]
    url: str = Field(
        pattern=r"^((rtsps?|https?|tcp)://.+|(udp|rtp)://.*:\d+.*|[^:]+\.sdp|v=0\s[\s\S]+)$",
        description="rtsp://, http://, udp://0.0.0.0:PORT for RTP or MPEG-TS that is sent to this "
        "computer, an .sdp file, or the text of a session description (SDP)",
    )
    transport: Literal["tcp", "udp"] = Field(
        "tcp", description="of RTSP; udp is quicker, tcp loses nothing on a tether"
    )
    codec: Literal["h264", "h265"] = Field(
        "h264", description="of RTP at a udp:// address, whose packets do not state it"
    )
    payload_type: int | None = Field(
        None,
        ge=0,
        le=127,
        description="that RTP at a udp:// address must have; None: that of its first packet",
    )
    latency_s: float = Field(
        0.0,
        ge=0,
        le=2.0,
        description="from exposure to arrival, taken off the times; streams do not report it. "
        "Measure: film a clock next to its own image",
    )
    max_age_s: float | None = Field(
        1.0,
        gt=0,
        le=2.0,
        description="older pictures, by the stream's own time, are left out as `stale`: 1 s is "
        "more than TCP needs to send lost data twice again (0.6 s), and less than the 2 s after "
        "which a live run waits for its camera. None: pictures are stamped at arrival, however old",
    )

    @model_validator(mode="after")
    def _pictures_may_be_as_old_as_they_always_are(self) -> StreamConfig:
        if self.max_age_s is not None and self.latency_s >= self.max_age_s:
            raise ValueError("max_age_s must be more than latency_s, or every picture is too old")
        return self


CameraConfig: TypeAlias = Annotated[
    V4l2Config | OakConfig | StreamConfig, Field(discriminator="kind")
]


# --------------------------------------------------------------------------------------------------
# Settings of a source: which frames, and how they are prepared.


def checked_crop(crop: str) -> str:
    """``crop``, if there are pictures that it fits.

    Raises:
        ValueError: it is neither ``left``, ``right`` nor ``x,y,width,height`` in pixels.
    """
    if crop not in {"left", "right"}:
        crop_sides(crop)
    return crop


def crop_sides(crop: str) -> tuple[int, int, int, int]:
    """x, y, width and height of a crop that states them, px.

    Raises:
        ValueError: it does not, or no picture has such a part.
    """
    said = f"{crop[:80]!r} is neither left, right nor x,y,width,height in pixels"
    try:
        x, y, width, height = (int(part) for part in crop.split(","))
    except ValueError as error:
        raise ValueError(said) from error
    if min(x, y) < 0 or min(width, height) < 1:
        raise ValueError(said)
    return x, y, width, height


class SourceConfig(StageConfig):
    """Which frames, and how they are prepared."""

    every: int = Field(1, ge=1, description="use every n-th frame")
    start: int = Field(0, ge=0, description="first frame index")
    stop: int | None = Field(None, ge=1, description="first frame index not used")
    width: int | None = Field(
        None,
        ge=64,
        le=8192,
        description="px; frames are made this wide (None: 480, or less if smaller)",
    )
    crop: Annotated[str, AfterValidator(checked_crop)] | None = Field(
        None, description="left | right | x,y,width,height, before resizing"
    )
    mask: Path | None = Field(
        None,
        description="picture of the camera's or the crop's size: white is used, black is not "
        "(vehicle frame, display)",
    )
    fps: float | None = Field(None, gt=0, description="frames/s of a folder without timestamps")


# --------------------------------------------------------------------------------------------------
# Settings of the small pictures that a dive keeps of what its camera saw.


class PicturesConfig(StageConfig):
    """One a second, for the viewer; fewer of a long dive."""

    enabled: bool = Field(True, description="False: none are kept")
    most_mb: float = Field(
        64.0, gt=0, description="MB (1e6 bytes) of all pictures of a dive: where they take more, "
        "every second one is removed, and from then on half as many are kept",
    )  # fmt: skip
