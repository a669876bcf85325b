"""Settings of the onboard service: dives, survival, health, recorder, viewer, coverage, and what it
may take of the machine."""

from __future__ import annotations

import ipaddress
from pathlib import Path
from typing import Literal

from pydantic import Field, IPvAnyNetwork, model_validator

from aquaflow.config.link import Port
from aquaflow.config.stage import Lab, MountingConfig, StageConfig


def is_loopback(host: str) -> bool:
    """True if a socket bound to ``host`` is reachable from this machine only."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


class ListenConfig(StageConfig):
    """Where a server listens. Beyond loopback only with a token."""

    enabled: bool = True
    host: str = Field("127.0.0.1", description="address to bind; 0.0.0.0: every interface")
    port: Port
    token_file: Path | None = Field(
        None, description="file that holds the token, readable by the service's user only"
    )
    trusted: list[IPvAnyNetwork] = Field(
        [], description="networks whose computers need no token, such as 192.168.2.0/24: everybody "
        "there may watch and control the dive",
    )  # fmt: skip
    proxies: list[IPvAnyNetwork] = Field(
        [], description="addresses of proxies whose X-Real-IP names the client, such as 127.0.0.1 "
        "for BlueOS's: every program at such an address can claim to be any client",
    )  # fmt: skip

    @model_validator(mode="after")
    def _others_need_a_token(self) -> ListenConfig:
        if self.enabled and not is_loopback(self.host) and self.token_file is None:
            raise ValueError(f"{self.host} can be reached from outside: set token_file as well")
        return self


class FoxgloveConfig(ListenConfig):
    """A running dive as ROS 2 messages over Foxglove's websocket; off unless asked for."""

    enabled: bool = False
    port: int = Field(8765, ge=0, le=65535, description="Foxglove's default; 0: any that is free")
    origins: list[str] = Field(
        ["https://app.foxglove.dev"],
        description="pages that may connect without being told the token, as a browser names them "
        "in Origin; file:// lets desktop apps in, and every page that is opened from the disk",
    )
    pose_hz: Lab[float] = Field(
        10.0, gt=0, le=60, description="tf, pose, camera picture, diagnostics"
    )
    refresh_s: Lab[float] = Field(
        3.0, gt=0, description="s between points and rendered pictures of the map, as the viewer's"
    )
    points: Lab[int] = Field(60_000, ge=100, description="of the map at most; 20 bytes each")


class LiveMappingConfig(StageConfig):
    """How mapping runs in parallel to tracking."""

    backlog: Lab[int] = Field(
        8, ge=1, description="frames that wait for mapping; then common frames come as views, "
        "without steps of their own, at three times as many mapping frames are left out, at eight "
        "times keyframes, and common frames where so many requests wait",
    )  # fmt: skip
    steps_per_view: Lab[int] = Field(
        40, ge=0, description="steps of the optimiser for each view in the end, as far as time "
        "allows: as 1500 steps of refining and 20 a frame for a clip of 75 views",
    )  # fmt: skip
    nice: Lab[int] = Field(
        0,
        ge=0,
        le=19,
        description="of the mapping thread. More than a little is unwise: where other programs are "
        "busy, it would be stopped while tracking waits for Python's lock that it holds (measured "
        "on two cores with ten busy processes: at 10, no step of mapping ended for a minute)",
    )
    refine_seconds: float | None = Field(
        20.0,
        ge=0,
        description="s; refining when the dive ends, within service.finish_s (None: as long as "
        "mapping.optimiser says)",
    )


class DiveConfig(StageConfig):
    """When dives begin and end. Recordings (``--source``) begin at once, whatever it says."""

    begin: Literal["at_once", "when_armed", "on_command"] = Field(
        "at_once",
        description="at_once: the first dive with the service; when_armed: one each time that the "
        "autopilot is armed; on_command: when the pilot asks. Whatever it says, the pilot may ask, "
        "and a dive that a crash cut off goes on by itself",
    )
    finish: Literal["on_command", "when_disarmed"] = Field(
        "on_command",
        description="on_command: when the pilot asks; when_disarmed: also some time after the "
        "autopilot was disarmed",
    )
    disarmed_s: float = Field(
        60.0,
        ge=0,
        description="s; an autopilot that is armed again within this time goes on with its dive "
        "(judgement: a pilot disarms to change a gripper or to rest on the ground)",
    )
    commands: bool = Field(
        False,
        description="obey MAV_CMD_USER_1 to 4 (start, stop, finish, new) of any ground station on "
        "the MAVLink network, which has no token",
    )
    site: Path | None = Field(
        None,
        description="folder of an earlier dive, or of a site, in which each dive is looked for; it "
        "goes on in that frame once it was recognised there; as `aquaflow run --in`",
    )


