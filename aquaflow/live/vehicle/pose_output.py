"""The vehicle's pose back to its autopilot: only in metres, with how well it is known.

The scale comes from telemetry and grows more certain during a dive; until it and the direction of
gravity are known well enough, and while pictures and telemetry are out of step, nothing is sent.
The autopilot's filter wants at least four poses a second; where tracking gives fewer, nothing is
sent, because a filter that starves is worse than one that knows it has no vision.
"""

from __future__ import annotations

import math
import time
from collections import Counter, deque
from collections.abc import Callable
from enum import Enum
from typing import Any

import numpy as np
import numpy.typing as npt

from aquaflow.config.service import PoseConfig
from aquaflow.geometry.similarity import Sim3
from aquaflow.live.feed import Feed
from aquaflow.live.loop import LiveLoop
from aquaflow.live.vehicle.body_track import BodyTrack, Sighting, body_pose, pose_covariance
from aquaflow.sources.outbound import BodyPose, BodyPoseChange, OutboundMessage
from aquaflow.telemetry.start import camera_in_body
from aquaflow.telemetry.world_frame import WorldFrame
from aquaflow.tracking.frames import Tracked

Array = npt.NDArray[np.float64]

LEAST_HZ = 4.0
"""What ArduPilot's filter needs (mavlink-nongps-position-estimation)."""
RATE_WINDOW = 12
"""Poses over which the rate is judged."""
LEAST_SIGMA_M, LEAST_SIGMA_RAD = 0.02, 0.01
"""1 sigma of a good pose against its keyframe: judgement, to be measured with a vehicle."""
SIGMA_SHARE = 0.02
"""Growth of the position's sigma with the way since the last loop: drift of 2 % (judgement)."""
LEAST_QUALITY = 0.05
"""The share of inliers below which sigmas grow no further."""
LARGEST_OFFSET_S = 0.25
"""Between pictures and telemetry, of which the autopilot's is one: its filter looks back no further
(ArduPilot, VISO_DELAY_MS: 0 to 250)."""
NORTH = ("true north", "magnetic north")
"""What x must point to for a frame that is named after north."""


class Withheld(str, Enum):
    """Why a pose was not sent."""

    NO_SCALE = "the map's scale in metres is not known"
    VAGUE_SCALE = "the map's scale is not known to service.pose.max_scale_sigma"
    UNCONFIRMED = "too little of the path shows whether telemetry and pictures are of one time"
    OUT_OF_STEP = "pictures and telemetry are out of step, see metric_frame.clock_offset_s"
    NOT_LEVEL = "the direction of gravity is not known"
    NO_MOUNTING = "the camera's mounting is not known; set fusion.camera or service.pose.mounting"
    VAGUE_POSITION = "the position is not known to service.pose.max_position_sigma_m"
    TOO_RARE = f"poses come less than {LEAST_HZ:.0f} times a second"
    NO_VELOCITY = "too few poses since the start, the last gap or jump"
    NO_RECEIVER = "no connected device takes poses"


