"""What stands around the dives of a service: its servers, its viewer, its words to the pilot."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from aquaflow.config.vehicle import VehicleConfig
from aquaflow.dive.views import DiveView, open_coverage, open_viewer
from aquaflow.live.control import ServiceControl
from aquaflow.live.dive_parts import Parts
from aquaflow.live.feed import Feed
from aquaflow.live.health.heartbeats import ServiceHealth
from aquaflow.live.health.http import HealthServer
from aquaflow.live.idle_loop import IdleLoop
from aquaflow.live.live_dive import LiveDive
from aquaflow.live.plan_view import PlanView
from aquaflow.live.report import report, report_between_dives, viewer_facts
from aquaflow.live.service_status import ServiceStatus
from aquaflow.live.vehicle.arming import Arming, PilotMessages
from aquaflow.live.vehicle.pose_output import PoseOutput
from aquaflow.types import Frame


class ServiceFrontends:
    """Close it after the last dive."""

    def __init__(
        self, feed: Feed, vehicle: VehicleConfig, control: ServiceControl, vitals: ServiceHealth
    ) -> None:
        """Begin to listen.

        Raises:
            InputError: an address is taken, or a token file cannot be read.
            ConfigError: a token will not do.
        """
        service = vehicle.service
        self.standby = IdleLoop(feed, control, vitals)
        self._feed, self._control, self._config = feed, control, service
        self._shown: tuple[Parts, PoseOutput | None] | None = None
        self._closing = contextlib.ExitStack()
        self.picture = NewestPicture()
        self._coverage = open_coverage(feed.failures) if vehicle.coverage.enabled else None
        messages = PilotMessages(service.report, feed, self._hints)
        self._watchers: list[Callable[[ServiceStatus], None]] = [
            self.picture.update,
            messages.update,
        ]
        if feed.pilot is not None:
            self._watchers.append(Arming(service.dive, control, feed.pilot).update)
        self.standby.watchers += self._watchers
        self._views: list[DiveView] = [] if self._coverage is None else [self._coverage]
        self._viewer_config = vehicle.viewer
        with contextlib.ExitStack() as opened:
            if self._coverage is not None:
                opened.callback(self._contain, self._coverage.close)
            if service.health.enabled:
                plan = PlanView(self._dive_shown, coverage=self._coverage)
                server = HealthServer(
                    service.health, self._page, plan.to_json, control, self.picture.jpeg,
                    self._coverage,
                )  # fmt: skip
                opened.callback(self._contain, server.close)
            if vehicle.viewer.enabled:
                self._views.append(open_viewer(vehicle.viewer, self.report, self._coverage))
                opened.callback(self._contain, self._views[-1].close)
            if service.foxglove.enabled:
                from aquaflow.live.foxglove.live import LiveFoxglove  # it loads torch

                self._views.append(LiveFoxglove(service.foxglove, self.report))
                opened.callback(self._contain, self._views[-1].close)
            self._closing = opened.pop_all()

    def report(self) -> dict[str, Any]:
        """The service as it is now; for any thread."""
        shown = self._shown
        if shown is None:
            return report_between_dives(self.standby, self._control, self._feed)
        parts, poses = shown
        return report(parts, self._config.hang_s, poses)

    def _page(self) -> dict[str, Any]:
        """The report, and where the page finds the viewer."""
        return self.report() | {"viewer": viewer_facts(self._viewer_config)}

    def show(self, dive: LiveDive) -> None:
        """From here on, this dive."""
        self.standby.end()
        parts, pose = dive.parts, self._config.pose
        poses = PoseOutput(pose, self._feed, parts.slam.metric_frame) if pose.enabled else None
        parts.loop.watchers += self._watchers
        if poses is not None:
            parts.loop.watchers.append(poses.update)
        for view in self._views:
            view.show(parts.loop)
            parts.loop.watchers.append(view.update)
        self._shown = parts, poses

    def hide(self) -> None:
        """From here on, no dive: what it holds may be let go."""
        self._shown = None
        if self._coverage is not None:
            self._coverage.hide()

    def _dive_shown(self) -> Parts | None:
        return None if self._shown is None else self._shown[0]

    def _hints(self) -> tuple[str, ...]:
        return () if self._coverage is None else self._coverage.sentences()

    def close(self) -> None:
        """Stop listening."""
        self.standby.end()
        self._closing.close()

    def _contain(self, close: Callable[[], None]) -> None:
        with self._feed.failures.contain("closing"):
            close()

    def __enter__(self) -> ServiceFrontends:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


# --------------------------------------------------------------------------------------------------
# The newest picture of the mapping camera for a web page: made when somebody asks for it.

WIDTH = 640
"""Most pixels across: enough to see where the camera looks, and 40 to 100 kB."""
QUALITY = 80
"""Of JPEG; artefacts begin to show below."""
SPACING_S = 0.5
"""Between two encodings, however many ask: two pictures of 640 px a second cost 1 % of a core."""


class NewestPicture:
    """A watcher of the service, and what answers GET /picture.jpg."""

    def __init__(self, now_s: Callable[[], float] = time.monotonic) -> None:
        self.encoded = 0
        """Pictures that were encoded."""
        self._now_s, self._made_s = now_s, -SPACING_S
        self._newest: Frame | None = None
        self._jpeg: tuple[Frame, bytes] | None = None
        self._making = threading.Lock()

    def update(self, service: ServiceStatus) -> None:
        """Called after every turn of the service; never waits."""
        self._newest = service.picture or self._newest

    def jpeg(self) -> bytes | None:
        """The newest picture, or one that was the newest ``SPACING_S`` ago; None before the
        first."""
        with self._making:
            frame, now = self._newest, self._now_s()
            if frame is None:
                return None
            made = self._jpeg
            if made is not None and (made[0] is frame or now - self._made_s < SPACING_S):
                return made[1]
            self._jpeg, self._made_s = (frame, _encode(frame)), now
            self.encoded += 1
            return self._jpeg[1]


def _encode(frame: Frame) -> bytes:
    import cv2

    image = frame.image
    height, width = image.shape[:2]
    if width > WIDTH:
        size = (WIDTH, max(1, round(height * WIDTH / width)))
        image = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
    bgr = cv2.cvtColor(image, cv2.COLOR_RGB2BGR)
    done, data = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
    assert done  # of three channels of bytes it always is
    return bytes(data)