class CheckpointConfig(StageConfig):
    """What a kill or a power cut may cost."""

    every_s: float = Field(10.0, gt=0, description="s between checkpoints, and so the most lost")
    deliverables_s: float = Field(
        60.0,
        gt=0,
        description="s between the maps, trajectories and reports that are written while the dive "
        "goes on; longer where they would take more than 3 % of a core",
    )
    resume_h: float = Field(
        12.0, ge=0, description="h; an unfinished dive that is older is left as it is (0: always)"
    )


class LimitsConfig(StageConfig):
    """When the service takes less for itself, and how it climbs back."""

    disk_mb: int = Field(1500, ge=0, description="MB free, below which nothing new is written")
    memory_share: float = Field(
        0.10, ge=0, lt=1, description="of the machine's or the unit's memory that must stay free"
    )
    temperature_c: float = Field(
        92.0, gt=0, description="degC of the hottest zone; a Jetson throttles itself at 97 to 99"
    )
    look_s: Lab[float] = Field(2.0, gt=0, description="s between looks; each may go down one step")
    calm_s: Lab[float] = Field(20.0, gt=0, description="s without need until it climbs up one step")


class PoseConfig(StageConfig):
    """The vehicle's pose back to its autopilot. Off unless asked for, and only in metres."""

    enabled: bool = False
    message: Literal["odometry", "vision_position_delta"] = "odometry"
    mounting: MountingConfig | None = Field(
        None, description="of the camera, where fusion.camera does not state it"
    )
    max_scale_sigma: float = Field(
        0.05, gt=0, lt=1, description="relative 1 sigma of the map's scale; beyond, nothing is sent"
    )
    max_position_sigma_m: float = Field(
        10.0, gt=0, description="m, 1 sigma of the position; beyond, no ODOMETRY is sent"
    )
    jump_m: Lab[float] = Field(
        0.2, gt=0, description="m; a correction that moves the pose further bumps reset_counter"
    )
    jump_deg: Lab[float] = Field(
        5.0, gt=0, le=180, description="deg; so does one that turns the pose further"
    )


class VehicleReportConfig(StageConfig):
    """Messages to the pilot over MAVLink."""

    status_text: bool = Field(True, description="STATUSTEXT when something changes")
    hints: bool = Field(
        False, description="STATUSTEXT also where the pilot swims too fast or too high for the "
        "coverage, or too far from the last line (see coverage); needs status_text",
    )  # fmt: skip
    values: bool = Field(True, description="NAMED_VALUE_FLOAT once a second: AQ_STATE, AQ_LAG, ...")


class ServiceConfig(StageConfig):
    """What ``aquaflow run`` does in addition to mapping."""

    dives: Path = Field(Path("dives"), description="folder that gets a folder for each dive")
    camera: str | None = Field(None, description="name of the camera that maps; None: the first")
    record: bool = Field(False, description="also record cameras and telemetry, as `record` does")
    hang_s: Lab[float] = Field(
        60.0, gt=0, description="s without a heartbeat of a stage until the process exits; "
        "one fit of the water may take 10 s on two cores",
    )  # fmt: skip
    finish_s: float | None = Field(
        100.0,
        gt=0,
        description="s; for all that ends a dive: frames that wait, refining, evaluation, files. "
        "Evaluation and refining are cut short (None: as long as it takes)",
    )
    stop_s: float = Field(
        15.0,
        gt=0,
        description="s; for the same from the moment on at which SIGTERM or Ctrl-C comes: the dive "
        "may go on, or be finished, later. Keep it 45 s below systemd's TimeoutStopSec",
    )
    health: ListenConfig = ListenConfig(port=8230)
    foxglove: FoxgloveConfig = FoxgloveConfig()
    dive: DiveConfig = DiveConfig()
    mapping: LiveMappingConfig = LiveMappingConfig()
    checkpoint: CheckpointConfig = CheckpointConfig()
    limits: LimitsConfig = LimitsConfig()
    pose: PoseConfig = PoseConfig()
    report: VehicleReportConfig = VehicleReportConfig()


