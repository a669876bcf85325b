"""The vehicle's pose back to its autopilot: only in metres, with how well it is known.

The autopilot's filter wants at least four poses a second; where tracking gives fewer, nothing is
sent, because a filter that starves is worse than one that knows it has no vision.
"""

from __future__ import annotations

import logging
import time
from collections import deque
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from aquaflow.config.service import PoseConfig
from aquaflow.errors import ConfigError
from aquaflow.geometry.similarity import Sim3
from aquaflow.service.feed import Feed
from aquaflow.service.loop import LiveLoop
from aquaflow.slam import Slam
from aquaflow.sources.outbound import BodyMotion, BodyPose
from aquaflow.tracking.frames import Tracked

log = logging.getLogger(__name__)

Array = npt.NDArray[np.float64]

LEAST_HZ = 4.0
"""What ArduPilot's filter needs (mavlink-nongps-position-estimation)."""
WINDOW = 12
"""Poses over which the rate is judged."""
AXES = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
"""Camera (right, down, forward) to body (forward, right, down), for one that looks forward."""
PRIOR_SIGMA = 0.1
"""Relative 1 sigma of a learned prior's metres under water, where none was trained (judgement)."""
LEAST_SIGMA_M, LEAST_SIGMA_RAD = 0.02, 0.01
"""1 sigma of a good pose against its keyframe: judgement, to be measured with a vehicle."""
SIGMA_SHARE = 0.02
"""Growth of the position's sigma with the way since the last loop: drift of 2 % (judgement)."""


@dataclass(frozen=True)
class MetricScale:
    """Metres per map unit, the source of that scale, and its uncertainty."""

    metres: float
    source: str
    relative_sigma: float


def metric_scale(slam: Slam) -> MetricScale | None:
    """The map's metric scale; None while it is arbitrary."""
    return MetricScale(1.0, "prior", PRIOR_SIGMA) if slam.prior.metric else None


class PoseOutput:
    """A watcher of the loop."""

    def __init__(self, config: PoseConfig, feed: Feed, scale: MetricScale | None) -> None:
        """Raises ConfigError where the map's scale in metres is unknown."""
        if scale is None:
            raise ConfigError(
                "service.pose.enabled: the map's scale is not known in metres, so that no pose may "
                "steer the vehicle; set it to false, or give telemetry or a prior with metric scale"
            )
        self.sent = 0
        self.jumps = 0
        """Times that the pose jumped: reset_counter."""
        self.withheld = 0
        """Poses that were not sent because they came too rarely."""
        self._config, self._feed, self._scale = config, feed, scale
        mounting = config.mounting
        angles = (mounting.yaw_deg, mounting.pitch_deg, mounting.roll_deg)
        self._R_bc = Rotation.from_euler("ZYX", angles, degrees=True).as_matrix() @ AXES
        self._camera_m = np.array(mounting.position_m, np.float64)
        self._before: tuple[Tracked, Array, Array] | None = None
        self._way_m = 0.0
        self._times_s: deque[float] = deque(maxlen=WINDOW)

    def update(self, loop: LiveLoop, now_s: float | None = None) -> None:
        """Called after every turn; sends a pose that is new."""
        latest = loop.latest
        if latest is None or latest.T_wc is None:
            return
        if self._before is not None and latest.frame.index == self._before[0].frame.index:
            return
        self._times_s.append(time.monotonic() if now_s is None else now_s)
        self._send(latest, *self._body(latest.T_wc))

    def _body(self, T_wc: Sim3) -> tuple[Array, Array]:
        """R [3, 3] and t [3] of the body, in forward-right-down axes of the first camera, m."""
        R = AXES @ T_wc.R @ self._R_bc.T
        camera_m = self._scale.metres * (AXES @ T_wc.t)
        return R, camera_m - R @ self._camera_m

    def _send(
        self,
        latest: Tracked,
        R: Array,  # [3, 3]
        t_m: Array,  # [3] m
    ) -> None:
        before, self._before = self._before, (latest, R, t_m)
        moved_m = 0.0 if before is None else float(np.linalg.norm(t_m - before[2]))
        jumped = before is not None and self._jumped(before[0], latest, moved_m)
        self.jumps += jumped
        self._way_m = 0.0 if jumped else self._way_m + moved_m
        if self._rate_hz() < LEAST_HZ:
            self.withheld += 1
            return
        quality = latest.quality.inlier_share
        if self._config.message == "odometry":
            covariance = self._covariance(quality)
            word = BodyPose(latest.frame.t_ns, R, t_m, covariance, quality, self.jumps)
            self.sent += self._feed.send(word)
        elif before is not None and not jumped:
            self.sent += self._feed.send(_motion(before, latest, R, t_m, quality))

    def _jumped(self, before: Tracked, latest: Tracked, moved_m: float) -> bool:
        return before.sub_map != latest.sub_map or moved_m > self._config.jump_m

    def _rate_hz(self) -> float:
        """Rate of the last poses; 0 while there are too few."""
        if len(self._times_s) < 2:
            return 0.0
        span = self._times_s[-1] - self._times_s[0]
        return (len(self._times_s) - 1) / span if span > 0.0 else float("inf")

    def _covariance(self, quality: float) -> Array:
        worse = 1.0 / max(quality, 0.05)
        drift = float(np.hypot(SIGMA_SHARE, self._scale.relative_sigma))
        position = worse * float(np.hypot(LEAST_SIGMA_M, drift * self._way_m))
        return np.diag([position**2] * 3 + [(worse * LEAST_SIGMA_RAD) ** 2] * 3)


def _motion(
    before: tuple[Tracked, Array, Array],  # with its R [3, 3] and t_m [3]
    latest: Tracked,
    R: Array,  # [3, 3]
    t_m: Array,  # [3] m
    quality: float,
) -> BodyMotion:
    tracked, R_before, t_before = before
    rotation = Rotation.from_matrix(R_before.T @ R).as_rotvec()
    since_ns = latest.frame.t_ns - tracked.frame.t_ns
    translation = R_before.T @ (t_m - t_before)
    return BodyMotion(latest.frame.t_ns, since_ns, rotation, translation, quality)