class PoseOutput:
    """A watcher of the loop."""

    def __init__(
        self, config: PoseConfig, feed: Feed, frame_of: Callable[[int], WorldFrame]
    ) -> None:
        """``frame_of`` gives a sub-map's place in the world, as it is known at that moment."""
        self.sent = 0
        self.jumps = 0
        """Times that the pose jumped: reset_counter."""
        self.withheld: Counter[Withheld] = Counter()
        """Poses that were not sent, by reason."""
        self.reason: Withheld | None = None
        """Why the newest pose was not sent."""
        self.scale_source = ""
        """Where the map's scale comes from, or why there is none."""
        self._config, self._feed, self._frame_of = config, feed, frame_of
        self._stated = None if config.mounting is None else camera_in_body(config.mounting)
        self._track = BodyTrack(config.jump_m, math.radians(config.jump_deg))
        self._index: int | None = None
        self._place_m: Array | None = None
        self._way_m = 0.0
        self._times_s: deque[float] = deque(maxlen=RATE_WINDOW)

    def update(self, loop: LiveLoop, now_s: float | None = None) -> None:
        """Called after every turn; sends a pose that is new."""
        latest = loop.latest
        if latest is None or latest.T_wc is None or latest.frame.index == self._index:
            return
        self._index = latest.frame.index
        self._times_s.append(time.monotonic() if now_s is None else now_s)
        self.reason = self._send(latest, latest.T_wc)
        if self.reason is None:
            self.sent += 1
        else:
            self.withheld[self.reason] += 1

    def to_json(self) -> dict[str, Any]:
        """Counts for /health."""
        return {
            "sent": self.sent,
            "jumps": self.jumps,
            "withheld": {reason.value: count for reason, count in dict(self.withheld).items()},
            "reason": "" if self.reason is None else self.reason.value,
            "scale": self.scale_source,
        }

    def _send(self, latest: Tracked, T_mc: Sim3) -> Withheld | None:
        """Send the pose; or why it is not sent."""
        frame = self._frame_of(latest.sub_map)
        self.scale_source = frame.scale_source
        T_bc = frame.T_bc or self._stated
        reason = self._missing(frame)
        if reason is not None or T_bc is None:
            return reason or Withheld.NO_MOUNTING
        t_ns = latest.frame.t_ns - self._feed.continued.known_shift_ns
        sighting = Sighting(t_ns, latest.sub_map, T_mc)
        self._follow(self._track.add(sighting, lambda T: body_pose(frame, T_bc, T)))
        if self._rate_hz() < LEAST_HZ:
            return Withheld.TOO_RARE
        quality = latest.quality.inlier_share
        message = (
            self._pose(frame, t_ns, quality)
            if self._config.message == "odometry"
            else self._motion(t_ns, quality)
        )
        if isinstance(message, Withheld):
            return message
        return None if self._feed.send(message) else Withheld.NO_RECEIVER

    def _missing(self, frame: WorldFrame) -> Withheld | None:
        if not frame.metric:
            return Withheld.NO_SCALE
        if not frame.scale_sigma <= self._config.max_scale_sigma:
            return Withheld.VAGUE_SCALE
        if not frame.scale_confirmed:
            return Withheld.UNCONFIRMED
        if not abs(frame.clock_offset_s) <= LARGEST_OFFSET_S:
            return Withheld.OUT_OF_STEP
        if self._config.message == "odometry" and not frame.level:
            return Withheld.NOT_LEVEL
        return None

    def _follow(self, jumped: bool) -> None:
        """Count the jump, or the way since the last one."""
        self.jumps += jumped
        place, before = self._track.pose.t_m, self._place_m
        self._place_m = place
        moved = 0.0 if before is None or jumped else float(np.linalg.norm(place - before))
        self._way_m = 0.0 if jumped else self._way_m + moved

    def _pose(self, frame: WorldFrame, t_ns: int, quality: float) -> OutboundMessage | Withheld:
        worse = 1.0 / max(quality, LEAST_QUALITY)
        sigma_m, sigma_rad = worse * LEAST_SIGMA_M, worse * LEAST_SIGMA_RAD
        motion = self._track.motion(sigma_m, sigma_rad)
        if motion is None:
            return Withheld.NO_VELOCITY
        pose = self._track.pose
        place_m = float(np.hypot(sigma_m, worse * SIGMA_SHARE * self._way_m))
        own = np.diag(np.repeat([place_m, sigma_rad], 3)) ** 2
        covariance = pose_covariance(frame, pose, own)
        # Written so that a sigma that is not a number withholds the pose.
        most = self._config.max_position_sigma_m
        if not float(np.linalg.eigvalsh(covariance[:3, :3])[-1]) <= most**2:
            return Withheld.VAGUE_POSITION
        motion_covariance = motion.covariance.copy()
        stretch = frame.scale_sigma * motion.velocity_m_s
        motion_covariance[:3, :3] += np.outer(stretch, stretch)
        return BodyPose(
            t_ns, pose.R, pose.t_m, covariance,
            motion.velocity_m_s, motion.rate_rad_s, motion_covariance,
            quality, self.jumps, frame.north in NORTH,
        )  # fmt: skip

    def _motion(self, t_ns: int, quality: float) -> OutboundMessage | Withheld:
        step = self._track.step()
        return Withheld.NO_VELOCITY if step is None else BodyPoseChange(t_ns, *step, quality)

    def _rate_hz(self) -> float:
        """Rate of the last poses; 0 while there are too few."""
        if len(self._times_s) < 2:
            return 0.0
        span = self._times_s[-1] - self._times_s[0]
        return (len(self._times_s) - 1) / span if span > 0.0 else float("inf")
