"""A running dive over Foxglove's websocket; a slow or dead client never slows the loop."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from aquaflow.config.service import FoxgloveConfig
from aquaflow.dive.metric_outputs import attitude_of
from aquaflow.dive.placement import placement
from aquaflow.dive.ros import messages, topics
from aquaflow.dive.ros.topics import MAP, OPTICAL, FrameTree
from aquaflow.dive.views import LOOK_S, DisplayThread, DiveView, RunningDive
from aquaflow.geometry.similarity import Sim3
from aquaflow.live.foxglove.map_moment import MapMoment, cloud_of, take_map_moment, water_status
from aquaflow.live.foxglove.server import FoxgloveServer
from aquaflow.live.report import GOOD
from aquaflow.mapping.work import OwnedMaps
from aquaflow.sources.newest import Newest
from aquaflow.sources.preprocessing import Preparation
from aquaflow.telemetry.world_frame import WorldFrame
from aquaflow.tracking.frames import Tracked
from aquaflow.types import Frame

LONGEST_PATH = 5000
"""Most poses of the path; a longer one is thinned, as in the viewer."""
LASTING_S = 1.0
"""Between two messages of what lasts: who comes later waits no longer for it."""
KEPT_STAMPS = 2000
"""Newest frames whose time is known when the map shows them."""
TELEMETRY = {"depth": topics.DEPTH, "altitude": topics.ALTITUDE}
"""Kinds of telemetry that have a topic of their own."""
PICTURES = (topics.RENDERED, topics.RESTORED)
WELL = frozenset(state.value for state in GOOD)
"""States that are no warning."""


@dataclass(frozen=True)
class _PosedMessage:
    """A posed frame, handed over by the loop."""

    t_ns: int
    tracked: Tracked
    picture: Frame | None
    frame: WorldFrame
    preparation: Preparation


class LiveFoxglove(DiveView):
    """Takes new data from the loop and the maps, and sends them from its own thread."""

    def __init__(self, config: FoxgloveConfig, report: Callable[[], dict[str, Any]]) -> None:
        """Raises what :class:`FoxgloveServer` raises."""
        self._config, self._report = config, report
        self._server = FoxgloveServer(config, "AquaFlow")
        self.port = self._server.port
        self._moments: Newest[_PosedMessage] = Newest()
        self._maps: Newest[MapMoment] = Newest()
        self._forget()
        self._showing = DisplayThread("foxglove", self._show, config.refresh_s)

    def _forget(self) -> None:
        self._path: list[tuple[int, int, Sim3]] = []
        self._stamps: dict[int, int] = {}
        self._preparation: Preparation | None = None
        self._pose_s = self._map_s = self._lasting_s = 0.0
        self._last = -1
        self._asked = False
        self._water: Any = None

    def show(self, dive: RunningDive) -> None:
        """A dive begins: its path is shown, and no other's."""
        self._forget()

    def update(self, dive: RunningDive) -> None:
        """Called after every turn of the loop; queues what is new, never waits."""
        now, latest = time.monotonic(), dive.latest
        if latest is None or latest.T_wc is None:
            return
        t_ns = _stamp_ns(latest.frame)
        self._stamps[latest.frame.index] = t_ns
        while len(self._stamps) > KEPT_STAMPS:
            del self._stamps[next(iter(self._stamps))]
        frame = dive.dive_run.slam.metric_frame(latest.sub_map)
        if latest.frame.index != self._last and now - self._pose_s >= 1.0 / self._config.pose_hz:
            self._pose_s, self._last = now, latest.frame.index
            self._hand_over(dive, latest, t_ns, frame)
        if now - self._map_s >= self._config.refresh_s and not self._asked:
            points = self._server.is_wanted(topics.POINTS)
            drawn = any(map(self._server.is_wanted, PICTURES))
            if points or drawn or self._server.is_wanted(topics.DIAGNOSTICS):
                self._map_s, self._asked = now, True
                sub_map = latest.sub_map
                dive.maps.inspect(
                    "show Foxglove the map",
                    lambda maps, _: self._take(maps, sub_map, frame, points, drawn),
                )

    def close(self) -> None:
        """End the thread and let the clients go."""
        self._showing.close()
        self._server.close()

    def _hand_over(self, dive: RunningDive, latest: Tracked, t_ns: int, frame: WorldFrame) -> None:
        run = dive.dive_run
        if self._preparation is None:  # of its own: the loop's prepares the next frame meanwhile
            self._preparation = Preparation(run.config.source, run.preparation.calibration)
        picture = dive.picture
        same = picture is not None and picture.index == latest.frame.index
        moment = _PosedMessage(t_ns, latest, picture if same else None, frame, self._preparation)
        self._moments.put(moment)

    def _take(
        self, maps: OwnedMaps, sub_map: int, frame: WorldFrame, points: bool, drawn: bool
    ) -> None:
        """In the mapping thread."""
        self._asked = False
        mapper = maps.mappers.get(sub_map)
        if mapper is not None and mapper.views and len(mapper.gaussians):
            self._maps.put(take_map_moment(mapper, sub_map, frame, points, drawn))

    # --- in the thread of its own -----------------------------------------------------------------

    def _show(self) -> None:
        moment = self._moments.take(LOOK_S)
        if moment is not None:
            self._show_pose(moment)
        shown = self._maps.take(0.0)
        if shown is not None:
            self._show_map(shown)

    def _show_pose(self, moment: _PosedMessage) -> None:
        tracked, frame, t_ns, send = moment.tracked, moment.frame, moment.t_ns, self._server.send
        assert tracked.T_wc is not None
        tree = FrameTree(frame, placement(frame))
        T_nc = frame.pose(tracked.T_wc)
        link = tree.moving(T_nc)
        send(topics.TF, t_ns, messages.transforms(t_ns, [link]))
        send(topics.POSE, t_ns, messages.pose(t_ns, link, None, None, None))
        send(topics.QUALITY, t_ns, messages.number(tracked.quality.inlier_share))
        heading, _, _ = attitude_of(frame, T_nc)
        if heading is not None:
            send(topics.HEADING, t_ns, messages.number(heading))
        self._show_picture(moment)
        report = self._report()
        send(topics.DIAGNOSTICS, t_ns, messages.diagnostics(t_ns, self._statuses(report, frame)))
        for kinds in report.get("telemetry", {}).values():
            for kind, topic in TELEMETRY.items():
                if kind in kinds:
                    send(topic, t_ns, messages.number(float(kinds[kind]["value"])))
        self._path.append((t_ns, tracked.sub_map, tracked.T_wc))
        if len(self._path) > LONGEST_PATH:
            self._path = self._path[::2]
        if time.monotonic() - self._lasting_s >= LASTING_S:
            self._lasting_s = time.monotonic()
            send(topics.TF_STATIC, t_ns, messages.transforms(t_ns, tree.fixed))
            self._show_path(t_ns, tracked.sub_map, frame, tree)

    def _show_path(self, t_ns: int, sub_map: int, frame: WorldFrame, tree: FrameTree) -> None:
        """All poses so far, where the dive's metric frame, which changes, has them now."""
        if self._server.is_wanted(topics.PATH):
            own = [(at_ns, T) for at_ns, number, T in self._path if number == sub_map]
            poses = [(at_ns, tree.moving(frame.pose(T)).T) for at_ns, T in own]
            self._server.send(topics.PATH, t_ns, messages.path(t_ns, MAP, poses))

    def _show_picture(self, moment: _PosedMessage) -> None:
        if moment.picture is None or not self._server.is_wanted(topics.CAMERA):
            return
        t_ns, prepared = moment.t_ns, moment.preparation(moment.picture)
        self._server.send(topics.CAMERA, t_ns, messages.jpeg(t_ns, OPTICAL, prepared.image))
        if prepared.camera is not None:
            info = messages.camera_info(t_ns, OPTICAL, prepared.camera)
            self._server.send(topics.CAMERA_INFO, t_ns, info)

    def _statuses(self, report: dict[str, Any], frame: WorldFrame) -> list[Any]:
        level = messages.OK if report["state"] in WELL else messages.WARN
        values = {"unit": frame.unit, "scale": frame.scale_source, "level": report["level"]}
        said = f"{report['state']}: {report['reason']}"
        tracking = messages.status(level, "aquaflow: tracking", said, values)
        return [tracking] if self._water is None else [tracking, self._water]

    def _show_map(self, shown: MapMoment) -> None:
        now_ns = time.time_ns()
        points = cloud_of(shown, self._config.points)
        if points is not None:
            cloud = messages.point_cloud(now_ns, MAP, points)
            self._server.send(topics.POINTS, now_ns, cloud)
        t_ns = self._stamps.get(shown.frame_index, now_ns)
        for topic, picture in zip(PICTURES, (shown.rendered, shown.restored), strict=True):
            if picture is not None:
                self._server.send(topic, t_ns, messages.jpeg(t_ns, OPTICAL, picture))
        self._water = water_status(shown.water, shown.frame)


def _stamp_ns(frame: Frame) -> int:
    """When a frame arrived, by the computer's clock: ns since 1970."""
    return time.time_ns() - (time.monotonic_ns() - frame.arrival_ns)
