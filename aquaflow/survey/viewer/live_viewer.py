"""The live viewer of a running dive; a slow or dead browser never slows the loop."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from datetime import datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import numpy.typing as npt

from aquaflow.config.service import ViewerConfig
from aquaflow.dive.metric_outputs import attitude_of
from aquaflow.dive.views import LOOK_S, DisplayThread, DiveView, RunningDive
from aquaflow.geometry.similarity import Sim3
from aquaflow.mapping.work import OwnedMaps
from aquaflow.sources.newest import Newest
from aquaflow.survey.coverage.plan import CoveragePlan
from aquaflow.survey.measure.quantity import Scale
from aquaflow.survey.viewer.dive_map import CLASSES, COVERAGE
from aquaflow.survey.viewer.levels import RANGE, Palette, range_level, steps_level
from aquaflow.survey.viewer.measuring import LengthUnit
from aquaflow.survey.viewer.moments import moments
from aquaflow.survey.viewer.page import ViewerPage
from aquaflow.survey.viewer.seen_water import SeenWater, seen_water
from aquaflow.survey.viewer.splats import ViewerSplats, splats
from aquaflow.survey.viewer.viewer_content import POSE_NUMBERS
from aquaflow.telemetry.world_frame import WorldFrame
from aquaflow.tracking.frames import Tracked
from aquaflow.types import CameraModel

if TYPE_CHECKING:
    from aquaflow.mapping.state import MapCopy  # it loads torch

COPYING_SHARE = 0.05
"""Of the process's CPU time, for copies of the map at most: on a busy machine one each
``refresh_s`` would take much of what mapping gets (notes/2026-11-survey.md#preview)."""
PICTURE_WIDTH_PX = 240
"""px of the camera's current picture: some kB at each pose."""


class LiveViewer(DiveView):
    """Takes new data from the loop and the maps, and shows them from its own thread. The map is
    copied while a browser looks."""

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
        self._poses: Newest[ViewerPose] = Newest()
        self._copies: Newest[tuple[int, MapCopy, float]] = Newest()
        """With their sub-maps, and s of CPU that they took."""
        self._copy_at_s = 0.0
        """The process's CPU time before which no other copy is made."""
        self._handed = (-1, -1)
        """Frames of the pose and the picture that were handed over last."""
        self._path = LivePath()
        self._pictures: Mapping[int, Path] = {}
        self._pose_s = self._map_s = 0.0
        self._asked = False
        self._showing = DisplayThread("viewer", self._show, config.refresh_s)

    @property
    def splats_shown(self) -> int:
        """Gaussians that a browser gets at the moment."""
        return self._page.splats_shown

    def show(self, dive: RunningDive) -> None:
        """A dive begins: its path is shown, and no other's."""
        self._path, self._asked, self._handed = LivePath(), False, (-1, -1)

    def update(self, dive: RunningDive) -> None:
        """Called after every turn of the loop; queues what is new for the browser, never waits."""
        now, latest, frame = time.monotonic(), dive.latest, dive.picture
        if latest is None or frame is None or latest.T_wc is None:
            return
        newest = latest.frame.index, frame.index
        if now - self._pose_s >= 1.0 / self._config.pose_hz and newest != self._handed:
            self._pose_s, self._handed = now, newest
            self._hand_over(dive, latest, frame.image)
        due = now - self._map_s >= self._config.refresh_s and not self._asked
        if due and self._page.watched and time.process_time() >= self._copy_at_s:
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
        step = max(1, image.shape[1] // PICTURE_WIDTH_PX)
        small = np.ascontiguousarray(image[::step, ::step])
        self._poses.put(ViewerPose(latest.T_wc, latest.frame.camera, small))

    def _copy(self, maps: OwnedMaps, sub_map: int) -> None:
        """In the mapping thread."""
        self._asked, began_s = False, time.thread_time()
        mapper = maps.mappers.get(sub_map)
        if mapper is not None and mapper.views and len(mapper.gaussians):
            from aquaflow.mapping.state import copy_map  # torch, which has made the map

            copy = copy_map(mapper)
            self._copies.put((sub_map, copy, time.thread_time() - began_s))

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
            (sub_map, copy, took_s), began_s = taken, time.thread_time()
            plan = self._plan(sub_map) if self._plan is not None and self._page.watched else None
            self._page.show_splats(*pack_for_browser(copy, self._config.splats, frame, plan))
            took_s += time.thread_time() - began_s
            self._copy_at_s = time.process_time() + took_s / COPYING_SHARE
        self._page.show_health(in_words(report))


def frame_of(report: dict[str, Any]) -> LengthUnit:
    """How lengths are said: the map is in its own units, and metres may be known by now."""
    known = report.get("metric_frame") or {}
    metres = known.get("metres_per_map_unit")
    if metres is None:
        return LengthUnit.of(WorldFrame.unknown())
    return LengthUnit(Scale("m", known.get("scale_sigma") or 0.0, 0.0), metres)


def in_words(report: dict[str, Any]) -> str:
    """The health panel: of a service with its pace, which a replay sets itself."""
    lines = [f"{report['state']}: {report['reason']}"]
    if "lag_ms" in report:
        lag = report["lag_ms"]
        lines += [
            f"{report['fps']:.1f} frames/s, lag {lag['p50'] or 0:.0f} ms "
            f"(95 %: {lag['p95'] or 0:.0f})",
            f"slowest stage: {report['slowest_stage'] or '-'}; {report['level']}",
        ]
    if "keyframes" in report:
        map_of = report["gaussians"]
        shown = "no map is made" if map_of is None else f"{map_of} Gaussians"
        lines.append(f"{report['keyframes']} keyframes, {shown}")
    if "overtaken" in report:
        lines.append(f"{report['overtaken']} frames overtaken, {report['failures']} failed")
    return "\n\n".join(lines)


# --------------------------------------------------------------------------------------------------
# The path of a running dive, as the viewer shows it: poses with their moments.

LONGEST_PATH = 5000
"""Most poses of the path that are shown; a longer one is thinned."""
OLD_S = 3.0
"""A depth that was measured so long ago is not the pose's."""
Rows = npt.NDArray[np.float32]


class _Row(NamedTuple):
    pose: tuple[float, ...]
    frame: int
    t_s: float
    depth_m: float
    heading_deg: float


class LivePath:
    """Tracking's thread adds poses; the viewer's thread says what the vehicle measures."""

    def __init__(self) -> None:
        self.began: datetime | None = None
        """UTC of the first pose, once a source of telemetry stated the time."""
        self._rows: list[_Row] = []
        self._depth_m = math.nan

    def add(self, tracked: Tracked, frame: WorldFrame) -> None:
        """A posed frame, in the metric ``frame`` of its sub-map as it is known by now, once; it may
        stay the newest for long."""
        T_wc = tracked.T_wc
        assert T_wc is not None
        if self._rows and self._rows[-1].frame == tracked.frame.index:
            return
        pose = (*T_wc.t.tolist(), *T_wc.quaternion.tolist(), tracked.quality.inlier_share)
        heading, _, _ = attitude_of(frame, frame.pose(T_wc))
        turned = math.nan if heading is None else heading
        at = tracked.frame
        self._rows.append(_Row(pose, at.index, 1e-9 * at.t_ns, self._depth_m, turned))
        if len(self._rows) > LONGEST_PATH:
            self._rows = self._rows[::2]

    def hear(self, telemetry: dict[str, dict[str, dict[str, Any]]]) -> None:
        """The newest values by source and kind, as /health has them."""
        kinds = {kind: said for each in telemetry.values() for kind, said in each.items()}
        depth, utc = kinds.get("depth"), kinds.get("utc_time")
        known = depth is not None and depth["age_s"] <= OLD_S
        self._depth_m = float(depth["value"]) if known and depth is not None else math.nan
        rows = self._rows
        if utc is not None and self.began is None and rows:
            now = datetime.fromisoformat(utc["value"].replace("Z", "+00:00"))
            ago_s = rows[-1].t_s - rows[0].t_s - float(utc["age_s"])
            self.began = now - timedelta(seconds=ago_s)

    def rows(self, kept: Iterable[int]) -> tuple[Rows, Rows]:
        """Poses [N, 8] and moments [N, 5]; ``kept``: frames whose picture is there."""
        rows = self._rows
        poses = np.array([row.pose for row in rows], np.float32).reshape(-1, POSE_NUMBERS)
        t_s, depth, heading = np.array([row[2:] for row in rows], np.float64).reshape(-1, 3).T
        index = np.array([row.frame for row in rows], np.int64)
        return poses, moments(t_s, depth, heading, index, kept)


# --------------------------------------------------------------------------------------------------
# The live viewer's copy of a dive, made by threads that have no time for browsers.
#
# The loop and the mapping thread put new data into queues of one; a thread of the viewer takes it
# from there, computes what a browser needs, and hands it to the server.

SEEN = "seen"
"""Name of the level that says how often a Gaussian was seen."""
OFTEN = 200.0
"""Steps of the optimiser after which a Gaussian counts as seen as often as can be."""


@dataclass(frozen=True)
class ViewerPose:
    """Where the camera is, and what it sees."""

    T_wc: Sim3
    camera: CameraModel
    picture: npt.NDArray[np.uint8]
    """[H, W, 3] RGB"""


def pack_for_browser(
    copy: MapCopy, budget: int, frame: LengthUnit | None = None, plan: CoveragePlan | None = None
) -> tuple[ViewerSplats, SeenWater | None, dict[str, Palette]]:
    """In the viewer's thread: what a browser gets, the water before it, and the palettes of what
    each Gaussian is coloured by: how often it was seen, from how far away, and, by the ``plan`` of
    its sub-map's coverage, how well."""
    plain, water, unit = (
        copy.parameters,
        _water(copy),
        frame or LengthUnit.of(WorldFrame.unknown()),
    )
    with np.errstate(over="ignore"):
        opacities = (1.0 / (1.0 + np.exp(-plain["opacity_logits"][:, 0]))).astype(np.float32)
        scales = np.exp(plain["log_scales"])
    often, palette = steps_level(copy.steps, OFTEN)
    chosen = splats(
        plain["means"], plain["quats"], scales, opacities, copy.clear, budget, {SEEN: often}
    )
    cameras = np.array([T_wc.t for T_wc in copy.views])
    ranges, range_palette = range_level(chosen.centres, cameras, unit.scale.unit, unit.metres)
    levels, palettes = chosen.levels | {RANGE: ranges}, {SEEN: palette, RANGE: range_palette}
    if plan is not None:
        levels[COVERAGE] = plan.classes_of(chosen.centres.astype(np.float64))
        palettes[COVERAGE] = CLASSES
    return replace(chosen, levels=levels), water, palettes


def _water(copy: MapCopy) -> SeenWater | None:
    """None where there is none, or none that can be shown yet."""
    if copy.water is None or not len(copy.parameters["means"]):
        return None
    away = np.linalg.norm(copy.parameters["means"] - copy.views[-1].t, axis=1)
    try:
        beta, B_inf, b, B_res, d, gain = copy.water
        tone = copy.tone
        return seen_water(
            beta, B_inf, b, B_res, d, tone.exposure * gain, float(np.median(away)),
            tone.compression, shown_compression=tone.compression, lamp=copy.lamp,
        )  # fmt: skip
    except ValueError:
        return None
