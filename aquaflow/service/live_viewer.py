"""The live viewer of a running dive; a slow or dead browser never slows the loop."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt

from aquaflow.config.viewer import ViewerConfig
from aquaflow.fusion.metric_frame import MetricFrame
from aquaflow.mapping.work import OwnedMaps
from aquaflow.measure.scale import Scale
from aquaflow.service.loop import LiveLoop
from aquaflow.sources.newest import Newest
from aquaflow.tracking.frames import Tracked
from aquaflow.viewer.copies import MapCopy, Pose, shown
from aquaflow.viewer.measuring import Frame
from aquaflow.viewer.page import ViewerPage

log = logging.getLogger(__name__)

LONGEST_PATH = 5000
"""Most poses of the trajectory that are shown; a longer one is thinned."""
LOOK_S = 0.1
"""Longest wait for a new pose; then the thread checks whether it shall end."""


class LiveViewer:
    """Takes new data from the loop and the maps, and shows them from its own thread."""

    def __init__(self, config: ViewerConfig, report: Callable[[], dict[str, Any]]) -> None:
        """Raises what :class:`ViewerPage` raises."""
        self._config, self._report = config, report
        self._page = ViewerPage(config, "AquaFlow")
        self.address = self._page.address
        self._poses: Newest[Pose] = Newest()
        self._copies: Newest[MapCopy] = Newest()
        self._path: list[tuple[float, ...]] = []
        self._pose_s = self._map_s = 0.0
        self._asked = False
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name="viewer", daemon=True)
        self._thread.start()

    @property
    def splats_shown(self) -> int:
        """Gaussians that a browser gets at the moment."""
        return self._page.splats_shown

    def begin(self) -> None:
        """A dive begins: its path is shown, and no other's."""
        self._path, self._asked = [], False

    def update(self, loop: LiveLoop) -> None:
        """Called after every turn of the loop; queues what is new for the browser, never waits."""
        now, latest, frame = time.monotonic(), loop.latest, loop.picture
        if latest is None or frame is None or latest.T_wc is None:
            return
        if now - self._pose_s >= 1.0 / self._config.pose_hz:
            self._pose_s = now
            self._hand_over(latest, frame.image)
        if now - self._map_s >= self._config.refresh_s and not self._asked:
            self._map_s, self._asked = now, True
            sub_map = latest.sub_map
            loop.maps.inspect("show the map", lambda maps, _: self._copy(maps, sub_map))

    def close(self) -> None:
        self._closing.set()
        self._thread.join(5.0)
        self._page.close()

    def _hand_over(
        self,
        latest: Tracked,
        image: npt.NDArray[np.uint8],  # [H, W, 3] RGB
    ) -> None:
        assert latest.T_wc is not None
        T = latest.T_wc
        self._path.append((*T.t.tolist(), *T.quaternion.tolist(), latest.quality.inlier_share))
        if len(self._path) > LONGEST_PATH:
            self._path = self._path[::2]
        step = max(1, image.shape[1] // self._config.picture_width)
        small = np.ascontiguousarray(image[::step, ::step])
        path = np.array(self._path, np.float32)
        self._poses.put(Pose(latest.T_wc, latest.frame.camera, small, path))

    def _copy(self, maps: OwnedMaps, sub_map: int) -> None:
        """In the mapping thread."""
        self._asked = False
        mapper = maps.mappers.get(sub_map)
        if mapper is not None and mapper.views and len(mapper.gaussians):
            from aquaflow.viewer.snapshot import copied  # torch, which has made the map

            self._copies.put(copied(mapper))

    def _run(self) -> None:
        while not self._closing.is_set():
            try:
                self._show()
            except Exception:  # whatever a browser did to the server, the dive goes on
                log.exception("the viewer failed to show the dive")
                self._closing.wait(self._config.refresh_s)

    def _show(self) -> None:
        pose = self._poses.take(LOOK_S)
        report = self._report()
        frame = frame_of(report)
        self._page.set_frame(frame)
        if pose is not None:
            self._page.show_camera(pose.T_wc, pose.camera, pose.picture)
            self._page.show_path(pose.path)
        copy = self._copies.take(0.0)
        if copy is not None:
            self._page.show_splats(*shown(copy, self._config.splats, frame, self._page.watched))
        self._page.show_health(in_words(report))


def frame_of(report: dict[str, Any]) -> Frame:
    """How lengths are said: the map is in its own units, and metres may be known by now."""
    known = report.get("metric_frame") or {}
    metres = known.get("metres_per_map_unit")
    if metres is None:
        return Frame.of(MetricFrame.unknown())
    return Frame(Scale("m", known.get("scale_sigma") or 0.0, 0.0), metres)


def in_words(report: dict[str, Any]) -> str:
    """The health panel."""
    lag = report["lag_ms"]
    lines = [
        f"{report['state']}: {report['reason']}",
        f"{report['fps']:.1f} frames/s, lag {lag['p50'] or 0:.0f} ms (95 %: {lag['p95'] or 0:.0f})",
        f"slowest stage: {report['slowest_stage'] or '-'}; {report['level']}",
        f"{report['keyframes']} keyframes, {report['gaussians']} Gaussians",
        f"{report['overtaken']} frames overtaken, {report['failures']} failed",
    ]
    return "\n\n".join(lines)
