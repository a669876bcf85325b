"""The live viewer of a running dive; a slow or dead browser never slows the loop."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from aquaflow.config.viewer import ViewerConfig
from aquaflow.dive.views import LOOK_S, DiveView, RunningDive, Showing
from aquaflow.mapping.work import OwnedMaps
from aquaflow.sources.newest import Newest
from aquaflow.survey.coverage.plan import CoveragePlan
from aquaflow.survey.measure.scale import Scale
from aquaflow.survey.viewer.copies import Pose, shown
from aquaflow.survey.viewer.live_path import LivePath
from aquaflow.survey.viewer.measuring import Frame
from aquaflow.survey.viewer.page import ViewerPage
from aquaflow.telemetry.metric_frame import MetricFrame
from aquaflow.tracking.frames import Tracked

if TYPE_CHECKING:
    from aquaflow.mapping.map_copy import MapCopy


class LiveViewer(DiveView):
    """Takes new data from the loop and the maps, and shows them from its own thread."""

    def __init__(
        self,
        config: ViewerConfig,
        report: Callable[[], dict[str, Any]],
        plan: Callable[[int], CoveragePlan | None] | None = None,
    ) -> None:
        """Raises what :class:`ViewerPage` raises. ``plan``: the coverage of a sub-map, if any."""
        self._config, self._report, self._plan = config, report, plan
        self._page = ViewerPage(config, "AquaFlow")
        self.address = self._page.address
        self._poses: Newest[Pose] = Newest()
        self._copies: Newest[tuple[int, MapCopy]] = Newest()
        """With their sub-maps."""
        self._path = LivePath()
        self._pictures: Mapping[int, Path] = {}
        self._pose_s = self._map_s = 0.0
        self._asked = False
        self._showing = Showing("viewer", self._show, config.refresh_s)

    @property
    def splats_shown(self) -> int:
        """Gaussians that a browser gets at the moment."""
        return self._page.splats_shown

    def show(self, dive: RunningDive) -> None:
        """A dive begins: its path is shown, and no other's."""
        self._path, self._asked = LivePath(), False

    def update(self, dive: RunningDive) -> None:
        """Called after every turn of the loop; queues what is new for the browser, never waits."""
        now, latest, frame = time.monotonic(), dive.latest, dive.picture
        if latest is None or frame is None or latest.T_wc is None:
            return
        if now - self._pose_s >= 1.0 / self._config.pose_hz:
            self._pose_s = now
            self._hand_over(dive, latest, frame.image)
        if now - self._map_s >= self._config.refresh_s and not self._asked:
            self._map_s, self._asked = now, True
            sub_map = latest.sub_map
            dive.maps.inspect("show the map", lambda maps, _: self._copy(maps, sub_map))

    def close(self) -> None:
        self._showing.close()
        self._page.close()

    def _hand_over(
        self,
        dive: RunningDive,
        latest: Tracked,
        image: npt.NDArray[np.uint8],  # [H, W, 3] RGB
    ) -> None:
        assert latest.T_wc is not None
        self._path.add(latest, dive.dive_run.slam.metric_frame(latest.sub_map))
        kept = dive.dive_run.pictures
        self._pictures = {} if kept is None else kept.paths
        step = max(1, image.shape[1] // self._config.picture_width)
        small = np.ascontiguousarray(image[::step, ::step])
        self._poses.put(Pose(latest.T_wc, latest.frame.camera, small))

    def _copy(self, maps: OwnedMaps, sub_map: int) -> None:
        """In the mapping thread."""
        self._asked = False
        mapper = maps.mappers.get(sub_map)
        if mapper is not None and mapper.views and len(mapper.gaussians):
            from aquaflow.mapping.map_copy import copied  # torch, which has made the map

            self._copies.put((sub_map, copied(mapper)))

    def _show(self) -> None:
        pose = self._poses.take(LOOK_S)
        report = self._report()
        self._path.hear(report.get("telemetry") or {})
        frame = frame_of(report)
        known = report.get("metric_frame") or {}
        self._page.set_frame(frame, north=known.get("north") or "")
        if pose is not None:
            self._page.show_camera(pose.T_wc, pose.camera, pose.picture)
            path, pictures = self._path, self._pictures
            self._page.show_pictures(pictures)
            self._page.show_path(*path.rows(pictures), path.began)
        taken = self._copies.take(0.0)
        if taken is not None:
            sub_map, copy = taken
            plan = self._plan(sub_map) if self._plan is not None and self._page.watched else None
            self._page.show_splats(*shown(copy, self._config.splats, frame, plan))
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