# --------------------------------------------------------------------------------------------------
# Settings of the recorder: how pictures are kept, and how files are cut.


class RecordingConfig(StageConfig):
    """How pictures are kept, how files are cut, and when to stop."""

    keep_received: bool = Field(
        True, description="keep JPEG, PNG, WebP and H.264 as the camera delivered them"
    )
    picture: Literal["jpeg", "png", "raw"] = Field(
        "jpeg",
        description="for pictures that came without such bytes; png and raw lose nothing "
        "(measured at 640x480 on one core: jpeg 1 ms, png 10 ms, raw 28 MB/s at 30 pictures/s)",
    )
    jpeg_quality: int = Field(
        95, ge=1, le=100, description="OpenCV's default; 8x8 blocks would be mapped as texture"
    )
    flush_s: Lab[float] = Field(
        0.5, gt=0, le=1, description="every so often all is brought to the disk (fsync)"
    )
    chunk_kb: Lab[int] = Field(
        512, ge=16, le=16_384, description="kB; a damaged place costs one chunk"
    )
    file_s: float = Field(600.0, gt=0, description="a new file after this long")
    file_mb: int = Field(2000, ge=1, description="MB; a new file after this much: FAT32 holds 4 GB")
    reserve_mb: int = Field(
        1000, ge=0, description="MB; recording stops while so much of the disk is still free"
    )
    queue_mb: Lab[int] = Field(
        128, ge=1, description="MB waiting for a slow disk: 4 s of 720p pictures; more is dropped"
    )


# --------------------------------------------------------------------------------------------------
# Settings of the window into a dive.


class ViewerConfig(ListenConfig):
    """The live view in a browser (docs/viewer.md); off unless asked for."""

    enabled: bool = False
    port: int = Field(8231, ge=0, le=65535, description="0: any that is free")
    splats: int = Field(
        60_000, ge=100, description="Gaussians shown at most of a live map, which a browser gets "
        "again as often as it changes and the link allows: 14 to 18 bytes each",
    )  # fmt: skip
    refresh_s: Lab[float] = Field(3.0, gt=0, description="s between pictures of the whole map")
    pose_hz: Lab[float] = Field(4.0, gt=0, le=30, description="frustum and trajectory")


# --------------------------------------------------------------------------------------------------
# Settings of the coverage: what counts as seen, and how survey lines shall overlap.


class CoverageConfig(StageConfig):
    """What the camera has seen from above, and the lines that it was seen along."""

    enabled: bool = Field(True, description="False: neither shown nor written nor hinted at")
    cells: Lab[int] = Field(
        16, ge=4, le=64, description="cells of the plan along the shorter side of what a picture "
        "shows, median: 6 % of it, and 0.1 m at 2 m altitude",
    )  # fmt: skip
    least_views: Lab[int] = Field(
        3, ge=1, description="keyframes that see a place well, before it counts as seen well: two "
        "give a point, a third one contradicts a wrong match",
    )  # fmt: skip
    least_directions: Lab[int] = Field(
        2, ge=1, le=17, description="different directions among its views (from above, or from one "
        "of four sides in steps of 15 degrees): without parallax there is no range",
    )  # fmt: skip
    least_contrast: Lab[float] = Field(
        0.1, gt=0, lt=0.5, description="apparent contrast of the ground's texture below which it "
        "is too far for this water: three times the noise of a picture in dim light, 0.03 of its "
        "signal (judgement); the texture's own contrast is taken as 0.6",
    )  # fmt: skip
    overlap: float = Field(
        0.6, ge=0, le=0.95, description="wanted of neighbouring survey lines, share of the swath: "
        "photogrammetry asks for 60 % (judgement: currents and altitude need the margin)",
    )  # fmt: skip
    forward_overlap: float = Field(
        0.6, ge=0, le=0.95, description="wanted of one tracked picture with the next, share of "
        "what a picture shows along the path",
    )  # fmt: skip
